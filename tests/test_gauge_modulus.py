"""The modulus follows from readings of a gauge."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.calibrate.gauge import GAUGE_ERROR, PRESSURE_ERROR, FoundPressures, modulus_from_pressures
from torchmembrane.calibrate.known_modulus import KnownPressures
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.camera.model import Camera
from torchmembrane.cli import main as cli
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press

EXAMPLES = Path(__file__).parents[1] / "examples"
CAP = Surface("spherical_cap", {"rim_radius": 12.0, "height": 9.0, "base_z": 3.0})
CAMERA = Camera("fisheye", (640, 480), (168.0, 168.0), (320.0, 240.0))
NOISE, PRESTRETCH, MODULUS = 0.05, 1.3, 0.12
CHANGE, REST = np.array([0.0, 0.2, 0.5, 0.7]), 2.0


def liquid(modulus):
    return FoundPressures(modulus * CHANGE, np.full(4, 1e-9), modulus * REST)


def soft_gas(modulus):
    """In series with a gas: softer presses take more of its volume."""
    yielding = 1 / (1 + modulus * REST / 3)
    return FoundPressures(modulus * CHANGE * yielding, np.full(4, 1e-9), modulus * REST)


def test_readings_in_proportion_give_the_modulus():
    for scale in (1.0, 2.0):
        fit = modulus_from_pressures(liquid, scale * 0.4 * CHANGE, True, 1.0, gas=False)
        assert fit.modulus == pytest.approx(scale * 0.4)
    assert np.allclose(fit.pressures, np.stack([CHANGE, 0.8 * CHANGE], -1))
    begun_elsewhere = modulus_from_pressures(liquid, 0.8 * CHANGE, True, 7.0, gas=False)
    assert begun_elsewhere.modulus == pytest.approx(0.8) and begun_elsewhere.deviation == pytest.approx(fit.deviation)


def test_what_the_gauge_reads_at_rest_does_not_matter_with_an_image_at_rest():
    for offset in (0.0, 1013.0, -3.0):
        readings = offset + 0.4 * CHANGE
        fit = modulus_from_pressures(liquid, readings, False, 1.0, gas=False)
        assert fit.modulus == pytest.approx(0.4) and np.allclose(fit.pressures[:, 1], 0.4 * CHANGE)
        one = modulus_from_pressures(liquid, np.where([1, 1, 0, 0], readings, np.nan), False, 1.0, gas=False)
        assert one.modulus == pytest.approx(0.4) and one.deviation > fit.deviation


@pytest.mark.parametrize("found", [liquid, soft_gas])
def test_the_deviation_is_that_of_readings_which_are_off_as_supposed(found):
    draws, rng, exact = [], np.random.default_rng(0), found(0.4)
    sigma = np.hypot(PRESSURE_ERROR * exact.change, GAUGE_ERROR * exact.rest)
    for _ in range(300):
        readings = exact.change + sigma * rng.normal(size=4)
        fit = modulus_from_pressures(found, readings, True, 0.4, gas=found is soft_gas)
        draws.append([fit.modulus, fit.deviation])
    draws = np.array(draws)
    assert draws[:, 0].std() == pytest.approx(np.median(draws[:, 1]), rel=0.15)


def test_readings_off_a_line_enlarge_the_deviation_as_a_fit_of_two_unknowns_has_it():
    """numpy's weighted line, its covariance scaled by chi squared over two less than the readings."""
    sigma = np.hypot(PRESSURE_ERROR * CHANGE, GAUGE_ERROR * REST)
    readings = 1013 + 0.4 * CHANGE + sigma * np.array([1, -1, -1, 1])
    fit = modulus_from_pressures(liquid, readings, False, 1.0, gas=False)
    (slope, _), covariance = np.polyfit(CHANGE, readings, 1, w=1 / sigma, cov=True)
    assert fit.modulus == pytest.approx(slope) and fit.deviation == pytest.approx(np.sqrt(covariance[0, 0]))


def test_the_gas_is_solved_with_its_modulus():
    readings = soft_gas(0.4).change
    fit = modulus_from_pressures(soft_gas, readings, True, 1.0, gas=True)
    assert fit.modulus == pytest.approx(0.4, rel=1e-3)


@pytest.mark.parametrize(
    ("readings", "since_rest", "said"),
    [
        ([0.0, np.nan, np.nan, np.nan], True, "too little"),
        ([np.nan, np.nan, 0.2, np.nan], False, "at rest and pressed"),
        ([np.nan, -0.1, -0.2, np.nan], True, "fall"),
        ([5.0, 4.9, 4.8, np.nan], False, "fall"),
        ([0.0, 0.08, 0.5, 0.28], True, "image 3"),
    ],
)
def test_readings_that_tell_nothing_or_contradict_are_refused(readings, since_rest, said):
    with pytest.raises(MembraneError, match=said):
        modulus_from_pressures(liquid, np.array(readings), since_rest, 1.0, gas=False)


