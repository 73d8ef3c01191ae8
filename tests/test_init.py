"""Every sensor file that `init` writes is read and reconstructs."""

import csv
import math
import re

import cv2
import numpy as np
import pytest
import torch

from torchmembrane import Camera, MembraneError, Sensor
from torchmembrane.calibrate.rim import find_rim
from torchmembrane.cli.main import main
from torchmembrane.presets.annotate import annotate
from torchmembrane.presets.dot_list import read_drafted_dots
from torchmembrane.presets.draft import (
    RimCircle,
    balanced,
    drafted_dots,
    drafted_surface,
    overpressure,
    pressure_in_hectopascal,
)
from torchmembrane.sensor.parts import Cavity, Markers, Material
from torchmembrane.sensor.units import METRE
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.render import Renderer

FISHEYE = "--image-size 640,480 --lens fisheye --view 150".split()
full = pytest.mark.full
SHAPES = {
    "dome": "--radius 12 --distance 12",
    "cap": "--radius 12 --height 7 --distance 12",
    "bubble": "--radius 30 --height 18 --distance 25 --shear-modulus 0.3 --thickness 0.3 --prestretch 1.3",
    "fingertip": "--semi-axes 10,8,12 --distance 8",
    "half_cylinder": "--radius 10 --length 30 --half-angle 75 --distance 20",
}


def drafted(tmp_path, shape, *more):
    path = tmp_path / "sensor.toml"
    assert main(["init", str(path), "--shape", shape, *SHAPES[shape].split(), *FISHEYE, *more]) == 0
    return path


def test_an_image_may_be_wider_than_a_thousand_pixels(tmp_path):
    path = tmp_path / "sensor.toml"
    numbers = "--shape dome --radius 20 --distance 30 --image-size 1280,720 --focal 420"
    assert main(["init", str(path), *numbers.split()]) == 0
    assert Sensor.from_file(path).camera.image_size == (1280, 720)


@pytest.mark.parametrize(
    "shape", ["dome", "bubble", "half_cylinder", pytest.param("cap", marks=full), pytest.param("fingertip", marks=full)]
)
def test_what_is_written_passes_check_and_reconstructs_a_press(tmp_path, shape):
    path = drafted(tmp_path, shape)
    assert main(["check", str(path)]) == 0
    size = Sensor.from_file(path).membrane.size
    pressed = ["--radius", str(size / 6), "--depth", str(size / 12), "--noise", "40"]
    press, results = tmp_path / "press", tmp_path / "results"
    assert main(["simulate", str(path), "--indenter", "sphere", *pressed, "--out", str(press)]) == 0
    assert main(["reconstruct", str(press / "sensor.toml"), str(press / "press.png"), "--out", str(results)]) == 0
    (row,) = csv.DictReader((results / "summary.csv").open())
    assert row["status_text"] == "ok" and row["force_unit"] == ("N" if shape == "bubble" else "relative")
    assert float(row["deepest"]) == pytest.approx(-size / 12, rel=0.25)


def test_every_key_that_is_written_has_a_word(tmp_path):
    for shape in SHAPES:
        lines = drafted(tmp_path, shape, "--force").read_text().splitlines()
        assert not [line for line in lines if " = " in line and not line.startswith("#") and "  # " not in line]


@pytest.mark.parametrize("unit", METRE)
def test_the_overpressure_is_that_of_a_neo_hookean_sphere(unit):
    """`p = 2 mu H / R (1 / l - 1 / l^7)` with thickness H and radius R before it is blown up."""
    stretch, mu, flat, before = 1.4, 0.3, 0.5, 10.0
    membrane = drafted_surface("dome", {"radius": stretch * before}, 20.0).membrane((65, 65))
    p = 2 * mu * flat / before * (1 / stretch - 1 / stretch**7) * METRE[unit] ** 2 / 100
    blown_up = Material("neo_hookean", stretch, None, mu, flat / stretch**2)
    assert overpressure(membrane, blown_up, unit) == pytest.approx(p, rel=5e-3)


@pytest.mark.parametrize("unit", METRE)
def test_what_is_proposed_in_comments_is_the_same_in_every_unit(unit, tmp_path):
    path, one = tmp_path / "sensor.toml", METRE[unit] / 1000
    path.write_text("[material]\nprestretch = 1.2\n")
    annotate(path, [], True, unit)
    proposed = {key: float(value) for key, value in re.findall(r"^# (\w+) = ([-+.e\d]+)", path.read_text(), re.MULTILINE)}
    lengths = {"distance": 2.0 * one, "shear_modulus": 0.3 / one**2}  # 0.3 N/mm^2
    assert {key: proposed[key] for key in lengths} == pytest.approx(lengths, rel=1e-5) and proposed["index"] == 1.33


