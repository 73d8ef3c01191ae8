"""Long commands say at once how far they are, and resume."""

import io
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchmembrane.accuracy import measure
from torchmembrane.accuracy.finished import FinishedSeries
from torchmembrane.accuracy.measure import spec_sheet
from torchmembrane.accuracy.spec_sheet import Effort, Outcome, PairTrial, PressTrial, RestTrial
from torchmembrane.calibrate import depth, material, rest, views
from torchmembrane.calibrate import presses as presses_module
from torchmembrane.cli import main as cli
from torchmembrane.cli import progress as shown
from torchmembrane.cli.progress import LINE_SECONDS, ProgressDisplay
from torchmembrane.errors import MembraneError
from torchmembrane.onnx import export
from torchmembrane.presets import preset
from torchmembrane.progress import within
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate import dataset

TRIED = Effort(strokes=2, frames=1, directions=1, distances=1, rest=1)


@pytest.fixture
def clock(monkeypatch):
    """The display's clock, in seconds: `clock[0]`."""
    now = [100.0]
    monkeypatch.setattr(shown, "monotonic", lambda: now[0])
    return now


def test_the_time_left_is_to_the_time_so_far_as_the_work_left_to_the_work_done():
    display = ProgressDisplay("a")
    assert display.time_left(0.2, 50.0) is None  # done before
    assert display.time_left(0.4, 60.0) == pytest.approx(30) and display.time_left(0.9, 85.0) == pytest.approx(5)


def test_the_time_left_forgets_a_slow_beginning():
    display = ProgressDisplay("a")
    for share, now in ((0.0, 0.0), (0.1, 300.0), (0.2, 310.0), (0.3, 320.0)):
        left = display.time_left(share, now)
    assert left == pytest.approx(70)


def test_two_processes_that_end_together_do_not_make_the_time_left_short():
    """Each takes 20 s for a twentieth of the work, and they began together: 20 s for a tenth."""
    display = ProgressDisplay("a")
    display.time_left(0.0, 0.0)
    for pair in range(1, 10):
        for share, now in ((0.1 * pair - 0.05, 20.0 * pair), (0.1 * pair, 20.0 * pair + 0.1)):
            left = display.time_left(share, now)
            assert left is None or left == pytest.approx(200 * (1 - share), rel=0.5) or share < 0.2
    assert left is not None


def test_no_time_is_told_by_a_beginning_that_is_a_small_part_of_the_work():
    """Processes start for 15 s, and then each of a thousand presses takes 1 s."""
    display = ProgressDisplay("a")
    said = [display.time_left(done / 1000, 15.0 + done if done else 0.0) for done in range(6)]
    assert said[:4] == [None] * 4 and said[4:] == [pytest.approx(1000 - done) for done in (4, 5)]


def test_a_part_of_the_work_tells_its_share_of_the_whole():
    told = []
    part = within(within(lambda *said: told.append(said), 0.5, 1.0), 0.2, 0.6)
    part(0.0, "first")
    part(0.5, "second")
    assert told == [(pytest.approx(0.6), "first"), (pytest.approx(0.7), "second")]


def test_elsewhere_than_on_a_terminal_lines_come_at_once_and_then_every_few_seconds(clock, capsys):
    with ProgressDisplay("calibrate material") as progress:
        progress(0.0, "images")
        clock[0] += 0.9 * LINE_SECONDS
        progress(0.1, "left out")
        clock[0] += 0.2 * LINE_SECONDS
        progress(0.25, "force balance")
    first, second = capsys.readouterr().err.splitlines()
    assert first == "calibrate material: 0 %: images"
    assert second == "calibrate material: 25 %, about 5 s left: force balance"


