"""Preconditioned conjugate gradients with a fixed number of steps, batched over frames and right-hand sides."""

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradient(
    apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], b: Tensor, steps: int
) -> Tensor:
    """Solve `A x = b` for symmetric positive definite `A`, each row of `b` by itself.

    Arguments: `apply` and `precondition` map `[..., N]` to `[..., N]` (`A` and an approximate inverse, both symmetric
    positive definite); `b [..., N]`; `steps` is fixed, so that the graph is static. Returns `x [..., N]`.
    Steps after convergence change nothing (a zero residual gives a zero step). Hestenes and Stiefel 1952.
    """
    tiny = torch.finfo(b.dtype).tiny
    ratio = lambda p, q: p / q.clamp_min(tiny)  # noqa: E731
    dot = lambda p, q: (p * q).sum(-1, keepdim=True)  # noqa: E731
    x, residual = 0, b
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
