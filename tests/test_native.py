"""Steps in machine code give the numbers of tensor operations."""

import ast
import copy
import pickle
import threading
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from torchmembrane.camera.model import Camera
from torchmembrane.estimators.force_balance import gauss_newton, schedule
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.force_balance.gauss_newton import State
from torchmembrane.estimators.force_balance.kernels import steps as native
from torchmembrane.estimators.force_balance.kernels.equations import LOADS as LOADS_OF_DEVIATIONS
from torchmembrane.estimators.force_balance.kernels.equations import WANTED
from torchmembrane.estimators.force_balance.marker_residuals import marker_rays
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.uncertainty import spreads_by_tensors
from torchmembrane.machine_code import kept, takes, using
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.solve import native_envelope
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import spherical_cap

CAMERA = Camera("fisheye", (640, 480), (168, 168), (320, 240))
PACKAGE = Path(native.__file__).parents[3]


def estimator(model="neo_hookean", prestretch=1.3, filling="liquid", grid=(11, 9), hole=False):
    """Of a cap, its lines not alike in both directions, 25 dots; `hole`: some inner vertices are fixed."""
    dome = spherical_cap(12, 9, 3, grid)
    if hole:
        fixed = dome.fixed.reshape(grid).numpy().copy()
        fixed[3:5, 4] = True
        dome = Membrane(dome.rest.reshape(*grid, 3).numpy(), fixed)
    positions = spherical_cap(12, 9, 3, (7, 7)).rest.reshape(7, 7, 3)[1:-1, 1:-1].reshape(-1, 3)
    pixels = CAMERA.point_to_pixel(positions)[None]
    covariance = 0.01 * torch.tensor([[1.0, 0.3], [0.3, 2.0]], dtype=torch.float64).expand(1, len(positions), 2, 2)
    rest = marker_rays(CAMERA, pixels, positions, torch.ones_like(pixels[..., 0]), covariance)
    energy = ElasticEnergy(dome, model, prestretch, 0.7, 0.3 if model == "mooney_rivlin" else 0.0)
    gas = (4.0, 5000.0) if filling == "gas" else None
    return ForceBalance(dome, energy, dome.closest_points(positions.numpy()), positions, 1e-3, filling, gas, rest=rest)