def test_a_gas_that_yields_to_anything_tells_no_modulus():
    def follows_the_volume(modulus):
        return FoundPressures(CHANGE, np.full(4, 1e-9), modulus * REST)

    with pytest.raises(MembraneError, match="so compliant"):
        modulus_from_pressures(follows_the_volume, CHANGE, True, 1.0, gas=True)


def sensor(material, filling="liquid"):
    dots = CAP.membrane((33, 33)).rest.reshape(33, 33, 3)[3:-3:3, 3:-3:3].reshape(-1, 3).numpy()
    return Sensor("cap", "mm", CAMERA, CAP.membrane((9, 9)), material, Cavity(filling), Markers("dots", "dark", dots))


@pytest.fixture(scope="module")
def presses():
    """Pixels of the dots at rest and under a ball pressed in two directions, on 31 x 31 vertices, with noise; the pressures."""
    dome, dots = CAP.membrane((31, 31)), sensor(Material("neo_hookean", 1.5)).markers.positions
    elasticity, pixels, pressures = ElasticEnergy(dome, "neo_hookean", PRESTRETCH, MODULUS), [], []
    for direction in ((0.5, 0.0, -0.866), (-0.3, 0.3, -0.906)):
        direction = torch.tensor(direction, dtype=torch.float64)
        ball = Sphere(4.0).touching(dome, direction)
        state = press(dome, elasticity, [[ball, ball.moved(2.5 * direction)]])
        pixels.append(CAMERA.point_to_pixel(carried(state.vertices, dome, dots)))
        pressures.append(float(state.pressure))
    pixels = torch.stack([CAMERA.point_to_pixel(torch.from_numpy(dots)), *pixels])
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return pixels + NOISE * noise, np.array([float(state.rest_pressure), *pressures])


def test_one_press_gives_an_unknown_modulus_and_several_give_it_more_surely(presses, calibration_grids):
    """With `full` also where what the gauge reads at rest is found from an image at rest."""
    pixels, pressures = presses
    unknown = sensor(Material("neo_hookean", 1.5))
    changes = pressures - pressures[0]
    one = material_from_pixels(unknown, pixels[1:2], pressures=KnownPressures(changes[1:2], since_rest=True))
    several = material_from_pixels(unknown, pixels[1:], pressures=KnownPressures(changes[1:], since_rest=True))
    found_in = [one, several]
    if calibration_grids == "default":
        found_in.append(material_from_pixels(unknown, pixels[:2], pressures=KnownPressures(1000 + pressures[:2])))
    for found in found_in:
        assert abs(found.values[1] / MODULUS - 1) < 0.15, found.values
        assert abs(found.values[1] - MODULUS) < 2 * found.deviations[1]
        assert found.sensor.force_unit == "N" and found.sensor.material.modulus == pytest.approx(found.values[1])
        assert found.covariance[0, 1] < 0  # more tension at rest, or a stiffer membrane
    assert several.deviations[1] < 0.85 * one.deviations[1]
    assert np.allclose(several.pressures[:, 1], changes[1:])


def test_an_open_cavity_is_refused(presses):
    pixels, pressures = presses
    known = KnownPressures(pressures)
    with pytest.raises(MembraneError, match="open"):
        material_from_pixels(sensor(Material("neo_hookean", 1.5), "open"), pixels, pressures=known)


@pytest.mark.usefixtures("calibration_grids")
def test_the_command_finds_the_modulus_of_the_example_from_rest_and_one_press(tmp_path):
    truth = np.load(EXAMPLES / "press_on_axis_truth.npz")
    rows = [("rest", 40.0), ("press_on_axis.png", 40.0 + 1e4 * float(truth["p"] - truth["p0"]))]
    table, images = tmp_path / "gauge.csv", [str(EXAMPLES / f"{name}.png") for name in ("rest", "press_on_axis")]
    table.write_text("name,pressure\n" + "".join(f"{name},{value}\n" for name, value in rows))
    arguments = [str(EXAMPLES / "sensor.toml"), *images, "--pressure", str(table), "--out", str(tmp_path / "out")]
    assert cli.main(["calibrate", "material", *arguments]) == 0
    design, made = Sensor.from_file(EXAMPLES / "sensor.toml"), Sensor.from_file(tmp_path / "out" / "sensor.toml")
    report = json.loads((tmp_path / "out" / "report.json").read_text())["parameters"]
    assert abs(report["modulus"]["value"] - design.material.modulus) < 2 * report["modulus"]["deviation"]
    assert made.material.modulus == pytest.approx(report["modulus"]["value"])
