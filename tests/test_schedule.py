"""Every frame lowers the losses' scale at its own speed till it settles."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.force_balance import schedule
from torchmembrane.estimators.force_balance.estimator import LOSS_OF_NOISE, ForceBalance
from torchmembrane.estimators.force_balance.gauss_newton import State
from torchmembrane.estimators.force_balance.robust import Cauchy
from torchmembrane.estimators.force_balance.schedule import (
    FIRM,
    LIGHT,
    RATE,
    RELAXATION,
    SETTLING_STEPS,
    STILL,
    falling,
    outlier_scale,
    scaled_step,
    settling_of,
    share_of_next,
)
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.traction_loss import WIDER
from torchmembrane.machine_code import using
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.sensor.parts import FRICTION
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import spherical_cap

SETTINGS = ForceBalanceSettings()
DOME = spherical_cap(12, 9, 3, (17, 17))


def estimator(dome: Membrane = DOME, friction: float = FRICTION, **changes) -> ForceBalance:
    positions = spherical_cap(12, 9, 3, (13, 13)).rest[~spherical_cap(12, 9, 3, (13, 13)).fixed]
    material = ElasticEnergy(dome, "neo_hookean", 1.3)
    markers = dome.closest_points(positions.numpy())
    given = dome, material, markers, positions
    return ForceBalance(*given, noise=1e-3, settings=replace(SETTINGS, **changes), friction=friction)


def seen(positions: torch.Tensor) -> Observation:
    directions = torch.nn.functional.normalize(positions, dim=-1)
    return Observation(torch.zeros_like(directions), directions, torch.ones_like(directions[..., 0]))


@pytest.fixture(scope="module")
def dented() -> Observation:
    """Two frames: at rest, and markers drawn to one side by up to a twentieth of the dome's size."""
    rest = estimator().equations.bearings.positions
    drawn = 0.05 * DOME.size * torch.exp(-((rest - rest[30]) ** 2).sum(-1) / 150)
    return seen(torch.stack([rest, rest + drawn[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=rest.dtype)]))


def edges(x: torch.Tensor, membrane: Membrane) -> torch.Tensor:
    grid = x.unflatten(1, membrane.grid)
    return torch.cat([grid.diff(dim=axis).flatten(1, 2) for axis in (1, 2)], 1)


@pytest.mark.parametrize("tau", SETTINGS.tau)
def test_a_step_changes_no_edge_by_more_than_its_share(dented, tau):
    one = estimator()
    measured = one.equations.bearings.measured(dented)
    x = one.membrane.rest + 0.3 * torch.randn(
        2, *one.membrane.rest.shape, generator=torch.Generator().manual_seed(0)
    ).double() * (~one.membrane.fixed[:, None])
    start = State(x - one.membrane.rest, *one.at_rest(measured.weight)[1:])
    tau = torch.full((2,), tau).double()
    after = one.gauss_newton.step(start, measured, tau, torch.ones_like(tau))
    before, now = edges(x, DOME), edges(one.membrane.rest + after.u, DOME)
    share = ((now - before).norm(dim=-1) / before.norm(dim=-1)).amax(-1)
    assert (share < schedule.LARGEST_STRETCH * (1 + 1e-6)).all() and (share > 0.01).all()


def test_the_scale_falls_slowly_while_the_surface_moves_and_fast_where_it_stands_still():
    moved = torch.tensor([1.0, STILL, STILL / 9]).double()
    torch.testing.assert_close(falling(moved), torch.tensor([RATE, RATE**2, RATE**10]).double(), rtol=1e-3, atol=0)
    assert [falling(value) for value in moved.tolist()] == pytest.approx(falling(moved).tolist(), rel=1e-12)
    assert [settling_of(steps) for steps in (1, 2, 9, 16, 64)] == [0, 1, 4, SETTLING_STEPS, SETTLING_STEPS]


