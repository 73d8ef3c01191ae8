"""Simulated presses obey closed forms, force balance and friction."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.simulate import equilibrium as equilibrium_module
from torchmembrane.simulate.equilibrium import EquilibriumProblem, Liquid, Open
from torchmembrane.simulate.frictional_contact import FrictionalContact
from torchmembrane.simulate.indenters import Plane, Sphere, facing
from torchmembrane.simulate.quasi_static import carried, press, presses
from torchmembrane.solve.stencil import ONE_RING, apply_stencil, inner, one_ring_edges
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import half_cylinder, heightfield, spherical_cap
from torchmembrane.surface.topology import corners, triangles_of

PRESTRETCH = 1.3
GRIDS = (9, 17, 33)


def elasticity_of(membrane, prestretch=PRESTRETCH, **material):
    return ElasticEnergy(membrane, "neo_hookean", prestretch, **material)


def errors_fall_quadratically(errors, within):
    """Second order over grids that double twice, the last one `within` of the truth."""
    errors = np.abs(errors)
    assert errors[-1] < within
    rate = np.log2(errors[:-1] / errors[1:])
    assert (rate > 1.6).all() and (rate < 2.6).all(), rate


@pytest.fixture(scope="module")
def dome():
    return spherical_cap(12, 9, 3, (17, 17))


def tip(membrane, direction=(0, 0, -1.0), radius=4.0):
    return Sphere(radius).touching(membrane, direction)


@pytest.mark.parametrize(
    ("make", "curvature"),
    [(lambda n: spherical_cap(12, 9, 15, (n, n)), 2 / 12.5), (lambda n: half_cylinder(10, 40, 80, 3, (n, n)), 1 / 10)],
)
def test_liquid_pressure_is_tension_times_curvature(make, curvature):
    """Laplace's law p = 2 T / R, T / R for the equilibrium at the rest volume, without the rest load."""
    errors = []
    for n in GRIDS:
        membrane = make(n)
        elasticity = elasticity_of(membrane)
        solution = EquilibriumProblem(membrane, elasticity, Liquid(float(membrane.rest_volume))).solve(membrane.rest, 0.1)
        errors.append(solution.pressure / float(elasticity.tension * curvature) - 1)
    errors_fall_quadratically(errors, 0.01)


def test_inflated_sphere_follows_its_pressure_curve():
    """A cap about the sphere's centre, its rim moved with the sphere: p = 2 mu (l^2 - 1 / (l^4 s^6)) / (s R), s = 1 ... 1.5."""
    stretches, errors = np.linspace(1, 1.5, 6), []
    exact = 2 * (PRESTRETCH**2 - 1 / (PRESTRETCH**4 * stretches**6)) / (stretches * 12.5)
    for n in GRIDS:
        cap = spherical_cap(12, 9, 12.5 - 9, (n, n))
        x, pressure, curve = cap.rest, exact[0], []
        for s in stretches:
            x = torch.where(cap.fixed[:, None], s * cap.rest, x)
            inflated = EquilibriumProblem(cap, elasticity_of(cap), Liquid(s**3 * float(cap.rest_volume)))
            x, pressure, *_ = inflated.solve(x, pressure)
            curve.append(pressure)
        errors.append(np.abs(curve / exact - 1).max())
    errors_fall_quadratically(errors, 0.01)


