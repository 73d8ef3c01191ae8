"""A frame that has not settled is solved again and improves."""

from dataclasses import replace

import pytest
import torch

from torchmembrane.control_flow import retry_rows
from torchmembrane.estimators.base import Equilibrium, Observation
from torchmembrane.estimators.force_balance.estimator import SINGLE_GRID_SETTLING_STEPS, ForceBalance
from torchmembrane.estimators.force_balance.gauss_newton import Scales, State
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.traction_loss import NO_CONTACT_SCALE
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import spherical_cap

SETTINGS = ForceBalanceSettings()
DOME = spherical_cap(12, 9, 3, (17, 17))


def estimator(dome: Membrane = DOME, **changes) -> ForceBalance:
    positions = spherical_cap(12, 9, 3, (13, 13)).rest[~spherical_cap(12, 9, 3, (13, 13)).fixed]
    material = ElasticEnergy(dome, "neo_hookean", 1.3)
    markers = dome.closest_points(positions.numpy())
    return ForceBalance(dome, material, markers, positions, noise=1e-3, settings=replace(SETTINGS, **changes))


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
    unweighted = torch.ones(2, len(one.equations.loss.area)).double()
    scales = Scales(*torch.tensor((tau, 50.0, SETTINGS.cone, 1.0, SETTINGS.damping)))
    after = one.gauss_newton.step(start, unweighted, measured, scales)[0]
    before, now = edges(x, DOME), edges(one.membrane.rest + after.u, DOME)
    share = ((now - before).norm(dim=-1) / before.norm(dim=-1)).amax(-1)
    assert (share < SETTINGS.largest_stretch * (1 + 1e-6)).all() and (share > 0.01).all()


def test_frames_that_settle_keep_their_first_solution_others_are_solved_again_from_rest(dented):
    anything = dict(settled_step_tol=1e9, largest_misfit=1e9, largest_relative_step=1e9, largest_volume_error=1e9)
    anything |= dict(
        largest_outlier_share=1.0, largest_unexplained=1e9, likely_objective=(1e9, 1e9, 1e9), largest_shared_misfit=1e9
    )
    kept, again = estimator(**anything), estimator(settled_step_tol=0.0, largest_relative_step=0.0)
    measured = kept.equations.bearings.measured(dented)
    torch.testing.assert_close(kept(dented).vertices, kept._solved(measured).vertices)
    torch.testing.assert_close(again(dented).vertices, again._solved(measured, is_retry=True).vertices)
    assert (kept(dented).vertices - again(dented).vertices)[1].abs().max() > 1e-4


def test_what_broke_down_or_is_unexplained_has_not_settled(dented):
    one = estimator()
    found = one(dented)._replace(relative_step=torch.tensor([0.0, 0.0], dtype=torch.float64), misfit=torch.zeros(2).double())
    found = found._replace(volume=one.cavity.rest_volume.expand(2), pressure=one.rest_pressure.expand(2))
    none = torch.zeros(2).double()
    found = found._replace(objective=none, unexplained=none, shared_misfit=none)
    assert one.is_settled(found).tolist() == [True, True]
    assert one.is_settled(found._replace(misfit=torch.tensor([0.0, 9.0]))).tolist() == [True, False]
    assert one.is_settled(found._replace(relative_step=torch.tensor([torch.nan, 1.5e-3]))).tolist() == [False, False]


def test_a_second_try_that_broke_down_is_not_taken(dented):
    """Four frames: done; not settled, and then settled; moving still; broken down."""
    one = estimator()
    found = one(dented)
    first = type(found)(*(value[:1].repeat(4, *[1] * (value.ndim - 1)) for value in found))
    first = first._replace(relative_step=torch.ones(4).double())
    steps = torch.tensor([0.0, 0.0, 1.5e-3, torch.nan], dtype=torch.float64)
    second = first._replace(vertices=first.vertices + 0.1 * DOME.size, relative_step=steps, objective=0 * steps)
    taken = one.chosen(torch.tensor([True, False, False, False]), first, second)
    assert taken.relative_step.tolist() == [1.0, 0.0, 1.5e-3, 1.0]
    torch.testing.assert_close(taken.vertices, torch.cat([first.vertices[:1], second.vertices[1:3], first.vertices[3:]]))


