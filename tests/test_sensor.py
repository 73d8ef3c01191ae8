"""A sensor file that is written is read back; mistakes are named."""

import dataclasses
import math
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchmembrane.cli.describe import described
from torchmembrane.errors import MembraneError
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.factories import cavity_filling, elastic_energy
from torchmembrane.sensor.marker_checks import LEAST_APART, OFF_SURFACE, refuse_coincident, refuse_off_surface
from torchmembrane.sensor.parts import FRICTION, Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.surface.shapes import spherical_cap

GOOD = """format = 1
name = "fingertip"
length_unit = "mm"

[camera]
model = "pinhole"
image_size = [32, 24]
focal = [20.0, 20.0]
centre = [15.5, 11.5]
distortion = [-0.1]
[[camera.ports]]
distance = 0.5
thickness = 0.25
index = 1.49
[[camera.ports]]
distance = 1.0
thickness = 0.25
index = 1.52
[camera.medium]
index = 1.33

[membrane]
shape = "spherical_cap"
rim_radius = 12.0
height = 6.0
base_z = 8.0

[material]
model = "mooney_rivlin"
prestretch = 1.2
c2_ratio = 0.1
shear_modulus = 0.3
thickness = 0.5

[cavity]
filling = "gas"
pressure = 1013.0

[markers]
kind = "dots"
file = "dots.csv"
rest_image = "rest.png"
polarity = "dark"
"""
PORTS = GOOD[GOOD.index("[[camera.ports]]") : GOOD.index("[camera.medium]")]
CAP = 'shape = "spherical_cap"\nrim_radius = 12.0\nheight = 6.0\nbase_z = 8.0\n'
GRID = 'shape = "grid"\nfile = "grid.npz"\n'
FIELD = 'shape = "heightfield"\nfile = "field.npz"\n'
MEMBRANES = {
    "spherical_cap": CAP,
    "grid": GRID + "grid = [9, 7]\n",
    "ellipsoid_cap": 'shape = "ellipsoid_cap"\nsemi_axes = [12, 9.0, 6.0]\nbase_z = 8.0\n',
    "half_cylinder": 'shape = "half_cylinder"\nradius = 8.0\nlength = 30.0\nhalf_angle = 60.0\nbase_z = 8.0\ngrid = [11, 9]\n',
    "heightfield": FIELD,
}
DOTS = ["x,y,z,size", "0.0,0.0,14.0,large", "3.0,0.0,13.7,small", "0.0,3.0,13.7,small"]


