"""Every length unit gives the same answer for one membrane."""

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from moved_sensors import moved
from PIL import Image
from scipy.spatial.transform import Rotation

import torchmembrane as tm
from torchmembrane.calibrate import explained, presses
from torchmembrane.cli import main as cli
from torchmembrane.integrations.frame_messages import SiUnits
from torchmembrane.live.line import described
from torchmembrane.live.loop import LiveFrame, StreamStats
from torchmembrane.machine_code import using
from torchmembrane.sensor.units import millimetre
from torchmembrane.simulate.render import Renderer

CAP = {"radius": 8.0, "height": 4.0, "distance": 14.0, "pitch": 2.1, "thickness": 0.4}  # mm
MODULUS = 0.3  # N/mm^2
DESIGN = "--shape cap --image-size 160,120 --focal 100 --prestretch 1.3 --filling gas".split()
BALL = "--indenter sphere --direction 0.3,0,0.95".split()
MOTIONS = np.array([[0.0, 0, 0, 0, 0, 0], [1.5, 0, 0, 0, -3, 0], [0, -1.5, 0, -3, 0, 0]])  # mm, degrees
NEAR = 2e-3  # of results in two units, relative: float32 rounds a membrane of 8 otherwise than one of 8000
LENGTHS = {"deepest", *(f"{key}_{axis}" for key in ("contact_1", "deepest") for axis in "xyz")}
PRESSURES = {"pressure", "pressure_change"}
"""Columns of summary.csv."""


class Tour:
    """The commands on one membrane in one unit, and what they say.

    Args:
        unit: of length.
        folder: to work in.
    """

    def __init__(self, unit: str, folder: Path) -> None:
        self.unit, self.one, self.folder, self.said = unit, millimetre(unit), folder, {}

    def go(self, capsys) -> "Tour":
        self.capsys = capsys
        for step in (self.draft, self.press, self.rest, self.views, self.depth, self.material):
            step()
        return self

    def run(self, name, *arguments):
        code = cli.main([str(argument) for argument in arguments])
        self.said[name], errors = self.capsys.readouterr()
        assert code == 0, errors

    def given(self, **lengths):
        """Options of lengths in mm."""
        return [part for name, length in lengths.items() for part in (f"--{name}", repr(length * self.one))]

    def calibrate(self, step, *arguments, name=None):
        self.run(name or step, "calibrate", step, *arguments, "--out", self.folder / (name or step))

    def draft(self):
        path = self.folder / "sensor.toml"
        stiff = "--shear-modulus", repr(MODULUS / self.one**2)
        self.run("init", "init", path, "--unit", self.unit, *DESIGN, *self.given(**CAP), *stiff)
        path.write_text(re.sub(r"grid = \[\d+, \d+\]", "grid = [9, 9]", path.read_text()))
        self.calibrate("layout", path, "--pitch", 20)

    def press(self):
        out = self.folder / "press"
        self.run("simulate", "simulate", self.folder / "sensor.toml", *BALL, *self.given(radius=3.0, depth=1.2), "--out", out)
        self.run("check", "check", out / "sensor.toml", "--out", self.folder / "check.png")
        self.run("reconstruct", "reconstruct", out / "sensor.toml", out / "press.png", "--out", out / "results", "--figures")

    def rest(self):
        self.calibrate("rest", self.folder / "sensor.toml", self.folder / "press" / "sensor_rest.png")

    def views(self):
        design, paths = tm.Sensor.from_file(self.folder / "sensor.toml"), []
        motions = MOTIONS * [*[self.one] * 3, 1, 1, 1]
        for k, motion in enumerate(motions):
            back = Rotation.from_rotvec(np.deg2rad(motion[3:])).inv()
            seen = moved(design, back, -back.apply(motion[:3]), 49)
            paths.append(self.folder / f"view{k}.png")
            Image.fromarray((255 * Renderer(seen)(seen.membrane.rest)).round().byte().numpy()).save(paths[-1])
        table = self.folder / "motions.csv"
        np.savetxt(table, motions, "%.17g", ",", header="x,y,z,turn_x,turn_y,turn_z")
        self.calibrate("views", self.folder / "sensor.toml", *paths, "--motions", table)

    def depth(self):
        sensor, image = tm.Sensor.from_file(self.folder / "press" / "sensor.toml"), self.folder / "press" / "sensor_rest.png"
        depth = Renderer(sensor).depth(sensor.membrane.rest).numpy()
        np.save(self.folder / "depth.npy", depth)
        Image.fromarray(np.nan_to_num(depth / self.one).round().astype(np.uint16)).save(self.folder / "depth.png")
        for kind in ("npy", "png"):
            given = self.folder / "sensor.toml", self.folder / f"depth.{kind}", "--image", image
            self.calibrate("depth", *given, name=f"depth of {kind}")

    def material(self):
        press = self.folder / "press"
        force = np.linalg.norm(np.load(press / "press_truth.npz")["force"])
        (self.folder / "forces.csv").write_text(f"image,force\npress.png,{force}\n")
        self.calibrate("material", press / "sensor.toml", press / "press.png", "--forces", self.folder / "forces.csv")

    def sensor(self, step):
        return tm.Sensor.from_file(self.folder / step / "sensor.toml")

    def lengths_said(self, step):
        """The numbers before the unit, and before newtons per unit squared, in mm and N/mm^2."""
        number = r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?)"
        lengths = re.findall(rf"{number} {self.unit}(?![²³\w/])", self.said[step])
        stresses = re.findall(rf"{number} N/{self.unit}²", self.said[step])
        return [float(text) / self.one for text in lengths] + [float(text) * self.one**2 for text in stresses]

    def report(self, step):
        """Values and deviations by name, in mm, degrees and N/mm, as the report prints them."""
        rows = re.findall(r"  (\S+) +(\S+) ± (\S+) +(degrees|N/\w+|\w*) +\(before", self.said[step])
        scale = {self.unit: 1 / self.one, f"N/{self.unit}": self.one}
        return {name: (float(value) * scale.get(unit, 1), float(sd) * scale.get(unit, 1)) for name, value, sd, unit in rows}