def test_a_second_try_settles_on_the_grids_that_are_finer_than_its_dents_damped_more(dented, monkeypatch):
    """Of three grids, with 9, 17 and 33 lines."""
    fine, damped = estimator(spherical_cap(12, 9, 3, (33, 33))), []
    for one, settling in ((fine, SETTINGS.settling_steps), (fine.coarse, 0), (fine.coarse.coarse, 0)):
        first, second = one.schedule(), one.schedule(is_retry=True)
        assert len(second) == SETTINGS.retry_steps_factor * len(first) + settling
        assert second[len(second) - settling :] == [second[-1]] * settling
    steps = fine.gauss_newton.forward
    monkeypatch.setattr(fine.gauss_newton, "forward", lambda *given, damping, **_: damped.append(damping) or steps(*given))
    for is_retry in (False, True):
        fine._solve_on_grid(fine.equations.bearings.measured(dented), is_retry)
    assert damped == [SETTINGS.settling_damping, SETTINGS.retry_damping] and damped[1] > damped[0]


def test_coarser_grids_lose_fewer_markers():
    """Of three grids; the markers' scale begins at twenty times its last, as tau begins at ten times."""
    fine = estimator(spherical_cap(12, 9, 3, (33, 33)))
    for one, last in (
        (fine, SETTINGS.outlier),
        (fine.coarse, SETTINGS.coarse_outlier),
        (fine.coarse.coarse, SETTINGS.coarse_outlier),
    ):
        assert one.gauss_newton.settings.outlier == last < 2.1 * SETTINGS.outlier
        assert [one.schedule(is_retry)[-1] for is_retry in (False, True)] == 2 * [(0.4, last)]
    assert fine.coarse.coarse.schedule()[0] == (4.0, pytest.approx(20 * SETTINGS.coarse_outlier, rel=0.01))


def test_normal_weights_are_the_geometric_mean_with_those_of_the_step_before(dented):
    one = estimator()
    loss, measured = one.equations.loss, one.equations.bearings.measured(dented)
    at = one.equations.forces.linearised(one.membrane.rest[None] * 0.01, one.rest_pressure[None])
    _, own = loss.weights(at.normal, at.force, measured.noise_level[:1], 0.4)
    before = torch.linspace(1e-3, 1.0, own.shape[1]).double()[None]
    for renewal, expected in ((1.0, own), (0.5, (own * before).sqrt()), (0.0, before)):
        W, w_n = loss.weights(at.normal, at.force, measured.noise_level[:1], 0.4, memory=(before, renewal))
        torch.testing.assert_close(w_n, expected)
        scale = SETTINGS.sparsity / (one.reference * one.size) ** 2 / loss.area
        along = (at.normal[:, :, None] * W * at.normal[:, None]).sum((1, 2))
        rho2 = loss.scale2(loss.parts(at.force / loss.area, at.normal)[2], measured.noise_level[:1], 0.4)
        torch.testing.assert_close(along, scale * expected / rho2)


def test_weights_are_remembered_while_the_losses_stay_and_the_last_steps_are_damped():
    """With `tau` declining all are new; a step alone is neither."""
    gauss_newton, kept = estimator().gauss_newton, SETTINGS.renewal
    taus = [4.0, 1.6, 0.4, 0.4, 0.4]
    steps = [gauss_newton._numbers(taus[: k + 1], (k >= 3) * SETTINGS.settling_damping) for k in range(5)]
    assert [renewal for renewal, _ in steps] == [1.0, 1.0, 1.0, kept, kept]
    least = [SETTINGS.damping * (tau / 0.4) ** 2 for tau in taus[:3]]
    assert [damping for _, damping in steps] == pytest.approx([*least, *2 * [SETTINGS.settling_damping]])
    assert kept < 1 and gauss_newton._numbers([0.4], 1.0) == (1.0, SETTINGS.damping)
    several, alone = estimator(spherical_cap(12, 9, 3, (17, 17))), estimator(spherical_cap(12, 9, 3, (9, 9)))
    assert (several.settling, several.coarse.settling, alone.settling) == (1, 1, SINGLE_GRID_SETTLING_STEPS)


