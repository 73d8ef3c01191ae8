"""Laws and accuracy of force balance and of its solver."""

from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import torch

from torchmembrane.camera.model import Camera
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.contacts import contact_indicator, contact_points
from torchmembrane.estimators.force_balance import gauss_newton as gauss_newton
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.force_balance.gauss_newton import State
from torchmembrane.estimators.force_balance.marker_residuals import MarkerResiduals, MeasuredRays
from torchmembrane.estimators.force_balance.robust import Cauchy
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.traction_loss import TractionLoss
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import FRICTION
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press
from torchmembrane.solve import block_pentadiagonal
from torchmembrane.solve.inverse_root import by_cholesky, by_products
from torchmembrane.solve.stencil import inner
from torchmembrane.solve.stencil_layouts import WIDTH
from torchmembrane.solve.stencil_system import Matrix
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import spherical_cap
from torchmembrane.surface.tangent import tangent_frame

SETTINGS = ForceBalanceSettings()
ONE = torch.ones(1, dtype=torch.float64)  # level of the noise
EXAMPLES = Path(__file__).parents[1] / "examples"
CAMERA = Camera("fisheye", (640, 480), (168, 168), (320, 240))


def dots(membrane, per_side=11):
    net = membrane.resampled((per_side + 2, per_side + 2)).rest.reshape(per_side + 2, per_side + 2, 3)
    return net[1:-1, 1:-1].reshape(-1, 3)


def make(n=13, **options):
    dome = spherical_cap(12, 9, 3, (n, n))
    positions = dots(spherical_cap(12, 9, 3, (33, 33)))
    elasticity = ElasticEnergy(dome, "neo_hookean", 1.3)
    markers = dome.closest_points(positions.numpy())
    return ForceBalance(dome, elasticity, markers, positions, noise=0.1 / 168, **options)


def seen(origins, directions, confidence=None):
    """The observation of one frame's rays, or of a batch's."""
    if directions.ndim == 2:
        origins, directions = origins[None], directions[None]
    return Observation(origins, directions, torch.ones_like(directions[..., 0]) if confidence is None else confidence)


@pytest.fixture(scope="module")
def pressed():
    """A ball of radius 4 pressed 2 mm, 30 degrees off the axis, on 31 x 31 vertices: noisy marker rays, and the truth."""
    dome = spherical_cap(12, 9, 3, (31, 31))
    elasticity = ElasticEnergy(dome, "neo_hookean", 1.3)
    ball, direction = Sphere(4.0), torch.tensor([0.5, 0.0, 0.866], dtype=torch.float64)
    start = ball.touching(dome, -direction)
    truth = press(dome, elasticity, [[start, start.moved(-2.0 * direction)]])
    positions = dots(spherical_cap(12, 9, 3, (33, 33)))
    moved = carried(truth.vertices, dome, positions)
    pixels = CAMERA.point_to_pixel(moved)
    noise = 0.05 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return CAMERA.pixel_to_ray(pixels + noise), positions, moved, truth


def bent(membrane, batch=1, size=0.05):
    generator = torch.Generator().manual_seed(2)
    return (
        membrane.rest
        + size * torch.randn(batch, *membrane.rest.shape, generator=generator, dtype=torch.float64) * (~membrane.fixed)[:, None]
    )


def dense(system, matrix):
    """The dense matrix `[3 N, 3 N]` of one frame's scaled blocks."""
    blocks, scale = system.row_blocks, matrix.scale[0]
    values = blocks.dense(matrix.entries.index_select(1, blocks.sources).unflatten(1, (-1, WIDTH)))
    rows, s = blocks.rows, values.shape[-1]
    full = values.new_zeros(rows, s, rows, s)
    for (i, j), block in zip(chain(*block_pentadiagonal.places(rows)), values, strict=True):
        if i >= 0:
            full[i, :, j], full[j, :, i] = block, block.mT
    columns = (
        blocks.in_blocks(torch.eye(scale.shape[1], dtype=scale.dtype)[None])[0][blocks.place_of_row].movedim(0, 1).flatten(1)
    )
    return columns @ full.flatten(2).flatten(0, 1) @ columns.T / (scale * scale.T)