@pytest.fixture(scope="module")
def tours(tmp_path_factory):
    """Those that have been made, by unit."""
    made = {}

    def tour(unit, capsys):
        if unit not in made:
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(explained, "GRID", (9, 9))
                patched.setattr(presses, "STRETCHES", np.geomspace(1.05, 1.7, 5))
                patched.setattr(presses, "BETWEEN", 2)
                if unit != "m":  # figures of each kind are drawn once
                    patched.setattr(Figure, "draw", lambda *_: None)
                made[unit] = Tour(unit, tmp_path_factory.mktemp(unit)).go(capsys)
        return made[unit]

    return tour


UNITS = ["um", *(pytest.param(unit, marks=pytest.mark.full) for unit in ("mm", "cm", "inch"))]
"""The smallest unit; those between it and the largest when all tests run."""


@pytest.fixture(params=UNITS)
def pair(request, tours, capsys):
    """The tour in metres, the largest unit, and in another one."""
    return tours("m", capsys), tours(request.param, capsys)


def test_every_step_of_the_tour_finds_the_same(pair):
    metres, other = pair
    for step in ("layout", "press", "rest", "views", "depth of npy", "depth of png", "material"):
        one, two = metres.sensor(step), other.sensor(step)
        assert (one.length_unit, two.length_unit) == ("m", other.unit) and one.markers.sizes == two.markers.sizes
        for a, b in (one.markers.positions, two.markers.positions), (one.membrane.rest.numpy(), two.membrane.rest.numpy()):
            assert np.abs(a / metres.one - b / other.one).max() < NEAR, step
        assert two.material.modulus * other.one == pytest.approx(one.material.modulus * metres.one, rel=NEAR)
        assert two.material.prestretch == pytest.approx(one.material.prestretch, rel=NEAR)
        assert two.cavity.pressure == one.cavity.pressure


def test_the_summary_of_a_press_is_the_same(pair):
    (one,), (two,) = (list(csv.DictReader((tour.folder / "press" / "results" / "summary.csv").open())) for tour in pair)

    def scale(key, tour):
        """To mm and N."""
        return 1 / tour.one if key in LENGTHS else tour.one**2 if key in PRESSURES else 1.0

    assert one["status"] == two["status"] == "0" and two["length_unit"] == pair[1].unit and two["force_unit"] == "N"
    for key in (
        *LENGTHS,
        *PRESSURES,
        "pressure_hpa",
        "force",
        "force_x",
        "force_z",
        "residual_px",
        "contacts",
        "markers_found",
    ):
        in_metres, other = (float(row[key]) * scale(key, tour) for row, tour in zip((one, two), pair, strict=True))
        assert other == pytest.approx(in_metres, rel=5 * NEAR, abs=NEAR), key