def test_of_the_steps_that_settle_the_likeliest_state_is_kept(dented, monkeypatch):
    """Two frames; of the last four of nine steps, one of which breaks down. Where one settles, the last: none is judged."""
    one, judged = estimator(), []
    likely = iter(torch.tensor([[3.0, 1.0], [2.0, 2.0], [torch.nan, 3.0], [4.0, 4.0]]).double())
    monkeypatch.setattr(one.gauss_newton, "objective", lambda state, *_: judged.append(state) or next(likely))
    measured, schedule = one.equations.bearings.measured(dented), 9 * [(0.4, 5.0)]
    state, before = one.gauss_newton(one.at_rest(measured.weight), measured, schedule, settling=4)
    assert len(judged) == 4
    for kept, at in zip(state, zip(*judged, strict=True), strict=True):
        torch.testing.assert_close(kept, torch.stack([at[1][0], at[0][1]]), rtol=0, atol=0)
    torch.testing.assert_close(before[0], judged[0].u[0], rtol=0, atol=0)
    assert 0 < (before[1] - judged[0].u[1]).abs().max() < 0.1 * one.size
    one.gauss_newton(one.at_rest(measured.weight), measured, schedule)
    assert len(judged) == 4


def test_where_contacts_push_nearly_everywhere_nothing_is_explained(dented):
    """A half of the surface pushed, the other pulled; all pulled; just below and just above what may be pushed."""
    one = estimator()
    loss, within, outward = one.equations.loss, ~one.membrane.fixed, one.reference * one.membrane.rest_normals
    normal, area = one.membrane.rest_normals[within].mT[None], one.membrane.rest_area[within]
    west = one.membrane.rest[:, 0] < one.membrane.rest[:, 0].median()
    for pushed in (west, ~west):
        traction = torch.where(pushed[:, None], -outward, outward)[within].mT[None]
        share = (area @ pushed[within].double() / area.sum()).item()
        assert loss.pushed(loss.parts(traction, normal)[2]).item() == pytest.approx(share, abs=0.1)
    assert loss.pushed(loss.parts(outward[within].mT[None], normal)[2]).item() == 0
    zero, limit = torch.zeros(2, dtype=torch.float64), SETTINGS.largest_pushed
    found = one(dented)._replace(misfit=zero, unexplained=zero, pushed=limit + torch.tensor([-0.01, 0.01]).double())
    assert one.is_explained(found).tolist() == [True, False]


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
    found = found._replace(misfit=0 * found.misfit, unexplained=0 * found.misfit)
    assert one.is_explained(found).tolist() == [True, False, False, True, True, False, True]


def test_only_rows_that_are_not_done_are_worked_out_again():
    asked = []

    def again(x):
        asked.append(x.tolist())
        return (10 * x,)

    done = torch.tensor([True, False, True])
    (taken,) = retry_rows(
        done, (torch.arange(3.0),), again, (torch.arange(3.0),), lambda _, values, others: (values[0] + others[0],)
    )
    assert asked == [[1.0]] and taken.tolist() == [0.0, 11.0, 2.0]


def test_markers_far_outside_are_a_reason_for_a_second_try_one_in_a_hundred_is_none():
    """On 121 markers at rest, none, one or two of them 12 deviations off, two 8, two far off and not trusted."""
    one = estimator()
    rest = one.equations.bearings.positions
    assert len(rest) == 121
    ray = torch.nn.functional.normalize(rest, dim=-1)
    across = torch.nn.functional.normalize(
        torch.linalg.cross(ray, torch.tensor([0.0, 1.0, 0.0]).to(ray).expand_as(ray)), dim=-1
    )
    off = torch.zeros(5, len(rest), 3, dtype=rest.dtype)
    for frame, (markers, deviations) in enumerate([(0, 0), (1, 12), (2, 12), (2, 8), (2, 50)]):
        angle = deviations * one.equations.bearings.noise
        off[frame, :markers] = angle * (rest.norm(dim=-1, keepdim=True) * across)[:markers]
    observation = seen(rest + off)
    observation.confidence[4, :2] = 0
    measured = one.equations.bearings.measured(observation)
    state = one.at_rest(measured.weight)
    found = one.equilibrium(*state, state.u, measured)
    assert one.is_settled(found).all()
    assert one.is_done(found, measured).tolist() == [True, True, False, True, True]


