"""A spec sheet reports what its trials gave."""

import math
import pickle
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from torchmembrane.accuracy import measure, presses, rig, statistics
from torchmembrane.accuracy.finished import FinishedSeries
from torchmembrane.accuracy.measure import spec_sheet
from torchmembrane.accuracy.spec_sheet import CLOSE, LOST, ClosestPair, Effort, Outcome, PairTrial, PressTrial, Spread
from torchmembrane.camera.model import Camera
from torchmembrane.cli import main as cli
from torchmembrane.cli.sheet import sheet_lines
from torchmembrane.errors import MembraneError
from torchmembrane.plot.accuracy import draw_sheet
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.working_range import WorkingRange
from torchmembrane.simulate import dataset

LITTLE = Effort(strokes=2, frames=3, directions=1, distances=2, rest=3)
NEAR = 1.0


def trial(force=1.0, stroke=0, **changed):
    """A press that is reconstructed well."""
    known = dict(depth=force, force_error=0.02, depth_error=0.1, place_error=0.3, surface_error=0.05, lost=0.0)
    return PressTrial(**dict(stroke=stroke, force=force, **known, at_rim=False, status=0) | changed)


@pytest.fixture(scope="module")
def sensor(small_sensor):
    return Sensor.from_file(small_sensor / "sensor.toml")


@pytest.fixture(scope="module")
def small_rig(sensor):
    return rig.Rig(sensor, 40.0)


@pytest.fixture
def on_small_rig(sensor, small_rig, monkeypatch):
    """Sheets of the sensor are measured on one rig."""

    def rig_of(given, noise):
        assert given is sensor and noise == 40.0
        return small_rig

    monkeypatch.setattr(measure, "Rig", rig_of)


@pytest.fixture(scope="module")
def stroke(small_rig):
    return presses.stroke_states(small_rig.simulator, 0, 6, 0.0, 0)


@pytest.fixture(scope="module")
def sheet(sensor):
    return spec_sheet(sensor, 3, effort=LITTLE)


def result_with(r, states, displacement, **fields):
    """A result that says this of the states' images, and nothing where nothing is said."""
    B, V, D = len(states), len(r.seen), len(r.reconstructor.rest_markers)
    nothing = dict(
        displacement=displacement,
        confidence=torch.ones(B, D),
        contact_points=torch.full((B, 4, 3), torch.nan),
        contact_at_rim=torch.full((B, 4), torch.nan),
        force=torch.stack([state.force for state in states]),
        pressure_change=torch.zeros(B),
        status=torch.zeros(B, dtype=torch.int32),
        normals=r.reconstructor.sensor.membrane.rest_normals.expand(B, V, 3),
    )
    blank = Reconstruction(*torch.zeros(len(Reconstruction._fields), B, 1))
    assert displacement.shape == (B, V, 3)
    return blank._replace(**nothing | fields)