def test_what_the_commands_print_is_the_same_to_the_digits_shown(pair):
    metres, other = pair
    for step in ("check", "simulate", "layout", "rest", "views", "depth of npy", "material"):
        one, two = metres.lengths_said(step), other.lengths_said(step)
        assert len(one) == len(two) and (one or step == "material"), step
        assert two == pytest.approx(one, rel=0.02, abs=1e-5), step
    for step in ("rest", "views", "material"):
        one, two = metres.report(step), other.report(step)
        assert one.keys() == two.keys() and one
        for name, (value, deviation) in one.items():
            assert two[name][1] == pytest.approx(deviation, rel=0.1), name
            assert abs(two[name][0] - value) < 0.3 * deviation, name  # two digits of the deviation are shown


def test_the_layout_is_drawn_in_millimetres_and_listed_to_as_many_digits(pair):
    drawings = [ElementTree.parse(tour.folder / "layout" / "layout.svg").getroot() for tour in pair]
    one, two = ([drawing.attrib, *(dot.attrib for dot in drawing.findall("{*}ellipse"))] for drawing in drawings)
    assert one[0] == two[0] and two[0]["width"] == "18.560mm" and len(one) == len(two) > 15
    for a, b in zip(one[1:], two[1:], strict=True):
        for key in ("cx", "cy", "rx", "ry"):
            assert float(a[key]) == pytest.approx(float(b[key]), abs=2e-3)
    rows = [list(csv.DictReader((tour.folder / "layout" / "layout.csv").open())) for tour in pair]
    for a, b in zip(*rows, strict=True):
        for key in ("x", "y", "z", "radius"):
            in_mm = (float(row[key]) / tour.one for row, tour in zip((a, b), pair, strict=True))
            assert next(in_mm) == pytest.approx(next(in_mm), rel=1e-3, abs=1e-3)


def test_examples_in_a_drafted_file_are_lengths_of_its_unit(pair):
    texts = [(tour.folder / "sensor.toml").read_text() for tour in pair]
    for key in ("distance", "thickness"):
        (one,), (two,) = (re.findall(rf"^# {key} = (\S+)", text, re.M) for text in texts)
        assert float(two) / pair[1].one == pytest.approx(float(one) / pair[0].one, rel=1e-5)


def test_the_live_line_shows_digits_in_every_unit(pair):
    lines = []
    for tour in pair:
        results = tm.read_results(tour.folder / "press" / "results")
        frame = results["press"]
        stats = StreamStats()
        stats.add(LiveFrame(0, 0.0, np.zeros((2, 2), np.uint8), frame, 0.05))
        line = described(LiveFrame(0, 0.0, np.zeros((2, 2), np.uint8), frame, 0.05), stats, results.mesh)
        force, moment = (re.search(rf"{key} (\S+) (\S+) (\S+) N", line).groups() for key in ("force", "moment"))
        lines.append(np.array([*map(float, force), *(float(part) / tour.one for part in moment)]))
    sizes = np.repeat([np.abs(half).max() for half in lines[0].reshape(2, 3)], 3)
    assert (np.abs(lines[1] - lines[0]) < 5 * NEAR * sizes).all()


@pytest.mark.parametrize("unit", ["m", *UNITS])
def test_tensor_operations_find_what_machine_code_finds(unit, tours, capsys):
    """On other devices, with gradients, in exported models and until machine code is compiled."""
    tour = tours(unit, capsys)
    reconstructor = tm.Reconstructor(tour.sensor("press"))
    images = reconstructor.read(tour.folder / "press" / "press.png")
    with torch.no_grad(), using(False):
        found = reconstructor(images).frame(0)
    kept = tm.read_results(tour.folder / "press" / "results")["press"]
    assert np.abs(found["force"] - kept["force"]).max() < 5 * NEAR * np.linalg.norm(kept["force"])
    assert np.abs(found["vertices"] - kept["vertices"]).max() < 5 * NEAR * tour.one


def test_messages_are_in_si_units_whatever_the_sensor_s(pair):
    si = []
    for tour in pair:
        results, gas = tm.read_results(tour.folder / "press" / "results"), tour.sensor("press").gas_pressure
        units, frame = SiUnits(results.mesh, gas), results["press"]
        points = units.points(frame)
        si.append([units.moment(frame), points[:, :3], points[:, 3] / np.abs(points[:, 3]).max(), units.pressure(frame)])
    for one, two in zip(*si, strict=True):
        assert np.abs(two - one).max() < 5 * NEAR * np.abs(one).max()
    assert 1.1e5 < si[1][3] < 1.5e5  # Pa, absolute


def test_reports_as_json_have_the_unit_beside_each_number(pair):
    for step, tour in (("views", pair[1]), ("rest", pair[1])):
        parameters = json.loads((tour.folder / step / "report.json").read_text())["parameters"]
        assert {row["unit"] for row in parameters.values()} == {"degrees", tour.unit}
