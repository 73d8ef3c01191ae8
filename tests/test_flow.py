"""Laws of the local affine maps and of the flow between markers."""

from pathlib import Path

import numpy as np
import pytest
import torch
from affine_maps import LocalAffineMaps, affine_fit, weighted_affine_fit

from torchmembrane import MembraneError
from torchmembrane.estimators.minimum_energy.flow import FlowInterpolation, roughness, weights
from torchmembrane.estimators.paper.bilinear import BilinearFlow, bilinear_matrix
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.surface.projection import SurfacePoints
from torchmembrane.surface.shapes import heightfield, spherical_cap

EXAMPLES = Path(__file__).parents[1] / "examples"


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_affine_fit_recovers_an_affine_map(batch):
    """Eqs. 15-17: `p' = A p + b` with `b = p'bar - A pbar`; eq. 17 prints -b."""
    A, b, p = random(*batch, 3, 2), random(*batch, 3, seed=1), random(*batch, 5, 2, seed=2)
    fit = affine_fit(p, p @ A.mT + b[..., None, :])
    torch.testing.assert_close(fit.A, A)
    torch.testing.assert_close(fit.b, b)


def test_affine_fit_is_the_least_squares_minimum():
    p, q = random(6, 2), random(6, 3, seed=1)
    fit = affine_fit(p, q)
    homogeneous = torch.cat([p, torch.ones(6, 1, dtype=torch.float64)], 1)
    want = torch.linalg.lstsq(homogeneous, q).solution.T
    torch.testing.assert_close(torch.cat([fit.A, fit.b[:, None]], 1), want)


def test_local_maps_are_affine_fits_of_each_quadrilateral():
    points, moved = random(20, 2), random(2, 20, 2, seed=1)
    maps = LocalAffineMaps(points, (4, 5))(moved)
    index = [1 * 5 + 2, 2 * 5 + 2, 2 * 5 + 3, 1 * 5 + 3]
    want = affine_fit(points[index], moved[1][index])
    torch.testing.assert_close(maps.A[1, 1, 2], want.A)
    torch.testing.assert_close(maps.b[1, 1, 2], want.b)


def pattern(membrane, per_side):
    """Markers on a regular net in the membrane's own coordinates, as points of its triangles."""
    inner = membrane.resampled((per_side + 2, per_side + 2)).rest.reshape(per_side + 2, per_side + 2, 3)
    xyz = inner[1:-1, 1:-1].reshape(-1, 3).numpy()
    return xyz, membrane.closest_points(xyz)


def bump(xyz, radius=12.0):
    """A smooth flow that vanishes at the rim, px."""
    x, y = xyz[..., 0] / radius, xyz[..., 1] / radius
    rest = np.clip(1 - x**2 - y**2, 0, None)
    return np.stack([10 * rest * (x + 0.5 * y), 8 * rest**2], -1)


def test_smooth_flow_is_reproduced_on_the_grid_and_better_with_more_markers():
    cap = spherical_cap(12, 9, 15, (17, 17))
    errors = []
    for per_side in (7, 11, 15):
        xyz, points = pattern(cap, per_side)
        flow = FlowInterpolation(cap, points)
        got = flow(torch.from_numpy(bump(xyz)), torch.ones(len(xyz), dtype=torch.float64))
        errors.append(float((got - torch.from_numpy(bump(cap.rest.numpy()))).square().mean().sqrt()))
    assert errors[0] > errors[1] > errors[2] and errors[2] < 0.1


def test_flow_vanishes_on_the_rim_and_for_zero_displacement():
    cap = spherical_cap(12, 9, 15, (17, 17))
    xyz, points = pattern(cap, 11)
    flow = FlowInterpolation(cap, points)
    got = flow(random(2, len(xyz), 2), torch.ones(2, len(xyz), dtype=torch.float64))
    assert (got[:, cap.fixed] == 0).all()
    assert (flow(torch.zeros(len(xyz), 2).double(), torch.ones(len(xyz)).double()) == 0).all()


def test_lost_markers_have_no_say_and_the_rest_fills_in():
    """The preconditioned solve equals the dense one for any confidences; NaN of a lost marker goes nowhere."""
    cap = spherical_cap(12, 9, 15, (17, 17))
    xyz, points = pattern(cap, 11)
    flow = FlowInterpolation(cap, points)
    s, c = torch.from_numpy(bump(xyz)), torch.ones(len(xyz), dtype=torch.float64)
    lost = [5, 30, 60, 61, 62, 90]
    c[lost], s[lost] = 0.0, torch.nan
    W, free = weights(points, len(cap.rest)), cap.free_vertices
    normal = (W.T @ (c[:, None] * W) + roughness(cap, len(xyz)))[free][:, free]
    want = torch.linalg.solve(normal, (W.T @ torch.where(c[:, None] > 0, s, 0.0))[free])
    got = flow(s, c)
    torch.testing.assert_close(got[free], want, rtol=0, atol=1e-4)
    clean = flow(torch.from_numpy(bump(xyz)), torch.ones_like(c))
    assert (got - clean).abs().max() < 1.0


def test_batch_equals_singles():
    field = heightfield(np.linspace(-3, 3, 9), np.linspace(-2, 2, 9), np.full((9, 9), 5.0))
    _, points = pattern(field, 5)
    flow, s, c = FlowInterpolation(field, points), random(3, 25, 2), random(3, 25, seed=4).sigmoid()
    singles = torch.stack([flow(a, b) for a, b in zip(s, c, strict=True)])
    torch.testing.assert_close(flow(s, c), singles)