def test_less_and_less_of_a_step_is_taken_as_the_one_before_approaches_the_length_that_settles():
    """All of it after one of twice this length, nothing after one of this length."""
    tol = SETTINGS.settled_step_tol
    moved = tol * torch.tensor([2.0, 1.5, 1.0]).double()
    torch.testing.assert_close(share_of_next(moved, tol), torch.tensor([1.0, 0.5, 0.0]).double())
    assert [share_of_next(value, tol) for value in moved.tolist()] == pytest.approx([1.0, 0.5, 0.0])


def test_steps_of_a_light_touch_count_in_proportion_to_its_displacement():
    moved, displacement = torch.tensor([1e-3, 1e-3, 1e-3, 1e-3]).double(), torch.tensor([0.0, LIGHT, FIRM, 1e6]).double()
    ratio = FIRM / LIGHT
    law = torch.tensor([ratio, ((1 + ratio**2) / 2) ** 0.5, (2 / (1 + ratio**-2)) ** 0.5, 1.0]).double()
    torch.testing.assert_close(scaled_step(moved, displacement), 1e-3 * law)
    pairs = zip(moved.tolist(), displacement.tolist(), strict=True)
    assert [scaled_step(*pair) for pair in pairs] == pytest.approx((1e-3 * law).tolist())


@pytest.fixture
def taus(monkeypatch):
    """Scales and shares of every step, as lists over the frames that take it; by tensor operations."""
    one, taken = estimator(), []
    step = one.gauss_newton.step

    def watched(state, measured, tau, share):
        after = step(state, measured, tau, share)
        moved, far = ((field.square().sum(-1).mean(-1).sqrt() / one.size).tolist() for field in (after.u - state.u, after.u))
        scaled = [
            by * ((displacement**2 + FIRM**2) / (displacement**2 + LIGHT**2)) ** 0.5
            for by, displacement in zip(moved, far, strict=True)
        ]
        taken.append((tau.tolist(), share.tolist(), scaled))
        return after

    monkeypatch.setattr(one.gauss_newton, "step", watched)
    monkeypatch.setattr("torchmembrane.estimators.force_balance.gauss_newton.GaussNewton._nested_step", GaussStep(watched))
    return one, taken


class GaussStep:
    """A step in place of the region that `torch.compile` compiles once."""

    def __init__(self, step):
        self.step = step

    def __call__(self, *given):
        return tuple(self.step(*given))


def test_each_frame_lowers_its_scale_by_how_far_it_has_moved_and_stops_when_it_has_settled(dented, taus):
    """The frame at rest is through when the other still moves; the last scale is not undercut."""
    one, taken = taus
    measured = one.equations.bearings.measured(dented)
    with torch.no_grad(), using(False):
        one.gauss_newton(one.at_rest(measured.weight), measured, 4.0, 64)
    both = [step for step in taken if len(step[0]) == 2]
    assert 1 < len(both) < len(taken) < 56 and all(len(step[0]) == 1 for step in taken[len(both) :])
    tau, share = {0: 4.0, 1: 4.0}, {0: 1.0, 1: 1.0}
    for scales, shares, moved in taken:
        for frame, scale, part, by in zip(range(2) if len(scales) == 2 else [1], scales, shares, moved, strict=True):
            assert (scale, part) == pytest.approx((tau[frame], share[frame]))
            tau[frame] = max(SETTINGS.tau[1], scale * falling(max(by, 1e-9)))
            share[frame] = 1.0 if scale > SETTINGS.tau[1] else min(1.0, by / SETTINGS.settled_step_tol - 1)
    assert min(taken[-1][1]) < 1
    last = both[-1][2][0], taken[-1][2][0]
    assert max(last) <= SETTINGS.settled_step_tol < taken[-2][2][0]
    assert tau == {0: SETTINGS.tau[1], 1: SETTINGS.tau[1]}


