"""The command as a person uses it, on the example sensor."""

import argparse
import csv
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from torchmembrane import __version__, presets
from torchmembrane.calibrate import camera, rest_error
from torchmembrane.camera import model
from torchmembrane.cli import arguments as types
from torchmembrane.cli import choices
from torchmembrane.cli import main as cli
from torchmembrane.cli.describe import _markers, _opening
from torchmembrane.errors import MembraneError
from torchmembrane.estimators.paper.estimator import FLOWS
from torchmembrane.estimators.registry import ESTIMATORS
from torchmembrane.markers import placement
from torchmembrane.mechanics import hyperelastic
from torchmembrane.presets import draft
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results import store
from torchmembrane.sensor import parts, units
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate import appearance, dataset, frames, simulator
from torchmembrane.surface import checks

EXAMPLES = Path(__file__).parent.parent / "examples"
SENSOR = str(EXAMPLES / "sensor.toml")


@pytest.fixture(scope="module")
def example_reconstructor():
    return Reconstructor(Sensor.from_file(SENSOR))


@pytest.fixture
def built_once(example_reconstructor, monkeypatch):
    """Commands that ask for the example's own reconstructor get this one."""

    def made(sensor, *estimator, **options):
        same = sensor.fingerprint == example_reconstructor.sensor.fingerprint
        its_own = same and options.get("model") in (None, "neo_hookean")
        return example_reconstructor if its_own else Reconstructor(sensor, *estimator, **options)

    for module in ("cli.build", "reconstruct"):
        monkeypatch.setattr(f"torchmembrane.{module}.Reconstructor", made)


@pytest.fixture
def sensor_copy(tmp_path):
    """Path of an editable copy of the example sensor; `edit(old, new)` changes its text."""
    for name in ("sensor.toml", "rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copyfile(EXAMPLES / name, tmp_path / name)
    path = tmp_path / "sensor.toml"

    def edit(old: str, new: str) -> str:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        return str(path)

    return edit


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def test_reconstruct_examples_end_to_end(tmp_path, capsys):
    out = tmp_path / "out"
    images = [EXAMPLES / "press_on_axis.png", EXAMPLES / "rest.png"]
    code, said, progress = run(capsys, "reconstruct", SENSOR, *images, "--out", out)
    assert code == 0 and "frames: 2 reconstructed, 0 failed" in said and "frame" in progress
    with np.load(out / "press_on_axis.npz") as pressed, np.load(out / "rest.npz") as rest:
        assert int(pressed["status"]) == int(rest["status"]) == 0
        assert np.abs(rest["displacement"]).max() < 1e-3 < np.abs(pressed["displacement"]).max()
        assert pressed["displacement"][len(pressed["displacement"]) // 2, 2] < -0.05


def test_options_reach_the_reconstructor(monkeypatch, tmp_path, capsys):
    def refuse(sensor, estimator, *, settings, model, locator):
        raise MembraneError(f"{sensor.name} {estimator} {model} {getattr(settings, 'flow', None)} {locator}")

    monkeypatch.setattr("torchmembrane.cli.build.Reconstructor", refuse)
    call = ("reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out")
    assert "nh130 force-balance None None None" in run(capsys, *call)[2]
    options = ("--locator", "soft", "--energy", "harmonic", "--flow", "smooth")
    assert "--flow smooth: force-balance has no such choice" in run(capsys, *call, *options)[2]
    assert "nh130 paper harmonic smooth soft" in run(capsys, *call, "--estimator", "paper", *options)[2]


def test_some_frames_failed_gives_1_and_says_which(built_once, tmp_path, capsys):
    (tmp_path / "broken.png").write_bytes(b"no image")
    Image.new("L", (640, 480)).save(tmp_path / "dark.png")
    images = [tmp_path / "broken.png", tmp_path / "dark.png", EXAMPLES / "rest.png"]
    code, said, errors = run(capsys, "reconstruct", SENSOR, *images, "--out", tmp_path / "out")
    assert code == 1 and "frames: 1 reconstructed, 2 failed" in said
    assert f"{images[0]}: not readable" in errors and f"{images[1]}: blank" in errors
    with open(tmp_path / "out" / "summary.csv", newline="") as file:
        rows = [(row["name"], row["status"]) for row in csv.DictReader(file)]
    assert rows == [("broken", "-1"), ("dark", "4"), ("rest", "0")]


@pytest.mark.parametrize("rest", [["first:0"], ["first:-1"], ["first:2", "a.png"]])
def test_a_recording_s_rest_is_of_at_least_one_frame(rest, small_sensor, small_images, tmp_path, capsys):
    call = ("reconstruct", small_sensor / "sensor.toml", small_images[0], "--out", tmp_path / "out", "--rest", *rest)
    code, _, errors = run(capsys, *call)
    assert code == 2 and f"--rest {' '.join(rest)}: expected images, or first:N with N of at least 1" in errors


def test_parquet_and_figures(built_once, tmp_path, capsys):
    arguments = ("--out", tmp_path, "--format", "parquet", "--figures", "--batch", "1")
    assert run(capsys, "reconstruct", SENSOR, EXAMPLES / "flat_plate.png", *arguments)[0] == 0
    assert (tmp_path / "frames" / "part-00000.parquet").exists() and (tmp_path / "flat_plate.png").exists()


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("reconstruct", "none.toml", EXAMPLES / "rest.png"), "none.toml"),
        (("reconstruct", SENSOR, "none.png"), "none.png"),
        (("reconstruct", SENSOR, EXAMPLES / "rest.png", EXAMPLES / "rest.png"), "'rest'"),
        (("check", "none.toml"), "none.toml"),
        (("view", "none.npz"), "none.npz"),
    ],
)
def test_wrong_arguments_give_2_and_a_message(tmp_path, capsys, arguments, expected):
    out = ("--out", tmp_path / "out")
    code, said, errors = run(capsys, *arguments, *out)
    assert code == 2 and errors.startswith("torchmembrane: error: ") and expected in errors and said == ""
    assert not (tmp_path / "out").exists()


