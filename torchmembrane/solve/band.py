"""Symmetric positive definite band matrices on a processor, by LAPACK: one call for what block elimination does in hundreds.

LAPACK takes one matrix at a time, with one thread, because for such small matrices further threads would only wait. The
functions are operators of torch, so that a compiled graph may contain them; gradients are those of the solution, see
`implicit.differentiable`.
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
"""Added, one instead of the other, to a diagonal about 1 of a matrix that rounding has left without a factor."""


def is_supported(matrix: Tensor) -> bool:
    """Whether these operators can be used: on a processor, without gradients, and not in an exported model."""
    recorded = torch.is_grad_enabled() and matrix.requires_grad
    return matrix.device.type == "cpu" and not recorded and not torch.compiler.is_exporting()


def factor(runs: Sequence[Tensor], starts: Sequence[int]) -> Tensor:
    """Cholesky factors of matrices; NaN for a matrix that is not positive definite.

    Args:
        runs: runs of neighbouring diagonals, `[B, n, K]` each, with the entries of every row from left to right. All other
            entries are zero.
        starts: how far the first diagonal of each run is to the right of the main one; 0 for the first run.

    Returns:
        `[B, n, k + 1]`: with `L L^T` the matrix, row by row the columns of `L` from the diagonal on.

    Example:
        >>> factor([torch.tensor([[[4.0, 2.0], [5.0, 0.0]]])], [0])
        tensor([[[2., 1.],
                 [2., 0.]]])
    """
    factors: Tensor = torch.ops.torchmembrane.band_factor(runs, starts)
    return factors


def solve(factors: Tensor, b: Tensor) -> Tensor:
    """Solutions for the rows of `b [B, C, n]`, from what `factor` gives.

    Example:
        >>> solve(factor([torch.tensor([[[4.0, 2.0], [5.0, 0.0]]])], [0]), torch.tensor([[[6.0, 7.0]]]))
        tensor([[[1., 1.]]])
    """
    solved: Tensor = torch.ops.torchmembrane.band_solve(factors, b)
    return solved


# Defined one by one: `torch.library.custom_op` loads torch's compiler, which takes a second, at the first call.
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
"""Held while there is one thread: of two that set it at once the later would take 1 for what was."""
_libraries = cache(lambda: ThreadpoolController().select(user_api="blas"))


@contextmanager
def _one_thread() -> Iterator[None]:
    with _alone, _libraries().limit(limits=1):
        yield


@cache
def _lapack(name: str, dtype: torch.dtype) -> Any:
    """LAPACK's function for a precision."""
    return get_lapack_funcs(name, dtype=torch.empty(0, dtype=dtype).numpy().dtype)