def test_of_overpressure_prestretch_and_modulus_any_two_give_the_third():
    membrane = drafted_surface("cap", {"radius": 12.0, "height": 7.0}, 20.0).membrane((33, 33))
    held = overpressure(membrane, Material("neo_hookean", 1.3, None, 0.4, 0.5), "mm")
    stretched, said = balanced(membrane, "mm", held, shear_modulus=0.4, thickness=0.5)
    assert stretched.prestretch == pytest.approx(1.3, rel=1e-5) and "from the overpressure" in said[0]
    stiff, said = balanced(membrane, "mm", held, prestretch=1.3, thickness=0.5)
    assert stiff.shear_modulus == pytest.approx(0.4, rel=1e-4) and "from the overpressure" in said[0]
    _, said = balanced(membrane, "mm", held, 1.3, 0.4, 0.5)
    assert not said
    _, said = balanced(membrane, "mm", 1.2 * held, 1.3, 0.4, 0.5)
    assert "disagree" in said[0]


@pytest.mark.parametrize("shape", ["dome", "half_cylinder"])
def test_dots_are_the_same_in_whatever_frame_they_are_given(tmp_path, shape):
    lengths = {"radius": 12.0, "length": 30.0, "half_angle": 75.0}
    surface, camera = drafted_surface(shape, lengths, 20.0), Camera("fisheye", (640, 480), (200, 200), (320, 240))
    X, sizes = drafted_dots(surface)
    x, y, h = (X - [0, 0, 20.0]).T
    angle, azimuth = np.degrees(np.arctan2(np.hypot(x, y), h)), np.degrees(np.arctan2(y, x))
    tables = {
        "x,y,z": X,
        "x,y,h": np.stack([x, y, h], -1),
        "x,y": np.stack([x, y], -1),
        "angle,azimuth": np.stack([angle, azimuth], -1),
        "u,v": camera.point_to_pixel(torch.from_numpy(X)).numpy(),
    }
    for header, values in tables.items():
        path = tmp_path / "dots.csv"
        rows = [",".join(map(repr, row)) + f",{size}" for row, size in zip(values.tolist(), sizes, strict=True)]
        path.write_text("\n".join([f"{header},size", *rows]) + "\n")
        got, got_sizes = read_drafted_dots(path, surface, camera)
        assert got_sizes == sizes and np.abs(got - X).max() < 0.02, header


def test_a_pitch_that_gives_too_many_dots_is_refused_with_their_number():
    """The area of half a sphere over the pitch's square."""
    with pytest.raises(MembraneError, match=r"a pitch of 0.05 gives (\d+) dots; expected one that gives 8 to") as refused:
        drafted_dots(drafted_surface("dome", {"radius": 12.0}, 15.0), 0.05)
    assert int(re.search(r"gives (\d+) dots", str(refused.value))[1]) == pytest.approx(2 * np.pi * (12 / 0.05) ** 2, rel=0.02)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_the_rim_s_circle_gives_the_distance_and_the_focal_length(model):
    camera = Camera(model, (640, 480), (200, 200), (320, 240))
    pixel = camera.point_to_pixel(torch.tensor([12.0, 0.0, 15.0], dtype=torch.float64))
    circle = RimCircle(12.0, float(pixel[0]) - 320, model)
    assert circle.distance(200.0) == pytest.approx(15.0) and circle.focal(15.0) == pytest.approx(200.0)


def test_a_rest_image_and_the_rim_s_circle_give_the_sensor_and_check_finds_all_of_its_dots(tmp_path, capsys):
    design, photo = Sensor.from_file(drafted(tmp_path, "dome")), tmp_path / "rest.png"
    image = noisy(Renderer(design, samples=2)(design.membrane.rest), 40.0, np.random.default_rng(0))
    cv2.imwrite(str(photo), (255 * image).round().byte().numpy())
    rim = torch.tensor([12.0, 0.0, 12.0], dtype=torch.float64)
    pixels = float(design.camera.point_to_pixel(rim)[0] - design.camera.centre[0])
    made, shape = tmp_path / "photo" / "sensor.toml", "--shape dome --radius 12 --view 150 --lens fisheye".split()
    arguments = [*shape, "--rest", str(photo), "--rim", f"319.5,239.5,{pixels}"]
    assert main(["init", str(made), *arguments]) == 0
    found = Sensor.from_file(made)
    assert found.surface.values["base_z"] == pytest.approx(12.0, abs=1e-3)
    assert found.camera.focal.tolist() == design.camera.focal.tolist()
    capsys.readouterr()
    assert main(["check", str(made)]) == 0
    dots = len(design.markers.positions)
    said = capsys.readouterr().out
    assert f"{dots} placed on the rest surface" in said and f"{dots} of {dots} found in the rest image" in said


