"""The contact law fits its presses, and its pressure adds up."""

import csv
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import torchmembrane as tm
from torchmembrane.accuracy.contact_law import (
    DEPTH,
    DEPTHS,
    HELD_DEPTHS,
    HELD_RADII,
    RADII,
    RADIUS,
    BallPress,
    ContactLaw,
    contact_law,
    curvatures_at,
    fitted,
    top_of,
)
from torchmembrane.cli.main import main
from torchmembrane.integrations.contact_files import write_contact_law
from torchmembrane.presets import NAMES
from torchmembrane.surface.shapes import half_cylinder, spherical_cap

LAW = ContactLaw(20.0, (0.0, 0.0, 30.0), (0.0, 0.0, -1.0), (0.08, 0.02), 2.0, 0.3, 1.3, 0.1, "mm", "N", [])


@pytest.fixture(scope="module")
def small_law(small_sensor):
    return contact_law(tm.Sensor.from_file(small_sensor / "sensor.toml"))


def presses_of(law):
    """Such as its own numbers say."""
    balls = [(r, d, False) for r in RADII for d in DEPTHS] + [(r, d, True) for r in HELD_RADII for d in HELD_DEPTHS]
    return [
        BallPress(r * law.size, d * law.size, float(law.force(r * law.size, d * law.size)), held_out)
        for r, d, held_out in balls
    ]


def test_the_numbers_of_a_law_are_found_from_its_presses():
    found = fitted(LAW._replace(reference=1.0, radius_exponent=0.0, depth_exponent=1.0, change=0.0), presses_of(LAW), "x")
    np.testing.assert_allclose(found[4:8], LAW[4:8], rtol=1e-9)
    assert abs(found.errors()).max() < 1e-9 and len(found.errors()) == len(HELD_RADII) * len(HELD_DEPTHS)


def test_the_reference_is_the_force_of_its_press_and_the_exponents_are_slopes():
    r, d, step = RADIUS * LAW.size, DEPTH * LAW.size, 1e-6
    assert float(LAW.force(r, d)) == pytest.approx(LAW.reference)
    slope = np.log(LAW.force(r, d * (1 + step)) / LAW.force(r, d)) / np.log(1 + step)
    assert slope == pytest.approx(LAW.depth_exponent, rel=1e-4)
    slope = np.log(LAW.force(r * (1 + step), d) / LAW.force(r, d)) / np.log(1 + step)
    assert slope == pytest.approx(LAW.radius_exponent, rel=1e-4)


def test_the_pressure_over_the_overlap_adds_up_to_the_force():
    """The overlap of paraboloids: depth `d - k1 x^2 / 2 - k2 y^2 / 2`, summed over a lattice."""
    r, d = 3.0, 1.1
    k1, k2 = (1 / r + each for each in LAW.curvatures)
    x, step = np.linspace(-3, 3, 1501, retstep=True)
    depth = d - k1 * x[:, None] ** 2 / 2 - k2 * x**2 / 2
    depth = depth[depth > 0]
    assert LAW.pressure(r, depth).sum() * step**2 == pytest.approx(float(LAW.force(r, d)), rel=1e-3)


def test_curvatures_are_those_of_a_cylinder_turned():
    surface = half_cylinder(9.0, 30.0, 70.0, 5.0, (33, 33))
    place, inward = top_of(surface)
    np.testing.assert_allclose(place[:2], 0, atol=1e-6)  # of the line that is farthest from the rim the middle
    np.testing.assert_allclose(curvatures_at(surface, place, inward), [1 / 9, 0], atol=3e-3)
    sphere = spherical_cap(8.0, 4.0, 0.0, (33, 33))
    k = 17 * 33 // 2 + 40
    place, inward = sphere.rest[k].numpy(), -sphere.rest_normals[k].numpy()
    np.testing.assert_allclose(curvatures_at(sphere, place, inward), [0.1, 0.1], atol=5e-3)