def test_another_sensor_s_folder_gives_2(built_once, sensor_copy, tmp_path, capsys):
    assert run(capsys, "reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out")[0] == 0
    other = sensor_copy("prestretch = 1.3", "prestretch = 1.4")
    code, _, errors = run(capsys, "reconstruct", other, EXAMPLES / "rest.png", "--out", tmp_path / "out")
    assert code == 2 and "another sensor" in errors


def test_other_options_give_2(built_once, tmp_path, capsys):
    call = ("reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out")
    assert run(capsys, *call)[0] == 0
    code, said, _ = run(capsys, *call, "--energy", "neo_hookean")  # what the sensor file says anyway
    assert code == 0 and "frames: 0 reconstructed, 0 failed, 1 finished before" in said
    code, _, errors = run(capsys, *call, "--energy", "harmonic")
    assert code == 2 and "--energy neo_hookean" in errors


@pytest.mark.parametrize("arguments", [[], ["reconstruct", SENSOR], ["reconstruct", SENSOR, "a.png", "--batch", "0"]])
def test_usage_errors_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2 and "usage: torchmembrane" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("init a.toml --diameter 24", "unrecognized arguments: --diameter 24; did you mean --radius (half the diameter)?"),
        ("init a.toml --fov 90", "did you mean --view?"),
        ("init a.toml --lens equidistant", "did you mean 'fisheye'?"),
        ("check a.toml --acuracy", "did you mean --accuracy?"),
        ("calibrate weight a.toml", "did you mean 'material'?"),
        ("reconstrct a.toml", "did you mean 'reconstruct'?"),
        ("check a.toml b.toml", "torchmembrane check: error: unrecognized arguments: b.toml"),
    ],
)
def test_wrong_arguments_are_answered_in_two_lines_with_what_was_meant(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments.split())
    lines = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and len(lines) == 2 and said in lines[1]


def test_a_vector_may_begin_with_a_minus():
    call = "simulate a.toml --indenter sphere --radius 1 --depth 1 --direction -0.5,0,0.87 --out out".split()
    assert cli.command_parser().parse_args(call).direction == [-0.5, 0.0, 0.87]


def test_cuda_without_a_device_is_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    code, _, errors = run(capsys, "reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out", "--device", "cuda")
    assert code == 2 and "CUDA" in errors