def test_trials_are_off_by_what_the_results_are(small_rig, stroke):
    """Force a tenth too large and turned by a right angle's tangent 0.1, depth 3/4, contact 0.7 aside, four markers lost."""
    r, u = small_rig, small_rig._displacement(stroke)
    F = torch.stack([state.force for state in stroke])
    across = torch.linalg.cross(F, torch.tensor([1.0, 2.0, 3.0], dtype=F.dtype).expand_as(F))
    across = across / across.norm(dim=-1, keepdim=True) * F.norm(dim=-1, keepdim=True)
    aside = torch.tensor([0.0, 0.7, 0.0], dtype=F.dtype)
    points = torch.full((len(stroke), 4, 3), torch.nan, dtype=F.dtype)
    points[:, 0] = torch.stack([state.contact_points[0] for state in stroke]) + aside
    points[:, 1] = 0.0  # a weaker contact elsewhere does not count
    confidence = torch.ones(len(stroke), len(r.reconstructor.rest_markers))
    confidence[:, :4] = 0.0
    rim = torch.tensor([[1.0, torch.nan]] + [[0.0, torch.nan]] * (len(stroke) - 1))
    fields = dict(contact_points=points, confidence=confidence, contact_at_rim=rim)
    given = result_with(r, stroke, 0.75 * u, force=1.1 * F + 0.1 * across, **fields)
    trials = rig.press_trials(5, stroke, u, given, r._normals(), r.seen, r._found())
    normals = r._normals()[r.seen]
    for k, got in enumerate(trials):
        depth = max(-(u[k][r.seen] * normals).sum(-1).tolist()[i] for i in range(len(normals)))
        assert got.stroke == 5 and got.status == 0 and got.at_rim is (k == 0) and got.relied_on is (k > 0)
        assert got.force == pytest.approx(float(F[k].norm())) and got.depth == pytest.approx(depth)
        assert got.force_error == pytest.approx(math.hypot(0.1, 0.1)) and got.place_error == pytest.approx(0.7)
        assert got.depth_error == pytest.approx(depth / 4) and got.surface_error == pytest.approx(0.25)
        assert got.lost == pytest.approx(4 / int(r._found().sum()))


def test_the_truth_at_the_solver_s_vertices_is_the_simulator_s(small_rig, stroke):
    """A linear displacement is taken to the grid of other lines as it is, but for how far facets are off the surface."""
    fine, coarse = small_rig.simulator.membrane, small_rig.reconstructor.sensor.membrane
    assert fine.grid == (22, 22) and coarse.grid == (9, 9)
    linear = torch.tensor([[0.1, 0.2, 0.0], [-0.3, 0.1, 0.2], [0.0, 0.4, -0.1]], dtype=torch.float64)
    moved = [stroke[0]._replace(vertices=fine.rest + k * fine.rest @ linear) for k in (1, 2)]
    expected = torch.stack([k * coarse.rest.double() @ linear for k in (1, 2)])
    torch.testing.assert_close(small_rig._displacement(moved), expected, rtol=0, atol=0.02)


def test_what_is_out_of_view_does_not_count(small_rig, stroke):
    r, u = small_rig, small_rig._displacement(stroke)
    seen = r.seen.clone()
    seen[u[-1].norm(dim=-1) > 0.3 * u[-1].norm(dim=-1).max()] = False
    found = torch.where(seen[:, None], u, 7.0)
    args = result_with(r, stroke, found), r._normals()
    (*_, blind), (*_, whole) = (rig.press_trials(0, stroke, u, *args, view, r._found()) for view in (seen, r.seen))
    assert blind.surface_error == blind.depth_error == 0 and whole.surface_error > 1 and blind.depth < whole.depth


def test_a_contact_that_is_not_reported_is_infinitely_far(small_rig, stroke):
    r, u = small_rig, small_rig._displacement(stroke)
    trials = rig.press_trials(0, stroke, u, result_with(r, stroke, u), r._normals(), r.seen, r._found())
    assert [t.place_error for t in trials] == [math.inf] * len(stroke) and not any(t.is_found(1e9) for t in trials)
    assert not any(t.at_rim for t in trials)


def test_pairs_are_told_apart_within_half_their_distance_of_each(small_rig, stroke):
    centres = torch.tensor([[0.0, 0.0, 18.0], [4.0, 0.0, 18.0]], dtype=torch.float64)
    pair = presses.PairPress(stroke[0]._replace(contact_points=centres), 4.0)
    cases = {
        "both": ([[0.5, 0.0, 18.0], [3.0, 1.0, 18.0]], 0, True),
        "one between them": ([[2.0, 0.0, 18.0]], 0, False),
        "two at the same": ([[0.5, 0.0, 18.0], [0.0, 1.0, 18.0]], 0, False),
        "none": ([], 0, False),
        "one too far": ([[0.0, 0.0, 18.0], [4.0, 2.1, 18.0]], 0, False),
        "both, not converged": ([[0.5, 0.0, 18.0], [3.0, 1.0, 18.0]], 3, False),
    }
    for name, (points, status, told) in cases.items():
        found = torch.full((1, 4, 3), torch.nan)
        found[0, : len(points)] = torch.tensor(points).reshape(-1, 3)
        u, code = torch.zeros(1, len(small_rig.seen), 3), torch.tensor([status], dtype=torch.int32)
        given = result_with(small_rig, stroke[:1], u, contact_points=found, status=code)
        (got,) = rig.pair_trials(2, [pair], given)
        assert got == PairTrial(2, 4.0, told), name