def write(folder, text=GOOD, dots=None):
    """A sensor file with all that any of the tests' texts name; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "dots.csv").write_text("\n".join(dots or DOTS) + "\n")
    Image.fromarray(np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)).save(folder / "rest.png")
    vertices = spherical_cap(12.0, 6.0, 8.0, (9, 7)).rest.numpy().reshape(9, 7, 3)
    border = np.ones((9, 7), bool)
    border[1:-1, 1:-1] = False
    np.savez(folder / "grid.npz", vertices=vertices, fixed=border)
    x, y = np.linspace(-10, 10, 9), np.linspace(-8, 8, 7)
    np.savez(folder / "field.npz", x=x, y=y, z=14 - 0.03 * (x[:, None] ** 2 + y**2))
    path = folder / "sensor.toml"
    path.write_text(text)
    return path


def replaced(old, new, text=GOOD):
    assert text.count(old) == 1
    return text.replace(old, new)


def with_membrane(shape, text=GOOD):
    return replaced(CAP, MEMBRANES[shape], text).replace('file = "dots.csv"\n', "")


def refusal(path):
    with pytest.raises(MembraneError) as caught:
        Sensor.from_file(path)
    return str(caught.value)


@pytest.mark.parametrize("names", ['["rest.png", "more/a.png"]', '["rest.png", "more/*.png"]'])
def test_several_rest_images_are_averaged(tmp_path, names):
    path = write(tmp_path, replaced('"rest.png"', names))
    (tmp_path / "more").mkdir()
    Image.fromarray(np.full((24, 32), 100, np.uint8)).save(tmp_path / "more" / "a.png")
    one = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)
    sensor = Sensor.from_file(path)
    np.testing.assert_allclose(sensor.markers.rest_image, (one + 100.0) / 2 / 255, atol=1e-7)
    again = Sensor.from_file(sensor.to_file(tmp_path / "again" / "sensor.toml"))
    assert np.array_equal(again.markers.rest_image, sensor.markers.rest_image)


def test_rest_images_that_are_none_or_of_two_sizes_are_named(tmp_path):
    path = write(tmp_path, replaced('"rest.png"', '["rest.png", "none*.png"]'))
    assert f"expected a file; there is none at {tmp_path / 'none*.png'}: paths are relative" in refusal(path)
    path.write_text(replaced('"rest.png"', '"*.png"'))
    Image.fromarray(np.zeros((12, 16), np.uint8)).save(tmp_path / "small.png")
    assert "small.png is 16 x 12 px; expected 32 x 24" in refusal(path)
    path.write_text(replaced('"rest.png"', "[]"))
    assert "rest_image = []; expected a file, or a list of files, in quotes" in refusal(path)


def test_reads_what_the_file_says(tmp_path):
    sensor = Sensor.from_file(write(tmp_path))
    assert (sensor.name, sensor.length_unit, sensor.force_unit) == ("fingertip", "mm", "N")
    assert sensor.camera.image_size == (32, 24) and sensor.camera.medium_index == 1.33
    assert [tuple(port) for port in sensor.camera.ports] == [(0.5, 0.25, 1.49), (1.0, 0.25, 1.52)]
    assert sensor.camera.distortion.tolist() == [-0.1, 0, 0, 0, 0]
    assert sensor.material == Material("mooney_rivlin", 1.2, 0.1, 0.3, 0.5) and sensor.material.modulus == 0.15
    assert sensor.cavity == Cavity("gas", 1013.0)
    assert sensor.markers.positions.tolist() == [[0, 0, 14], [3, 0, 13.7], [0, 3, 13.7]]
    assert sensor.markers.sizes == ["large", "small", "small"]
    assert sensor.markers.rest_image.shape == (24, 32)
    assert torch.equal(sensor.membrane.rest, spherical_cap(12.0, 6.0, 8.0, (25, 25)).rest)


@pytest.mark.parametrize("unit, metre", [("mm", 1000.0), ("cm", 100.0), ("m", 1.0), ("um", 1e6), ("inch", 39.37007874015748)])
def test_pressure_comes_in_the_sensors_units(tmp_path, unit, metre):
    sensor = Sensor.from_file(write(tmp_path, replaced('"mm"', f'"{unit}"')))
    assert math.isclose(sensor.gas_pressure, 101300.0 / metre**2)


@pytest.mark.parametrize("missing", ["shear_modulus = 0.3\n", "thickness = 0.5\n"])
def test_without_modulus_or_thickness_forces_are_relative(tmp_path, missing):
    sensor = Sensor.from_file(write(tmp_path, replaced(missing, "")))
    assert sensor.force_unit == "relative" and sensor.material.modulus == 1.0


def test_friction_is_read_and_written_and_0_5_where_it_is_left_out(tmp_path):
    usual = Sensor.from_file(write(tmp_path / "a"))
    slippery = Sensor.from_file(write(tmp_path / "b", replaced("thickness = 0.5", "thickness = 0.5\nfriction = 0.0")))
    assert usual.material.friction == FRICTION == 0.5 and slippery.material.friction == 0.0
    assert "friction" not in usual.to_file(tmp_path / "c").read_text()
    assert Sensor.from_file(slippery.to_file(tmp_path / "d")).material.friction == 0.0
    lines = "\n".join([*described(usual), *described(slippery)])
    assert "friction 0.5 with what touches it, the default" in lines and "friction 0 with what touches it\n" in lines


@pytest.mark.parametrize("shape", MEMBRANES)
def test_what_is_written_is_read_back(tmp_path, shape):
    sensor = Sensor.from_file(write(tmp_path / "a", with_membrane(shape)))
    written = sensor.to_file(tmp_path / "new" / "b")
    assert written == tmp_path / "new" / "b" / "sensor.toml"
    again = Sensor.from_file(written)
    assert again.fingerprint == sensor.fingerprint
    assert again.surface.shape == shape and again.membrane.grid == sensor.membrane.grid
    assert torch.equal(again.membrane.rest, sensor.membrane.rest)
    assert torch.equal(again.membrane.fixed, sensor.membrane.fixed)
    assert np.array_equal(again.markers.rest_image, sensor.markers.rest_image)
    assert Sensor.from_file(again.to_file(tmp_path / "c.toml")).fingerprint == sensor.fingerprint


def test_dots_awkward_names_and_colours_survive_writing(tmp_path):
    sensor = Sensor.from_file(write(tmp_path / "a"))
    colour = np.random.default_rng(0).random((24, 32, 3))
    positions = sensor.markers.positions + 0.1 / 3
    markers = dataclasses.replace(sensor.markers, positions=positions, rest_image=colour)
    sensor = dataclasses.replace(sensor, name='a "b" \\ \u00e9 \U0001f600 \x7f\n', markers=markers)
    again = Sensor.from_file(sensor.to_file(tmp_path / "b.toml"))
    assert again.name == sensor.name and again.fingerprint == sensor.fingerprint
    assert np.array_equal(again.markers.positions, positions) and again.markers.sizes == sensor.markers.sizes


def test_a_replaced_membrane_is_written_as_its_grid(tmp_path):
    sensor = Sensor.from_file(write(tmp_path / "a"))
    other = dataclasses.replace(sensor, membrane=spherical_cap(12.0, 6.5, 8.0, (7, 9)))
    assert other.fingerprint != sensor.fingerprint
    again = Sensor.from_file(other.to_file(tmp_path / "b"))
    assert again.surface.shape == "grid" and torch.equal(again.membrane.rest, other.membrane.rest)


def test_fingerprint_is_of_the_content_not_of_its_place_or_order(tmp_path):
    sensor = Sensor.from_file(write(tmp_path / "a"))
    moved = shutil.copytree(tmp_path / "a", tmp_path / "elsewhere" / "b")
    (moved / "dots.csv").rename(moved / "points.csv")
    head, *tables = GOOD.split("\n\n")
    reordered = "\n\n".join([head, *reversed(tables)]).replace('file = "dots.csv"', 'file = "points.csv"')
    reordered = reordered.replace("rim_radius = 12.0\nheight = 6.0", "height = 6 # mm\nrim_radius = 12.0")
    reordered = reordered.replace("[-0.1]", "[-0.1, 0.0]").replace("base_z = 8.0", "base_z = 8.0\ngrid = [25, 25]")
    (moved / "sensor.toml").write_text(reordered)
    assert Sensor.from_file(moved / "sensor.toml").fingerprint == sensor.fingerprint
    assert len(sensor.fingerprint) == 64


@pytest.mark.parametrize(
    "old, new",
    [
        ('"fingertip"', '"thumb"'),
        ('"mm"', '"cm"'),
        ('"pinhole"', '"fisheye"'),
        ("focal = [20.0,", "focal = [20.5,"),
        ("centre = [15.5,", "centre = [15.6,"),
        ("[-0.1]", "[-0.11]"),
        ("thickness = 0.25\nindex = 1.49", "thickness = 0.26\nindex = 1.49"),
        ("index = 1.33", "index = 1.34"),
        ("height = 6.0", "height = 6.1"),
        ("base_z = 8.0", "base_z = 8.0\ngrid = [19, 25]"),
        ("prestretch = 1.2", "prestretch = 1.3"),
        ("c2_ratio = 0.1", "c2_ratio = 0.2"),
        ("shear_modulus = 0.3\n", ""),
        ("thickness = 0.5", "thickness = 0.6"),
        ("thickness = 0.5", "thickness = 0.5\nfriction = 0.8"),
        ("pressure = 1013.0", "pressure = 1014.0"),
        ("pressure = 1013.0", "pressure = 1013.0\nvolume = 9.0"),
        ('"gas"', '"liquid"'),
        ('"dark"', '"light"'),
        ('rest_image = "rest.png"\n', ""),
        ('file = "dots.csv"\n', ""),
    ],
)
def test_fingerprint_changes_with_any_value(tmp_path, old, new):
    sensor, other = Sensor.from_file(write(tmp_path)), Sensor.from_file(write(tmp_path, replaced(old, new)))
    assert other.fingerprint != sensor.fingerprint


def test_fingerprint_changes_with_any_array(tmp_path):
    path = write(tmp_path, with_membrane("grid"))
    seen = {Sensor.from_file(path).fingerprint}
    arrays = dict(np.load(tmp_path / "grid.npz"))
    for name, at, value in (("vertices", (4, 3, 2), 14.001), ("fixed", (1, 1), True)):
        arrays[name][at] = value
        np.savez(tmp_path / "grid.npz", **arrays)
        seen.add(Sensor.from_file(path).fingerprint)
    image = np.asarray(Image.open(tmp_path / "rest.png")).copy()
    image[3, 4] += 1
    Image.fromarray(image).save(tmp_path / "rest.png")
    seen.add(Sensor.from_file(path).fingerprint)
    assert len(seen) == 4


def test_a_file_without_a_mode_or_a_tool_has_the_fingerprint_that_it_always_had():
    """Folders of results go by it: they are continued."""
    examples = Path(__file__).parents[1] / "examples"
    known = "7fc64d13020689469967f9341c9783157a378e7cfa03c05f47c038220186e831"
    assert Sensor.from_file(examples / "sensor.toml").fingerprint == known


@pytest.mark.parametrize("last", ["0.0,3.0,13.7,large", "0.0,3.0,13.71,small"])
def test_fingerprint_changes_with_any_dot(tmp_path, last):
    changed = Sensor.from_file(write(tmp_path, dots=[*DOTS[:-1], last])).fingerprint
    assert changed != Sensor.from_file(write(tmp_path)).fingerprint


def test_fingerprint_of_a_sensor_made_in_python_is_that_of_its_file(tmp_path):
    sensor = Sensor.from_file(write(tmp_path))
    cap = Surface("spherical_cap", {"base_z": 8, "height": 6, "rim_radius": 12})
    alike = dataclasses.replace(sensor, surface=cap, cavity=Cavity("gas", 1013))
    assert alike.surface is cap and alike.fingerprint == sensor.fingerprint


@pytest.mark.parametrize("count, n", [(3, 25), (92, 25), (93, 33), (121, 33), (2000, 33)])
def test_solver_grid_follows_the_number_of_dots(tmp_path, count, n):
    radius, angle = 11 * np.sqrt((np.arange(count) + 0.5) / count), 2.4 * np.arange(count)  # a spiral on the cap
    z = -1 + np.sqrt(15**2 - radius**2)
    dots = [DOTS[0], *(f"{x},{y},{z},small" for x, y, z in zip(radius * np.cos(angle), radius * np.sin(angle), z, strict=True))]
    assert Sensor.from_file(write(tmp_path, dots=dots)).membrane.grid == (n, n)


def test_solver_grid_without_listed_dots(tmp_path):
    found = replaced('file = "dots.csv"\n', "")
    assert Sensor.from_file(write(tmp_path, found)).membrane.grid == (33, 33)
    assert Sensor.from_file(write(tmp_path, replaced('"dots"', '"texture"', found))).membrane.grid == (25, 25)
    finer = replaced("base_z = 8.0", "base_z = 8.0\ngrid = [9, 13]")
    assert Sensor.from_file(write(tmp_path, finer)).membrane.grid == (9, 13)


TEXTURE = replaced('kind = "dots"\nfile = "dots.csv"', 'kind = "texture"')
NO_FILE = replaced('file = "dots.csv"\n', "")
BAD_TEXTS = [
    (replaced('"spherical_cap"', '"half_sphere"'), "did you mean 'spherical_cap' (half a sphere has rim_radius = height)?"),
    (replaced('"spherical_cap"', '"height_field"'), "did you mean 'heightfield'?"),
    (replaced('"gas"', '"air"'), "filling is 'air'; expected 'liquid', 'gas' or 'open': did you mean 'gas'?"),
    (replaced('"mooney_rivlin"', '"NeoHookean"'), "did you mean 'neo_hookean'?"),
    (replaced('"dark"', '"black"'), "did you mean 'dark'?"),
    (replaced("pressure", "overpressure"), "[cavity] overpressure is unknown", "did you mean 'pressure' (of a gas, absolute"),
    (replaced("rim_radius", "radius"), "[membrane] radius is unknown", "did you mean 'rim_radius'?"),
    (replaced('name = "fingertip"', 'name = "fingertip'), "not valid TOML: ", "line 2"),
    (GOOD + "[markers", "not valid TOML: ", "at line 44, the last"),
    (replaced("format = 1", "format = 2"), "format = 2", "expected 1", "update"),
    (replaced("format = 1\n", ""), "format is missing", "add it"),
    (replaced('"mm"', '"feet"'), 'length_unit = "feet"; expected "mm" or "cm" or "m" or "um" or "inch"'),
    (replaced('"mm"', '"\u00b5m"'), "did you mean 'um'?"),
    (replaced('"mm"', '"in"'), "did you mean 'inch'?"),
    (replaced('name = "fingertip"', 'nam = "fingertip"'), "nam is unknown", "did you mean 'name'?"),
    (replaced("focal =", "focl ="), "[camera] focl is unknown", "did you mean 'focal'?"),
    (replaced("height = 6.0", "heigth = 6.0"), "[membrane] heigth is unknown", "did you mean 'height'?"),
    (replaced("height = 6.0", "height = 6.0\nradius = 3.0"), "[membrane] radius is unknown for shape spherical_cap"),
    (replaced("prestretch", "stretch"), "[material] stretch is unknown", "'prestretch'"),
    (replaced("pressure", "presure"), "[cavity] presure is unknown", "'pressure'"),
    (replaced("polarity", "colour"), "[markers] colour is unknown", "remove it"),
    (replaced("index = 1.52", "indx = 1.52"), "[camera.ports[1]] indx is unknown", "'index'"),
    (replaced("[camera.medium]\nindex", "[camera.medium]\nn"), "[camera.medium] n is unknown"),
    (replaced("[camera.medium]\nindex = 1.33\n", ""), "[camera] medium is missing", "[camera.medium]"),
    (replaced("index = 1.52\n", ""), "[camera.ports[1]] index is missing"),
    (replaced("focal = [20.0, 20.0]\n", ""), "[camera] focal is missing", "a list of 2 finite numbers"),
    (replaced("focal = [20.0, 20.0]", "focal = 20.0"), "[camera] focal = 20.0; expected a list of 2"),
    (replaced("focal = [20.0, 20.0]", "focal = [20.0, nan]"), "[camera] focal = [20.0, nan]; expected a list of 2 finite"),
    (replaced("focal = [20.0, 20.0]", "focal = [20.0, -20.0]"), "[camera]", "focal is [20.0, -20.0]; expected positive"),
    (replaced("image_size = [32, 24]", "image_size = [32.5, 24]"), "image_size = [32.5, 24]; expected a list of 2 whole"),
    (replaced('"pinhole"', '"equidistant"'), "[camera] model", "did you mean 'fisheye'?"),
    (replaced('"pinhole"', '"rational_polynomial"'), "[camera] model", "did you mean 'pinhole'?"),
    (replaced('"pinhole"', '"plumb_bob"'), "[camera] model", "did you mean 'pinhole'?"),
    (
        replaced("[-0.1]", "[-5.0, 2.0, -1.0, 3.0]"),
        "[camera] distortion = [-5.0, 2.0, -1.0, 3.0]: ",
        "px from the centre, within the image",
    ),
    (replaced("[-0.1]", "[-0.5]"), "[camera] distortion = [-0.5]: ", "px from the centre, within the image"),
    (replaced("[-0.1]", "[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1e-3, 0]"), "[camera]", "thin prisms and tilt are not modelled"),
    (replaced("[-0.1]", "[1, 2, 3, 4, 5, 6]"), "[camera]", "distortion is", "at most k1 k2 p1 p2 k3"),
    (replaced('"pinhole"', '"ortho"'), '[camera] model = "ortho"; expected "pinhole" or "fisheye"'),
    (replaced("distance = 1.0", "distance = 0.6"), "[camera]", "ports[1].distance is 0.6; expected", "in order"),
    (replaced("index = 1.33", "index = 0.5"), "[camera]", "medium_index is 0.5"),
    (replaced(PORTS, ""), "[camera.medium] index = 1.33; expected 1 or no such table without [[camera.ports]]"),
    (replaced("[[camera.ports]]\ndistance = 1.0", "[camera.port]\ndistance = 1.0"), "port is unknown", "'ports'"),
    (replaced('shape = "spherical_cap"', 'shape = "cone"'), '[membrane] shape = "cone"; expected "grid" or'),
    (replaced('shape = "spherical_cap"\n', ""), "[membrane] shape is missing"),
    (replaced("height = 6.0", "height = true"), "[membrane] height = True; expected a finite number"),
    (replaced("height = 6.0", "height = inf"), "[membrane] height = inf; expected a finite number"),
    (replaced("height = 6.0", "height = -6.0"), "[membrane]", "height = -6.0; expected a finite positive"),
    (replaced("base_z = 8.0", "base_z = -80.0"), "[membrane]", "behind the camera"),
    (replaced("base_z = 8.0", "base_z = 8.0\ngrid = [3, 17]"), "[membrane] grid = [3, 17]; expected 5 x 5"),
    (replaced("base_z = 8.0", "base_z = 8.0\ngrid = [17]"), "[membrane] grid = [17]; expected a list of 2 whole"),
    (replaced(CAP, GRID.replace("grid.npz", "no.npz")), '[membrane] file = "no.npz"; expected a file', "relative to"),
    (replaced(CAP, GRID.replace("grid.npz", "dots.csv")), "dots.csv: not readable", "expected an .npz"),
    (replaced(CAP, GRID.replace("grid.npz", "field.npz")), "vertices is missing, the file holds x, y, z"),
    (replaced("prestretch = 1.2", "prestretch = 0.9"), "[material]", "prestretch is 0.9; expected 1"),
    (replaced("prestretch = 1.2", 'prestretch = "1.2"'), '[material] prestretch = "1.2"; expected a finite number'),
    (replaced('"mooney_rivlin"', '"neo_hookean"'), "[material]", "c2_ratio is 0.1; expected none", "remove it"),
    (replaced("c2_ratio = 0.1\n", ""), "[material]", "c2_ratio is None; expected C2 / C1", "add it"),
    (replaced('"mooney_rivlin"', '"ogden"'), "[material]", "'ogden'; expected one of harmonic, neo_hookean"),
    (replaced("thickness = 0.5", "thickness = 0.0"), "[material]", "thickness is 0.0; expected a finite positive"),
    (
        replaced("thickness = 0.5", "friction = -0.1"),
        "[material]",
        "friction is -0.1; expected Coulomb's",
        "0 (no friction) to 10",
    ),
    (replaced("pressure = 1013.0\n", ""), "[cavity]", "pressure is None; expected", "hPa"),
    (replaced("pressure = 1013.0", "pressure = -1.0"), "[cavity]", "pressure is -1.0; expected a finite positive"),
    (replaced('"gas"', '"steam"'), "[cavity]", "filling is 'steam'; expected 'liquid'"),
    (replaced("[cavity]\n", ""), "[material] filling is unknown"),
    (replaced('kind = "dots"', 'kind = "dot"'), '[markers] kind = "dot"; expected "dots" or "texture"'),
    (replaced('"dark"', '"black"'), '[markers] polarity = "black"; expected "dark" or "light"'),
    (replaced('polarity = "dark"\n', ""), "[markers] polarity is missing"),
    (replaced('"dots.csv"', '"no.csv"'), '[markers] file = "no.csv"; expected a file', "no.csv: paths are relative"),
    (replaced('"rest.png"', '"no.png"'), '[markers] rest_image = "no.png"; expected a file'),
    (replaced('"rest.png"', '"dots.csv"'), '[markers] rest_image = "dots.csv"', "not readable as an image"),
    (replaced("[32, 24]", "[64, 48]"), "rest_image is 32 x 24 px and image_size [64, 48]; expected the same"),
    (replaced('rest_image = "rest.png"\n', "", TEXTURE), "[markers]", "rest_image is missing; expected for texture"),
    (replaced('rest_image = "rest.png"\n', "", NO_FILE), "[markers]", "neither dots nor a rest image is given"),
    (replaced('kind = "dots"', 'kind = "texture"'), '[markers] file = "dots.csv"; expected none for texture'),
]


@pytest.mark.parametrize("text, words", [(text, words) for text, *words in BAD_TEXTS])
def test_every_mistake_in_the_file_is_named(tmp_path, text, words):
    path = write(tmp_path, text)
    message = refusal(path)
    assert str(tmp_path) in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "dots, words",
    [
        (["x,y,z", "0,0,14"], "line 1: the header is 'x,y,z'; expected x,y,z,size"),
        (["0,0,14,small"], "line 1: the header is '0,0,14,small'"),
        (["x,y,z,size"], "no dots after the header"),
        ([*DOTS, "", "0,0,14"], "line 6: 3 values, 0,0,14; expected four"),
        ([*DOTS, "0,0,fourteen,small"], "line 5: z = 'fourteen'; expected a number"),
        ([*DOTS, "0,nan,14,small"], "line 5: y = nan; expected a finite number"),
        ([*DOTS, "0,1e308,14,small"], "line 5: y = 1e308; expected a coordinate up to 1e+06"),
        ([*DOTS, "0,0,14,medium"], "line 5: size = 'medium'; expected small or large"),
        ([*DOTS, "", "0,0,14,small", "0,0,4,small"], "line 7: the dot at [0.0, 0.0, 4.0] is 9.985 off the rest surface"),
    ],
)
def test_every_mistake_in_the_dots_is_named_with_its_line(tmp_path, dots, words):
    message = refusal(write(tmp_path, dots=dots))
    assert str(tmp_path / "dots.csv") in message and words in message


@pytest.mark.parametrize(
    "name, change, words",
    [
        ("grid", {"vertices": np.zeros((9, 7))}, "vertices of shape [9, 7]; expected [m, n, 3]"),
        ("grid", {"vertices": np.full((9, 7, 3), np.nan)}, "vertices[0, 0, 0] is not finite"),
        ("grid", {"vertices": np.full((9, 7, 3), "a")}, "vertices is of type <U1; expected numbers"),
        ("grid", {"fixed": np.zeros((9, 7), bool)}, "border vertex (0, 0) is free"),
        ("grid", {"fixed": np.ones((9, 7))}, "fixed is float64 [9, 7]; expected bool [9, 7]"),
        ("heightfield", {"x": np.zeros(9)}, "expected strictly increasing"),
        ("heightfield", {"z": np.ones((3, 4))}, "expected x [m], y [n], z [m, n]"),
    ],
)
def test_every_mistake_in_the_arrays_is_named(tmp_path, name, change, words):
    path = write(tmp_path, with_membrane(name))
    file = tmp_path / ("grid.npz" if name == "grid" else "field.npz")
    np.savez(file, **dict(np.load(file)) | change)
    message = refusal(path)
    assert file.name in message and str(tmp_path) in message and words in message


def test_a_file_that_is_not_there_and_one_that_is_no_text(tmp_path):
    assert "no.toml: no such file" in refusal(tmp_path / "no.toml")
    assert "not readable" in refusal(tmp_path)
    (tmp_path / "sensor.toml").write_bytes(b"name = '\xff'")
    assert "not UTF-8 text" in refusal(tmp_path / "sensor.toml")


def test_a_sensor_made_in_python_is_checked_alike(tmp_path):
    sensor = Sensor.from_file(write(tmp_path))
    for markers, words in (
        (dict(rest_image=np.zeros((10, 10))), "rest_image is 10 x 10 px"),
        (dict(positions=[[0.0, 0.0, 4.0]], sizes=["small"]), "markers.positions[0] at [0.0, 0.0, 4.0]"),
        (dict(positions=[[0.0, 4.0]], sizes=["small"]), "expected [D, 3]"),
        (dict(positions=[[0.0, 0.0, 14.0], [0.0, 0.0, np.inf]], sizes=["small"] * 2), "expected [D, 3], finite"),
        (dict(sizes=["small"]), "expected 3 times"),
    ):
        with pytest.raises(MembraneError) as caught:
            dataclasses.replace(sensor, markers=dataclasses.replace(sensor.markers, **markers))
        assert words in str(caught.value)
    with pytest.raises(MembraneError, match="expected none without positions"):
        Markers("dots", sizes=["small"], rest_image=np.zeros((24, 32)))


def test_a_grid_keeps_its_source_when_the_solver_takes_another(tmp_path):
    sensor = Sensor.from_file(write(tmp_path / "a", replaced(CAP, GRID)))
    assert sensor.membrane.grid == (25, 25) and sensor.surface.values["vertices"].shape == (9, 7, 3)
    written = np.load(sensor.to_file(tmp_path / "b").with_name("sensor_grid.npz"))
    assert np.array_equal(written["vertices"], sensor.surface.values["vertices"])
    assert torch.equal(Surface.from_membrane(sensor.membrane).membrane((25, 25)).rest, sensor.membrane.rest)


def test_a_files_own_lines_are_made_even_unless_they_are_asked_for(tmp_path):
    """Lines crowded at one side of the file's grid, of the size that the solver takes anyway."""
    x = 12 * np.linspace(-1, 1, 25)
    crowded = np.sign(x) * (np.abs(x) / 12) ** 0.5 * 12
    X, Y = np.meshgrid(crowded, x, indexing="ij")
    vertices = np.stack([X, Y, np.full_like(X, 14.0)], -1)
    fixed = np.pad(np.zeros((23, 23), bool), 1, constant_values=True)
    np.savez(tmp_path / "flat.npz", vertices=vertices, fixed=fixed)
    text = replaced(CAP, 'shape = "grid"\nfile = "flat.npz"\n')
    sensor = Sensor.from_file(write(tmp_path, text))
    steps = np.diff(sensor.membrane.rest.reshape(25, 25, 3)[:, 12, 0].numpy())
    assert steps.max() < 1.05 * steps.min()
    asked = Sensor.from_file(write(tmp_path, text.replace('file = "flat.npz"', 'file = "flat.npz"\ngrid = [25, 25]')))
    np.testing.assert_array_equal(asked.membrane.rest.reshape(25, 25, 3).numpy(), vertices)