def test_flat_square_bulges_like_the_fourier_series():
    """T laplace w = -p on a square: w = sum of 16 p a^2 / (pi^4 T) sin sin / (i j (i^2 + j^2)) over odd i, j."""
    side, pressure, errors = 20.0, 1e-4, []
    odd = np.arange(1, 400, 2)
    sign = np.sin(odd * np.pi / 2) / odd
    series = 16 * side**2 / np.pi**4 * (sign[:, None] * sign / (odd[:, None] ** 2 + odd**2)).sum()
    for n in GRIDS:
        along = np.linspace(-side / 2, side / 2, n)
        flat = heightfield(along, along, np.full((n, n), 10.0))
        elasticity = elasticity_of(flat)
        x = EquilibriumProblem(flat, elasticity, Open()).solve(flat.rest, pressure).vertices
        middle = float(x[n * n // 2, 2]) - 10
        errors.append(middle * float(elasticity.tension) / (pressure * series) - 1)
    errors_fall_quadratically(errors, 0.002)


def test_volume_ring_is_the_gradient_and_its_autograd(dome):
    m, n = dome.grid
    edges, chords = apply_stencil(dome.rest, one_ring_edges(), dome.grid, border=False).chunk(2, -1)
    blocks = dome.volume_one_ring(chords)
    gradient = torch.einsum("abin,bin->an", blocks, edges.unflatten(-1, (6, -1))) / 2
    torch.testing.assert_close(gradient.mT, inner(dome.volume_gradient(dome.rest), dome.grid))
    slope = torch.autograd.functional.jacobian(dome.volume_gradient, dome.rest).transpose(1, 2)
    i, j = 3, 4
    for (di, dj), block in zip(ONE_RING, blocks[..., (i - 1) * (n - 2) + j - 1].unbind(-1), strict=True):
        torch.testing.assert_close(block, slope[i * n + j, (i + di) * n + j + dj])
    assert slope[i * n + j, i * n + j].abs().max() < 1e-12


def test_volume_hessian_blocks_are_autograd_of_the_volume(dome):
    p = triangles_of(corners(dome.rest, dome.grid))[3, 4, 1]
    volume = lambda p: dome.outward / 6 * torch.linalg.det(p)  # noqa: E731
    hessian = torch.autograd.functional.hessian(volume, p).reshape(9, 9)
    torch.testing.assert_close(dome.volume_hessian_blocks(dome.rest)[3, 4, 1], hessian)


def test_without_contact_the_rest_surface_stays(dome):
    far = tip(dome).moved((0, 0, 5.0))
    state = press(dome, elasticity_of(dome), [[far]])
    torch.testing.assert_close(state.vertices, dome.rest, rtol=0, atol=1e-9)
    assert not state.contact.any() and state.force.norm() == 0 and state.contact_points.isnan().all()
    assert state.pressure == pytest.approx(state.rest_pressure)


@pytest.fixture(scope="module")
def slid(dome):
    """A ball pressed in and slid along with friction, some of its contact sticking, some slipping."""
    start = tip(dome, (0.3, 0.1, -1))
    down = start.moved((0.6, 0.2, -2.0))
    end = down.moved((0.5, -0.5, 0))
    return end, press(dome, elasticity_of(dome), [[start, down, end]], friction=0.4)


def test_forces_balance_and_the_liquid_keeps_its_volume(dome, slid):
    """Contact + pressure on the lumped areas + rim + rest load = 0."""
    _, state = slid
    elasticity = elasticity_of(dome)
    areas = torch.zeros_like(dome.rest).index_add(
        0, dome.triangles.ravel(), dome.area_vectors(state.vertices).reshape(-1, 3).repeat_interleave(3, 0) / 3
    )
    _, load = rest_balance(dome, elasticity)
    total = state.force + state.pressure * areas.sum(0) + load.sum(0) + state.rim_reaction
    assert total.norm() < 1e-6 * state.force.norm() and state.imbalance < 1e-8
    assert abs(state.volume_error) < 1e-9
    torch.testing.assert_close((state.traction * dome.vertex_area(state.vertices)[:, None]).sum(0), state.force)


def test_a_contact_s_point_is_the_centroid_of_its_normal_forces(dome):
    """Without friction nodal forces are normal ones; here their centroid is 0.1 off the mean of the vertices that touch."""
    ball = tip(dome, (0.3, 0, -1.0))
    state = press(dome, elasticity_of(dome), [[ball, ball.moved((0.3, 0, -1.0))]])
    force = state.traction.norm(dim=-1) * dome.vertex_area(state.vertices)
    centroid = force @ state.vertices / force.sum()
    torch.testing.assert_close(state.contact_points[0], centroid)
    assert (centroid - state.vertices[state.contact].mean(0)).norm() > 0.01


def test_nothing_penetrates_and_friction_stays_in_its_cone(dome, slid):
    ball, state = slid
    assert state.penetration < 1e-6
    normals = ball.normal(state.vertices).detach()[state.contact]
    traction = state.traction[state.contact]
    normal = (traction * normals).sum(-1)
    tangential = (traction - normal[:, None] * normals).norm(dim=-1)
    assert (normal > 0).all() and (tangential <= 0.4 * normal * (1 + 1e-9)).all()
    slipping = tangential > 0.4 * normal * (1 - 1e-9)
    assert slipping.any() and not slipping.all()


def test_a_plate_that_slides_far_drags_with_mu_times_its_force(dome):
    plate = Plane(rotation=facing((0, 0, -1))).touching(dome, (0, 0, -1))
    down = plate.moved((0, 0, -1.5))
    *_, state = presses(dome, elasticity_of(dome), [[plate, down, down.moved((3.0, 0, 0))]], friction=0.2)
    assert float(state.force[0]) == pytest.approx(-0.2 * float(state.force[2]), rel=1e-3)
    assert abs(float(state.force[1])) < 1e-3 * float(state.force[0])


def test_what_sticks_moves_with_the_indenter(dome):
    start = tip(dome)
    down = start.moved((0, 0, -2.0))
    pushed, dragged = presses(dome, elasticity_of(dome), [[down, down.moved((0.3, 0, 0))]], friction=50.0)
    stuck = pushed.contact & dragged.contact
    moved = (dragged.vertices - pushed.vertices)[stuck]
    assert stuck.sum() > 3
    torch.testing.assert_close(moved, torch.tensor([0.3, 0, 0]).double().expand_as(moved), rtol=0, atol=1e-6)


def test_without_friction_only_the_end_of_the_path_counts_and_release_forgets(dome):
    start = tip(dome, (0.3, 0.1, -1))
    end = start.moved((0.4, 0.5, -2.0))
    elasticity = elasticity_of(dome)
    straight = press(dome, elasticity, [[start, end]])
    *_, detour, released = presses(dome, elasticity, [[start, start.moved((-1.0, 0, -2.5)), end, start.moved((0, 0, 1.0))]])
    torch.testing.assert_close(detour.vertices, straight.vertices, rtol=0, atol=1e-6)
    torch.testing.assert_close(released.vertices, dome.rest, rtol=0, atol=1e-6)


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_the_work_of_the_indenter_is_the_energy_stored_and_what_friction_takes(dome, friction):
    """A press and a slide of 3 mm, in which friction takes mu N times the slide; the liquid does no work."""
    elasticity, start = elasticity_of(dome), tip(dome)
    _, load = rest_balance(dome, elasticity)
    offsets = np.zeros((61, 3))
    offsets[:31, 2], offsets[31:, 2], offsets[31:, 0] = -np.linspace(0, 2, 31), -2, np.linspace(0, 3, 31)[1:]
    states = list(presses(dome, elasticity, [[start.moved(offset) for offset in offsets]], friction=friction))
    force = np.stack([state.force.numpy() for state in states])
    work = ((force[1:] + force[:-1]) / 2 * np.diff(offsets, axis=0)).sum()
    last = states[-1].vertices
    stored = float(elasticity.energy(last) - elasticity.energy(dome.rest) - (load * (last - dome.rest)).sum())
    pushes = [(s.traction.norm(dim=-1) * dome.vertex_area(s.vertices)).sum() for s in states[31:]]
    taken = friction / (1 + friction**2) ** 0.5 * 3 * float(sum(pushes)) / len(pushes)
    assert work - stored == pytest.approx(taken, rel=0.03, abs=5e-3 * stored)


def test_turning_everything_turns_the_answer(dome):
    turn = facing((0.2, -0.1, 1.0)) @ facing((0, 1.0, 0.05)).T @ facing((0, 0.9, 0.1))
    turned = Membrane((dome.rest @ turn.T).reshape(17, 17, 3))
    ball = tip(dome, (0.4, 0, -1)).moved((0.6, 0, -1.5))
    one = press(dome, elasticity_of(dome), [[ball]])
    other = press(turned, elasticity_of(turned), [[ball.at(turn @ ball.translation)]])
    torch.testing.assert_close(other.vertices, one.vertices @ turn.T, rtol=0, atol=1e-8)
    torch.testing.assert_close(other.force, turn @ one.force, rtol=0, atol=1e-7)


def test_scaling_lengths_and_modulus_scales_forces(dome):
    large = Membrane(2 * dome.rest.reshape(17, 17, 3))
    ball, large_ball = tip(dome).moved((0, 0, -2.0)), tip(large, radius=8.0).moved((0, 0, -4.0))
    one = press(dome, elasticity_of(dome), [[ball]])
    other = press(large, elasticity_of(large, modulus=3.0), [[large_ball]])
    torch.testing.assert_close(other.vertices, 2 * one.vertices, rtol=0, atol=1e-7)
    torch.testing.assert_close(other.force, 6 * one.force)
    assert other.pressure == pytest.approx(1.5 * one.pressure)


def test_a_gas_yields_by_its_law_between_liquid_and_open(dome):
    path, elasticity = [[tip(dome), tip(dome).moved((0, 0, -2.0))]], elasticity_of(dome)
    absolute, volume = 1.0, 3000.0
    liquid = press(dome, elasticity, path)
    gas = press(dome, elasticity, path, filling="gas", gas=(absolute, volume))
    free = press(dome, elasticity, path, filling="open")
    rise = gas.volume_error * float(dome.rest_volume)
    assert (absolute + gas.pressure - gas.rest_pressure) * (volume + rise) == pytest.approx(absolute * volume, rel=1e-9)
    assert free.pressure == pytest.approx(free.rest_pressure) and free.volume_error < gas.volume_error < 0
    assert -liquid.force[2] > -gas.force[2] > -free.force[2] > 0


def test_two_indenters_have_their_own_forces(dome):
    left, right = tip(dome, (0.5, 0, -1)), tip(dome, (-0.5, 0, -1))
    left, right = left.moved((0.6, 0, -1.2)), right.moved((-0.6, 0, -1.2))
    state = press(dome, elasticity_of(dome), [[left], [right]])
    torch.testing.assert_close(state.forces.sum(0), state.force)
    mirror = torch.tensor([-1.0, 1, 1]).double()
    torch.testing.assert_close(state.forces[0], mirror * state.forces[1], rtol=0.02, atol=0.02)
    assert state.contact_points[0, 0] < -1 and state.contact_points[1, 0] > 1


def test_a_small_ball_does_not_slip_through_in_one_long_step():
    dome = spherical_cap(12, 9, 3, (25, 25))
    ball = tip(dome, radius=1.0)
    state = press(dome, elasticity_of(dome), [[ball, ball.moved((0, 0, -3.0))]], increment=3.0)
    assert float(state.vertices[312, 2]) == pytest.approx(12 - 3.0, abs=1e-6)


@pytest.mark.parametrize(("model", "prestretch"), [("mooney_rivlin", 1.3), ("neo_hookean", 1.05), ("harmonic", 1.3)])
def test_every_material_can_be_pressed(dome, model, prestretch):
    elasticity = ElasticEnergy(dome, model, prestretch, c2_ratio=0.2)
    state = press(dome, elasticity, [[tip(dome), tip(dome).moved((0.3, 0, -2.5))]], friction=0.3)
    assert state.force[2] < 0 and state.pressure > state.rest_pressure and state.imbalance < 1e-8


def test_carried_points_move_with_the_surface(dome):
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    corner = dome.triangles[torch.arange(20) * 12]
    weights = weights / weights.sum(1, keepdim=True)
    at = lambda x: (weights[..., None] * x[corner]).sum(1)  # noqa: E731
    x = dome.rest + torch.randn(3, *dome.rest.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(carried(dome.rest, dome, at(dome.rest)), at(dome.rest))
    torch.testing.assert_close(carried(x, dome, at(dome.rest)), torch.stack([at(y) for y in x]))


@pytest.mark.parametrize(("limit", "value"), [("NEWTON_STEPS", 2), ("HALVINGS", 0)])
def test_an_unconverged_state_is_never_given(dome, monkeypatch, limit, value):
    monkeypatch.setattr(equilibrium_module, limit, value)
    with pytest.raises(MembraneError, match="press: no equilibrium .* in steps down to"):
        press(dome, elasticity_of(dome), [[tip(dome), tip(dome).moved((0, 0, -3.0))]])


def test_wrong_arguments_are_refused(dome):
    elasticity, ball = elasticity_of(dome), tip(dome)
    for paths, options, message in (
        ([[ball], [ball, ball]], {}, "paths of"),
        ([], {}, "paths of"),
        ([[ball]], dict(friction=-0.1), "friction = -0.1"),
        ([[ball]], dict(filling="gas"), "gas = None"),
        ([[ball]], dict(filling="water"), "water"),
    ):
        with pytest.raises(MembraneError, match=message):
            press(dome, elasticity, paths, **options)


def test_a_vertex_is_carried_from_where_the_body_meets_it():
    """A plate moved by 1.5 down and 0.6 sideways: one vertex it meets at two thirds, one it holds, one it never meets."""
    plate, travel = Plane(rotation=facing((0, 0, -1.0)), translation=(0, 0, 1.0)), torch.tensor([0.6, 0.0, -1.5]).double()
    x = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 1.0], [4.0, 0.0, -3.0]], dtype=torch.float64)
    contact = FrictionalContact.at_first_pose(plate, x, 1.0, 0.3)
    contact = contact._replace(normal=torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64))
    carried_by = contact.carried_to(plate.moved(travel), x).anchor - x
    torch.testing.assert_close(carried_by, torch.tensor([[1 / 3], [1.0], [0.0]]).double() * travel)


def test_a_body_that_turns_goes_by_increments_of_what_its_farthest_points_travel(dome, monkeypatch):
    """A ball turned by half a radian on the spot, with steps of a tenth of the surface's size."""
    solve, turns = EquilibriumProblem.solve, []

    def watched(problem, x, pressure, contacts=()):
        turns.append(contacts[0].indenter.rotation)
        return solve(problem, x, pressure, contacts)

    monkeypatch.setattr(EquilibriumProblem, "solve", watched)
    ball, c, s = tip(dome).moved((0, 0, -0.3)), np.cos(0.5), np.sin(0.5)
    turned = ball.at(ball.translation, torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64))
    press(dome, elasticity_of(dome), [[ball, turned]], increment=0.1 * dome.size)
    steps = [float(((before.T @ after).trace() - 1).div(2).clamp(-1, 1).acos()) for before, after in pairwise(turns)]
    assert max(steps) < 0.1 + 1e-6 and sum(steps) == pytest.approx(0.5, abs=1e-6)