def test_rest_is_the_mean_square_in_view(small_rig, stroke):
    u = torch.zeros(2, len(small_rig.seen), 3)
    u[1, small_rig.seen] = torch.tensor([0.0, 3.0, 4.0])
    points = torch.full((2, 4, 3), torch.nan)
    points[1, :2] = 0.0
    force, change = torch.tensor([[0.0, 0, 0], [2.0, 3.0, 6.0]]), torch.tensor([0.0, -0.5])
    given = result_with(small_rig, stroke[:2], u, contact_points=points, force=force, pressure_change=change)
    still, moved = rig.rest_trials(given, small_rig.seen)
    assert still == (0, 0, 0, 0, 0) and moved == (5, 7, 0.5, 2, 0)
    floor = statistics.rest_floor([still, moved, moved._replace(status=3)])
    assert (floor.frames, floor.not_ok, floor.touched) == (3, 1, 1) and floor.surface == Spread(2.5, 4.5)


def test_bands_hold_the_errors_of_their_presses():
    """Ten presses in each, of force errors 0.01 ... 0.1: median 0.055, 90 % 0.091; of what is not relied on, none."""
    forces = [0.5, 2.0, 9.0, 25.0, 100.0]
    trials = [
        trial(force, force_error=0.01 * k, depth_error=force * k, place_error=0.1 * k + (5.0 if k == 10 else 0.0))
        for force in forces
        for k in range(1, 11)
    ]
    wrong = [trial(9.0, status=3, force_error=9.0), trial(9.0, at_rim=True, force_error=9.0)]
    table = statistics.bands([*trials, *wrong], near=NEAR)
    assert [(band.low, band.high) for band in table] == [(0, 1), (1, 3), (3, 10), (10, 30), (30, 100)]
    assert [band.presses for band in table] == [10, 10, 12, 10, 10]
    assert [band.relied_on for band in table] == [1, 1, pytest.approx(10 / 12), 1, 1]
    for band, force in zip(table, forces, strict=True):
        assert band.force == pytest.approx((0.055, 0.091)) and band.depth == pytest.approx((5.5 * force, 9.1 * force))
        assert band.found == 0.9 and band.place == pytest.approx((0.55, 1.41))


def test_a_press_as_hard_as_a_band_s_end_is_in_that_band_only():
    table = statistics.bands([trial(force) for force in (1.0, 3.0, 100.0)], near=NEAR)
    assert [(band.high, band.presses) for band in table] == [(1, 1), (3, 1), (100, 1)]


def test_pairs_begin_at_the_widest_distance_and_come_nearer_by_the_same_ratio(small_rig, monkeypatch):
    places = []
    monkeypatch.setattr(presses, "_pair", lambda simulator, place, way: places.append(place) or [None])
    presses.pair_states(small_rig.simulator, 0, 3, 0)
    apart = [np.linalg.norm(place[1] - place[0]) for place in places]
    size = small_rig.simulator.membrane.size
    wanted = [presses.WIDEST * size * presses.NEARER**k for k in range(3)]
    assert len(places) > 0 and min(abs(apart[0] / np.array(wanted) - 1)) < 0.1  # the tangent's points, brought to the surface