def test_a_frame_of_a_batch_is_that_frame_alone(dented):
    """By tensor operations, however many steps the others take."""
    one = estimator()
    measured = one.equations.bearings.measured(dented)
    alone = type(measured)(*(None if value is None else value[1:] for value in measured))
    with torch.no_grad(), using(False):
        both, _ = one.gauss_newton(one.at_rest(measured.weight), measured, 4.0, 64)
        single, _ = one.gauss_newton(one.at_rest(alone.weight), alone, 4.0, 64)
    torch.testing.assert_close(both.u[1:], single.u, rtol=0, atol=1e-9 * one.size)


def test_a_frame_that_breaks_down_takes_no_further_steps(dented, taus):
    one, taken = taus
    broken = dented._replace(directions=torch.where(torch.tensor([True, False])[:, None, None], torch.nan, dented.directions))
    measured = one.equations.bearings.measured(broken)
    with torch.no_grad(), using(False):
        state, _ = one.gauss_newton(one.at_rest(measured.weight), measured, 4.0, 64)
    assert len([step for step in taken if len(step[0]) == 2]) <= 2
    assert state.u[0].isnan().any() and state.u[1].isfinite().all()


def test_frames_that_have_not_settled_take_relaxed_steps_at_the_last_scale(dented, taus):
    """The last four of eight steps; the frame at rest has settled before."""
    one, taken = taus
    measured = one.equations.bearings.measured(dented)
    with torch.no_grad(), using(False):
        one.gauss_newton(one.at_rest(measured.weight), measured, 0.5, 8)
    whole, relaxed = taken[: 8 - settling_of(8)], taken[8 - settling_of(8) :]
    assert all(max(shares) == 1 for _, shares, _ in whole) and relaxed[0][1] == [RELAXATION]
    assert all(scales == [SETTINGS.tau[1]] for scales, _, _ in relaxed)
    for (_, _, moved), (_, shares, _) in pairwise(relaxed):
        assert shares == pytest.approx([min(RELAXATION, share_of_next(moved[0], SETTINGS.settled_step_tol))])


@pytest.mark.parametrize("native", [False, True])
def test_the_answer_does_not_jump_where_rounding_decides_whether_a_frame_has_settled(dented, native):
    """The length that settles is just above or just below that of a step: one more step then, of almost no length."""
    measured = estimator().equations.bearings.measured(dented)

    def solved(tol: float) -> tuple[torch.Tensor, torch.Tensor, float]:
        one = estimator(settled_step_tol=tol)
        with torch.no_grad(), using(native):
            state, before = one.gauss_newton(one.at_rest(measured.weight), measured, SETTINGS.tau[1], 64)
        moved, far = ((field[1].square().sum(-1).mean(-1).sqrt() / one.size).item() for field in (state.u - before, state.u))
        return state.u[1], before[1], scaled_step(moved, far)

    first = solved(1e3)[2]
    second, at_first, length = solved(first / 2)
    torch.testing.assert_close(at_first, solved(1e3)[0])
    above, below = solved(length * (1 + 1e-6)), solved(length * (1 - 1e-6))
    torch.testing.assert_close(above[0], second)
    torch.testing.assert_close(below[1], second)
    assert 0 < (below[0] - second).norm() < 1e-5 * (second - at_first).norm()


def test_a_share_of_a_step_is_that_share_of_every_unknown(dented):
    one = estimator()
    measured = one.equations.bearings.measured(dented)
    start, tau = one.at_rest(measured.weight), torch.full((2,), 4.0).double()
    whole, half = (one.gauss_newton.step(start, measured, tau, torch.full_like(tau, share)) for share in (1.0, 0.5))
    for before, after, part in zip(start, whole, half, strict=True):
        torch.testing.assert_close(part, (before + after) / 2)


