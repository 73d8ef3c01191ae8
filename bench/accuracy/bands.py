"""Errors by how hard the membrane is pressed: the share of a stroke's largest force."""

import numpy as np

BANDS = (0, 0.02, 0.05, 0.15, 0.5, 1.01)


def by_force(rows: list[dict]) -> list[dict]:
    """Median and 90 % quantile of the errors of every band, and the share of contacts found; printed.

    Args:
        rows: frames with `sensor` (a stroke), `true_force`, the errors `force` and `surface` over the truth, NaN where there is
            no surface, and whether the contact is `found`.
    """
    top = {name: max(r["true_force"] for r in rows if r["sensor"] == name) for name in {r["sensor"] for r in rows}}
    table = []
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        chosen = [row for row in rows if low < row["true_force"] / top[row["sensor"]] <= high]
        if chosen:
            force, surface = (np.nan_to_num([row[key] for row in chosen], nan=9.0) for key in ("force", "surface"))
            (f, F), (s, S) = (np.percentile(values, (50, 90)) for values in (force, surface))
            found = float(np.mean([row["found"] for row in chosen]))
            table.append(dict(low=low, high=high, frames=len(chosen), force=(f, F), surface=(s, S), found=found))
            print(
                f"force {low:.2f} to {high:.2f}: {len(chosen):3d} frames, force {f:.3f} / {F:.3f}, surface {s:.3f} / {S:.3f}, "
                f"found {found:.2f}"
            )
    return table
