"""Solutions of symmetric systems, `dx = A^-1 (db - dA x)`, whose gradients do not differentiate the steps of the solver."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import MembraneError

Linear = Callable[[Tensor], Tensor]


def differentiable(solve: Linear, apply: Linear, b: Tensor) -> Tensor:
    """`x = solve(b)` with the gradients of the exact solution of `A x = b`.

    The gradient of `x` passes through one more `solve` (`A` is symmetric) to the residual `b - A x`, and from there to `b` and
    to whatever `A` depends on.

    Args:
        solve: `A^-1`, itself without gradients.
        apply: `A`, from `[..., N]` to `[..., N]`, with gradients.
        b: `[..., N]`.

    Limitations:
        First derivatives only: second ones raise a `MembraneError`, and there is no forward mode. They are as exact as `solve`.

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
    """The identity on `x`, with the gradients of `A^-1 residual`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(residual: Tensor, x: Tensor, solve: Linear) -> Tensor:
        return x.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Linear], output: Tensor) -> None:
        residual, _, ctx.solve = inputs
        ctx.save_for_backward(residual)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (residual,) = ctx.saved_tensors
        with torch.no_grad():
            solved = ctx.solve(gradient)
        return _Once.apply(solved, gradient, residual), None, None


class _Once(torch.autograd.Function):
    """The identity on a gradient that refuses to be differentiated again."""

    generate_vmap_rule = True

    @staticmethod
    def forward(solved: Tensor, gradient: Tensor, residual: Tensor) -> Tensor:
        return solved.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        raise MembraneError(
            "second derivatives of a reconstruction: its solves are differentiated once; expected first ones: leave out "
            "create_graph, or take finite differences of the gradient"
        )