def test_relaxed_steps_end_where_whole_steps_go_to_and_fro(dented, monkeypatch):
    """Steps to the other side of a state are made of those to it: only half of them reach it."""
    one = estimator(settled_step_tol=1e-9)
    measured = one.equations.bearings.measured(dented)
    step, rest = one.gauss_newton.step, one.at_rest(measured.weight)
    goal = step(rest, measured, *(torch.full((2,), value).double() for value in (SETTINGS.tau[1], 1.0)))
    there = goal.u.clone()

    def across(state, measured, tau, share):
        return State(state.u + 2 * share[:, None, None] * (there[-len(state.u) :] - state.u), state.pressure, state.moved)

    monkeypatch.setattr(one.gauss_newton, "_compiled_step", across)
    with torch.no_grad(), using(False):
        whole, _ = one.gauss_newton(rest, measured, SETTINGS.tau[1], 1)
        settled, before = one.gauss_newton(rest, measured, SETTINGS.tau[1], 16)
    torch.testing.assert_close(whole.u, 2 * there)
    torch.testing.assert_close(settled.u, there)


def test_each_grid_begins_with_its_scale_and_number_of_steps(dented, monkeypatch):
    """Of three grids, with 9, 17 and 33 lines; the second takes a step first, which tells where it is to be dented."""
    fine, given = estimator(spherical_cap(12, 9, 3, (33, 33))), []
    for one in (fine, fine.coarse, fine.coarse.coarse):
        steps = one.gauss_newton.forward
        monkeypatch.setattr(
            one.gauss_newton,
            "forward",
            lambda state, measured, tau, count, steps=steps: given.append((tau, count)) or steps(state, measured, tau, count),
        )
    fine._solve_on_grid(fine.equations.bearings.measured(dented))
    coarsest, second, finest = SETTINGS.steps
    first, last = SETTINGS.tau
    assert given == [(first, coarsest), (last, 1), (last, second), (last, finest)]
    assert (fine.dent, fine.coarse.coarse.dent) == (None, None) and fine.coarse.dent is not None


def test_a_coarser_grid_has_settled_with_steps_as_much_longer_as_its_error_is_larger():
    """Half the lines, four times the error; both the tensor operations and the machine code read these settings."""
    one, tol = estimator(spherical_cap(12, 9, 3, (33, 33))), SETTINGS.settled_step_tol
    for factor in (1, 4, 16):
        assert one.gauss_newton.settings.settled_step_tol == one.equations.loss.settings.settled_step_tol == factor * tol
        one = one.coarse
    assert one is None


def test_on_coarser_grids_errors_that_look_like_friction_are_not_forgiven_and_no_markers_lost_to_them():
    """On nine lines that seventeen follow: a quarter of the friction, twice the markers' scale; not on nine alone."""
    fine = estimator(spherical_cap(12, 9, 3, (33, 33)))
    for one, step in ((fine, 1), (fine.coarse, 1), (fine.coarse.coarse, 2), (estimator(spherical_cap(12, 9, 3, (9, 9))), 1)):
        assert one.equations.loss.friction == FRICTION / step**2
        assert one.gauss_newton.settings.outlier == one.equations.loss.settings.outlier == SETTINGS.outlier * step


def test_the_markers_scale_begins_at_twenty_times_its_last_because_tau_begins_at_ten_times():
    first, last = SETTINGS.tau
    assert outlier_scale(SETTINGS.outlier, first / last) == pytest.approx(20 * SETTINGS.outlier, rel=0.01)
    assert outlier_scale(SETTINGS.outlier, 1.0) == SETTINGS.outlier


def test_the_shear_of_a_sliding_contact_costs_as_much_as_its_push():
    """Under a push far above tau, for two coefficients of friction; a push costs at most half the square of tau."""
    for friction in (0.3, 0.8):
        loss = estimator(friction=friction).equations.loss
        push2 = torch.tensor([[1e3]], dtype=torch.float64)
        cost = loss.shear_weight(push2) * loss.shear.loss(push2 * friction**2)
        assert cost.item() == pytest.approx(SETTINGS.tau[1] ** 2 / 2, rel=0.02)