def problem(balance, frames=3, gauge=False, dtype=torch.float64):
    """A state of a pressed surface, some way off, and what is measured: some markers are lost."""
    generator = torch.Generator().manual_seed(3)

    def noise(*shape, size=1.0):
        return size * torch.randn(*shape, generator=generator, dtype=torch.float64)

    membrane, positions = balance.membrane, balance.equations.bearings.positions
    free = (~membrane.fixed).double()[:, None]
    towards = torch.tensor([0.3, 0.1, -1.0], dtype=torch.float64)
    dent = torch.exp(-((membrane.rest - membrane.rest[len(free) // 2]).square().sum(-1)) / 8)[:, None] * towards
    u = (dent + noise(frames, *membrane.rest.shape, size=0.05)) * free
    pixels = CAMERA.point_to_pixel(positions) + noise(frames, len(positions), 2, size=2.0)
    covariance = (0.02 + 0.01 * noise(frames, len(positions), 1, 1) ** 2) * torch.eye(2, dtype=torch.float64)
    confidence = (torch.rand(frames, len(positions), generator=generator) > 0.2).double()
    observation = marker_rays(CAMERA, pixels, positions, confidence, covariance)
    if gauge:
        observation = balance.gauged(observation, balance.rest_pressure + noise(frames, size=0.01))
    state = State(u, balance.rest_pressure * (1 + noise(frames, size=0.1)), noise(frames, 4, size=0.01))
    measured = balance.equations.bearings.measured(observation)
    cast = State(*(value.to(dtype) for value in state))
    return cast, type(measured)(*(None if value is None else value.to(dtype) for value in measured))


def taken(balance, state, measured, tau=0.4, steps=1):
    """The state after one step or several, and the displacement before the last."""
    gauss_newton = balance.gauss_newton
    return gauss_newton.native.take(gauss_newton.equations, gauss_newton.cavity, state, measured, tau, steps)


def expected(balance, state, measured, tau=0.4):
    """After one step by tensor operations."""
    tau = torch.full_like(state.pressure, tau)
    with torch.no_grad():
        return *balance.gauss_newton.step(state, measured, tau, torch.ones_like(tau)), state.u


def assert_same(found, wanted, rtol=1e-9):
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=rtol, atol=rtol * float(other.abs().max()))


@pytest.mark.parametrize("model", ["harmonic", "neo_hookean", "mooney_rivlin"])
@pytest.mark.parametrize("filling", ["liquid", "gas", "open"])
@pytest.mark.parametrize("hole", [False, True])
def test_a_step_is_that_of_tensor_operations(model, filling, hole):
    balance = estimator(model, filling=filling, hole=hole)
    given = problem(balance, gauge=filling != "open")
    assert_same(taken(balance, *given), expected(balance, *given))


@pytest.mark.parametrize("filling", ["liquid", "gas", "open"])
def test_refinement_makes_a_step_in_single_precision_several_times_more_exact(monkeypatch, filling):
    """The solution of a step's equations by tensor operations, and the step in machine code."""
    single, double = estimator(filling=filling).float(), estimator(filling=filling)
    state, measured = problem(double)
    given = [
        cast(*(None if v is None else v.float() for v in values))
        for cast, values in ((State, state), (type(measured), measured))
    ]
    rounded = [
        cast(*(None if v is None else v.double() for v in values))
        for cast, values in zip((State, type(measured)), given, strict=True)
    ]
    exact = expected(double, *rounded)[0]

    def error(u):
        return (u.double() - exact).norm().item()

    in_machine_code = error(taken(single, *given)[0])
    with torch.no_grad():
        scales = (torch.full_like(given[0].pressure, scale) for scale in (0.4, 2.5))
        _, normal, loads, _, _ = single.equations.linearised(*given[0], given[1], *scales)
        precise = double.gauss_newton._solved(type(normal)(*(v.double() for v in normal)), loads.double())
        refined = (single.gauss_newton._solved(normal, loads).double() - precise).norm()
        monkeypatch.setattr(gauss_newton, "refined", lambda solve, apply, b: solve(b))
        assert refined < (single.gauss_newton._solved(normal, loads).double() - precise).norm() / 3
    assert in_machine_code < error(expected(single, *given)[0]) / 3


def set_settings(balance, **changes):
    settings = replace(ForceBalanceSettings(), **changes)
    balance.gauss_newton.settings = balance.equations.loss.settings = settings
    balance.equations.loss.shear = type(balance.equations.loss.shear)(settings.slip)
    return settings


@pytest.mark.parametrize("tau, friction", [(4.0, 0.1), (16.0, 0.0), (0.4, 0.5)])
@pytest.mark.parametrize("grid", [(9, 9), (6, 13), (17, 17)])
def test_so_it_is_with_all_scales_on_all_grids(tau, friction, grid):
    balance = estimator(grid=grid)
    balance.equations.loss.friction = friction
    given = problem(balance)
    assert_same(taken(balance, *given, tau), expected(balance, *given, tau))


@pytest.mark.parametrize("filling", ["liquid", "gas", "open"])
@pytest.mark.parametrize("gauge", [False, True])
@pytest.mark.parametrize("hole", [False, True])
def test_deviations_are_those_of_tensor_operations(filling, gauge, hole):
    """Also where no vertex is deepest alone."""
    balance = estimator("mooney_rivlin", filling=filling, hole=hole)
    state, measured = problem(balance, gauge=gauge and filling != "open")
    flat = State(torch.where(torch.arange(3)[:, None, None] == 1, 0.0, state.u), *state[1:])
    gauss_newton = balance.gauss_newton
    settings = replace(gauss_newton.settings, outlier=3.5)  # of the finest grid, on a coarser one
    for at in (state, flat):
        force, depth = spreads_by_tensors(gauss_newton.equations, gauss_newton.cavity, settings, at, measured)
        found = gauss_newton.native.spread(gauss_newton.equations, gauss_newton.cavity, at, measured, settings.outlier)
        assert_same([found], [torch.cat([force, depth[:, None]], 1)])
        assert found.min() > 0 or filling == "open"


@pytest.mark.parametrize("filling, hole, grid", [("liquid", False, (11, 9)), ("gas", True, (13, 9)), ("open", False, (17, 17))])
def test_what_a_state_amounts_to_is_that_of_tensor_operations(filling, hole, grid):
    """Near the rest surface, where noise explains all, and far from it."""
    balance = estimator("mooney_rivlin", filling=filling, hole=hole, grid=grid)
    state, measured = problem(balance, gauge=filling != "open")
    for share in (1.0, 1e-3):
        u = share * state.u
        given = u, balance.rest_pressure + share * (state.pressure - balance.rest_pressure), state.moved, 0.9 * u, measured
        with torch.no_grad():
            found = balance.equilibrium(*given)
            with using(False):
                wanted = balance.equilibrium(*given)
        assert_same(found, wanted)
        assert (found.reference > 1e3 * balance.reference).any() or share == 1.0


@pytest.mark.parametrize("steps, tol, settle", [(2, 3e-5, 0), (9, 3e-5, 0), (20, 3e-5, 1), (60, 3e-5, 1), (60, 1e-2, 1)])
def test_a_schedule_is_that_of_tensor_operations(steps, tol, settle):
    """Until every frame has settled, of which some do early; and where the last steps are relaxed."""
    balance = estimator()
    set_settings(balance, settled_step_tol=tol)
    state, measured = problem(balance)
    state = State(0.1 * state.u, *state[1:])
    found = taken(balance, state, measured, 4.0, steps)
    with torch.no_grad(), using(False):
        after, before = balance.gauss_newton(state, measured, 4.0, steps)
    assert_same(found, [*after, before], rtol=1e-6)
    moved = (after.u - before).square().sum(-1).mean(-1).sqrt() / balance.size
    assert (moved <= tol).tolist() == 3 * [bool(settle)]


def test_every_setting_is_heard_of():
    """Each changes a step, as it changes that of tensor operations."""
    changed = dict(shear=2.0, tau=(4.0, 0.45), sparsity=900.0, floor=0.1, scale_share=0.9, contact_noise=220.0)
    changed |= dict(camera_motion=0.5, outlier=9.0)
    balance = estimator()
    given = problem(balance)
    usual = taken(balance, *given, 0.5)[0]
    for name, value in changed.items():
        other = estimator()
        set_settings(other, **{name: value})
        found = taken(other, *given, 0.5)
        assert_same(found, expected(other, *given, 0.5))
        assert float((found[0] - usual).abs().max()) > 1e-6 * float(usual.abs().max()), name


def test_no_step_stretches_an_edge_by_more_than_its_limit(monkeypatch):
    monkeypatch.setattr(schedule, "LARGEST_STRETCH", 1e-3)
    balance = estimator()
    given = problem(balance)
    found = taken(balance, *given, 0.5)
    assert_same(found, expected(balance, *given, 0.5))
    rest, grid = balance.membrane.rest.double(), balance.membrane.grid
    edges = [(x + rest).unflatten(1, grid).diff(dim=axis) for x in (given[0].u.double(), found[0].double()) for axis in (1, 2)]
    stretch = max(
        ((after - before).norm(dim=-1) / before.norm(dim=-1)).max() for before, after in zip(edges[:2], edges[2:], strict=True)
    )
    assert 0.9e-3 < float(stretch) < 1.001e-3


def test_a_frame_alone_is_that_of_a_batch_to_the_last_digit():
    balance = estimator()
    state, measured = problem(balance)
    together = taken(balance, state, measured, 4.0, 30)
    for k in range(3):
        one = type(measured)(*(None if value is None else value[k : k + 1] for value in measured))
        alone = taken(balance, State(*(value[k : k + 1] for value in state)), one, 4.0, 30)
        assert_same(alone, [value[k : k + 1] for value in together], rtol=0)


def test_nothing_that_was_given_changes():
    balance = estimator()
    state, measured = problem(balance)
    before = [value.clone() for value in (*state, *measured[:5])]
    taken(balance, state, measured)
    assert_same([*state, *measured[:5]], before, rtol=0)


def test_zero_flow_gives_zero_displacement():
    balance = estimator()
    _, measured = problem(balance)
    at_rest = balance.equations.bearings.angles(torch.zeros_like(balance.membrane.rest[None]), measured, torch.zeros(1, 4))
    positions = balance.equations.bearings.positions.T.expand(3, -1, -1)
    along = torch.nn.functional.normalize(positions - measured.origins, dim=1)
    across = measured.across - (measured.across * along[:, None]).sum(2, keepdim=True) * along[:, None]
    assert float(at_rest[0].abs().max()) > 1
    after = taken(balance, balance.at_rest(measured.weight), measured._replace(across=across))
    assert float(after[0].abs().max()) < 1e-12 * balance.size


@pytest.mark.parametrize("spoil", ["across", "origins"])
def test_a_broken_frame_is_nan_and_the_others_are_not(spoil):
    balance = estimator()
    state, measured = problem(balance)
    broken = getattr(measured, spoil).clone()
    broken[1, ..., 4] = torch.nan
    found = taken(balance, state, measured._replace(**{spoil: broken}), 4.0, 30)
    assert found[0][1].isnan().any() and found[1][1].isnan()
    fine = taken(balance, state, measured, 4.0, 30)
    assert_same([value[::2] for value in found], [value[::2] for value in fine], rtol=0)


def test_another_prestretch_is_another_step():
    balance = estimator()
    given = problem(balance)
    before = taken(balance, *given)
    balance.set_prestretch(torch.tensor(1.5, dtype=torch.float64))
    after = taken(balance, *given)
    assert_same(after, expected(balance, *given))
    assert float((after[0] - before[0]).abs().max()) > 1e-3


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda balance: pickle.loads(pickle.dumps(balance))])
def test_a_copy_has_its_own_constants(copied):
    balance = estimator()
    given = problem(balance)
    before = taken(balance, *given)
    other = copied(balance)
    other.set_prestretch(torch.tensor(1.5, dtype=torch.float64))
    assert_same(taken(other, *given), expected(other, *given))
    assert_same(taken(balance, *given), before, rtol=0)


def test_threads_do_not_disturb_each_other():
    balance = estimator()
    given = [problem(balance, frames=frames) for frames in (1, 2, 3, 4)]
    alone, found = [taken(balance, *one) for one in given], {}

    def work(k):
        for _ in range(30):
            found[k] = taken(balance, *given[k])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, one in enumerate(alone):
        assert_same(found[k], one, rtol=0)


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_frames_of_a_batch_are_shared_out_among_threads(threads, monkeypatch):
    """Of five, each by one of them, all at the same time; nothing of a result hangs on it."""
    balance, used, entered = estimator(), set(), threading.Barrier(min(threads, 5))
    given = problem(balance, frames=5)
    gauss_newton = balance.gauss_newton
    spread = gauss_newton.equations, gauss_newton.cavity, *given, 2.5
    alone = *taken(balance, *given), gauss_newton.native.spread(*spread)
    frames = native.frames

    def watched(*arguments):
        used.add(threading.get_ident())
        entered.wait(60)
        frames(*arguments)

    monkeypatch.setattr(native, "frames", watched)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    assert_same((*taken(balance, *given), gauss_newton.native.spread(*spread)), alone, rtol=0)
    assert len(used) >= min(threads, 5) and threading.get_ident() not in used


def test_single_precision_loses_a_slack_sheet():
    """Of a sheet of prestretch 1.002 it changes a step by a thousandth, of one of 1.3 by less than a tenth of that."""
    errors = []
    for prestretch, is_slack in ((1.002, True), (1.3, False)):
        balance = estimator(prestretch=prestretch, grid=(17, 17))
        assert balance.equations.is_slack == is_slack
        wanted = taken(balance, *problem(balance))
        found = taken(copy.deepcopy(balance).float(), *problem(balance, dtype=torch.float32))
        errors.append(float((found[0].double() - wanted[0]).abs().max() / (wanted[0] - problem(balance)[0].u).abs().max()))
    assert errors[0] > 5e-4 and errors[1] < 0.1 * errors[0]


def test_what_needs_tensor_operations_is_left_to_them():
    x = torch.ones(3)
    assert takes(x, None)
    assert not takes(x, torch.ones(1, requires_grad=True))
    with torch.no_grad():
        assert takes(torch.ones(1, requires_grad=True))
    assert not takes(torch.ones(3, device="meta"))
    asked = []
    torch.func.vmap(lambda one: asked.append(takes(one)) or one)(x)
    torch.compile(lambda one: one + takes(one), backend="eager")(x)
    assert asked == [False]
    assert torch.compile(lambda one: one + takes(one), backend="eager")(x)[0] == 1


def test_loads_that_a_step_does_not_have_are_zero():
    """Those of the deviations are not left in memory, where every step would make them smaller, down to subnormal numbers."""
    balance = estimator()
    state, measured = problem(balance)
    gauss_newton = balance.gauss_newton
    gauss_newton.native.spread(gauss_newton.equations, gauss_newton.cavity, state, measured, 2.5)
    (work,) = gauss_newton.native._idle[np.dtype(float)]
    loads = work.y.reshape(-1, native_envelope.COLUMNS)
    assert loads[:, WANTED:LOADS_OF_DEVIATIONS].any(0).all() and not loads[:, LOADS_OF_DEVIATIONS:].any()
    taken(balance, state, measured)
    assert loads[:, :WANTED].any(0).all() and not loads[:, WANTED:].any()


def test_what_can_be_kept_nowhere_is_compiled_all_the_same():
    """Numba refuses a function without a file, as one where nothing can be written."""
    names: dict = {}
    exec("def double(x):\n    return 2 * x", names)
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(cache=True)(names["double"])
    assert kept(names["double"])(3) == 6


def column_major(values):
    """The same values in another order in memory."""
    return values.movedim(-1, 0).contiguous().movedim(0, -1)


def test_whatever_the_sensor_and_however_its_tensors_lie_in_memory_nothing_is_compiled_again():
    """Once for each precision: a sensor whose arrays have another layout would wait a minute before its first frame."""
    for other in (dict(), dict(grid=(17, 17), hole=True), dict(filling="gas"), dict(filling="open", grid=(5, 5))):
        balance = estimator(**other)
        gauss_newton = balance.gauss_newton
        gauss_newton.settings = replace(gauss_newton.settings, sparsity=round(gauss_newton.settings.sparsity))
        (u, pressure, moved), measured = problem(balance)
        state = State(column_major(u), column_major(pressure), column_major(moved))
        taken(balance, state, measured)
        with torch.no_grad():
            balance.equilibrium(*state, column_major(u), measured)
        gauss_newton.native.spread(gauss_newton.equations, gauss_newton.cavity, state, measured, 3.5)
    precisions = [str(signature[2].dtype) for signature in native.frames.signatures]
    assert len(precisions) == len(set(precisions))


def test_what_is_kept_on_disk_hangs_on_all_its_sources():
    """Every file with something compiled is in a fingerprint."""
    texts = {path.stem: path.read_text() for path in PACKAGE.rglob("*.py") if path.stem != "machine_code"}
    named = set()
    for stem, text in texts.items():
        calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
        for call in (node for node in calls if getattr(node.func, "id", "") == "fingerprint"):
            named |= {stem} | {node.id for node in ast.walk(call) if isinstance(node, ast.Name)}
    compiled = {stem for stem, text in texts.items() if "@compiled" in text}
    assert compiled and compiled <= named
