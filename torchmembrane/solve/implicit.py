"""Solutions of symmetric systems whose gradients take the solver, not its steps: `dx = A^-1 (db - dA x)`."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Linear = Callable[[Tensor], Tensor]


def differentiable(solve: Linear, apply: Linear, b: Tensor) -> Tensor:
    """`x = solve(b)` with the gradients of the exact solution of `A x = b`.

    Those of `x` go through one more `solve`, `A` being symmetric, to the residual `b - A x`, and from there to `b` and to what
    `A` is made of.

    Args:
        solve: `A^-1`, itself without gradients.
        apply: `A`, from `[..., N]` to `[..., N]`, with gradients.
        b: `[..., N]`.

    Limitations:
        Once: no second derivatives. As exact as `solve` is.

    Example:
        >>> a, b = torch.tensor(2.0, requires_grad=True), torch.tensor([3.0])
        >>> differentiable(lambda r: r / 2, lambda x: a * x, b).sum().backward()
        >>> a.grad  # of b / a
        tensor(-0.7500)
    """
    if not torch.is_grad_enabled():
        return solve(b)
    with torch.no_grad():
        x = solve(b)
    solution: Tensor = _Solution.apply(b - apply(x), x, solve)
    return solution


class _Solution(torch.autograd.Function):
    """`x`, its gradients those of `A^-1 residual`."""

    @staticmethod
    def forward(ctx: Any, residual: Tensor, x: Tensor, solve: Linear) -> Tensor:
        ctx.solve = solve
        return x.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.solve(gradient), None, None
