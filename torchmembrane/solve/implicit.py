"""Implicit differentiation of solutions of symmetric systems: `dx = A^-1 (db - dA x)`, without differentiating the solver."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import MembraneError

Linear = Callable[[Tensor], Tensor]


def differentiable(solve: Linear, apply: Linear, b: Tensor) -> Tensor:
    """Return `x = solve(b)` with the gradients of the exact solution of `A x = b`.

    Backpropagation applies `solve` once more (`A` is symmetric) to the gradient of `x` and passes the result through the
    residual `b - A x` to `b` and to everything that `A` depends on.

    Args:
        solve: function that applies `A^-1`; it is not differentiated.
        apply: function that multiplies by `A`, from `[..., N]` to `[..., N]`; it is differentiated.
        b: right-hand sides, `[..., N]`.

    Limitations:
        Only first derivatives in reverse mode are available: second ones raise a `MembraneError`. They are as exact as `solve`.

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
    """Identity function of `x` whose gradients are those of `A^-1 residual`."""

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
    """Identity function of a gradient that raises an error if it is differentiated again."""

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
            "second derivatives of a reconstruction: its solves can only be differentiated once; expected first ones: leave "
            "out create_graph, or take finite differences of the gradient"
        )