def test_too_few_markers_are_refused():
    cap = spherical_cap(12, 9, 15)
    points = SurfacePoints(np.zeros((2, 3), int), np.full((2, 3), 1 / 3), np.zeros(2))
    with pytest.raises(MembraneError, match="at least 3"):
        FlowInterpolation(cap, points)


def test_bilinear_flow_is_exact_for_bilinear_fields_between_dots():
    """On a net of dots a field bilinear in the grid's coordinates comes back exactly inside the net (section 5)."""
    field = heightfield(np.linspace(-3, 3, 17), np.linspace(-2, 2, 17), np.full((17, 17), 5.0))
    xyz, points = pattern(field, 7)
    flow = BilinearFlow(field, points)
    bilinear = lambda p: torch.from_numpy(np.stack([1 + p[:, 0] * p[:, 1], p[:, 0] - 2 * p[:, 1]], 1))  # noqa: E731
    got = flow(bilinear(xyz), torch.ones(len(xyz), dtype=torch.float64))
    inner = (field.rest[:, 0].abs() <= xyz[:, 0].max()) & (field.rest[:, 1].abs() <= xyz[:, 1].max())
    assert inner.sum() > 100
    torch.testing.assert_close(got[inner], bilinear(field.rest.numpy())[inner])
    assert (got[field.fixed] == 0).all()


def test_bilinear_flow_between_scattered_dots_stays_between_their_values():
    cap = spherical_cap(12, 9, 15, (17, 17))
    rng = np.random.default_rng(2)
    vertices = cap.triangles.numpy()[rng.integers(len(cap.triangles), size=60)]
    points = SurfacePoints(vertices, rng.dirichlet((1, 1, 1), 60), np.zeros(60))
    s, c = torch.from_numpy(rng.uniform(1, 2, (60, 2))), torch.ones(60, dtype=torch.float64)
    got = BilinearFlow(cap, points)(s, c)
    assert (got >= -1e-9).all() and (got <= 2 + 1e-9).all()
    assert (got[~cap.fixed] > 0).float().mean() > 0.95
    c[7] = 0
    s[7] = torch.nan
    assert BilinearFlow(cap, points)(s, c).isfinite().all()


def test_every_vertex_lies_where_its_bilinear_weights_say():
    """The example's dots, between which cells are long and skew: a Newton step that has not converged gives no weights."""
    sensor = Sensor.from_file(EXAMPLES / "sensor.toml")
    membrane = sensor.membrane
    points = membrane.closest_points(sensor.markers.positions)
    matrix = bilinear_matrix(membrane, points)
    m, n = membrane.grid
    place = np.stack(np.divmod(np.arange(m * n), n), 1).astype(float)
    dots = (place[points.vertices] * points.weights[..., None]).sum(1)
    between = np.isclose(matrix.sum(1), 1.0)  # no share of the rim, whose flow is zero
    assert between.sum() > 0.5 * m * n and (matrix >= -1e-9).all() and matrix.sum(1).max() < 1 + 1e-9
    np.testing.assert_allclose((matrix @ dots)[between], place[between], atol=1e-5)
    short = ~between & ~membrane.fixed.numpy() & (matrix.sum(1) > 0.02)
    toward = (matrix @ dots)[short] / matrix.sum(1)[short, None] - place[short]
    assert np.linalg.norm(toward, axis=1).max() < 8


def spd(*shape, seed=0):
    M = random(*shape, seed=seed)
    return M @ M.mT + 0.3 * torch.eye(shape[-1], dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (3, 2)])
def test_one_weight_matrix_for_all_matches_changes_nothing(batch):
    """Appendix C for points in space: eq. 52 holds for any Q of eq. 46."""
    p, q, Q = random(*batch, 7, 3), random(*batch, 7, 3, seed=1), spd(*batch, 3, 3, seed=2)
    got, want = weighted_affine_fit(p, q, Q[..., None, :, :].expand(*batch, 7, 3, 3)), affine_fit(p, q)
    torch.testing.assert_close(got.A, want.A)
    torch.testing.assert_close(got.b, want.b)


def test_weights_of_their_own_give_the_least_weighted_squares():
    """Eq. 46 with the uncertainty of each match, against whitened least squares; a doubtful match is passed over."""
    p, q, Q = random(8, 3), random(8, 3, seed=1), spd(8, 3, 3, seed=2)
    white = torch.linalg.cholesky(Q).mT
    one = torch.cat([p, torch.ones(8, 1, dtype=torch.float64)], 1)
    rows = torch.einsum("nrq,na->nrqa", white, one).reshape(24, 12)
    want = torch.linalg.lstsq(rows, (white @ q[..., None]).reshape(24, 1)).solution.reshape(3, 4)
    got = weighted_affine_fit(p, q, Q)
    torch.testing.assert_close(torch.cat([got.A, got.b[:, None]], 1), want)
    A, b = random(3, 3, seed=3), random(3, seed=4)
    images = p @ A.T + b
    images[0] += 50
    Q[0] *= 1e-9
    torch.testing.assert_close(weighted_affine_fit(p, images, Q).A, A, rtol=0, atol=1e-5)