def test_presses_held_out_are_within_five_percent(small_law):
    assert len(small_law.presses) == 23 and len(small_law.errors()) == 8
    assert abs(small_law.errors()).max() < 0.05 and abs(small_law.errors(False)).max() < 0.08


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_presses_on_presets_held_out_are_within_five_percent(name):
    assert abs(contact_law(tm.preset(name)).errors()).max() < 0.05


def test_too_few_presses_are_refused():
    with pytest.raises(tm.MembraneError, match="7 of 15 presses.*expected 8 of three balls"):
        fitted(LAW, presses_of(LAW)[:7], "x")


def test_a_ball_that_does_not_fit_into_a_hollow_is_refused():
    with pytest.raises(tm.MembraneError, match="does not fit into the surface"):
        LAW._replace(curvatures=(-0.1, -0.5)).pressure(4.0, 1.0)


def test_files_are_in_si_units_whatever_the_sensor_s(small_sensor, small_law, tmp_path):
    """The same sensor in centimetres: lengths a tenth, forces the same, and the same files."""
    sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
    turned = tm.Pose(np.array([0.0, 90.0, 0.0]), np.array([1.5, 0.0, 30.0]))
    scaled = small_law._replace(
        size=small_law.size / 10,
        place=np.array(small_law.place) / 10,
        curvatures=[10 * each for each in small_law.curvatures],
        length_unit="cm",
        presses=[each._replace(radius=each.radius / 10, depth=each.depth / 10) for each in small_law.presses],
    )
    write_contact_law(small_law, replace(sensor, tool=turned), tmp_path / "mm")
    pose = tm.Pose(turned.rotation, turned.translation / 10)
    write_contact_law(scaled, replace(sensor, tool=pose), tmp_path / "cm")
    assert (tmp_path / "mm/contact.csv").read_text() == (tmp_path / "cm/contact.csv").read_text()
    told, other = (tomllib.loads((tmp_path / unit / "contact.toml").read_text()) for unit in ("mm", "cm"))
    assert {key: pytest.approx(value) for key, value in told.items() if key != "force_unit"}.items() <= other.items()
    np.testing.assert_allclose(told["place"], turned.points(np.array(small_law.place)) / 1000, atol=1e-9)
    np.testing.assert_allclose(told["inward"], turned.rotation @ small_law.inward, atol=1e-9)
    row = next(csv.DictReader((tmp_path / "mm/contact.csv").open()))
    r, d = float(row["radius"]), float(row["depth"])
    a, b = np.log(r / told["reference_radius"]), np.log(d / told["reference_depth"])
    n = told["depth_exponent"] + told["exponent_change"] * a
    force = told["reference_force"] * np.exp(told["radius_exponent"] * a + n * b)  # as the file's head says
    pressure = n * force / d * np.sqrt(np.prod([1 / r + each for each in told["curvatures"]])) / (2 * np.pi)
    np.testing.assert_allclose([float(row["force"]), float(row["pressure"])], [force, pressure], rtol=1e-4)


def test_the_command_writes_the_law_beside_the_robot_s_model(small_sensor, small_law, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torchmembrane.accuracy.contact_law.contact_law", lambda *_: small_law)
    assert main(["check", str(small_sensor / "sensor.toml"), "--robot", str(tmp_path)]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"cap.urdf", "cap.xml", "contact.toml", "contact.csv", "contact.png"} <= names
    assert "contact pressure over depth, off by" in capsys.readouterr().out


def test_a_sensor_that_cannot_be_pressed_keeps_its_model(small_sensor, tmp_path, capsys, monkeypatch):
    def refused(*_):
        raise tm.MembraneError("3 of 15 presses can be followed")

    monkeypatch.setattr("torchmembrane.accuracy.contact_law.contact_law", refused)
    assert main(["check", str(small_sensor / "sensor.toml"), "--robot", str(tmp_path)]) == 0
    assert (tmp_path / "cap.urdf").exists() and not (tmp_path / "contact.toml").exists()
    assert "contact.toml not written: 3 of 15" in capsys.readouterr().out