def test_presses_are_drawn_with_their_errors_in_percent(sheet):
    bad = trial(2.0, depth=0.7, surface_error=0.4)
    figure = Figure()
    draw_sheet(figure, sheet._replace(presses=[trial(1.0, depth=0.5, surface_error=0.1), bad]))
    points = {line.get_label(): line.get_xydata().tolist() for line in figure.axes[2].lines}
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xydata(), [[1, 2], [2, 2]])  # of force errors of 0.02
    assert points["reconstructed"] == [[0.5, pytest.approx(10)]] and points["not"] == [[0.7, pytest.approx(40)]]


def test_bands_without_results_say_so():
    (band,) = statistics.bands([trial(status=7)], NEAR)
    assert band.relied_on == 0 and math.isnan(band.found) and math.isnan(band.force.median)
    assert statistics.bands([], NEAR) == []


def test_the_lightest_touch_is_the_first_found_twice_in_a_row():
    away = dict(place_error=math.inf)
    chance = [trial(1, **away), trial(2), trial(3, **away), trial(4), trial(5), trial(6, **away)]
    never = [trial(force, stroke=1, **away) for force in (1, 2)]
    doubtful = [trial(1, stroke=2, status=3), trial(2, stroke=2), trial(3, stroke=2)]
    touch = statistics.lightest_touch([*chance, *never, *doubtful], NEAR)
    assert (touch.strokes, touch.found) == (3, 2) and touch.force == Spread(3.0, 3.8) == touch.depth


@pytest.mark.parametrize(
    ("changed", "end"),
    [
        ({}, statistics.UNBROKEN),
        (dict(status=3), "not converged"),
        (dict(status=1, surface_error=math.nan), "too few markers"),
        (dict(lost=LOST + 0.01), "markers lost"),
        (dict(surface_error=CLOSE + 0.01), "surface off"),
        (dict(surface_error=math.nan), "surface off"),
        (dict(lost=LOST, surface_error=CLOSE), statistics.UNBROKEN),
    ],
)
def test_the_deepest_press_is_the_last_before_the_first_failure(changed, end):
    light = [trial(0.1, place_error=math.inf, surface_error=0.9)]  # not found yet, which is no failure
    trials = [*light, trial(1), trial(2), trial(3, **changed), trial(4)]
    deepest = statistics.deepest_press(trials, NEAR)
    assert deepest.ends == {end: 1} and deepest.depths == [4 if end == statistics.UNBROKEN else 2] == deepest.forces
    assert statistics.deepest_press(light, NEAR) == ([0.0], [0.0], {statistics.UNFOUND: 1})


def test_the_closest_pair_is_that_from_which_on_all_are_told_apart():
    """Monotone: what is resolved below a distance that is not, does not count."""
    told = {0: (8, 6, 5, 2), 1: (8, 4), 2: ()}
    trials = [PairTrial(k, d, d in known) for k, known in told.items() for d in (2, 5, 8, 6, 4, 3)]
    pair = statistics.closest_pair(trials)
    assert pair == ClosestPair(3, 2, Spread(6.5, 7.7), 2, 8)
    fewer = [t._replace(told=t.told and t.distance > 6) for t in trials]
    assert statistics.closest_pair(fewer).distance.median >= pair.distance.median
    assert statistics.closest_pair([]).directions == 0


def test_strokes_grow_quadratically_from_the_first_touch(small_rig, stroke):
    """A ball's depth over that of the last frame, and the force, which grows faster than it."""
    K, n = len(stroke), np.arange(1, len(stroke) + 1)
    depth = (-small_rig._displacement(stroke) @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).amax(-1)
    assert K > 3
    np.testing.assert_allclose(depth / depth[-1], (n / K) ** 2, atol=0.06)
    per_depth = np.array([float(state.force.norm()) for state in stroke]) / n**2
    assert (np.diff(per_depth) > 0).all()
    assert presses.shares(3, 0.5)[0] == pytest.approx((1.5 / 3.5) ** 2)