def test_the_elastic_energy_is_of_the_sensors_material_unless_another_is_given(tmp_path):
    sensor = Sensor.from_file(write(tmp_path))
    energy, membrane = elastic_energy(sensor, sensor.membrane), sensor.membrane
    same = ElasticEnergy(membrane, "mooney_rivlin", 1.2, 0.15, 0.1)
    assert torch.equal(energy.gradient(membrane.rest), same.gradient(membrane.rest))
    other = elastic_energy(sensor, membrane, "neo_hookean", prestretch=1.4, modulus=2.0)
    assert (other.model, float(other.prestretch), float(other.c1)) == ("neo_hookean", 1.4, 1.0)


def test_a_gas_keeps_pressure_times_volume_in_the_sensors_units(tmp_path):
    sensor = Sensor.from_file(write(tmp_path))
    assert cavity_filling(sensor, sensor.membrane) == ("gas", (0.1013, sensor.membrane.cavity_volume))
    known = dataclasses.replace(sensor, cavity=Cavity("gas", 1013.0, 500.0))
    assert cavity_filling(known, sensor.membrane) == ("gas", (pytest.approx(0.1013), 500.0))
    for filling in ("liquid", "open"):
        other = dataclasses.replace(sensor, cavity=Cavity(filling))
        assert cavity_filling(other, sensor.membrane) == (filling, None)


