"""Closed-form solutions of many symmetric 2 x 2 systems: metrics of triangles, Newton steps in the image plane, borders.

The functions use plain arithmetic, so they accept numbers, numpy arrays and torch tensors, and compile to machine code. A
symmetric matrix `[[a, b], [b, c]]` is given by its three entries.
"""

from typing import Any


def symmetric_adjugate_product(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """Return the product `adj [[a, b], [b, c]] (u, v)`: the solution of the system times its determinant.

    Args:
        a: entry 11; a number, array or tensor `[...]` like all other arguments.
        b: entries 12 and 21.
        c: entry 22.
        u: first component of the right-hand side.
        v: its second component.

    Returns:
        Both components, `[...]`. Divide them by `symmetric_determinant`, bounded from below where it may vanish.

    Example:
        >>> symmetric_adjugate_product(2.0, 1.0, 3.0, 4.0, 7.0)
        (5.0, 10.0)
    """
    return c * u - b * v, a * v - b * u


def symmetric_determinant(a: Any, b: Any, c: Any) -> Any:
    """Return the determinant `a c - b^2` of symmetric matrices.

    Args:
        a: entry 11; a number, array or tensor `[...]` like the other arguments.
        b: entries 12 and 21.
        c: entry 22.

    Returns:
        The determinants, `[...]`.

    Example:
        >>> symmetric_determinant(2.0, 1.0, 3.0)
        5.0
    """
    return a * c - b * b


def symmetric_solution(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """Solve the system `[[a, b], [b, c]] x = (u, v)`.

    Args:
        a: entry 11; a number, array or tensor `[...]` like all other arguments.
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