def test_a_converged_solution_gives_way_to_a_likelier_one_only(dented):
    """Five frames: the second less likely; likelier; less likely, but the first has not converged, or does not explain; hardly
    likelier: which of two stands must not hang on rounding."""
    one = estimator()
    found = one(dented)
    first = type(found)(*(value[:1].repeat(5, *[1] * (value.ndim - 1)) for value in found))
    steps = torch.tensor([1.5e-3, 1.5e-3, 3e-3, 1.5e-3, 1.5e-3], dtype=torch.float64)
    misfit = torch.tensor([0.5, 0.5, 0.5, 9.0, 0.5], dtype=torch.float64)
    first = first._replace(volume=one.membrane.volume(first.vertices), relative_step=steps, misfit=misfit)
    first = first._replace(objective=torch.full_like(steps, 2.0), unexplained=torch.full_like(steps, 2.0))
    second = first._replace(vertices=first.vertices + 1.0, objective=torch.tensor([3.0, 1.79, 3.0, 3.0, 1.81]).double())
    assert one.is_converged(first).tolist() == [True, True, False, True, True]
    assert one.is_explained(first).tolist() == [True, True, True, False, True]
    taken = one.chosen(torch.zeros(5, dtype=torch.bool), first, second)
    torch.testing.assert_close(taken.vertices, torch.cat([first.vertices[:1], second.vertices[1:4], first.vertices[4:]]))


def test_unlikely_solutions_are_tried_again_and_what_no_push_is_the_reason_of_explains_nothing(dented):
    """On a grid that resolves the contacts, and on one of half the lines, whose model errs four times as much: likely; not; so
    that nothing explains it; and unlikely by its pushes alone, however much."""
    coarse = estimator(spherical_cap(12, 9, 3, (9, 9)), largest_outlier_share=1.0)
    for one, error in ((estimator(largest_outlier_share=1.0), 1.0), (coarse, 16.0)):
        found = one(dented)
        moved = (found.vertices[1] - one.membrane.rest).square().sum(-1).mean().sqrt() / one.size
        largest = (SETTINGS.largest_unexplained + SETTINGS.unexplained_per_displacement * moved) * error
        least, most, _ = SETTINGS.likely_objective
        likely = min(least + SETTINGS.likely_per_displacement * moved, most) * error
        first = type(found)(*(value[1:].repeat(4, *[1] * (value.ndim - 1)) for value in found))
        objective = torch.tensor([0.9 * likely, 1.1 * likely, 0.9 * likely, 100 * largest]).double()
        unexplained = torch.tensor([0.0, 0.9 * largest, 1.1 * largest, 0.0]).double()
        first = first._replace(objective=objective, unexplained=unexplained, misfit=0 * objective, relative_step=0 * objective)
        first = first._replace(volume=one.membrane.volume(first.vertices), shared_misfit=0 * objective)
        rows = type(dented)(*(None if value is None else value[1:].expand(4, *value.shape[1:]) for value in dented))
        measured = one.equations.bearings.measured(rows)
        assert one.is_explained(first).tolist() == [True, True, False, True]
        assert one.is_done(first, measured).tolist() == [True, False, False, False]


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
    pulls = share[:, 0] * (SETTINGS.largest_unexplained + SETTINGS.unexplained_per_displacement * moved)
    alike = share[:, 1] * SETTINGS.largest_shared_misfit
    found = found._replace(unexplained=pulls, shared_misfit=alike, misfit=0 * pulls, pushed=0 * pulls)
    assert one.is_explained(found).tolist() == [True, True, False, True, False, False]


def test_a_press_may_be_further_off_its_markers_than_a_sensor_at_rest(dented):
    """Just below and just above what a press may be off, and the former of a surface at rest; the model of a grid of half the
    lines errs four times as much."""
    for one, error in ((estimator(), 1.0), (estimator(spherical_cap(12, 9, 3, (9, 9))), 4.0)):
        found = one(dented)
        moved = (found.vertices[1] - one.membrane.rest).square().sum(-1).mean().sqrt() / one.size
        largest = (SETTINGS.largest_misfit + SETTINGS.misfit_per_displacement * moved) * error
        first = type(found)(*(value[1:].repeat(3, *[1] * (value.ndim - 1)) for value in found))
        vertices = torch.cat([first.vertices[:2], one.membrane.rest[None].to(first.vertices)])
        first = first._replace(vertices=vertices, misfit=largest * torch.tensor([0.999, 1.001, 0.999]).double())
        none = 0 * first.objective
        first = first._replace(objective=none, unexplained=none, shared_misfit=none)
        assert one.is_explained(first).tolist() == [True, False, False]


