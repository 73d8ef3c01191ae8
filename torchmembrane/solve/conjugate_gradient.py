"""Preconditioned conjugate gradient method with a fixed number of steps, batched over frames and right-hand sides."""

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradient(
    apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], b: Tensor, steps: int
) -> Tensor:
    """Solve `A x = b` for symmetric positive definite `A`, independently for each row of `b`.

    Steps after convergence change nothing (a zero residual gives a zero step).

    Args:
        apply: function that multiplies by `A`, from `[..., N]` to `[..., N]`.
        precondition: function that applies an approximate inverse of `A`, which must be symmetric positive definite too.
        b: right-hand sides, `[..., N]`.
        steps: number of steps; fixed, so that the graph is static.

    Returns:
        `x [..., N]`.

    Reference: Hestenes and Stiefel 1952, Methods of conjugate gradients for solving linear systems.

    Example:
        >>> A, b = torch.tensor([[2.0, 1.0], [1.0, 3.0]]), torch.tensor([3.0, 4.0])
        >>> conjugate_gradient(lambda y: y @ A, lambda r: r, b, 2)
        tensor([1.0000, 1.0000])
    """
    tiny = torch.finfo(b.dtype).tiny

    def ratio(p: Tensor, q: Tensor) -> Tensor:
        return p / q.clamp_min(tiny)

    def dot(p: Tensor, q: Tensor) -> Tensor:
        return (p * q).sum(-1, keepdim=True)

    x, residual = torch.zeros_like(b), b
    z = precondition(residual)
    direction, rho = z, dot(residual, z)
    for _ in range(steps):
        image = apply(direction)
        alpha = ratio(rho, dot(direction, image))
        x, residual = x + alpha * direction, residual - alpha * image
        z = precondition(residual)
        rho, previous = dot(residual, z), rho
        direction = z + ratio(rho, previous) * direction
    return x
