"""Areas, normals, volume and orientation of the rest surface."""

import math

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.solve.stencil import FEW, apply_stencil, convolved_by_product
from torchmembrane.solve.symmetric_2x2 import symmetric_adjugate_product, symmetric_determinant, symmetric_solution
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import disc_grid, ellipsoid_cap, half_cylinder, heightfield, spherical_cap
from torchmembrane.surface.tangent import tangent_axes, tangent_frame
from torchmembrane.surface.topology import (
    TRIANGLE_CORNERS,
    corners,
    corners_to_vertices,
    rim_loop,
    triangles_of,
    triangles_to_corners,
)

SHAPES = {
    "spherical_cap": lambda n: spherical_cap(12, 9, 15, (n, n)),
    "ellipsoid_cap": lambda n: ellipsoid_cap((12, 9, 12), 2, (n, n)),
    "half_cylinder": lambda n: half_cylinder(10, 40, 80, 3, (n, n)),
    "heightfield": lambda n: heightfield(np.linspace(-3, 3, n), np.linspace(-2, 2, n + 2), np.full((n, n + 2), 5.0)),
}


@pytest.fixture(params=SHAPES)
def membrane(request):
    return SHAPES[request.param](9)


def moved(membrane, batch=()):
    generator = torch.Generator().manual_seed(3)
    return membrane.rest + 0.1 * torch.randn(*batch, *membrane.rest.shape, generator=generator, dtype=torch.float64)


def test_gathers_and_sums_are_adjoint(membrane):
    grid = membrane.grid
    x = moved(membrane)
    y = torch.randn(grid[0] - 1, grid[1] - 1, 2, 3, 3, dtype=torch.float64)
    gathered = (triangles_of(corners(x, grid)) * y).sum()
    torch.testing.assert_close(gathered, (x * corners_to_vertices(triangles_to_corners(y), grid)).sum())


@pytest.mark.parametrize("transposed", [False, True])
def test_structured_triangles_are_the_listed_ones(membrane, transposed):
    """Eq. 8: quadrilateral by quadrilateral, split from (i, j) to (i+1, j+1), both halves turned outwards: written out here."""
    m, n = membrane.grid
    if transposed:  # a grid of the other winding
        m, n, membrane = n, m, Membrane(membrane.rest.reshape(m, n, 3).numpy().transpose(1, 0, 2))
    listed = []
    for i in range(m - 1):
        for j in range(n - 1):
            a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
            listed += [(a, b, c), (a, c, d)]
    p = membrane.rest.numpy()[np.array(listed)]
    seen_from_behind = np.einsum("tk,tk->t", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), p.mean(1)) < 0
    assert seen_from_behind.all() or not seen_from_behind.any()
    assert seen_from_behind[0] == (membrane.outward < 0) == transposed
    listed = [(a, c, b) if transposed else (a, b, c) for a, b, c in listed]
    assert membrane.triangles.tolist() == [list(triangle) for triangle in listed]
    x = moved(membrane)
    p = x.numpy()[np.array(listed)]
    area_vectors = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) / 2
    np.testing.assert_allclose(membrane.area_vectors(x).reshape(-1, 3).numpy(), area_vectors, atol=1e-12)
    volume = np.einsum("tk,tk->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    assert float(membrane.volume(x)) == pytest.approx(volume)


def test_quadrilaterals_have_the_corners_of_equation_8():
    """(i, j), (i+1, j), (i+1, j+1), (i, j+1), once around."""
    places = torch.tensor([[i, j] for i in range(4) for j in range(6)])
    at = corners(places, (4, 6))
    for i, j in ((0, 0), (2, 4), (1, 3)):
        assert at[i, j].tolist() == [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]]
    assert triangles_of(torch.arange(4)[:, None])[..., 0].tolist() == [list(corner) for corner in TRIANGLE_CORNERS]


def test_volume_gradient_is_autograd_of_volume(membrane):
    x = moved(membrane, (2,)).requires_grad_()
    (gradient,) = torch.autograd.grad(membrane.volume(x).sum(), x)
    torch.testing.assert_close(membrane.volume_gradient(x), gradient)


