"""Cholesky factorisation and solution of symmetric positive definite band matrices on the CPU by LAPACK.

One LAPACK call replaces hundreds of operations of block elimination. LAPACK takes one matrix at a time, with one thread,
because further threads would only wait for such small matrices. The functions are torch operators, so that a compiled graph can
contain them; `implicit.differentiable` gives their gradients.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

import numpy as np
import torch
from scipy.linalg.lapack import get_lapack_funcs
from threadpoolctl import ThreadpoolController
from torch import Tensor

RIDGES = (0.0, 1e-6, 1e-5, 1e-4)
"""Values that are added to the diagonal, which is about 1: tried in turn until a Cholesky factor exists, because rounding
errors may have made the matrix indefinite."""


def is_supported(matrix: Tensor) -> bool:
    """Return whether these operators can be used: on the CPU, without gradients, and not in an exported model."""
    recorded = torch.is_grad_enabled() and matrix.requires_grad
    return matrix.device.type == "cpu" and not recorded and not torch.compiler.is_exporting()


def factor(runs: Sequence[Tensor], starts: Sequence[int]) -> Tensor:
    """Return the Cholesky factors of band matrices; NaN for a matrix that is not positive definite.

    Args:
        runs: runs of adjacent diagonals, `[B, n, K]` each, with the entries of every row from left to right. All other entries
            of the matrix are zero.
        starts: offset of each run's first diagonal from the main diagonal, to the right; 0 for the first run.

    Returns:
        `[B, n, k + 1]`: row `i` holds column `i` of the factor `L` of `L L^T`, from the diagonal down.

    Example:
        >>> factor([torch.tensor([[[4.0, 2.0], [5.0, 0.0]]])], [0])
        tensor([[[2., 1.],
                 [2., 0.]]])
    """
    factors: Tensor = torch.ops.torchmembrane.band_factor(runs, starts)
    return factors


def solve(factors: Tensor, b: Tensor) -> Tensor:
    """Return the solutions for the right-hand sides in the rows of `b [B, C, n]`, from the result of `factor`.

    Example:
        >>> solve(factor([torch.tensor([[[4.0, 2.0], [5.0, 0.0]]])], [0]), torch.tensor([[[6.0, 7.0]]]))
        tensor([[[1., 1.]]])
    """
    solved: Tensor = torch.ops.torchmembrane.band_solve(factors, b)
    return solved


# The operators are defined one by one, because `torch.library.custom_op` loads torch's compiler at the first call: one second.
torch.library.define("torchmembrane::band_factor", "(Tensor[] runs, SymInt[] starts) -> Tensor")
torch.library.define("torchmembrane::band_solve", "(Tensor factors, Tensor b) -> Tensor")


@torch.library.impl("torchmembrane::band_factor", "CPU")
def _factor(runs: Sequence[Tensor], starts: Sequence[int]) -> Tensor:
    pbtrf = _lapack("pbtrf", runs[0].dtype)
    matrices = [run.numpy() for run in runs]
    factors = runs[0].new_empty(*runs[0].shape[:2], starts[-1] + runs[-1].shape[-1])
    with _one_thread():
        for frame, kept in enumerate(factors.numpy()):
            for ridge in RIDGES:
                kept[:] = 0
                for matrix, start in zip(matrices, starts, strict=True):
                    kept[:, start : start + matrix.shape[-1]] = matrix[frame]
                kept[:, 0] += ridge
                if pbtrf(kept.T, lower=1, overwrite_ab=1)[1] == 0:
                    break
            else:
                kept[:] = np.nan
    return factors


@torch.library.register_fake("torchmembrane::band_factor")
def _(runs: Sequence[Tensor], starts: Sequence[int]) -> Tensor:
    return runs[0].new_empty(*runs[0].shape[:2], starts[-1] + runs[-1].shape[-1])


@torch.library.impl("torchmembrane::band_solve", "CPU")
def _solve(factors: Tensor, b: Tensor) -> Tensor:
    pbtrs = _lapack("pbtrs", b.dtype)
    solved = b.clone(memory_format=torch.contiguous_format)
    with _one_thread():
        for kept, x in zip(factors.numpy(), solved.numpy(), strict=True):
            pbtrs(kept.T, x.T, lower=1, overwrite_b=1)
    return solved


@torch.library.register_fake("torchmembrane::band_solve")
def _(factors: Tensor, b: Tensor) -> Tensor:
    return torch.empty_like(b, memory_format=torch.contiguous_format)


@torch.library.register_vmap("torchmembrane::band_solve")
def _(info: Any, dims: tuple[int | None, int | None], factors: Tensor, b: Tensor) -> tuple[Tensor, int]:
    each = [
        part.expand(info.batch_size, *part.shape) if dim is None else part.movedim(dim, 0)
        for part, dim in zip((factors, b), dims, strict=True)
    ]
    return solve(*(part.flatten(0, 1) for part in each)).unflatten(0, (info.batch_size, -1)), 0


_alone = Lock()
"""Held while BLAS is limited to one thread. If two threads set the limit at once, the second would take 1 for the old value."""
_libraries = cache(lambda: ThreadpoolController().select(user_api="blas"))


@contextmanager
def _one_thread() -> Iterator[None]:
    with _alone, _libraries().limit(limits=1):
        yield


@cache
def _lapack(name: str, dtype: torch.dtype) -> Any:
    """Return LAPACK's function of this name for a precision."""
    return get_lapack_funcs(name, dtype=torch.empty(0, dtype=dtype, device="cpu").numpy().dtype)
