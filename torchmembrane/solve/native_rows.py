"""Products of a vector with a matrix of averages, as machine code: most rows of the matrix begin and end with zeros."""

import numpy as np

from ..machine_code import compiled


def within(rows: np.ndarray) -> np.ndarray:
    """Where the rows begin and end to be more than zero, `[N, 2]`.

    Example:
        >>> within(np.array([[0.0, 2.0, 3.0, 0.0]])).tolist()
        [[1, 3]]
    """
    there = rows != 0
    return np.stack([there.argmax(1), rows.shape[1] - there[:, ::-1].argmax(1)], 1)


@compiled
def sum_rows(total, rows, places, shares):
    """Compute `total = shares @ rows`, four rows at a time, for the rows with a non-zero share; `places [N, 2]` is from
    `within`."""
    chosen, own, count = np.zeros(4, np.intp), np.zeros(4, total.dtype), 0
    total[:] = 0
    for i in range(len(rows)):
        if shares[i] != 0:
            chosen[count], own[count] = i, shares[i]
            count += 1
        if count == 4 or (count > 0 and i == len(rows) - 1):
            chosen[count:], own[count:] = chosen[0], 0
            first, end = len(total), 0
            for k in chosen:
                first, end = min(first, places[k, 0]), max(end, places[k, 1])
            part, a, b, c, d = total[first:end], chosen[0], chosen[1], chosen[2], chosen[3]
            row_a, row_b, row_c, row_d = rows[a, first:end], rows[b, first:end], rows[c, first:end], rows[d, first:end]
            of_a, of_b, of_c, of_d = own[0], own[1], own[2], own[3]
            for k in range(len(part)):
                part[k] += of_a * row_a[k] + of_b * row_b[k] + of_c * row_c[k] + of_d * row_d[k]
            count = 0