def test_volume_gradient_is_a_third_of_the_area_vectors_inside_the_rim(membrane):
    x, inside = moved(membrane), ~membrane.fixed
    direction = torch.nn.functional.normalize(membrane.volume_gradient(x), dim=-1)
    torch.testing.assert_close(membrane.normals(x)[inside], direction[inside])


def test_moving_all_free_vertices_by_the_gradient_changes_the_volume_by_its_square(membrane):
    """Pins eq. 20: the trace needs adj C, the transpose of the cofactors; with cofactors it fails."""
    x, step = moved(membrane), 1e-5
    v = membrane.volume_gradient(x)
    rise = (membrane.volume(x + step * v) - membrane.volume(x - step * v)) / (2 * step)
    torch.testing.assert_close(rise, (v**2).sum())


def test_volume_is_positive_for_outward_triangles_clockwise_from_the_origin():
    """Pins eq. 19: the paper says counterclockwise seen from the origin, which gives -V."""
    cap = spherical_cap(12, 9, 15, (65, 65))
    cone, dome = math.pi * 144 * 15 / 3, math.pi * 9 / 6 * (3 * 144 + 81)
    assert float(cap.rest_volume) == pytest.approx(cone + dome, rel=1e-3)
    assert cap.cavity_volume == pytest.approx(dome, rel=2e-3)
    a, b, c = cap.rest[cap.triangles[0]]
    from_origin = torch.linalg.cross(b - a, c - a) @ a
    assert from_origin > 0