def test_only_what_is_in_view_is_pressed(sensor):
    simulator = rig.Simulator(looking_aside(sensor, 150))
    view, X = presses.in_view(simulator), simulator.membrane.rest.numpy()
    assert 0.1 < view.mean() < 0.7
    for number in range(4):
        rng = np.random.default_rng([0, 1, number])
        drawn = dataset.random_stroke(simulator, dataset.Plan(("sphere",)), rng, view)
        from_line = np.linalg.norm(np.cross(X - drawn.indenter.translation.numpy(), drawn.travel), axis=1)
        assert from_line[view].min() < 1e-6
    for pair in presses.pair_states(simulator, 0, 3, 0):
        assert np.isfinite(pair.distance) and pair.state.contact[view].any()


def looking_aside(sensor, column):
    """Its camera's centre at that column: of 160, the membrane lies within 57 of it."""
    camera = Camera("pinhole", (160, 120), (100, 100), (column, 60))
    return replace(sensor, name="aside", camera=camera, markers=replace(sensor.markers, rest_image=None))


def test_a_sensor_that_cannot_be_pressed_says_why(sensor):
    simulator = rig.Simulator(looking_aside(sensor, 212))
    for states in (lambda: presses.stroke_states(simulator, 0, 2, 0.0, 0), lambda: presses.pair_states(simulator, 0, 2, 0)):
        with pytest.raises(MembraneError, match="check the camera and the rest surface"):
            states()


@pytest.mark.usefixtures("on_small_rig")
def test_what_cannot_be_simulated_is_left_out_and_said(sensor, monkeypatch):
    def refuse_the_first(simulator, number, *rest):
        if number == 0:
            raise MembraneError("stroke 1: no equilibrium")
        return strokes(simulator, number, *rest)

    strokes, least = presses.stroke_states, LITTLE._replace(frames=1, directions=0, rest=1)
    monkeypatch.setattr(measure, "stroke_states", refuse_the_first)
    known = spec_sheet(sensor, 3, effort=least)
    assert known.left_out == ["stroke 1: no equilibrium"] and {t.stroke for t in known.presses} == {1}
    assert "left out, as they cannot be simulated: 1" in "\n".join(sheet_lines(known))
    with pytest.raises(MembraneError, match="none of 1 strokes can be simulated; stroke 1: no equilibrium"):
        spec_sheet(sensor, 3, effort=least._replace(strokes=1))


def test_a_stroke_that_the_membrane_cannot_follow_ends_there(small_rig, stroke, monkeypatch):
    """Where no equilibrium is found, where it costs too much, and before the membrane is behind the camera."""
    good = stroke[0]
    behind = good._replace(vertices=good.vertices - torch.tensor([0.0, 0.0, 20.0]))
    costly = good._replace(iterations=presses.STEPS + 1)

    def yielding(*states):
        def found(*_, **__):
            for state in states:
                if state is None:
                    raise MembraneError("no equilibrium")
                yield state

        return found

    for states, followed in (((good, good, None), 1), ((good, good, behind, good), 1), ((good, good, costly, good), 2)):
        monkeypatch.setattr(presses, "presses", yielding(*states))
        assert len(presses.stroke_states(small_rig.simulator, 0, 5, 0.0, 0)) == followed
    monkeypatch.setattr(presses, "presses", yielding(good, None))
    with pytest.raises(MembraneError, match="stroke 1: no equilibrium"):
        presses.stroke_states(small_rig.simulator, 0, 5, 0.0, 0)


@pytest.mark.full
def test_a_seed_gives_one_sheet(sensor, sheet):
    assert pickle.dumps(spec_sheet(sensor, 3, effort=LITTLE)) == pickle.dumps(sheet)


@pytest.mark.usefixtures("on_small_rig")
def test_another_seed_gives_another_sheet(sensor, sheet):
    """That the same seed gives the same one, the sheet says that is interrupted."""
    other = spec_sheet(sensor, 4, effort=LITTLE._replace(strokes=1, directions=0))
    assert other.rest != sheet.rest and not {t.force for t in other.presses} & {t.force for t in sheet.presses}