def photographed(tmp_path, focal=(200.0, 200.0)):
    """A rest image, its noise 40 dB, of a dome whose rim is about (327.5, 231); and its radius, px."""
    centre, surface = (327.5, 231.0), drafted_surface("dome", {"radius": 12.0}, 12.0)
    camera, dots = Camera("fisheye", (640, 480), focal, centre), drafted_dots(surface)
    markers, material = Markers("dots", "dark", *dots), Material("neo_hookean", 1.2)
    sensor = Sensor("dome", "mm", camera, surface.membrane((17, 17)), material, Cavity("liquid"), markers, surface)
    image = noisy(Renderer(sensor, samples=2)(sensor.membrane.rest), 40.0, np.random.default_rng(0))
    path = tmp_path / "rest.png"
    cv2.imwrite(str(path), (255 * image).round().byte().numpy())
    on_rim = camera.point_to_pixel(torch.tensor([12.0, 0.0, 12.0], dtype=torch.float64))
    return path, float(on_rim[0]) - centre[0]


def test_the_rim_is_found_in_the_rest_image(tmp_path, capsys):
    image, radius = photographed(tmp_path)
    made, view = tmp_path / "made.toml", str(np.degrees(640 / 200.0))
    call = [
        "init",
        str(made),
        *"--shape dome --radius 12 --lens fisheye --rim auto".split(),
        "--view",
        view,
        "--rest",
        str(image),
    ]
    assert main(call) == 0
    u, v, found = (float(number) for number in re.findall(r"--rim ([\d.]+),([\d.]+),([\d.]+)", capsys.readouterr().out)[0])
    assert [u, v, found] == pytest.approx([327.5, 231.0, radius], abs=0.15)
    assert Sensor.from_file(made).surface.values["base_z"] == pytest.approx(12.0, abs=0.02)


def test_a_rim_that_is_no_circle_is_refused(tmp_path, capsys):
    image, _ = photographed(tmp_path, focal=(220.0, 180.0))
    call = ["init", str(tmp_path / "made.toml"), *"--shape dome --radius 12 --lens fisheye --view 150 --rim auto".split()]
    assert main([*call, "--rest", str(image)]) == 2
    assert "is an ellipse with semi-axes of 172" in capsys.readouterr().err


@pytest.mark.parametrize("outside", [0.02, 0.9])
@pytest.mark.parametrize("markers", [True, False])
def test_an_ellipse_is_found_whether_lighter_or_darker_outside(outside, markers):
    v, u = np.mgrid[:240, :320]
    radius = np.hypot((u - 150) / 110, (v - 125) / 90)
    slope = 50 * np.sign(outside - 0.5)
    image = np.clip((0.5 + outside) / 2 + (radius - 1) * slope, min(outside, 0.5), max(outside, 0.5))
    dots = np.stack(np.meshgrid(np.arange(90, 220, 30), np.arange(75, 185, 25)), -1).reshape(-1, 2)
    for x, y in dots:
        image[np.hypot(u - x, v - y) < 6] = 0.1
    rim = find_rim(image + 0.02 * np.random.default_rng(0).standard_normal(image.shape), dots if markers else None)
    assert [*rim.centre, *rim.half_axes] == pytest.approx([150, 125, 110, 90], abs=0.3)
    assert rim.share > 0.95


@pytest.mark.parametrize("radius", [80.0, 80.25, 80.5, 80.75])
def test_a_rim_is_found_between_the_pixels(radius):
    """Of a blurred edge without noise."""
    v, u = np.mgrid[:240, :320]
    image = 0.2 + 0.6 / (1 + np.exp((np.hypot(u - 160.3, v - 118.8) - radius) / 0.8))
    rim = find_rim(image)
    assert [*rim.centre, *rim.half_axes] == pytest.approx([160.3, 118.8, radius, radius], abs=0.03)