def test_what_is_likely_grows_with_the_press_up_to_a_limit(dented):
    one, zero = estimator(largest_outlier_share=1.0), torch.zeros(2, dtype=torch.float64)
    found = one(dented)._replace(misfit=zero, relative_step=zero, unexplained=zero, shared_misfit=zero, objective=zero + 0.8)
    measured = one.equations.bearings.measured(dented)
    moved = (found.vertices - one.membrane.rest).square().sum(-1).mean(-1).sqrt() / one.size
    assert moved[0] < 1e-4 < 0.015 < moved[1]
    assert one.is_done(found, measured).tolist() == [True, True]  # without a contact in the first
    for share, expected in ((0.99, True), (1.01, False)):
        assert one.is_done(found._replace(objective=zero + share * SETTINGS.likely_objective[2]), measured)[0] == expected
    found = found._replace(reference=one.reference * torch.ones_like(found.reference))
    assert one.is_done(found, measured).tolist() == [False, True]
    least, most, _ = SETTINGS.likely_objective
    steep = estimator(likely_per_displacement=(most - least) / moved[1].item() / 2, largest_outlier_share=1.0)
    for objective, expected in ((0.49 * (least + most), True), (0.51 * (least + most), False)):
        assert steep.is_done(found._replace(objective=0 * moved + objective), measured)[1] == expected
    assert not estimator(likely_per_displacement=1e9, largest_outlier_share=1.0).is_done(
        found._replace(objective=0 * moved + 1.01 * most), measured
    )[1]


@pytest.mark.parametrize("lines", [17, 33])
def test_contacts_that_push_around_their_middle_only_are_tried_again(dented, lines):
    """Pushes in a disc, in a ring, in a ring that noise explains, and in two discs that are far apart."""
    one = estimator(spherical_cap(12, 9, 3, (lines, lines)))
    rest, normals, zero = one.membrane.rest, one.membrane.rest_normals, torch.zeros(4, dtype=torch.float64)
    off = torch.stack([(rest - rest[one.membrane.grid[1] * (lines // 2) + k]).norm(dim=-1) for k in (lines // 2, lines // 8)])
    disc, ring = (torch.exp(-(((off[0] - r) / (0.05 * one.size)) ** 2)) for r in (0.0, 0.2 * one.size))
    pushes = torch.stack([disc, ring, ring, disc + torch.exp(-((off[1] / (0.05 * one.size)) ** 2))])
    reference = one.reference * torch.tensor([1.0, 1.0, NO_CONTACT_SCALE, 1.0])[:, None].expand(4, len(rest))
    traction = -one.reference * pushes[..., None] * normals
    x = rest.expand(4, -1, -1)
    volume, moved = one.membrane.volume(x), torch.zeros(4, 4, dtype=torch.float64)
    found = Equilibrium(x, one.rest_pressure.expand(4), volume, traction, zero, reference, zero, moved, zero, zero, zero, zero)
    assert one.dents.is_ring_shaped(found, one.membrane).tolist() == [False, True, False, False]
    measured = one.equations.bearings.measured(Observation(*(value[:1].expand(4, *value.shape[1:]) for value in dented[:3])))
    assert one.is_done(found, measured).tolist() == [True, False, True, True]


def test_the_objective_of_a_solution_is_over_the_markers_seen(dented):
    one = estimator()
    half = dented._replace(confidence=dented.confidence * (torch.arange(dented.confidence.shape[1]) % 2))
    for observation in (dented, half):
        found, measured, seen = one(observation), one.equations.bearings.measured(observation), observation.confidence.sum(-1)
        state = State(found.vertices - one.membrane.rest, found.pressure, found.moved)
        traction, normal = one.gauss_newton.tractions(*state[:2])
        objective = one.gauss_newton.objective(state, traction, normal, measured)
        pushes = one.equations.loss(traction, normal, measured.noise_level).pushes
        torch.testing.assert_close(found.objective, objective / seen)
        torch.testing.assert_close(found.unexplained, (objective - pushes) / seen)