@pytest.mark.parametrize(
    ("make", "area"),
    [
        (SHAPES["spherical_cap"], 2 * math.pi * 12.5 * 9),
        (SHAPES["half_cylinder"], 40 * 10 * math.radians(160)),
    ],
)
def test_area_converges_quadratically(make, area):
    errors = [abs(float(make(n).rest_area.sum()) - area) for n in (17, 33, 65)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (rates > 1.8).all() and (rates < 2.3).all()


def test_normals_point_away_from_the_camera(membrane):
    inside = ~membrane.fixed
    assert ((membrane.rest_normals * membrane.rest).sum(-1)[inside] > 0).all()
    torch.testing.assert_close(membrane.rest_normals.norm(dim=-1), torch.ones(len(membrane.rest), dtype=torch.float64))


def test_sphere_normals_are_radial():
    cap = spherical_cap(12, 9, 15, (33, 33))
    radial = torch.nn.functional.normalize(cap.rest - torch.tensor([0, 0, 11.5], dtype=torch.float64), dim=-1)
    assert ((cap.rest_normals * radial).sum(-1)[~cap.fixed] > 0.999).all()


def test_either_winding_gives_the_same_surface(membrane):
    m, n = membrane.grid
    turned = Membrane(membrane.rest.reshape(m, n, 3).numpy().transpose(1, 0, 2))
    torch.testing.assert_close(turned.rest_volume, membrane.rest_volume, rtol=5e-3, atol=0)
    assert turned.outward == -membrane.outward and turned.cavity_volume == pytest.approx(membrane.cavity_volume, rel=0.1)
    same = turned.rest_normals.reshape(n, m, 3).transpose(0, 1).reshape(-1, 3)
    assert ((same * membrane.rest_normals).sum(-1) > 0.95).all()


def test_resampling_a_uniform_grid_keeps_common_vertices():
    fine = SHAPES["half_cylinder"](33)
    coarse = fine.resampled((17, 17))
    torch.testing.assert_close(coarse.rest.reshape(17, 17, 3), fine.rest.reshape(33, 33, 3)[::2, ::2], rtol=0, atol=1e-4)


def test_resampling_spaces_lines_equally_on_steep_sides_and_stays_on_the_surface():
    """A grid uniform in x and y is coarse where the finger is steep; its resampled twin is not, with the rim on the rim."""
    x, y = disc_grid(33, 33)
    steep = np.stack([12 * x, 9 * y, 2 + 12 * np.sqrt(np.clip(1 - x**2 - y**2, 0, None))], -1)
    even = Membrane(steep).resampled((21, 19))
    ellipse = (even.rest[even.fixed, :2] / torch.tensor([12.0, 9.0])).norm(dim=-1)
    torch.testing.assert_close(ellipse, torch.ones_like(ellipse), rtol=0, atol=2e-3)
    ellipsoid = ((even.rest - torch.tensor([0, 0, 2.0])) / torch.tensor([12.0, 9.0, 12.0])).norm(dim=-1)
    assert (ellipsoid - 1).abs().max() < 0.02
    step = (even.rest.reshape(21, 19, 3).diff(dim=0).square().sum(-1).mean(1)) ** 0.5
    assert step.max() < 1.15 * step.min()
    rms_line = (np.diff(steep, axis=0) ** 2).sum(-1).mean(1) ** 0.5
    assert rms_line.max() > 1.5 * rms_line.min()


def test_closest_points_recover_barycentric_points_and_their_distance():
    cap = spherical_cap(12, 9, 15, (17, 17))
    rng = np.random.default_rng(0)
    weights = rng.dirichlet((1, 1, 1), 40)
    index = cap.triangles.numpy()[rng.integers(len(cap.triangles), size=40)]
    corners_xyz = cap.rest.numpy()[index]
    normal = np.cross(corners_xyz[:, 1] - corners_xyz[:, 0], corners_xyz[:, 2] - corners_xyz[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    on_surface = (corners_xyz * weights[..., None]).sum(1)
    found = cap.closest_points(on_surface)
    again = (cap.rest.numpy()[found.vertices] * found.weights[..., None]).sum(1)
    np.testing.assert_allclose(again, on_surface, atol=1e-9)
    off = cap.closest_points(on_surface + 0.05 * normal).distance
    assert (off <= 0.05 + 1e-12).all() and np.quantile(off, 0.1) > 0.0499


def test_rays_meet_the_surface_where_their_points_came_from(membrane):
    rng = np.random.default_rng(1)
    weights = rng.dirichlet((1, 1, 1), 30)
    index = membrane.triangles.numpy()[rng.integers(len(membrane.triangles), size=30)]
    points = (membrane.rest.numpy()[index] * weights[..., None]).sum(1)
    origin = np.tile([0.1, -0.2, 0.3], (30, 1))
    ranges = np.linalg.norm(points - origin, axis=1)
    hit = membrane.ray_points(origin, (points - origin) / ranges[:, None])
    np.testing.assert_allclose(hit.distance, ranges, rtol=1e-9)
    np.testing.assert_allclose((membrane.rest.numpy()[hit.vertices] * hit.weights[..., None]).sum(1), points, atol=1e-9)
    missed = membrane.ray_points(origin[:1], -(points - origin)[:1])
    assert np.isnan(missed.distance).all()


FLAT = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [4.0], indexing="ij"), -1)[:, :, 0]


def _folded():
    grid = FLAT.copy()
    grid[2, 2] = (4.5, 2, 4)
    return grid


def _changed(index, value):
    grid = FLAT.copy()
    grid[index] = value
    return grid


@pytest.mark.parametrize(
    ("vertices", "fixed", "words"),
    [
        (FLAT[..., :2], None, "expected [m, n, 3]"),
        (FLAT[:2], None, "m, n >= 3"),
        (_changed((1, 3, 2), np.nan), None, "vertex (1, 3) is not finite"),
        (_folded(), None, "without folds"),
        (FLAT * [1, 1, -1], None, "behind the camera"),
        (_changed((2, 2), FLAT[2, 3]), None, "has no area"),
        (FLAT, np.zeros((5, 5), bool), "border vertex (0, 0) is free"),
        (FLAT, np.ones((5, 5), bool), "every vertex is fixed"),
        (FLAT, np.ones((4, 5), bool), "one per vertex"),
    ],
)
def test_wrong_grids_are_refused_in_words(vertices, fixed, words):
    with pytest.raises(MembraneError) as error:
        Membrane(vertices, fixed)
    assert words in str(error.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda: spherical_cap(-1, 9, 15),
        lambda: ellipsoid_cap((1, float("nan"), 1), 2),
        lambda: half_cylinder(10, 40, 120, 3),
        lambda: heightfield([0, 1, 1], [0, 1, 2], np.ones((3, 3))),
        lambda: heightfield([0, 1, 2], [0, 1, 2], np.ones((3, 4))),
    ],
)
def test_wrong_shapes_are_refused(make):
    with pytest.raises(MembraneError):
        make()