def test_on_a_terminal_there_is_a_bar(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    with ProgressDisplay("export") as progress:
        progress(0.5, "check against torch")
        progress.write("a line")
    said = terminal.getvalue()
    assert "\rexport:  50 %|" in said and "check against torch" in said and "a line\n" in said


@pytest.mark.parametrize(
    ("title", "arguments"),
    [
        ("calibrate material", ["calibrate", "material", "a.toml", "a.png", "--out", "out"]),
        ("calibrate rest", ["calibrate", "rest", "a.toml", "a.png", "--out", "out"]),
        ("check --accuracy", ["check", "a.toml", "--accuracy"]),
        ("export", ["export", "a.toml", "-o", "a.onnx"]),
        ("simulate --random", ["simulate", "a.toml", "--random", "3", "--out", "out"]),
    ],
)
def test_a_line_comes_before_torch_is_imported(title, arguments):
    code = f"import sys\nsys.modules['torch'] = None\nfrom torchmembrane.cli.main import main\nmain({arguments!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.splitlines()[0] == f"{title}: loading packages" and "ModuleNotFoundError" in done.stderr


class Heavy(Exception):
    """The first step that takes long has begun."""


def heavy(*_, **__):
    raise Heavy


@pytest.mark.parametrize(
    ("computation", "owner", "step"),
    [
        (lambda sensor, told: rest.rest_from_image(sensor, IMAGE, progress=told), rest, "fine_surface"),
        (lambda sensor, told: views.rest_from_views(sensor, [IMAGE] * 2, MOTIONS, 0.01, progress=told), views, "fine_surface"),
        (lambda sensor, told: depth.rest_from_depth(sensor, IMAGE, IMAGE, progress=told), depth, "fine_surface"),
        (
            lambda sensor, told: material.material_from_images(sensor, IMAGE[None, None], progress=told),
            material,
            "coarse_reconstructor",
        ),
        (lambda sensor, told: spec_sheet(sensor, noise=40.0, progress=told), measure, "Rig"),
        (lambda sensor, told: export.export(Reconstructor(sensor), "a", progress=told), Reconstructor, "reconstruct_grey"),
        (lambda sensor, told: dataset.make_frames(None, dataset.Plan(), 3, FRAMES, progress=told), dataset, "_in_processes"),
    ],
    ids=["rest", "views", "depth", "material", "accuracy", "export", "random"],
)
def test_progress_is_told_before_the_first_heavy_step(computation, owner, step, small_sensor, monkeypatch):
    sensor, told = Sensor.from_file(small_sensor / "sensor.toml"), []
    monkeypatch.setattr(owner, step, heavy)
    with pytest.raises(Heavy):
        computation(sensor, lambda *said: told.append(said))
    ((share, words),) = told
    assert share == 0 and words


IMAGE, MOTIONS = np.zeros((120, 160)), np.eye(2, 6, -1)
FRAMES = SimpleNamespace(names=set, flush=lambda: None)


def test_the_losses_tell_equal_steps_up_to_the_end(monkeypatch):
    """Solves, their neighbours, solves between, all neighbours: the shares grow and never pass 1."""
    told = []
    presses = SimpleNamespace(
        reconstructor=SimpleNamespace(sensor=preset("bubble")),
        observation=SimpleNamespace(confidence=torch.ones(1, 3)),
        explained=lambda stretch, modulus: (stretch, SimpleNamespace(unexplained=torch.tensor([(stretch - 1.4) ** 2]))),
    )
    for name in ("_solutions", "_profile"):
        setattr(presses, name, getattr(presses_module.Presses, name).__get__(presses))
    monkeypatch.setattr("torchmembrane.calibrate.stretch_loss._better", lambda own, *_: own)
    found = presses_module.Presses.profile(presses, lambda share, _: told.append(share))
    assert len(found.stretches) == 14 and told[0] == 0 and told == sorted(told) and 0.9 < told[-1] < 1


def made_up(number):
    """Outcomes with every kind of number that a trial may hold."""
    press = PressTrial(number, 1 / 3, 0.1 + 0.2, 1e-17, 5e-324, math.inf, math.nan, 0.0, True, 3)
    return Outcome([RestTrial(0.1, 2 / 3, 1e300, number, 0)], [press], [PairTrial(number, math.pi, False)], "")


@pytest.fixture
def tried(monkeypatch):
    """The series that are tried, none of which is simulated; `tried.interrupt`: of which one the user has enough."""
    calls = SimpleNamespace(series=[], interrupt=None)

    def outcome_of(rig, series):
        if len(calls.series) == calls.interrupt:
            raise KeyboardInterrupt
        calls.series.append((series.kind, series.number))
        return made_up(len(series.kind) + series.number)

    rig = SimpleNamespace(simulator=SimpleNamespace(grid=(3, 3)), reconstructor=SimpleNamespace(rest_markers=range(49)))
    monkeypatch.setattr(measure, "Rig", lambda *_: rig)
    monkeypatch.setattr(measure, "outcome_of", outcome_of)
    return calls


def test_an_interrupted_sheet_goes_on_from_the_series_that_are_finished(tried, small_sensor, tmp_path):
    sensor, told = Sensor.from_file(small_sensor / "sensor.toml"), []

    def finished():
        return FinishedSeries.resumed(tmp_path, "1", sensor, 7, 40.0, TRIED)

    whole = spec_sheet(sensor, 7, noise=40.0, effort=TRIED)
    assert len(tried.series) == 4
    tried.series, tried.interrupt = [], 2
    with pytest.raises(KeyboardInterrupt):
        spec_sheet(sensor, 7, noise=40.0, effort=TRIED, finished=finished())
    (file,) = tmp_path.iterdir()
    assert finished().path == file and repr(finished().outcomes[0]) == repr(made_up(len(measure.REST)))
    tried.series, tried.interrupt = [], None
    again = spec_sheet(sensor, 7, noise=40.0, effort=TRIED, finished=finished(), progress=lambda *said: told.append(said[0]))
    assert tried.series == [(measure.STROKE, 1), (measure.PAIR, 0)] and repr(again) == repr(whole)
    assert 0 < told[0] == told[1] < told[2] < told[3] == pytest.approx(1)
    finished().remove()
    assert list(tmp_path.iterdir()) == []


def test_series_are_kept_for_the_same_trials_only(small_sensor, tmp_path):
    sensor = Sensor.from_file(small_sensor / "sensor.toml")
    same = ("1", sensor, 7, 40.0, TRIED)
    others = [("2", *same[1:]), ("1", preset("bubble"), *same[2:]), (*same[:2], 8, *same[3:])]
    others += [(*same[:3], None, TRIED), (*same[:4], TRIED._replace(rest=2))]
    paths = {FinishedSeries.resumed(tmp_path, *each).path for each in (same, *others)}
    assert len(paths) == 1 + len(others) and FinishedSeries.resumed(tmp_path, *same).path in paths


DAMAGED = ["", "[]", '{"0": [[], []]}', '{"a": [[], [], [], ""]}', '{"0": [[[1]], [], [], ""]}', "[" * 9999]


@pytest.mark.parametrize("content", DAMAGED)
def test_a_damaged_file_of_series_is_refused(content, small_sensor, tmp_path):
    same = (tmp_path, "1", Sensor.from_file(small_sensor / "sensor.toml"), 7, 40.0, TRIED)
    FinishedSeries.resumed(*same).path.write_text(content)
    with pytest.raises(MembraneError, match="remove the file to begin anew"):
        FinishedSeries.resumed(*same)


def test_where_nothing_can_be_kept_the_work_goes_on(small_sensor, tmp_path):
    (tmp_path / "file").write_text("")
    finished = FinishedSeries(tmp_path / "file" / "a.json", {})
    with pytest.warns(UserWarning, match="an interruption loses what is done"):
        finished.keep(0, made_up(0))


def test_the_command_says_that_it_goes_on_and_removes_the_file(tried, small_sensor, tmp_path, monkeypatch, capsys):
    sensor = shutil.copytree(small_sensor, tmp_path / "sensor")  # beside which its range is written
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    call = ["check", str(sensor / "sensor.toml"), "--accuracy", "--jobs", "1"]
    tried.interrupt = 3
    assert cli.main(call) == 130
    (file,) = Path().iterdir()
    assert len(json.loads(file.read_text())) == 3 and "what is done so far is kept" in capsys.readouterr().err
    tried.series, tried.interrupt = [], None
    assert cli.main(call) == 0
    assert f"check --accuracy: continues from 3 finished series in {file.name}\n" in capsys.readouterr().err
    assert len(tried.series) == 9 and list(Path().iterdir()) == []