def test_what_is_no_setting_follows_from_the_settings():
    """Shear is linear above an eighth of the last scale of a push; far pushes count for a quarter of near ones."""
    assert SETTINGS.slip == pytest.approx(0.05) and SETTINGS.far_share == pytest.approx(0.05)
    other = ForceBalanceSettings(tau=(8.0, 0.8), scale_share=0.6)
    assert other.slip == pytest.approx(2 * SETTINGS.slip) and other.far_share == pytest.approx(3 * SETTINGS.far_share)


def test_a_solution_has_converged_if_its_last_step_was_short_and_its_volume_is_kept(dented):
    """Just below and just above what is allowed of either, and a volume that is as much too small."""
    one = estimator()
    found = one(dented)
    found = type(found)(*(value[:1].repeat(5, *[1] * (value.ndim - 1)) for value in found))
    step = SETTINGS.convergence_tol * torch.tensor([0.99, 1.01, 0.0, 0.0, 0.0]).double()
    off = SETTINGS.convergence_tol * torch.tensor([0.0, 0.0, 0.99, 1.01, -1.01]).double()
    found = found._replace(relative_step=step, volume=one.membrane.rest_volume * (1 + off))
    assert one.is_converged(found).tolist() == [True, False, True, False, False]


def test_pushes_are_compared_with_the_largest_one_in_a_neighbourhood_twice_as_wide_as_that_of_a_push():
    """Weights of the mean around the vertex in the middle, per area."""
    loss, rest = estimator().equations.loss, DOME.rest[~DOME.fixed]
    middle = len(rest) // 2
    distance2 = (rest - rest[middle]).square().sum(1)
    near = distance2 < (4 * SETTINGS.reach * DOME.size) ** 2
    for weights, reach in ((loss.surroundings, SETTINGS.reach), (loss.wider, WIDER * SETTINGS.reach)):
        share = (weights[:, middle] / loss.area)[near]
        expected = torch.exp(-distance2[near] / (2 * (reach * DOME.size) ** 2))
        torch.testing.assert_close(share / share.max(), expected, rtol=1e-4, atol=1e-6)
    assert WIDER == 2


