"""Closed forms for symmetric 2 x 2 systems, for many at once: metrics of triangles, Newton steps in the image plane, borders.

Plain arithmetic, so numbers, arrays of numpy, tensors of torch and machine code alike; a symmetric matrix `[[a, b], [b, c]]` is
its three entries.
"""

from typing import Any


def symmetric_adjugate_product(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """The product `adj [[a, b], [b, c]] (u, v)`: the solution of the system times its determinant.

    Args:
        a: entry 11, an array or tensor `[...]` as all the others.
        b: entries 12 and 21.
        c: entry 22.
        u: first component of the right-hand side.
        v: its second component.

    Returns:
        Both components, `[...]`: divide them by `symmetric_determinant`, bounded from below where it may vanish.

    Example:
        >>> symmetric_adjugate_product(2.0, 1.0, 3.0, 4.0, 7.0)
        (5.0, 10.0)
    """
    return c * u - b * v, a * v - b * u


def symmetric_determinant(a: Any, b: Any, c: Any) -> Any:
    """The determinant `a c - b^2` of symmetric matrices.

    Args:
        a: entry 11, an array or tensor `[...]` as the others.
        b: entries 12 and 21.
        c: entry 22.

    Returns:
        `[...]`.

    Example:
        >>> symmetric_determinant(2.0, 1.0, 3.0)
        5.0
    """
    return a * c - b * b


def symmetric_solution(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """The solution of the system `[[a, b], [b, c]] x = (u, v)`.

    Args:
        a: entry 11, a number, array or tensor `[...]` as all the others.
        b: entries 12 and 21.
        c: entry 22.
        u: first component of the right-hand side.
        v: its second component.

    Returns:
        Both components of `x`, `[...]`.

    Example:
        >>> symmetric_solution(2.0, 1.0, 3.0, 4.0, 7.0)
        (1.0, 2.0)
    """
    det = a * c - b * b
    return (c * u - b * v) / det, (a * v - b * u) / det
