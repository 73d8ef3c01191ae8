"""Implicit differentiation: gradients of solutions without differentiating the solver.

A x = b, symmetric   dx = A^-1 (db - dA x)              `differentiable`
x = T(x)             dx = (1 - dT/dx)^-1 dT             `differentiable_fixed_point`, where dT is the change of T at fixed x
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import MembraneError
from ..torch_modes import without_autocast
from .anderson import accelerated, first

Linear = Callable[[Tensor], Tensor]
ADJOINT_STEPS = 24
"""Largest number of products with the transpose of `dT/dx` in the gradient of a fixed point."""
ADJOINT_TOL_POWER = 0.6
"""The gradient is exact enough when its residual is below this power of the rounding error: 7e-5 in float32."""
UNROLLED_STEPS = 8
"""Number of steps whose gradient a compiled graph takes instead, which cannot differentiate within its backward pass."""


def refined(solve: Linear, apply: Linear, b: Tensor) -> Tensor:
    """Return `x = solve(b)` after one step of iterative refinement, which solves again for the residual `b - A x`.

    In single precision `solve` loses as many digits as the condition of `A` has. The step wins back most of them if `apply`
    computes the residual more exactly than from the entries of `A`, for example from the factors of `A = B^T B`.

    Reference: Higham 2002, Accuracy and stability of numerical algorithms, chapter 12.

    Args:
        solve: function that applies an approximation of `A^-1`.
        apply: function that multiplies by `A`, from `[..., N]` to `[..., N]`.
        b: right-hand sides, `[..., N]`.

    Example:
        >>> round(refined(lambda r: 0.49 * r, lambda x: 2 * x, torch.tensor(1.0)).item(), 4)  # 1 / 2
        0.4998
    """
    x = solve(b)
    return x + solve(b - apply(x))


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


def differentiable_fixed_point(step: Linear, x: Tensor) -> Tensor:
    """Return `x = step(x)` with the gradients of the exact fixed point.

    Backpropagation solves `y = g + (d step / dx)^T y` for the gradient `g` of `x`, by Anderson's method, and passes `y` through
    one step to everything that the step depends on. A compiled graph takes the gradient of `UNROLLED_STEPS` steps instead,
    which is the same where so many steps converge.

    Args:
        step: a step of the fixed-point iteration, `[B, N]` to `[B, N]`, row by row.
        x: the fixed point, `[B, N]`; what it was computed from is not differentiated.

    Limitations:
        As for `differentiable`. They are the gradients of the fixed point as far as `x` has converged to it.

    Reference: Bai, Kolter and Koltun 2019, Deep equilibrium models.

    Example:
        >>> a = torch.tensor(0.5, requires_grad=True)
        >>> differentiable_fixed_point(lambda x: a * x + 1, torch.tensor([[2.0]])).sum().backward()
        >>> round(a.grad.item(), 4)  # of 1 / (1 - a)
        4.0
    """
    x = x.detach()
    if torch.compiler.is_compiling():
        after = x
        for _ in range(UNROLLED_STEPS):
            after = step(after)
        return x + (after - after.detach())

    def adjoint(gradient: Tensor) -> Tensor:
        with torch.enable_grad():
            _, transposed = torch.func.vjp(step, x)
            y, *history = first(gradient, transposed(gradient)[0])
            for _ in range(ADJOINT_STEPS - 1):
                move = gradient + transposed(y)[0] - y
                if _is_short(move, gradient):
                    break
                y, *history = accelerated(y, move, *history)
        return y.detach()

    fixed: Tensor = _Solution.apply(step(x), x, adjoint)
    return fixed


def _is_short(move: Tensor, gradient: Tensor) -> bool:
    """Return whether all moves are short compared with the gradients, `[B, N]` each; False where `vmap` hides the values."""
    if torch.func.debug_unwrap(move, recurse=False) is not move:
        return False
    tolerance = torch.finfo(move.dtype).eps ** ADJOINT_TOL_POWER
    return not bool((move.norm(dim=-1) > tolerance * gradient.norm(dim=-1)).any())


class _Solution(torch.autograd.Function):
    """Identity function of `x` whose gradient `g` passes `solve(g)` to `residual`.

    For a linear system `residual` is `b - A x`, and `solve` applies `A^-1`. For a fixed point `residual` is `step(x)`, and
    `solve` solves the adjoint system.
    """

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
        with torch.no_grad(), without_autocast(gradient.device.type):
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