@pytest.mark.parametrize("count, share", [(25, 0.2), (100, 0.1), (2500, 0.05)])
def test_a_contact_counts_as_found_within_the_markers_spacing_and_within_a_twentieth_of_the_size(
    sensor, monkeypatch, count, share
):
    markers, simulator = SimpleNamespace(rest_markers=np.zeros((count, 3))), SimpleNamespace(grid=(22, 22))
    monkeypatch.setattr(measure, "Rig", lambda *_: SimpleNamespace(simulator=simulator, reconstructor=markers))
    monkeypatch.setattr(measure, "_outcomes", lambda *_: [Outcome()])
    sheet, size = spec_sheet(sensor, noise=40.0, effort=Effort(0, 0, 0, 0, 0)), sensor.membrane.size
    assert sheet.near == pytest.approx(share * size) and sheet.spacing == pytest.approx(size / count**0.5)


def test_a_sheet_is_what_its_trials_give(sheet, sensor):
    assert 3 < len(sheet.presses) <= 6 and len(sheet.pairs) == 2 and sheet.rest.frames == 3
    assert sheet.near == sheet.spacing == pytest.approx(sensor.membrane.size / 7)
    assert sheet.bands == statistics.bands(sheet.presses, sheet.near)
    assert sheet.deepest == statistics.deepest_press(sheet.presses, sheet.near)
    assert sheet.lightest == statistics.lightest_touch(sheet.presses, sheet.near)
    assert sheet.closest == statistics.closest_pair(sheet.pairs)
    assert (sheet.simulated_on, sheet.reconstructed_on, sheet.force_unit) == ((22, 22), (9, 9), "N")
    firm = [t for t in sheet.presses if t.force > 0.2 * max(t.force for t in sheet.presses)]
    assert np.median([t.force_error for t in firm]) < 0.5 and np.median([t.surface_error for t in firm]) < 0.5


@pytest.mark.usefixtures("on_small_rig")
def test_an_interrupted_sheet_is_the_same_to_the_last_bit(sensor, sheet, tmp_path, monkeypatch):
    """Its frames at rest and one stroke from the file."""

    def stop(simulator, number, *rest):
        if number == 1:
            raise KeyboardInterrupt
        return strokes(simulator, number, *rest)

    strokes = presses.stroke_states
    monkeypatch.setattr(measure, "stroke_states", stop)
    with pytest.raises(KeyboardInterrupt):
        spec_sheet(sensor, 3, effort=LITTLE, finished=FinishedSeries.resumed(tmp_path, "1", sensor, 3, None, LITTLE))
    monkeypatch.setattr(measure, "stroke_states", strokes)
    kept = FinishedSeries.resumed(tmp_path, "1", sensor, 3, None, LITTLE)
    assert list(kept.outcomes) == [0, 1]
    assert repr(spec_sheet(sensor, 3, effort=LITTLE, finished=kept)) == repr(sheet)


def test_noise_is_that_of_the_rest_image(sensor):
    simulator = rig.Simulator(sensor, appearance=rig.Appearance(noise=33.0))
    noisy = replace(sensor, markers=replace(sensor.markers, rest_image=simulator.rest_image()))
    assert rig.image_noise(noisy) == pytest.approx(33, abs=1.5)
    assert rig.image_noise(sensor) == rig.USUAL_NOISE  # it has none
    assert (
        rig.image_noise(replace(sensor, markers=replace(sensor.markers, rest_image=np.full((120, 160), 0.5)))) == rig.QUIETEST
    )