def test_a_relative_gas_is_a_liquid_and_says_so_where_it_is_asked(tmp_path):
    sensor = Sensor.from_file(write(tmp_path, replaced("shear_modulus = 0.3\n", "")))
    with pytest.warns(UserWarning, match="acts as a liquid"):
        assert cavity_filling(sensor, sensor.membrane, warn=True) == ("liquid", None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cavity_filling(sensor, sensor.membrane) == ("liquid", None)


HOSTILE = [
    (replaced("format = 1", "format = " + "9" * 4400), "a line of 4409 characters; expected"),
    (replaced("format = 1", "format = 0x" + "f" * 1900), "more than 300 digits"),
    (replaced("height = 6.0", "height = 1" + "0" * 400), "more than 300 digits"),
    (replaced("[-0.1]", "[" * 1900), "more than 8 levels"),
    (replaced("[-0.1]", "[" * 40 + "]" * 40), "more than 8 levels"),
    (replaced("height = 6.0", "height = 6.0" + "." * 2000), "a line of 2012 characters; expected"),
    (GOOD + "#\n" * 20000, "holds 40", "at most 32768 bytes"),
    (replaced("shear_modulus = 0.3", "shear_modulus = 1e-300"), "shear_modulus is 1e-300; expected a finite positive", "1e-12"),
    (replaced("thickness = 0.5", "thickness = 1e300"), "thickness is 1e+300; expected a finite positive number, from 1e-06"),
    (
        replaced("prestretch = 1.2", "prestretch = 1e9"),
        "prestretch is 1000000000.0; expected 1 (unstretched) or more, at most 10",
    ),
    (replaced("c2_ratio = 0.1", "c2_ratio = 1e9"), "c2_ratio is 1000000000.0; expected C2 / C1, from 0 to 1000"),
    (replaced("pressure = 1013.0", "pressure = 1e9"), "pressure is 1000000000.0; expected a finite positive number, from"),
    (replaced("focal = [20.0, 20.0]", "focal = [20.0, 1e200]"), "focal is [20.0, 1e+200]; expected positive", "to 1e+06 px"),
    (
        replaced("focal = [20.0, 20.0]", "focal = [20.0, 500.0]"),
        "focal is [20.0, 500.0]; expected two values, the larger at most 20",
    ),
    (replaced("centre = [15.5, 11.5]", "centre = [1e200, 11.5]"), "centre is [1e+200, 11.5]; expected values up to 1e+06"),
    (replaced("[-0.1]", "[1e200]"), "distortion is [1e+200]; expected values up to 1e+06"),
    (replaced("image_size = [32, 24]", "image_size = [10000, 10000]"), "image_size is [10000, 10000]; expected", "33554432 px"),
    (replaced("index = 1.52", "index = 1e9"), "ports[1].index is 1000000000.0; expected 1 (air)"),
    (replaced("height = 6.0", "height = 1e200"), "height = 1e+200; expected a finite positive number, from 1e-06 to 1e+06"),
    (replaced("base_z = 8.0", "base_z = 1e200"), "expected coordinates up to 1e+06"),
    (
        replaced("base_z = 8.0", "base_z = 8.0\ngrid = [1000000, 1000000]"),
        "[membrane] grid = [1000000, 1000000]; expected 5 x 5",
    ),
    (
        replaced("base_z = 8.0", "base_z = 8.0\ngrid = [2000, 2000]"),
        "[membrane] grid = [2000, 2000]; expected 5 x 5",
    ),
    (
        replaced("base_z = 8.0", "base_z = 8.0\ngrid = [66, 65]"),
        "[membrane] grid = [66, 65]; expected 5 x 5",
        "at most 65 x 65",
    ),
    (GOOD + '"a\\nb" = 1\n', '[markers] "a\\nb" is unknown here'),
    (replaced('"rest.png"', '"a\\nb.png"'), "a\\nb.png", "expected a file; there is none at"),
    (replaced('"rest.png"', '"."'), "rest_image", "not readable (it is a folder)"),
    (replaced('"dots.csv"', '"."'), "not readable (it is a folder)"),
    (replaced('"dots.csv"', '"sensor.toml"'), "line 1: the header is", "expected x,y,z,size"),
    *(
        (
            replaced(old, f'"{name}"'),
            f'= "{name}"; expected a path relative to the sensor file, of a file in its folder or below',
        )
        for old in ('"dots.csv"', '"rest.png"')
        for name in ("/etc/passwd", "../sensor.toml", "a/../../b", "/etc/*", "C:/dots.csv")
    ),
    (replaced(CAP, GRID.replace("grid.npz", "/etc/passwd")), '[membrane] file = "/etc/passwd"; expected a path relative'),
]


@pytest.mark.parametrize("text, words", [(text, words) for text, *words in HOSTILE])
def test_what_no_sensor_file_says_is_refused_in_one_line(tmp_path, text, words):
    message = refusal(write(tmp_path, text))
    assert message.isprintable() and str(tmp_path) in message and len(message) < len(str(tmp_path)) * 3 + 500
    for word in words:
        assert word in message


def test_a_byte_order_mark_is_passed_over(tmp_path):
    path = write(tmp_path)
    path.write_text(GOOD, encoding="utf-8-sig")
    assert Sensor.from_file(path).name == "fingertip"
    path.write_bytes(GOOD.encode() + b"#\0")
    assert "contains NUL" in refusal(path)


def test_a_listed_file_that_is_none_is_not_quoted(tmp_path):
    path = write(tmp_path, dots=["root:x:0:0:root:/root:/bin/bash"])
    assert "the header is 31 characters that name no columns" in refusal(path)


def test_dots_that_lie_on_one_another_are_named_with_both_lines(tmp_path):
    message = refusal(write(tmp_path, dots=[*DOTS, DOTS[2]]))
    assert (
        f"{tmp_path / 'dots.csv'}, line 5: the dot at [3.0, 0.0, 13.7] coincides with that" in message and "line 3" in message
    )
    sensor = Sensor.from_file(write(tmp_path / "b"))
    twice = dataclasses.replace(sensor.markers, positions=np.repeat(sensor.markers.positions, 2, 0), sizes=["small"] * 6)
    with pytest.raises(MembraneError, match=r"markers.positions\[1\] .* coincides with that .*remove one"):
        dataclasses.replace(sensor, markers=twice)


@pytest.mark.parametrize("scale", [0.01, 1.0, 1000.0])
def test_how_far_off_or_near_a_dot_may_be_is_measured_by_the_surface(scale):
    membrane = spherical_cap(12.0 * scale, 6.0 * scale, 8.0 * scale, (9, 9))
    dot, outward, unit = membrane.rest[40].numpy(), membrane.rest_normals[40].numpy(), membrane.size
    refuse_off_surface(membrane, (dot + 0.9 * OFF_SURFACE * unit * outward)[None], ["a"])
    with pytest.raises(MembraneError, match="off the rest surface"):
        refuse_off_surface(membrane, (dot + 1.1 * OFF_SURFACE * unit * outward)[None], ["a"])
    refuse_coincident(membrane, np.stack([dot, dot + [1.1 * LEAST_APART * unit, 0, 0]]), ["a", "b"])
    with pytest.raises(MembraneError, match="coincides with that"):
        refuse_coincident(membrane, np.stack([dot, dot + [0.9 * LEAST_APART * unit, 0, 0]]), ["a", "b"])


def test_more_dots_than_can_be_followed_are_refused_by_their_number(tmp_path):
    assert "10000 dots; expected at most 2000" in refusal(write(tmp_path, dots=[DOTS[0], *[DOTS[1]] * 10000]))


@pytest.mark.parametrize("count", [1, 3])
def test_too_few_dots_are_refused_by_the_reconstructor_by_their_number(tmp_path, count):
    path = write(tmp_path, replaced('rest_image = "rest.png"\n', ""), DOTS[: 1 + count])
    with pytest.raises(MembraneError) as caught:
        Reconstructor.from_file(path)
    assert (
        str(caught.value).startswith(f"{path}: ") and f"{count} dots" in str(caught.value) and "at least 8" in str(caught.value)
    )


def test_a_rest_image_of_another_size_is_refused_before_its_pixels_are_decoded(tmp_path):
    path = write(tmp_path)
    Image.new("1", (5000, 6000)).save(tmp_path / "rest.png")
    whole = (tmp_path / "rest.png").read_bytes()
    (tmp_path / "rest.png").write_bytes(whole[: len(whole) // 2])
    assert "rest_image is 5000 x 6000 px and image_size [32, 24]" in refusal(path)


@pytest.mark.parametrize(
    "shape, words", [((3, 9, 3), "3 x 9 lines; expected at least 4"), ((600, 600, 3), "expected at most 262144")]
)
def test_grids_too_small_or_too_large_to_interpolate_are_refused(tmp_path, shape, words):
    path = write(tmp_path, with_membrane("grid"))
    x, y = np.meshgrid(*(np.linspace(-9, 9, count) for count in shape[:2]), indexing="ij")
    fixed = np.pad(np.zeros([count - 2 for count in shape[:2]], bool), 1, constant_values=True)
    np.savez_compressed(tmp_path / "grid.npz", vertices=np.stack([x, y, 14 + 0 * x], -1), fixed=fixed)
    assert words in refusal(path) and str(tmp_path) in refusal(path)