def test_a_rim_that_is_not_in_the_image_is_not_found():
    dots = np.stack(np.meshgrid(np.arange(90, 220, 30), np.arange(75, 185, 25)), -1).reshape(-1, 2)
    v, u = np.mgrid[:240, :320]
    image = 0.7 + 0.02 * np.random.default_rng(0).standard_normal((240, 320))
    for x, y in dots:
        image[np.hypot(u - x, v - y) < 6] = 0.1
    for inside in (dots, None):
        with pytest.raises(MembraneError, match="no rim is seen"):
            find_rim(image, inside)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "--shape is missing"),
        ("--shape dome", "--radius is missing"),
        ("--shape dome --radius 12 --distance 12 --view 100", "--image-size is missing"),
        ("--shape dome --radius 12 --image-size 640,480 --view 100", "--distance is missing"),
        ("--shape dome --radius 12 --image-size 640,480 --distance 12", "--view is missing"),
        (
            "--shape dome --radius 12 --height 3 --image-size 640,480 --distance 12 --view 100",
            "--height is not a length of a dome",
        ),
        ("--shape dome --radius 12 --image-size 640,480 --distance 12 --view 200", "less than 180"),
        ("--shape dome --radius 12 --image-size 640,480 --distance 12 --view 100 --focal 300", "one of them"),
        ("--shape dome --radius 12 --image-size 640,480 --distance 12 --view 100 --overpressure 20hPa", "follows"),
        ("--shape dome --radius 12 --image-size 640,480 --distance 12 --view 100 --rim 1,2,3", "--rest"),
        ("--shape dome --radius 12 --image-size 640,480 --view 100 --rim auto", "--rest"),
        (
            "--shape half_cylinder --radius 12 --length 30 --view 100 --rest rest.png --rim 9,9,5",
            "circular rim (dome, cap, bubble)",
        ),
        ("--shape fingertip --semi-axes 9,7,9 --view 100 --rest rest.png --rim 9,9,5", "circular rim (dome, cap, bubble)"),
    ],
)
def test_what_is_missing_or_too_much_is_named(tmp_path, capsys, arguments, said):
    assert main(["init", str(tmp_path / "sensor.toml"), *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1 and not (tmp_path / "sensor.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--radius 12 --rest {rest} --rim 9,9,0 --focal 385", "expected a positive number"),
        ("--radius 12 --rest {rest} --rim 9,9,5 --distance 0", "the rim behind a pinhole"),
        (
            "--radius 12 --distance 15 --image-size 640,480 --view 120 --lens fisheye --views left right=25,0",
            "right='25,0'; expected",
        ),
    ],
)
def test_numbers_that_cannot_be_are_refused_in_words(tmp_path, capsys, arguments, said):
    cv2.imwrite(str(tmp_path / "rest.png"), np.full((24, 32), 100, np.uint8))
    command = ["init", str(tmp_path / "sensor.toml"), "--shape", "dome", *arguments.format(rest=tmp_path / "rest.png").split()]
    try:
        assert main(command) == 2
    except SystemExit as error:
        assert error.code == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("away, code", [(0.0, 0), (40.0, 2)])
def test_the_distance_of_an_outline_is_told_once(tmp_path, capsys, away, code):
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    points = np.stack([25 * np.cos(turn), 18 * np.sin(turn), np.full(40, away)], 1)
    np.savetxt(tmp_path / "rim.csv", points, delimiter=",", header="x,y,z", comments="")
    given = f"--outline {tmp_path / 'rim.csv'} --height 6 --distance 40 --image-size 640,480 --focal 620 --prestretch 1.1"
    assert main(["init", str(tmp_path / "sensor.toml"), *given.split()]) == code
    assert ("lie at z = 40; expected either z in the camera's frame" in capsys.readouterr().err) == (code == 2)


@pytest.mark.parametrize("text", ["250000 Pa", "2500hPa", "2500 mbar", "250kPa", "2.5 bar", "36.259434 psi"])
def test_a_pressure_is_the_same_in_all_of_its_units(text):
    assert pressure_in_hectopascal(text) == pytest.approx(2500.0, rel=1e-6)


@pytest.mark.parametrize("text", ["20", "20 furlongs", "hPa"])
def test_a_pressure_without_a_known_unit_is_refused(tmp_path, capsys, text):
    with pytest.raises(SystemExit):
        main(["init", str(tmp_path / "sensor.toml"), "--overpressure", text])
    assert "expected a number and its unit" in capsys.readouterr().err