def test_the_command_prints_and_draws_the_sheet(small_sensor, sheet, monkeypatch, tmp_path, capsys):
    asked = {}

    def known(sensor, seed, **options):
        asked.update(options, seed=seed, name=sensor.name)
        return sheet

    monkeypatch.setattr("torchmembrane.accuracy.measure.spec_sheet", known)
    path = Sensor.from_file(small_sensor / "sensor.toml").to_file(tmp_path)
    call = ["check", str(path), "--accuracy", "--seed", "3", "--jobs", "1"]
    assert cli.main([*call, "--out", str(tmp_path / "a.png")]) == 0
    said = capsys.readouterr().out
    assert {"progress", "finished"} < asked.keys() and asked["finished"].path.parent == tmp_path
    assert {key: asked[key] for key in ("seed", "noise", "jobs", "name")} == dict(seed=3, noise=None, jobs=1, name="cap")
    assert "\n".join(sheet_lines(sheet)) in said and said.endswith(f"\ndrawn in {tmp_path / 'a.png'}\n")
    assert f"kept in {tmp_path / 'sensor_range.toml'}" in said and Sensor.from_file(path).range == sheet.range
    for part in ("at rest   surface", "lightest  ", "errors    by the true force", "two       ", "deepest   press", "force, N"):
        assert part in said
    assert Image.open(tmp_path / "a.png").size == (1600, 1160)
    assert cli.main(["check", str(small_sensor / "sensor.toml"), "--seed", "3"]) == 2
    assert "--seed goes with --accuracy only" in capsys.readouterr().err


def test_the_sheet_s_lines_hold_its_figures(sheet):
    band = sheet.bands[0]._replace(low=0.0, high=1.25, presses=7, relied_on=0.5, found=0.25, force=Spread(0.012, 0.34))
    told = sheet._replace(
        bands=[band._replace(depth=Spread(0.1, 0.2), place=Spread(math.nan, math.nan))],
        closest=ClosestPair(3, 2, Spread(4.0, 5.0), 1.0, 9.0),
        force_unit="relative",
        range=WorkingRange(0.25, 60.0, 12.5, "of this sensor"),
    )
    lines = "\n".join(sheet_lines(told))
    cells = "0 to 1.2", "7", "50 %", "25 %", "1.2 % / 34 %", "0.1 / 0.2", "- / -"
    assert "  ".join(f"{c:>{w}}" for c, w in zip(cells, (20, 7, 9, 5, 13, 15, 15), strict=True)) in lines
    assert "distance of 4 / 5 mm on" in lines and "2 of 3 directions; tried from 9 down to 1 mm" in lines
    assert "force, relative" in lines and "N/mm" not in lines
    assert "right up to 0.25 of the size deep and 12.5 relative" in lines
    assert "range     none: presses are wrong" in "\n".join(sheet_lines(told._replace(range=None)))


@pytest.mark.parametrize("work", [measure, dataset])
def test_other_processes_leave_the_sensor_as_it_is(sensor, work, monkeypatch):
    """What torch's own pickling moves to shared memory, arrays would look at in vain: none of it is handed over."""
    gridded = replace(sensor, surface=None, membrane=sensor.membrane.resampled((9, 9)))
    before = {name: array.copy() for name, array in gridded.surface.arrays().items()}

    class Pool:
        def __init__(self, jobs, begin, arguments):
            bytes(ForkingPickler.dumps(arguments))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def imap(self, work, tasks):
            return iter(())

        imap_unordered = imap

    monkeypatch.setattr("multiprocessing.context.SpawnContext.Pool", lambda _, *arguments: Pool(*arguments))
    if work is measure:
        made = rig.Rig(gridded, 40.0)
        assert list(measure._in_processes(made, [(k, measure.Series("rest", k, LITTLE, 0)) for k in range(2)], 2)) == []
    else:
        list(dataset._in_processes(rig.Simulator(gridded), dataset.Plan(), [0, 1], 2))
    overwritten = [np.full((9, 9, 3), 7.0) for _ in range(50)]
    assert before and len(overwritten) == 50
    for name, array in before.items():
        np.testing.assert_array_equal(gridded.surface.values[name], array)