def test_what_neighbouring_markers_have_in_common_is_a_reason_to_doubt_what_each_has_alone_is_none():
    """Off by 1.2 and 1.5 deviations, all alike, but that what is across a ray turns with it; by 50 alike, of which 10 count;
    every second the other way; each its own way; a quarter alike, the others at rest; that quarter not trusted."""
    one = estimator()
    rest, noise = one.equations.bearings.positions, one.equations.bearings.noise
    ray = torch.nn.functional.normalize(rest, dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0]).to(ray).expand_as(ray)
    across = torch.nn.functional.normalize(torch.linalg.cross(ray, up), dim=-1)
    along = torch.linalg.cross(ray, across)
    row, column = torch.arange(121) // 11, torch.arange(121) % 11
    even, part = 1.0 - 2 * ((row + column) % 2), ((row < 5) & (column < 6)).double()
    own = torch.randn(2, 121, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    alike = torch.stack(
        [torch.full((121,), 1.2), torch.full((121,), 1.5), torch.full((121,), 50.0), 3 * even, 3 * own[0], 9 * part, 9 * part]
    )
    other = torch.zeros(7, 121).double()
    other[4] = 3 * own[1]
    depth = noise * rest.norm(dim=-1, keepdim=True)
    observation = seen(rest + depth * (alike[..., None] * across + other[..., None] * along))
    observation.confidence[6, part > 0] = 0
    measured = one.equations.bearings.measured(observation)
    state = one.at_rest(measured.weight)
    found = one.equilibrium(*state, state.u, measured)
    expected = torch.tensor([1.2, 1.5, SETTINGS.far, 0.0]).double()
    torch.testing.assert_close(found.shared_misfit[:4], expected, rtol=0.06, atol=0)
    assert found.shared_misfit[4] < 1.0 < found.misfit[4]
    assert 9 * 0.8 * (30 / 121) ** 0.5 < found.shared_misfit[5] < 9 * (30 / 121) ** 0.5 and found.shared_misfit[6] < 1e-9
    found = found._replace(unexplained=0 * found.misfit)
    assert one.is_explained(found).tolist() == [True, False, False, True, True, False, True]


def test_pulls_and_neighbours_that_deviate_alike_add_up_but_for_a_rest_image_that_has_aged(dented):
    """A press may have six tenths of what is allowed of either, but not of both; a surface that moves by a two-thousandth of
    its size may have both; none may have more of one than is allowed."""
    one = estimator()
    moved = torch.tensor([0.05, 0.05, 0.05, 5e-4, 5e-4, 5e-4]).double()
    share = torch.tensor([[0.6, 0.3], [0.3, 0.6], [0.6, 0.6], [0.6, 0.6], [1.01, 0.1], [0.1, 1.01]]).double()
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    found = one(dented)
    found = type(found)(*(value[:1].repeat(6, *[1] * (value.ndim - 1)) for value in found))
    found = found._replace(vertices=one.membrane.rest + one.size * moved[:, None, None] * up)
    pulls = share[:, 0] * (LOSS_OF_NOISE + SETTINGS.unexplained_per_displacement * moved)
    alike = share[:, 1] * SETTINGS.largest_shared_misfit
    found = found._replace(unexplained=pulls, shared_misfit=alike)
    assert one.is_explained(found).tolist() == [True, True, False, True, False, False]


def test_noise_alone_leaves_a_loss_of_one_per_marker():
    """While the loss is quadratic; that of large residuals grows more slowly."""
    square = torch.randn(2, 100_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64).square().sum(0)
    assert Cauchy(1e4).loss(square).mean().item() == pytest.approx(LOSS_OF_NOISE, rel=0.01)
    assert 0.7 < Cauchy(SETTINGS.outlier).loss(square).mean() < LOSS_OF_NOISE


def test_a_press_may_leave_more_unexplained_than_a_sensor_at_rest(dented):
    """Just below and just above what a press may leave, and the former of a surface at rest; the model of a grid of half the
    lines errs four times as much, in a sum of squares sixteen times."""
    for one, error in ((estimator(), 1.0), (estimator(spherical_cap(12, 9, 3, (9, 9))), 4.0)):
        found = one(dented)
        moved = (found.vertices[1] - one.membrane.rest).square().sum(-1).mean().sqrt() / one.size
        largest = (LOSS_OF_NOISE + SETTINGS.unexplained_per_displacement * moved) * error**2
        first = type(found)(*(value[1:].repeat(5, *[1] * (value.ndim - 1)) for value in found))
        vertices = first.vertices.clone()
        vertices[2] = one.membrane.rest
        pulls = largest * torch.tensor([0.999, 1.001, 0.999, 0.0, 0.0]).double()
        alike = SETTINGS.largest_shared_misfit * error * torch.tensor([0.0, 0.0, 0.0, 0.999, 1.001]).double()
        first = first._replace(vertices=vertices, unexplained=pulls, shared_misfit=alike)
        assert one.is_explained(first).tolist() == [True, False, False, True, False]


def test_the_objective_of_a_solution_is_over_the_markers_seen(dented):
    one = estimator()
    half = dented._replace(confidence=dented.confidence * (torch.arange(dented.confidence.shape[1]) % 2))
    for observation in (dented, half):
        found, measured, seen = one(observation), one.equations.bearings.measured(observation), observation.confidence.sum(-1)
        state = State(found.vertices - one.membrane.rest, found.pressure, found.moved)
        traction, normal = one.gauss_newton.tractions(*state[:2])
        terms, angles = one.equations.loss(traction, normal, measured.noise_level), one.equations.bearings.angles
        misfit = one.gauss_newton.misfit(angles(state.u, measured, state.moved)[0], state.pressure, measured)
        objective, pushes = misfit + terms.others + terms.pushes, terms.pushes
        torch.testing.assert_close(found.objective, objective / seen)
        torch.testing.assert_close(found.unexplained, (objective - pushes) / seen)
