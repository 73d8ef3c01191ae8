"""Band factorisation equals the dense one, in batches and graphs."""

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torchmembrane.solve import band

STARTS, WIDTHS, SIZE = [0, 5, 11], [3, 2, 4], 30


def runs(batch=2, dtype=torch.float64):
    """Diagonals 0 to 2, 5 and 6, 11 to 14, dominated by the first; what leads out of the matrix is there too."""
    generator = torch.Generator().manual_seed(0)
    found = [torch.rand(batch, SIZE, width, generator=generator, dtype=torch.float64) - 0.5 for width in WIDTHS]
    found[0][..., 0] += 6.0
    return [run.to(dtype) for run in found]


def dense(found):
    matrix = torch.zeros(len(found[0]), SIZE, SIZE, dtype=found[0].dtype)
    for run, start in zip(found, STARTS, strict=True):
        for k in range(run.shape[-1]):
            i = torch.arange(SIZE - start - k)
            matrix[:, i, i + start + k] = matrix[:, i + start + k, i] = run[:, : len(i), k]
    return matrix


def loads(batch=2, count=3):
    return torch.randn(batch, count, SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_solutions_are_those_of_the_dense_matrix(dtype):
    found = runs(dtype=dtype)
    x = band.solve(band.factor(found, STARTS), loads().to(dtype))
    torch.testing.assert_close(x @ dense(found), loads().to(dtype))


def test_factors_are_those_of_the_dense_matrix():
    factor, exact = band.factor(runs(), STARTS), torch.linalg.cholesky(dense(runs()))
    for k in range(factor.shape[-1]):
        torch.testing.assert_close(factor[:, : SIZE - k, k], exact.diagonal(-k, 1, 2))


def test_a_matrix_that_rounding_left_without_a_factor_gets_a_ridge_and_others_none():
    """An eigenvalue of -4e-6 in the second frame."""
    found = runs()
    matrix = dense(found)[1]
    found[0][1, :, 0] -= torch.linalg.eigvalsh(matrix)[0] + 4e-6
    factor = band.factor(found, STARTS)
    torch.testing.assert_close(factor[0], band.factor([run[:1] for run in found], STARTS)[0], rtol=0, atol=0)
    found[0][1, :, 0] += 1e-5
    torch.testing.assert_close(factor, band.factor(found, STARTS), rtol=0, atol=0)


@pytest.mark.parametrize("spoil", [-20.0, torch.nan])
def test_a_matrix_that_is_not_positive_has_no_solution_and_the_others_keep_theirs(spoil):
    found = runs()
    found[0][1, SIZE // 2, 0] = spoil
    x = band.solve(band.factor(found, STARTS), loads())
    assert x[1].isnan().all()
    torch.testing.assert_close(x[:1] @ dense(found)[:1], loads()[:1])


@pytest.mark.parametrize("dims", [(None, 0), (None, 2), (0, 0), (0, None)])
def test_solutions_vmapped_are_those_one_by_one(dims):
    factors, b = band.factor(runs(4), STARTS).unflatten(0, (2, 2)), loads(4).unflatten(0, (2, 2))
    factors, b = (one[0] if dim is None else one.movedim(0, dim) for one, dim in zip((factors, b), dims, strict=True))
    found = torch.func.vmap(band.solve, dims)(factors, b)
    for k, x in enumerate(found):
        each = (one if dim is None else one.select(dim, k) for one, dim in zip((factors, b), dims, strict=True))
        torch.testing.assert_close(x, band.solve(*each))


def test_others_keep_their_threads():
    def threads():
        return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        before, within, pbtrf = threads(), [], band._lapack
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                band, "_lapack", lambda *of: lambda *given, **how: within.append(threads()) or pbtrf(*of)(*given, **how)
            )
            band.factor(runs(), STARTS)
        assert within and set(within[0].values()) == {1} and set(before.values()) == {2}
        assert threads() == before


def test_operators_are_what_torch_expects_of_them():
    """That nothing given is changed or returned, and shapes are right on the meta device."""
    found = runs()
    torch.library.opcheck(torch.ops.torchmembrane.band_factor.default, (found, STARTS))
    torch.library.opcheck(torch.ops.torchmembrane.band_solve.default, (band.factor(found, STARTS), loads()))


def test_gradients_and_other_devices_are_left_to_others():
    matrix = runs()[0]
    assert band.is_supported(matrix)
    assert not band.is_supported(matrix.to("meta")) and not band.is_supported(matrix.clone().requires_grad_())
    with torch.no_grad():
        assert band.is_supported(matrix.clone().requires_grad_())