def solved_by(way, matrix, loads):
    """Solutions for the loads by a way of elimination."""
    return matrix.scale * way.substitute(way.factor(matrix.entries), matrix.scale * loads)


def by_component(values):
    """Rows over vertices and components, `[..., N 3]`, as the system has them, `[..., 3 N]`."""
    return values.unflatten(-1, (-1, 3)).mT.flatten(-2)


def jacobian_at_inner_vertices(function, u, estimator):
    """Derivative of `function(u)` in the inner vertices' coordinates, a row for each of its numbers."""
    jacobian = torch.autograd.functional.jacobian(function, u)
    return inner(jacobian.flatten(0, -4).squeeze(1), estimator.membrane.grid).flatten(1)


def linear_angles(bearings, u, y, measured, moved):
    """The angles at `y` where the markers' step from `u` is linear in their triangles, as the equations have it."""
    at, step = bearings.markers(u), inner(y - u, bearings.grid)
    bearings.markers = lambda _: at + bearings.vertex_shares @ step
    try:
        return bearings.angles(y, measured, moved)[0]
    finally:
        del bearings.markers


def test_linearised_force_and_volume_are_those_and_their_derivatives():
    estimator = make(9)
    membrane, forces = estimator.membrane, estimator.equations.forces
    x, p = bent(membrane), torch.tensor([0.3], dtype=torch.float64)
    u = x - membrane.rest
    at = forces.linearised(u, p)

    def within(field):
        return inner(field, membrane.grid)

    torch.testing.assert_close(at.force.mT, within(forces(u, p)))
    torch.testing.assert_close(at.volume.mT, within(membrane.volume_gradient(x)))
    torch.testing.assert_close(at.normal.mT, within(membrane.normals(x)))
    exact = by_component(jacobian_at_inner_vertices(lambda y: within(forces(y, p)).mT, u, estimator))
    single_moves = torch.eye(len(exact), dtype=torch.float64).unflatten(-1, (3, -1))[None]
    stiffness = forces.change(at.stiffness, single_moves).flatten(2)[0].T
    torch.testing.assert_close(stiffness, exact)
    torch.testing.assert_close(stiffness, stiffness.T)