def across(directions):
    """The two vectors across `[B, 3, D]` written out, components first."""
    x, y, z = directions.unbind(1)
    none = torch.zeros_like(x)
    first = torch.where((z.abs() < 0.9)[:, None], torch.stack([y, -x, none], 1), torch.stack([none, z, -y], 1))
    first = torch.nn.functional.normalize(first, dim=1)
    return torch.stack([first, torch.linalg.cross(directions, first, dim=1)], 1)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 200)])
def test_tangent_frames_are_orthonormal_right_handed_and_the_same_on_any_axis(batch):
    generator = torch.Generator().manual_seed(0)
    n = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
    frame = torch.cat([n[..., None, :], tangent_frame(n)], -2)
    one = torch.eye(3, dtype=torch.float64).expand(*batch, 3, 3)
    torch.testing.assert_close(frame @ frame.mT, one, rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(batch, dtype=torch.float64))
    if batch:
        components_first = tangent_frame(n.movedim(-1, 0), 0).movedim((0, 1), (-2, -1))
        torch.testing.assert_close(components_first, tangent_frame(n), rtol=0, atol=1e-15)
        first = n.reshape(1, -1, 3).mT
        assert torch.equal(tangent_frame(first, dim=1), across(first))


def test_tangent_axes_are_orthonormal_and_right_handed_also_along_the_axes():
    rng = np.random.default_rng(0)
    normals = np.concatenate([rng.normal(size=(50, 3)), np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frame = np.concatenate([normals[:, None], tangent_axes(normals)], 1)
    np.testing.assert_allclose(frame @ frame.swapaxes(1, 2), np.broadcast_to(np.eye(3), frame.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0)


@pytest.mark.parametrize("grid", [(3, 3), (4, 6), (7, 5)])
def test_the_rim_loop_goes_once_around_the_border(grid):
    m, n = grid
    i, j = np.divmod(rim_loop(grid), n)
    assert len(set(zip(i.tolist(), j.tolist(), strict=True))) == len(i) == 2 * (m + n) - 4
    assert (np.isin(i, (0, m - 1)) | np.isin(j, (0, n - 1))).all()
    assert (np.abs(i - np.roll(i, 1)) + np.abs(j - np.roll(j, 1)) == 1).all()


def test_symmetric_closed_forms_solve_their_systems():
    rng = np.random.default_rng(0)
    a, b, c, u, v = rng.normal(size=(5, 40))
    matrix = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    solved = np.stack(symmetric_adjugate_product(a, b, c, u, v), -1) / symmetric_determinant(a, b, c)[:, None]
    for x in (solved, np.stack(symmetric_solution(a, b, c, u, v), -1)):
        np.testing.assert_allclose((matrix @ x[..., None])[..., 0], np.stack([u, v], -1), atol=1e-9)


def test_a_convolution_by_product_is_one():
    """As exported models have it in double precision."""
    generator = torch.Generator().manual_seed(0)
    planes, kernels = (torch.randn(*shape, generator=generator).double() for shape in ((2, 3, 7, 6), (4, 3, 3, 2)))
    torch.testing.assert_close(convolved_by_product(planes, kernels), torch.nn.functional.conv2d(planes, kernels))


@pytest.mark.parametrize("planes", [1, FEW, FEW + 1])
@pytest.mark.parametrize("border", [False, True])
def test_stencils_combine_the_values_around_however_many_there_are(planes, border):
    """Sums of shifted slices, with and without gradients."""
    generator = torch.Generator().manual_seed(planes)
    kernels = torch.randn(2, 3, 3, generator=generator)
    field = torch.randn(1, 7 * 6, planes, generator=generator)
    wide = torch.nn.functional.pad(field.mT.unflatten(-1, (7, 6)), (1, 1, 1, 1) if border else (0, 0, 0, 0))
    m, n = wide.shape[2] - 2, wide.shape[3] - 2
    shifted = torch.stack([wide[..., i : i + m, j : j + n] for i in range(3) for j in range(3)], 2)
    expected = torch.einsum("wk,bckij->bcwij", kernels.flatten(1), shifted).flatten(2)
    recorded = field.clone().requires_grad_()
    with torch.no_grad():
        found = apply_stencil(field, kernels, (7, 6), border)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(apply_stencil(recorded, kernels, (7, 6), border), expected)