@pytest.mark.parametrize("lost", ["_dots.csv", ".toml"])
def test_no_file_is_written_over_unless_it_is_asked_for(tmp_path, capsys, lost):
    """Not the sensor file, nor one of those beside it, of which another may be the user's own."""
    path = drafted(tmp_path, "dome")
    path.with_name(f"sensor{lost}").unlink()
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert main(["init", str(path), "--shape", "dome", *SHAPES["dome"].split(), *FISHEYE]) == 2
    said = capsys.readouterr().err
    assert "is there already" in said and "--force" in said
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("option, name", [("--dots", "sensor_dots.csv"), ("--rest", "sensor_rest.png")])
def test_what_is_read_is_never_written_over(tmp_path, capsys, option, name):
    path = drafted(tmp_path, "dome")
    given = tmp_path / name
    given.touch()
    (tmp_path / "here").symlink_to(tmp_path)
    before = {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    options = [argument for argument in FISHEYE if argument != "--pitch"]
    command = ["init", str(path), "--force", "--shape", "dome", *SHAPES["dome"].split(), *options]
    assert main([*command, option, str(tmp_path / "here" / name)]) == 2
    assert f"would write over {given}, which it reads" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


def test_on_a_terminal_what_is_missing_is_asked_for(tmp_path, monkeypatch):
    answers = iter(["cap", "12", "7", "640,480", "15", "100"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: next(answers))
    path = tmp_path / "sensor.toml"
    assert main(["init", str(path)]) == 0
    sensor = Sensor.from_file(path)
    assert sensor.surface.values == {"rim_radius": 12.0, "height": 7.0, "base_z": 15.0}
    assert sensor.camera.focal[0].item() == pytest.approx(320 / math.tan(math.radians(50)), abs=1e-3)


def test_the_lens_centre_need_not_be_whole(tmp_path):
    assert Sensor.from_file(drafted(tmp_path, "dome", "--centre", "307.9,241.6")).camera.centre.tolist() == [307.9, 241.6]


ROWS = "\n".join(f"{x},{y}" for x in (-4, 0, 4) for y in (-4, 0, 4))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"x,y\n{ROWS}\n30,0\n", "line 11: 30,0 misses the membrane"),
        ("a,b\n1,2\n", "the header is 'a,b'; expected x,y,z or x,y,h or x,y or angle,azimuth or u,v, each with ,size"),
        ("x;y\n1;2\n", "the header is 'x;y'"),
        (f"x,y\n{ROWS}\n1,a\n", "line 11: y = 'a'; expected a number such as 12 or 1.5, with a point and not a comma"),
        (f"x,y\n{ROWS}\n1,nan\n", "line 11: y = nan; expected a finite number"),
        (f"x,y\n{ROWS}\n1,2,3\n", "line 11: 3 values, 1,2,3; expected two, x,y"),
        ("x,y,size\n" + ROWS.replace("\n", ",large\n") + ",medium\n", "line 10: size = 'medium'; expected small or large"),
        ("x,y\n", "0 dots; expected 8 to 2000"),
        ("x,y\n1,2\n", "1 dots; expected 8 to 2000"),
        ("x,y\n" + "1,2\n" * 2001, "2001 dots; expected 8 to 2000"),
    ],
)
def test_bad_dots_are_named_with_their_line(tmp_path, text, said):
    surface, camera = drafted_surface("dome", {"radius": 12.0}, 20.0), Camera("pinhole", (640, 480), (400, 400), (320, 240))
    (tmp_path / "dots.csv").write_text(text)
    with pytest.raises(MembraneError, match=re.escape(said)):
        read_drafted_dots(tmp_path / "dots.csv", surface, camera)


def test_heights_over_the_rim_that_are_called_z_are_recognised(tmp_path):
    surface, camera = drafted_surface("dome", {"radius": 12.0}, 20.0), Camera("pinhole", (640, 480), (400, 400), (320, 240))
    X, _ = drafted_dots(surface)
    path = tmp_path / "dots.csv"
    np.savetxt(path, X - [0, 0, 20.0], delimiter=",", header="x,y,z", comments="")
    with pytest.raises(MembraneError, match="expected the header x,y,h"):
        read_drafted_dots(path, surface, camera)