@pytest.mark.parametrize("hole", [False, True])
def test_normal_equations_are_those_of_the_dense_jacobians(hole):
    """Jacobians of all forces and angles by autograd; some vertices inside the rim fixed as well."""
    fixed = torch.ones(10, 9, dtype=torch.bool)
    fixed[1:-1, 1:-1] = False
    fixed[4, 3] = hole
    dome = Membrane(spherical_cap(12, 9, 3, (10, 9)).rest.reshape(10, 9, 3).numpy(), fixed.numpy())
    positions = dots(spherical_cap(12, 9, 3, (33, 33)))
    estimator = ForceBalance(
        dome, ElasticEnergy(dome, prestretch=1.3), dome.closest_points(positions.numpy()), positions, 0.1 / 168
    )
    u, p = bent(dome) - dome.rest, torch.tensor([0.3], dtype=torch.float64)
    directions = torch.nn.functional.normalize(positions + 0.3, dim=-1)[None]
    motion = torch.rand(1, 2, 4, directions.shape[1], generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    measured = MeasuredRays(
        0.1 * directions.mT, tangent_frame(directions.mT, dim=1), torch.ones(1, directions.shape[1]).double(), ONE, motion
    )
    moved = torch.tensor([[0.3, -0.2, 0.1, 0.5]], dtype=torch.float64)
    equations = estimator.equations
    at = equations.forces.linearised(u, p)
    angle, jacobian = equations.bearings.angles(u, measured, moved)
    generator = torch.Generator().manual_seed(3)
    weight = torch.rand(1, len(positions), generator=generator, dtype=torch.float64)
    root = torch.rand(1, at.force.shape[-1], 3, 3, generator=generator, dtype=torch.float64)
    W = (root @ root.mT).movedim(1, -1)
    normal = equations.normal_equations(at, W, jacobian, weight)
    loads, (fWv, vWv) = equations.loads(normal, at, angle)
    matrix, (volume, load, of_fluid) = equations.matrix(normal, 1e-6), loads.unbind(1)

    moving = equations.forces.inner_free.repeat(3) > 0
    unknowns = torch.nonzero(moving).ravel()
    A = jacobian_at_inner_vertices(lambda y: inner(equations.forces(y, p), dome.grid).mT, u, estimator)
    J = jacobian_at_inner_vertices(lambda y: linear_angles(equations.bearings, u, y, measured, moved), u, estimator)
    A, J = (by_component(rows)[:, unknowns] for rows in (A, J))
    W = torch.diag_embed(W[0]).movedim(2, 1).flatten(2).flatten(0, 1)
    w = torch.diag(weight[0].repeat(2))
    M = dense(equations.system, matrix)[unknowns[:, None], unknowns]
    torch.testing.assert_close(M, (A.T @ W @ A + J.T @ w @ J) * (1 + 1e-6 * torch.eye(len(M))))
    f, v = at.force.flatten(), at.volume.flatten()
    torch.testing.assert_close(load[0, unknowns], A.T @ W @ f + J.T @ w @ angle.flatten())
    torch.testing.assert_close(of_fluid[0, unknowns], -A.T @ W @ v)
    torch.testing.assert_close(torch.stack([fWv, vWv], -1)[0], torch.stack([f @ W @ v, v @ W @ v]))
    torch.testing.assert_close(volume[0, unknowns], v[moving])
    system, recorded = equations.system, matrix._replace(entries=matrix.entries.clone().requires_grad_())
    for way, given in ((system.band, matrix), (system.row_blocks, recorded)):
        factor = system.factor(given)
        assert factor.way is way
        solved = system.substitute(factor, loads)[0].T.detach()
        torch.testing.assert_close(solved[unknowns], torch.linalg.solve(M, loads[0].T[unknowns]))
        assert (solved.count_nonzero(0) == len(unknowns)).all()
    steps = torch.zeros_like(loads)
    steps[..., unknowns] = torch.rand(3, len(unknowns), generator=generator, dtype=torch.float64)
    product = equations.product(normal, steps)[0].T
    torch.testing.assert_close(product[unknowns], (A.T @ W @ A + J.T @ w @ J) @ steps[0].T[unknowns])
    assert (product.count_nonzero(0) == len(unknowns)).all()
    of_camera = equations.motion(normal, measured, angle)
    K = motion[0].movedim(1, -1).flatten(0, 1)
    torch.testing.assert_close(of_camera.coupling[0, :, unknowns], K.T @ w @ J)
    torch.testing.assert_close(of_camera.own[0], K.T @ w @ K)
    torch.testing.assert_close(of_camera.slope[0], K.T @ w @ angle.flatten())


def test_the_bearing_jacobian_is_the_derivative_of_the_angles():
    estimator = make(7)
    bearings = estimator.equations.bearings
    directions = torch.nn.functional.normalize(bearings.positions + 0.3, dim=-1)[None]
    motion = torch.rand(1, 2, 4, directions.shape[1], generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    measured = MeasuredRays(
        0.1 * directions.mT, tangent_frame(directions.mT, dim=1), torch.ones(1, directions.shape[1]).double(), ONE, motion
    )
    moved = torch.tensor([[0.3, -0.2, 0.1, 0.5]], dtype=torch.float64)
    u = bent(estimator.membrane) - estimator.membrane.rest
    _, jacobian = bearings.angles(u, measured, moved)
    exact = torch.autograd.functional.jacobian(lambda y: bearings.angles(y, measured, moved)[0], u)[0, :, :, 0]
    expected = torch.einsum("acd,dn->adnc", jacobian[0], bearings.smooth_shares)
    torch.testing.assert_close(inner(exact, estimator.membrane.grid), expected)


def test_a_push_lowers_the_price_of_shear(pressed):
    """Without friction shear is as expensive under a push as elsewhere, and another surface is found."""
    (origins, directions), *_ = pressed
    steep, usual = make(13), make(13)
    steep.equations.loss.friction = 0.0
    found = []
    for one in (steep, usual):
        measured = one.equations.bearings.measured(seen(origins, directions))
        found.append(one.gauss_newton(one.at_rest(measured.weight), measured, SETTINGS.tau[0], 30)[0].u)
    assert (found[1] - found[0]).abs().max() > 0.01


@pytest.mark.parametrize(("n", "share"), [(9, 0.7), (17, 0.3), (33, 0.1)])
def test_markers_follow_a_curved_displacement_between_the_grids_lines(n, share):
    """A dent a quarter of the dome wide: markers are carried along by it, and not by the triangles' chords."""
    estimator = make(n)
    bearings, membrane = estimator.equations.bearings, estimator.membrane
    normals = spherical_cap(12, 9, 3, (65, 65)).closest_points(bearings.positions.numpy())

    def dent(X):
        inwards = torch.nn.functional.normalize(X - torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64), dim=-1)
        return -2.0 * torch.exp(-(X - X.new_tensor([1.0, 2.0, 11.7])).square().sum(-1, keepdim=True) / (2 * 3.0**2)) * inwards

    assert (abs(normals.distance) < 0.05).all()  # of the same surface
    free = estimator.equations.forces.free
    u = (dent(membrane.rest) * free)[None]
    exact = bearings.positions + dent(bearings.positions)
    smooth = (bearings.markers(u)[0] - exact).norm(dim=-1)
    linear = bearings.positions + bearings.vertex_shares @ inner(u, membrane.grid)[0]
    chord = (linear - exact).norm(dim=-1)
    assert smooth.square().mean().sqrt() < share * chord.square().mean().sqrt()


def test_angles_vanish_on_the_rays_and_grow_with_the_distance_across():
    estimator = make(7)
    bearings, y = estimator.equations.bearings, estimator.equations.bearings.positions
    directions = torch.nn.functional.normalize(y, dim=-1)[None]
    measured = bearings.measured(seen(torch.zeros_like(directions), directions))
    angle, _ = bearings.angles(torch.zeros_like(estimator.membrane.rest[None]), measured, torch.zeros(1, 4).double())
    assert angle.abs().max() < 1e-12
    basis = measured.across.movedim(-1, 1) * bearings.noise
    identity = basis @ basis.mT
    torch.testing.assert_close(identity, torch.eye(2, dtype=torch.float64).expand_as(identity))


def test_the_noise_of_a_frame_is_over_that_of_its_own_markers_at_rest():
    """Four frames: twice as noisy; and without the marker that the rest image shows badly; without any; one marker blurred."""
    estimator = make(7)
    y = estimator.equations.bearings.positions
    directions = torch.nn.functional.normalize(y, dim=-1)[None]
    sure = 1e3 * torch.ones(len(y), 1, 1, dtype=torch.float64)
    sure[3] /= 1e3  # badly seen at rest: its turns are hardly any of its standard deviations
    at_rest = seen(torch.zeros_like(directions), directions)._replace(across=tangent_frame(directions) * sure)
    bearings = MarkerResiduals(estimator.membrane, estimator.membrane.closest_points(y.numpy()), y, 1e-3, at_rest)
    frames = Observation(*(None if value is None else value.repeat(4, *[1] * (value.ndim - 1)) for value in at_rest))
    across, confidence = frames.across / 2, frames.confidence.clone()
    confidence[1, 3], confidence[2], across[3, 5] = 0.0, 0.0, across[3, 5] / 100
    blurred = 2 * 100 ** (1 / len(y))
    level = bearings.measured(frames._replace(across=across, confidence=confidence)).noise_level
    torch.testing.assert_close(level, torch.tensor([2.0, 2.0, 1.0, blurred], dtype=torch.float64))


@pytest.mark.parametrize("n", [9, 17])
@pytest.mark.parametrize("options", [{}, dict(filling="open"), dict(filling="gas", gas=(0.1, 2600.0))])
def test_rest_rays_give_the_rest_surface_without_forces(options, n):
    """On one grid, and by way of a coarser one, whose rest pressure is another."""
    estimator = make(n, **options)
    directions = torch.nn.functional.normalize(estimator.equations.bearings.positions, dim=-1)[None]
    result = estimator(seen(torch.zeros_like(directions), directions))
    assert (result.vertices - estimator.membrane.rest).abs().max() < 1e-6
    assert result.traction.abs().max() < 1e-6 * estimator.reference
    torch.testing.assert_close(result.pressure[0], estimator.rest_pressure)


def test_an_open_cavity_stays_at_its_grids_rest_pressure(pressed):
    estimator, (origins, directions) = make(33, filling="open"), pressed[0]
    found = estimator(seen(origins, directions))
    torch.testing.assert_close(found.pressure[0], estimator.rest_pressure)
    below = estimator.coarsened(found.vertices, found.pressure, found.moved)
    torch.testing.assert_close(below.pressure[0], estimator.coarse.rest_pressure)
    assert abs(float(estimator.rest_pressure / estimator.coarse.coarse.rest_pressure) - 1) > 1e-3


@pytest.mark.parametrize("n", [13, 17])
def test_the_rim_stays_exactly_where_it_is(pressed, n):
    """Appendix B: also where all the markers are turned, on one grid and by way of a coarser one."""
    estimator, (origins, directions) = make(n), pressed[0]
    turned = torch.nn.functional.normalize(directions + torch.tensor([0.03, -0.02, 0.0]), dim=-1)
    rim, x = estimator.membrane.fixed, estimator(seen(origins, turned)).vertices[0]
    assert torch.equal(x[rim], estimator.membrane.rest[rim])
    assert (x - estimator.membrane.rest)[~rim].norm(dim=-1).median() > 0.1


def relative(estimator, result, positions, moved):
    got = estimator.equations.bearings.markers(result.vertices - estimator.membrane.rest)[0]
    return float((got - moved).norm() / (moved - positions).norm())


def test_a_press_simulated_on_another_grid_is_recovered_with_its_force_and_place(pressed):
    rays, positions, moved, truth = pressed
    estimator = make(17)
    result = estimator(seen(*rays))
    assert relative(estimator, result, positions, moved) < 0.15
    force = (result.traction * estimator.membrane.rest_area[:, None]).sum(1)[0]
    assert (force - truth.force).norm() < 0.1 * truth.force.norm()
    assert abs(float(result.pressure - estimator.rest_pressure) - (truth.pressure - truth.rest_pressure)) < 0.15 * (
        truth.pressure - truth.rest_pressure
    )
    torch.testing.assert_close(result.volume, estimator.membrane.rest_volume[None], rtol=1e-5, atol=0)
    normals = estimator.membrane.normals(result.vertices)
    point = estimator.contacts(result, normals).points[0, 0]
    assert (point - truth.contact_points[0]).norm() < 1.0


def test_pulls_stay_within_the_grids_own_error(pressed):
    """The truth itself, put on such a grid, has tractions of some hundredths of the rest pressure where nothing touches."""
    rays, positions, _, _ = pressed
    estimator = make(17)
    result = estimator(seen(*rays))
    q_n = (result.traction * estimator.membrane.normals(result.vertices)).sum(-1)
    assert q_n.max() < 0.3 * estimator.reference < 0.1 * -q_n.min()


def at_rest(estimator):
    """Rest positions and normals of the inner vertices."""
    return (inner(field, estimator.membrane.grid) for field in (estimator.membrane.rest, estimator.membrane.rest_normals))


def along_y(normal):
    return torch.linalg.cross(normal, torch.tensor([0.0, 1.0, 0.0], dtype=normal.dtype).expand_as(normal))


def patch_of_pushes(estimator, push, tensile_elsewhere=0.0, shear=0.0):
    """Forces at rest, over the reference: `push` and `shear` on the middle of the dome, `tensile_elsewhere` on the rest."""
    X, normal = at_rest(estimator)
    middle = X[:, :2].norm(dim=1) < 4.0
    pushed = -push * normal + shear * along_y(normal)
    traction = torch.where(middle[:, None], pushed, tensile_elsewhere * normal) * estimator.reference
    return (traction * estimator.equations.loss.area[:, None])[None], middle


def weights(estimator, force, tau=0.5):
    """Weight of the normal and of one tangential direction at every inner vertex, over that of a small push."""
    _, normal = at_rest(estimator)
    loss = estimator.equations.loss
    loss.push_noise = torch.full_like(loss.area, 1e6)  # tractions over p0
    W = loss.weights(normal.mT, force.mT, ONE, tau * ONE)[0].movedim(-1, 0)
    along = torch.nn.functional.normalize(along_y(normal), dim=-1)
    scale = SETTINGS.sparsity / (estimator.reference * estimator.size) ** 2 / loss.area
    return tuple((d[:, None] @ W @ d[..., None]).ravel() / scale for d in (normal, along))


def test_large_pushes_weigh_little_small_ones_and_tensile_tractions_do_not():
    estimator = make(17)
    centre = next(at_rest(estimator))[:, :2].norm(dim=1).argmin()
    for push, tau, low, high in ((1e-3, 0.5, 0.99, 1.01), (4.0, 0.5, 0.0, 0.01), (4.0, 100.0, 0.95, 1.01)):
        force, _ = patch_of_pushes(estimator, push)
        assert low < weights(estimator, force, tau)[0][centre] < high
    force, middle = patch_of_pushes(estimator, 4.0, tensile_elsewhere=4.0)
    torch.testing.assert_close(
        weights(estimator, force)[0][~middle], torch.full((int((~middle).sum()),), 1 + SETTINGS.floor).double()
    )


def test_shear_weighs_much_but_where_something_pushes():
    estimator = make(17)
    centre = next(at_rest(estimator))[:, :2].norm(dim=1).argmin()
    large, _ = patch_of_pushes(estimator, 1e-6, shear=0.5)
    small, _ = patch_of_pushes(estimator, 4.0, shear=0.5)
    large, small = (weights(estimator, force)[1][centre] for force in (large, small))
    full, cone = SETTINGS.shear / 0.5, estimator.equations.loss.cone
    assert 0.9 * full < large < full and small < large / (0.9 * cone * 4)


def test_a_lone_push_is_taken_for_error_its_patch_for_a_contact():
    estimator = make(25)
    force, middle = patch_of_pushes(estimator, 2.0)
    centre = next(at_rest(estimator))[:, :2].norm(dim=1).argmin()
    alone = torch.zeros_like(force)
    alone[0, centre] = force[0, centre]
    assert weights(estimator, alone)[0][centre] > 1.5 * weights(estimator, force)[0][centre]


def test_outliers_weigh_little(pressed):
    """A few markers off by 2 px of 168 px/rad, a fifth of the spacing."""
    (origins, directions), positions, moved, _ = pressed
    wrong = directions.clone()
    generator = torch.Generator().manual_seed(1)
    outliers = torch.randperm(len(positions), generator=generator)[:6]
    wrong[outliers] += (
        2 / 168 * torch.nn.functional.normalize(torch.randn(6, 3, generator=generator, dtype=wrong.dtype), dim=-1)
    )
    wrong = torch.nn.functional.normalize(wrong, dim=-1)
    estimator = make(17)
    clean = relative(estimator, estimator(seen(origins, directions)), positions, moved)
    spoiled = relative(estimator, estimator(seen(origins, wrong)), positions, moved)
    assert spoiled < clean + 0.03


def test_a_fine_grid_begins_with_the_coarse_ones_solution(pressed):
    (origins, directions), positions, moved, truth = pressed
    fine = make(33)
    assert fine.coarse.membrane.grid == (17, 17) and fine.coarse.coarse.membrane.grid == (9, 9)
    assert fine.coarse.coarse.coarse is None and make(16).coarse is None
    surface = State(bent(fine.coarse.membrane) - fine.coarse.membrane.rest, torch.ones(1), torch.ones(1, 4))
    torch.testing.assert_close(fine.coarsened(*fine.refined(*surface)), surface)
    result = fine(seen(origins, directions))
    assert relative(fine, result, positions, moved) < 0.1
    force = (result.traction * fine.membrane.rest_area[:, None]).sum(1)[0]
    assert (force - truth.force).norm() < 0.07 * truth.force.norm()


def test_elimination_by_products_rounds_a_contacts_system_as_cholesky_does(monkeypatch, pressed):
    """Weights of forces a thousandfold apart, in float32."""
    (origins, directions), *_ = pressed
    estimator = make(33)
    equations = estimator.equations
    measured = equations.bearings.measured(seen(origins, directions))
    found = estimator(seen(origins, directions))
    scales = (torch.full_like(found.pressure, scale) for scale in (SETTINGS.tau[1], SETTINGS.outlier))
    _, normal, loads, *_ = equations.linearised(
        found.vertices - estimator.membrane.rest, found.pressure, found.moved, measured, *scales
    )
    matrix = equations.matrix(normal)

    def solved(root, matrix, loads):
        monkeypatch.setattr(block_pentadiagonal, "inverse_root", root)
        return solved_by(equations.system.row_blocks, matrix, loads)

    exact = solved(by_cholesky, matrix, loads)

    def error(x):
        return (x - exact).norm(dim=2) / exact.norm(dim=2)

    single = Matrix(*(part.float() for part in matrix)), loads.float()
    of_cholesky = error(solved(by_cholesky, *single))
    assert (error(solved(by_products, *single)) < 2 * of_cholesky).all()
    assert (error(solved_by(equations.system.band, *single)) < 2 * of_cholesky).all()


def test_batch_equals_singles_and_lost_markers_have_zero_weight(pressed):
    (origins, directions), positions, moved, _ = pressed
    estimator = make(9)
    weight = torch.ones(2, len(positions), dtype=torch.float64)
    weight[1, [3, 40, 41]] = 0
    spoiled = torch.stack([directions, directions.clone()])
    spoiled[1, [3, 40, 41]] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    both = estimator(seen(torch.stack([origins, origins]), spoiled, weight))
    alone = estimator(seen(origins[None], spoiled[1:], weight[1:]))
    torch.testing.assert_close(both.vertices[1:], alone.vertices, rtol=0, atol=1e-7)
    assert relative(estimator, alone, positions, moved) < 0.5


def test_a_batch_in_parts_is_what_it_is_at_once(pressed, monkeypatch):
    """Five frames, two at a time and the last alone."""
    (origins, directions), positions, *_ = pressed
    estimator = make(9)
    turned = torch.nn.functional.normalize(directions + 2e-3 * torch.arange(5).double()[:, None, None], dim=-1)
    frames = seen(origins.expand(5, -1, -1), turned)
    at_once = estimator(frames)
    monkeypatch.setattr(gauss_newton, "VERTICES", 2 * 81)
    torch.testing.assert_close(estimator(frames).vertices, at_once.vertices, rtol=0, atol=1e-7)
    assert (at_once.vertices.diff(dim=0).flatten(1).norm(dim=1) > 1e-3).all()


def test_float32_agrees_with_float64(pressed):
    (origins, directions), positions, _, _ = pressed
    double = make(13)(seen(origins, directions))
    single = make(13).float()(seen(origins.float(), directions.float()))
    assert (double.vertices - single.vertices).abs().max() < 0.05


def test_indicator_and_points_of_known_loads():
    dome = spherical_cap(12, 9, 3, (21, 21))
    load = torch.zeros(2, len(dome.rest), dtype=torch.float64)
    first, second = 10 * 21 + 4, 10 * 21 + 16
    load[0, first], load[0, second] = 2.0, 3.0
    peaks = torch.tensor([[first, second, -1, -1], [-1, -1, -1, -1]])
    points, mine = contact_points(dome.rest.expand(2, -1, -1), dome.rest, load, peaks)
    assert mine[0, 0, second] == mine[0, 1, first] == 1 and mine[0].sum() == len(dome.rest) and mine[1].sum() == 0
    torch.testing.assert_close(points[0, 0], dome.rest[second], rtol=0, atol=1e-3)
    torch.testing.assert_close(points[0, 1], dome.rest[first], rtol=0, atol=1e-3)
    assert points[0, 2:].isnan().all() and points[1].isnan().all()
    traction = -0.25 * dome.rest_normals[None]
    torch.testing.assert_close(
        contact_indicator(traction, dome.rest_normals, 0.25), torch.full((1, len(dome.rest)), 2 / 3, dtype=torch.float64)
    )
    assert (contact_indicator(-traction, dome.rest_normals, 0.25) == 0).all()


def test_the_example_images_give_shape_force_and_place():
    """Through rendered pixels, against an independent program's truth: several times better than minimum energy."""
    reconstructor = Reconstructor.from_file(EXAMPLES / "sensor.toml", estimator="force-balance")
    names = ("press_on_axis", "two_contacts", "flat_plate")
    with torch.no_grad():
        result = reconstructor(reconstructor.read(*(EXAMPLES / f"{name}.png" for name in names)))
    assert (result.status == 0).all()
    errors = []
    for k, name in enumerate(names):
        truth = np.load(EXAMPLES / f"{name}_truth.npz")
        X, Y = truth["dots_nominal"], truth["dots_deformed"]
        errors.append(np.sqrt(((result.markers[k].numpy() - Y) ** 2).sum() / ((Y - X) ** 2).sum()))
        place = truth["contact_centroid_each"][0]
        assert np.nanmin(np.linalg.norm(result.contact_points[k].numpy() - place, axis=1)) < 2.5
        torch.testing.assert_close(
            result.force[k], (result.traction[k] * reconstructor.estimator.membrane.rest_area[:, None]).sum(0)
        )
    assert np.median(errors) < 0.15 and max(errors) < 0.3, errors


def test_the_loss_of_normal_tractions_has_the_derivative_that_the_weights_say():
    estimator = make()
    membrane, p0 = estimator.membrane, estimator.reference
    loss = TractionLoss(membrane, p0, replace(SETTINGS, floor=1e-12), FRICTION)
    loss.push_noise = torch.full_like(loss.area, 1e6)  # tractions over p0
    loss.surroundings = torch.eye(len(loss.area), dtype=torch.float64)
    normal = inner(membrane.rest_normals, membrane.grid).mT[None]
    level = p0 * torch.linspace(-1.5, 0.5, normal.shape[-1], dtype=torch.float64)
    traction = (level * normal).requires_grad_()
    (gradient,) = torch.autograd.grad(sum(loss(traction, normal, ONE)[2:]).sum(), traction)
    force = traction.detach() * loss.area
    expected = loss.area * (loss.weights(normal, force, ONE, SETTINGS.tau[1] * ONE) * force[:, None]).sum(2)
    torch.testing.assert_close((gradient * normal).sum(1), (expected * normal).sum(1), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("far", [3, 300])
def test_a_slack_sheet_at_rest_is_explained_in_single_precision(far):
    """Near the camera and far from it; markers a hundredth of their noise off."""
    dome = spherical_cap(12, 9, far, (33, 33))
    elasticity, positions = ElasticEnergy(dome, "neo_hookean", 1.004), dots(spherical_cap(12, 9, far, (65, 65)))
    noise = 0.1 / 168
    estimator = ForceBalance(dome, elasticity, dome.closest_points(positions.numpy()), positions, noise).float()
    off = 0.01 * noise * torch.randn(positions.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rays = torch.nn.functional.normalize(torch.nn.functional.normalize(positions, dim=-1) + off, dim=-1)[None].float()
    with torch.no_grad():
        found = estimator(seen(torch.zeros_like(rays), rays))
    assert estimator.is_explained(found).item() and found.objective.item() < 0.1


def test_the_objective_is_the_misfit_of_the_markers_and_the_loss_of_the_tractions(pressed):
    (origins, directions), *_ = pressed
    estimator = make()
    observation = seen(origins, directions)
    found, rest = estimator(observation), estimator.at_rest(observation.confidence)
    bearings, gauss_newton = estimator.equations.bearings, estimator.gauss_newton
    measured = bearings.measured(observation)
    misfit = bearings.angles(found.vertices - estimator.membrane.rest, measured, found.moved)[0].square().sum(1)
    expected = Cauchy(SETTINGS.outlier).loss(misfit).sum(1)
    state = State(found.vertices - estimator.membrane.rest, found.pressure, found.moved)
    traction, normal = gauss_newton.tractions(*state[:2])
    terms = estimator.equations.loss(traction, normal, measured.noise_level)
    assert (terms.others > 0).all() and (terms.pushes > 0).all()
    torch.testing.assert_close(found.objective * measured.weight.sum(-1), expected + terms.others + terms.pushes)
    assert (found.objective < estimator.equilibrium(*rest, rest.u, measured).objective).all()