def test_interruption_gives_130(built_once, monkeypatch, tmp_path, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchmembrane.jobs.local.reconstruct_files", stop)
    code, _, errors = run(capsys, "reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out")
    assert code == 130 and "interrupted" in errors


def test_check_says_what_it_understood_and_draws_it(built_once, tmp_path, capsys):
    code, said, _ = run(capsys, "check", SENSOR, "--out", tmp_path / "sensor.png")
    assert code == 0
    camera = ("fisheye, 640 x 480 px", "field of view 229 x 172 degrees", "no ports")
    membrane = ("grid 33 x 33: 1089 vertices, 128", "neo_hookean, prestretch 1.3", "tension 1.34 N/mm,", "hPa", "liquid")
    for part in (*camera, *membrane, "121 listed", "121 of 121 found"):
        assert part in said
    assert Image.open(tmp_path / "sensor.png").width == 1600


def test_check_names_missing_markers(sensor_copy, tmp_path, capsys):
    path = sensor_copy("finger", "scratched")
    image = np.array(Image.open(tmp_path / "rest.png"))
    image[226:260, 305:340] = image[232, 305]
    Image.fromarray(image).save(tmp_path / "rest.png")
    code, said, _ = run(capsys, "check", path)
    assert code == 0 and "120 of 121 found" in said
    assert "not found: marker 60 (from 0), expected at pixel 32" in said


def test_check_lists_the_first_missing_markers_and_measures_those_found(small_sensor):
    """Of 49: 20 are missing, 29 found, of which one is 5 px off."""
    sensor = Sensor.from_file(small_sensor / "sensor.toml")
    sensor = replace(sensor, markers=replace(sensor.markers, rest_image=np.zeros((120, 160))))
    off = torch.zeros(49, 2)
    off[19], off[20] = 70.0, torch.tensor([3.0, -4.0])
    made = SimpleNamespace(rest_pixels=torch.zeros(49, 2), observer=SimpleNamespace(measured_rest=off))
    lines = _markers(sensor, made, {"confidence": np.arange(49) >= 20, "status": np.array(0)})
    missing = [line for line in lines if "not found: marker" in line]
    assert len(missing) == 12 and "29 of 49 found in the rest image" in lines and "  and 8 more" in lines
    assert "they lie 0.93 px (rms; at most 5.00 px) from where the model has them" in lines


def test_the_field_of_view_ends_at_the_outer_edges_of_the_image():
    """A pinhole of 8 x 6 px sees 8 x 6 px about its centre."""
    camera = model.Camera("pinhole", (8, 6), (4.0, 3.0), (3.5, 2.5))
    assert [_opening(camera, axis) for axis in (0, 1)] == pytest.approx([90.0, 90.0])


def test_check_of_a_bad_sensor_gives_2(sensor_copy, capsys):
    code, _, errors = run(capsys, "check", sensor_copy("prestretch = 1.3", "prestretch = 0.5"))
    assert code == 2 and "prestretch" in errors and "Traceback" not in errors


def test_check_of_a_sensor_whose_markers_are_not_found(monkeypatch, tmp_path, capsys):
    def refuse(*_, **__):
        raise MembraneError("only 3 of 121 markers are found in the rest image")

    monkeypatch.setattr("torchmembrane.reconstruct.Reconstructor", refuse)
    code, said, errors = run(capsys, "check", SENSOR, "--out", tmp_path / "sensor.png")
    assert code == 2 and "only 3 of 121" in errors and "fisheye" in said and (tmp_path / "sensor.png").exists()


def test_view_draws_a_stored_result(built_once, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("torchmembrane.cli.view._has_display", lambda: False)
    assert run(capsys, "reconstruct", SENSOR, EXAMPLES / "rest.png", "--out", tmp_path / "out")[0] == 0
    result = tmp_path / "out" / "rest.npz"
    code, said, _ = run(capsys, "view", result, "--image", EXAMPLES / "rest.png", "--out", tmp_path / "a.png")
    assert code == 0 and str(tmp_path / "a.png") in said and Image.open(tmp_path / "a.png").size == (1066, 1170)
    assert run(capsys, "view", result)[0] == 0 and (tmp_path / "out" / "rest_view.png").exists()
    code, _, errors = run(capsys, "view", shutil.copy(result, tmp_path))
    assert code == 2 and "mesh.npz" in errors


@pytest.mark.parametrize("command", ["init", "reconstruct", "check", "view", "export"])
def test_help_shows_examples_and_exit_codes(command, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--help"])
    said = capsys.readouterr().out
    assert stop.value.code == 0 and f"  torchmembrane {command} " in said and "examples:" in said
    assert "exit code" in said or command == "view"


HEAVY = ("torch", "kornia", "scipy", "matplotlib", "tqdm", "numpy", "PIL")


def test_help_loads_nothing_heavy():
    calls = [["--help"], ["--version"], ["init", "--help"], ["simulate", "--help"], ["calibrate", "ports", "--help"]]
    code = (
        "import sys\nfrom torchmembrane.cli.main import main\n"
        f"for call in {calls!r}:\n    try:\n        main(call)\n    except SystemExit as stop:\n        assert stop.code == 0\n"
        f"    print('loaded', call[0], [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    said = [line for line in done.stdout.splitlines() if line.startswith("loaded ")]
    assert said == [f"loaded {call[0]} []" for call in calls]


def test_the_options_choices_are_what_the_package_has():
    assert choices.ESTIMATORS == tuple(ESTIMATORS) and choices.ENERGIES == hyperelastic.MODELS
    assert choices.FLOWS == tuple(FLOWS)
    assert choices.RESULT_FORMATS == store.FORMATS
    assert choices.LOCATORS == placement.LOCATORS
    assert (*choices.DRAFTS, choices.OUTLINE) == tuple(draft.SHAPES) and choices.LENGTH_UNITS == tuple(units.METRE)
    assert choices.LENSES == tuple(model.COEFFICIENTS) and choices.LONGEST_SIDE == model.LONGEST_SIDE
    assert (choices.HEIGHT_ERROR, choices.MOST_HEIGHT_ERROR) == (rest_error.HEIGHT_ERROR, rest_error.MOST_ERROR)
    assert choices.FARTHEST == checks.FARTHEST
    assert choices.FILLINGS == parts.FILLINGS
    assert choices.PRESETS == presets.NAMES and choices.INDENTERS == dataset.KINDS and choices.LEGS == simulator.LEGS
    assert choices.SIMULATION_FORMATS == frames.FORMATS and choices.PORTS == camera.PORTS
    assert (choices.HIGHLIGHT, choices.BLUR) == (appearance.Appearance.highlight, appearance.Appearance.blur)
    assert (choices.MOST_BLUR, choices.MOST_DECIBEL) == (appearance.RANGES["blur"][1], appearance.RANGES["noise"][1])


@pytest.mark.parametrize(
    "kind, good, value, bad",
    [
        (types.positive, "0.5", 0.5, ["0", "-1", "nan", "inf", "1,2", "a", ""]),
        (types.count, "12", 12, ["0", "-3", "1.5", "", "1e3"]),
        (types.seed, "0", 0, ["-1", "0.5", "x"]),
        (types.number_from(-2, 3), "-2", -2.0, ["-2.01", "3.01", "nan", "inf", "x"]),
        (types.number_from(-2, 3), "3", 3.0, ["-3"]),
        (types.share, "8/8", (8, 8), ["0/8", "9/8", "-1/8", "1/0", "1", "a/8", "1/8/8"]),
        (types.vector, "1,-2,3.5", [1.0, -2.0, 3.5], ["1,2", "1,2,3,4", "1,2,nan", "1,2,x", ""]),
        (types.positive_pair("two radii"), "0.1,2", [0.1, 2.0], ["1", "1,0", "1,2,3", "1,-2"]),
        (types.count_pair("two counts"), "11,8", [11, 8], ["11", "11,0", "11,8.5", "11;8"]),
        (types.numbers("numbers"), "0,17", [0, 17], ["", "1,", "a", "1.5"]),
        (types.some_of(("push", "slide"), "legs"), "slide,push", ["slide", "push"], ["", "pull", "push,"]),
    ],
)
def test_types_of_arguments_say_what_they_expect(kind, good, value, bad):
    assert kind(good) == value
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError, match="expected"):
            kind(text)


def test_version_also_as_a_module(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchmembrane", "--version"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("torchmembrane", run_name="__main__")
    assert stop.value.code == 0 and capsys.readouterr().out.strip() == f"torchmembrane {__version__}"