@pytest.mark.parametrize("unit", METRE)
def test_a_draft_is_as_exact_in_any_unit(tmp_path, unit):
    """Dots from above are written as near the membrane, and as many are drawn."""
    made, one = tmp_path / f"{unit}.toml", METRE[unit] / METRE["mm"]
    dots, places = tmp_path / "dots.csv", np.array([[x, y] for x in (-5.1, 0.3, 4.7) for y in (-5.2, 0.1, 4.9)])
    np.savetxt(dots, one * places, "%.17g", ",", header="x,y", comments="")
    lengths = ["--radius", f"{12 * one!r}", "--distance", f"{12.3456 * one!r}", "--unit", unit]
    assert main(["init", str(made), "--shape", "dome", *lengths, *FISHEYE, "--dots", str(dots)]) == 0
    sensor = Sensor.from_file(made)
    assert sensor.surface.values["base_z"] == pytest.approx(12.3456 * one, rel=1e-7)
    X = sensor.markers.positions / one - [0, 0, 12.3456]
    assert np.abs(np.linalg.norm(X, axis=1) - 12).max() < 0.005  # of the fine surface's facets
    assert len(drafted_dots(drafted_surface("dome", {"radius": 12 * one}, 12 * one))[1]) == 137


@pytest.mark.parametrize("pitch", ["30", "0.05", "1e-9"])
def test_a_pitch_of_too_few_or_too_many_dots_is_refused_with_one_that_serves(tmp_path, capsys, pitch):
    design = ["--shape", "dome", *SHAPES["dome"].split(), *FISHEYE]
    assert main(["init", str(tmp_path / "a.toml"), *design, "--pitch", pitch]) == 2
    assert "gives 8 to 2000 dots, such as 2.73" in capsys.readouterr().err


def test_a_camera_that_hardly_sees_the_dots_is_refused_and_one_that_sees_a_part_says_so(tmp_path, capsys):
    call = ["init", str(tmp_path / "a.toml"), *"--shape dome --radius 12 --distance 15 --image-size 640,480".split()]
    assert main([*call, "--view", "90", "--centre", "3000,20"]) == 2
    assert "0 of 137 dots are in the camera's view" in capsys.readouterr().err and not (tmp_path / "a.toml").exists()
    assert main([*call, "--view", "40"]) == 0 and "137 dots, to be made on the membrane, 35 of them" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "a.toml")]) == 0 and "35 of 137 in the camera's view" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ("half_sphere", "did you mean 'dome'?"),
        ("Hemisphere", "did you mean 'dome'?"),
        ("spherical_cap", "did you mean 'cap'?"),
        ("ellipsoid_cap", "did you mean 'fingertip'?"),
        ("cylinder", "did you mean 'half_cylinder'?"),
        ("bubbel", "did you mean 'bubble'?"),
        ("height_field", "as arrays: shape = 'heightfield' or 'grid'"),
        ("mesh", "as arrays: shape = 'heightfield' or 'grid'"),
        ("octopus", "as arrays: shape = 'heightfield' or 'grid'"),
    ],
)
def test_other_words_for_a_shape_are_answered_with_the_right_one(tmp_path, capsys, monkeypatch, shape, said):
    with pytest.raises(SystemExit):
        main(["init", str(tmp_path / "a.toml"), "--shape", shape])
    assert said in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: shape)
    assert main(["init", str(tmp_path / "a.toml")]) == 2 and said in capsys.readouterr().err


def test_what_gives_a_missing_number_in_its_place_is_said(tmp_path, capsys):
    call = ["init", str(tmp_path / "a.toml"), *"--shape dome --radius 12 --image-size 640,480".split()]
    assert main([*call, "--view", "90"]) == 2 and "or --rim, the rim's circle in the rest image" in capsys.readouterr().err
    assert main([*call, "--distance", "15"]) == 2 and "or --focal, px" in capsys.readouterr().err


def test_a_pattern_is_laid_out_for_a_design_without_dots_as_for_one_with_dots(tmp_path, capsys):
    path = drafted(tmp_path, "cap")
    bare = tmp_path / "bare.toml"
    bare.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("file = ")))
    for design in (path, bare):
        call = ["calibrate", "pattern", str(design), "--pitch", "30", "--out", str(tmp_path / design.stem)]
        assert main(call) == 0
    listed, unlisted = ((tmp_path / name / "sensor_dots.csv").read_text() for name in ("sensor", "bare"))
    assert listed == unlisted and len(listed.splitlines()) > 50
    assert main(["check", str(bare)]) == 2 and "neither dots nor a rest image is given" in capsys.readouterr().err
