"""Inverse roots of symmetric positive definite matrices, batched: `R` with `R^T R = A^-1`.

The Schur complement of an elimination, computed as `C - B^T A^-1 B = C - (R B)^T R B`, stays positive definite where the
rounding error of `A^-1` itself would make it indefinite: in float32 from condition numbers of about 1e5, which a contact on a
nearly unstretched sheet has.

A matrix is split recursively into 2 x 2 blocks down to `LEAF` rows, so that most of the work is matrix products. The root of a
leaf is the inverse of its Cholesky factor. In ONNX, which has no Cholesky factorisation, the matrix is split to `ITERATED_LEAF`
rows, and the root of a leaf is found by products as well: `R <- (a + b M + c M^2) R` with `M = R A R^T`, starting from `R = I`.
A step maps every eigenvalue `x^2` of `M` to `p(x)^2` with `p(x) = a x + b x^3 + c x^5`, the odd quintic that is closest to 1
between the smallest `x` that the condition number allows and the largest. No other composition of such polynomials is closer to
1 (Amsel, Persson, Musco and Gower 2025, The Polar Express). Because each step starts from `A` itself, it corrects the rounding
errors of the steps before.

Such a root is too small in the directions of eigenvalues far below the largest one divided by `LARGEST_CONDITION`. A negative
eigenvalue, caused by rounding, grows in the last steps and may diverge if its magnitude reaches this limit. In that case the
root is that of an upper bound of the eigenvalues of `A` (Gershgorin), as if a positive matrix had been added to this leaf; the
solution is still a descent direction.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..control_flow import can_sync, onnx_function

LEAF = 140  # rows; splitting a smaller matrix saves no time
ITERATED_LEAF = 48  # rows, in exported models
LANES = 16  # numbers per vector register: onnxruntime takes 1.5 times as long for products of 47 x 47 as for 48 x 48
RIDGE = 1e-5  # relative to a leaf's largest eigenvalue, added if it has no Cholesky factor; covers float32's rounding errors
LARGEST_CONDITION = {torch.float32: 1.2e5, torch.float64: 1e10}  # of a leaf
LARGEST_NORM = 10.0  # of R, relative to the square root of the largest condition; a larger norm means divergence
EXCHANGES = 30  # of the extrema (Remez), to find one polynomial
NARROW = 0.02  # length of an interval about 1 below which the quintic that is flat at 1 is used


def inverse_root(matrix: Tensor) -> Tensor:
    """Return the inverse root `R` of a symmetric positive definite `matrix [..., n, n]`.

    Example:
        >>> R = inverse_root(torch.tensor([[2.0, 1.0], [1.0, 1.0]]))
        >>> (R.mT @ R).round(decimals=4)
        tensor([[ 1., -1.],
                [-1.,  2.]])
    """
    return by_products(matrix) if torch.compiler.is_exporting() else by_cholesky(matrix)


def by_cholesky(matrix: Tensor) -> Tensor:
    """Return the inverse of the Cholesky factor. If rounding has made a leaf indefinite, `RIDGE` is added to its diagonal."""
    if matrix.shape[-1] > LEAF:
        return _by_parts(matrix, by_cholesky, LEAF)
    factor, info = torch.linalg.cholesky_ex(matrix)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    if not (info.is_cpu and can_sync(info)) or any(info.flatten().tolist()):  # else waiting costs more than factoring again
        ridge = torch.where(info > 0, RIDGE * matrix.abs().sum(-1).amax(-1), 0.0)
        factor = torch.linalg.cholesky_ex(matrix + ridge[..., None, None] * one).L
    return torch.linalg.solve_triangular(factor, one.expand_as(matrix), upper=False)


@onnx_function
def by_products(matrix: Tensor) -> Tensor:
    """Return the inverse root, computed by matrix products.

    It is too small in the directions of eigenvalues below the largest one of a leaf divided by `LARGEST_CONDITION`.
    """
    if matrix.shape[-1] > ITERATED_LEAF:
        return _by_parts(matrix, by_products, ITERATED_LEAF)
    condition = LARGEST_CONDITION[matrix.dtype]
    steps = Steps.to(condition, 10 * torch.finfo(matrix.dtype).eps)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    largest = matrix.abs().sum(-1, keepdim=True).amax(-2, keepdim=True)
    A = matrix * (steps.first / largest)
    M = A - steps.shifts[0] * one
    R = M @ M + steps.offsets[0] * one
    for shift, offset in zip(steps.shifts[1:], steps.offsets[1:], strict=True):
        M = R @ A @ R.mT - shift * one
        R = (M @ M + offset * one) @ R
    is_root = torch.linalg.vector_norm(R, dim=(-2, -1), keepdim=True) < LARGEST_NORM * condition**0.5
    return torch.where(is_root, R, one / steps.last) * (steps.last * largest.rsqrt())


def _by_parts(matrix: Tensor, inverse_root: Callable[[Tensor], Tensor], leaf: int) -> Tensor:
    """Return the inverse root, computed from those of the upper left block and of its Schur complement, each with about half of
    the rows. The split gives as few leaves as possible, with multiples of `LANES` rows where possible."""
    n = matrix.shape[-1]
    leaves = -(-n // leaf)
    cut = min(-(-(leaves // 2) * n // leaves // LANES) * LANES, leaves // 2 * leaf)
    sizes = [cut, n - cut]
    upper, lower = matrix.split(sizes, -2)
    (A, B), (_, C) = upper.split(sizes, -1), lower.split(sizes, -1)
    root = inverse_root(A)
    coupling = root @ B
    further = inverse_root(C - coupling.mT @ coupling)
    first = F.pad(root, (0, B.shape[-1]))
    return torch.cat([first, torch.cat([-(further @ coupling.mT) @ root, further], -1)], -2)


class Steps(NamedTuple):
    """Steps `R <- T R` without products with scalars: `T = (R A R^T - shift)^2 + offset`; `A` and `R` absorb scale factors.

    A step computes `R / r` and `t T` in place of `R` and `T`, where `c t r^4 = 1` with the coefficient `c` of `M^2`; the next
    step has `r / t` in place of `r`.
    """

    first: float
    shifts: list[float]
    offsets: list[float]
    last: float

    @classmethod
    def to(cls, condition: float, rounding: float) -> "Steps":
        """Return the steps for matrices with a condition number up to `condition`, after which the square roots of all
        eigenvalues of `M` are 1 up to `rounding`."""
        steps = quintics(condition**-0.5, rounding)
        t = [1.0]
        for (_, _, c), (_, _, following) in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
            t.insert(0, (t[0] * following / c) ** 0.2)
        scales = [(c * each) ** 0.5 for (_, _, c), each in zip(steps, t, strict=True)]
        shifts = [-b / (2 * c) * scale for (_, b, c), scale in zip(steps, scales, strict=True)]
        offsets = [a * each - shift**2 for (a, _, _), each, shift in zip(steps, t, shifts, strict=True)]
        return cls(scales[0], shifts, offsets, 1 / math.prod(t))


def quintics(low: float, rounding: float) -> list[tuple[float, float, float]]:
    """Return the coefficients `a, b, c` of odd polynomials `a x + b x^3 + c x^5` whose composition maps all numbers from `low`
    to 1 to 1, up to `rounding`."""
    found, high, error = [], 1.0, 1.0
    while error > rounding:
        a, b, c, error = _nearest_to_one(low, high)
        found.append((a, b, c))
        low, high = 1 - error, 1 + error
    return found


def _nearest_to_one(low: float, high: float) -> tuple[float, float, float, float]:
    """Return the coefficients `a, b, c` and the largest error of the odd quintic that is closest to 1 from `low` to `high`.

    The errors at both ends and at the two extrema between them are equal, with alternating signs (Remez). If the interval is
    shorter than `NARROW`, it is the quintic whose first and second derivatives vanish at 1.
    """
    if high - low < NARROW:
        return 15 / 8, -10 / 8, 3 / 8, 2.5 * (high - 1) ** 3
    least, most = low + (high - low) / 4, high - (high - low) / 4
    for _ in range(EXCHANGES):
        x = np.array([low, least, most, high])
        a, b, c, error = np.linalg.solve(np.stack([x, x**3, x**5, [1, -1, 1, -1]], 1), np.ones(4))
        least, most = np.sqrt(np.sort(np.roots([5 * c, 3 * b, a])).clip(low**2, high**2))
    return float(a), float(b), float(c), float(error)
