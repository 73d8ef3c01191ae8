"""Prestretch and stiffness are found within three deviations."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.calibrate.explained import _log_stretch
from torchmembrane.calibrate.known_modulus import KnownForces
from torchmembrane.calibrate.material import material_from_images, material_from_pixels
from torchmembrane.calibrate.presses import STRETCHES, Presses
from torchmembrane.calibrate.report import Report
from torchmembrane.camera.model import Camera
from torchmembrane.cli import main as cli
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.plot.calibration import material_figure
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press

EXAMPLES = Path(__file__).parents[1] / "examples"
CAP = Surface("spherical_cap", {"rim_radius": 12.0, "height": 9.0, "base_z": 3.0})
CAMERA = Camera("fisheye", (640, 480), (168.0, 168.0), (320.0, 240.0))
NOISE, PRESTRETCH, MODULUS = 0.05, 1.2, 0.4


def sensor(material):
    dots = CAP.membrane((33, 33)).rest.reshape(33, 33, 3)[3:-3:3, 3:-3:3].reshape(-1, 3).numpy()
    return Sensor("cap", "mm", CAMERA, CAP.membrane((9, 9)), material, Cavity("liquid"), Markers("dots", "dark", dots))


@pytest.fixture(scope="module")
def presses():
    """Pixels of the dots under a ball pressed in three directions, on 31 x 31 vertices, with noise, and its forces."""
    dome, dots = CAP.membrane((31, 31)), sensor(Material("neo_hookean", 1.5)).markers.positions
    elasticity, pixels, forces = ElasticEnergy(dome, "neo_hookean", PRESTRETCH, MODULUS), [], []
    for direction in ((0.5, 0.0, -0.866), (-0.3, 0.3, -0.906), (0.0, -0.5, -0.866)):
        direction = torch.tensor(direction, dtype=torch.float64)
        ball = Sphere(4.0).touching(dome, direction)
        state = press(dome, elasticity, [[ball, ball.moved(2.5 * direction)]])
        pixels.append(CAMERA.point_to_pixel(carried(state.vertices, dome, dots)))
        forces.append(state.force.numpy())
    pixels = torch.stack(pixels)
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return pixels + NOISE * noise, np.stack(forces)


def test_losses_are_read_as_logarithms_of_a_probability():
    z = np.log(STRETCHES)
    mean, deviation = _log_stretch(STRETCHES, np.full((len(z), 2), 7.0))
    assert abs(mean - z.mean()) < 1e-3 and abs(deviation - (z[-1] - z[0]) / 12**0.5) < 1e-3
    z = np.linspace(0.01, 1.1, 300)
    one, other, wrong = (((z - centre) / 0.04) ** 2 / 2 for centre in (0.3, 0.34, 0.9))
    mean, deviation = _log_stretch(np.exp(z), np.stack([one, other], -1))
    assert abs(mean - 0.32) < 1e-3 and abs(deviation - 0.04 / 2**0.5) < 1e-3
    mean, deviation = _log_stretch(np.exp(z), np.stack([one, other, wrong], -1))
    assert abs(mean - 0.32) < 5e-3 and deviation < 0.05


def test_prestretch_and_modulus_are_found_whatever_the_file_says(presses):
    pixels, forces = presses
    found = material_from_pixels(sensor(Material("neo_hookean", 1.5, shear_modulus=3.0, thickness=0.5)), pixels, forces)
    error = np.abs(found.values - [PRESTRETCH, MODULUS])
    assert (error < 3 * found.deviations).all(), (found.values, found.deviations)
    assert found.deviations[0] < 0.1 * PRESTRETCH and found.deviations[1] < 0.3 * MODULUS
    assert found.covariance[0, 1] < 0  # more tension at rest, or a stiffer membrane
    material = found.sensor.material
    assert (material.prestretch, material.modulus) == pytest.approx(tuple(found.values))
    assert material.thickness == 0.5
    assert np.allclose(found.forces[:, 1], np.linalg.norm(forces, axis=1))


def test_modulus_is_proportional_to_the_forces_and_needs_but_one_of_them(presses):
    pixels, forces = presses
    reconstructor = Reconstructor(sensor(Material("neo_hookean", 1.5)), dtype=torch.float64)
    seen = Presses(reconstructor, pixels - reconstructor.rest_pixels, torch.ones(pixels.shape[:2], dtype=torch.float64))
    lengths = np.linalg.norm(forces, axis=1, keepdims=True) * [[1.0], [np.nan], [np.nan]]
    one, twice = (np.array(seen.modulus(0.2, 0.05, KnownForces(k * lengths))[:3]) for k in (1, 2))
    assert np.allclose(twice, 2 * one) and one[0] > 0 > one[2]


def test_of_a_measured_force_counts_what_is_along_the_one_that_is_found():
    """Turned by 60 degrees it is half as much along it; of a magnitude all is."""
    traction, area = torch.tensor([[[0.0, 0.0, -0.2], [0.0, 0.0, -0.1]]], dtype=torch.float64), torch.tensor([5.0, 10.0])
    explained = SimpleNamespace(membrane=SimpleNamespace(rest_area=area)), SimpleNamespace(traction=traction)
    presses = SimpleNamespace(explained=lambda stretch, modulus: explained)
    turned = 3.0 * np.array([[np.sin(np.pi / 3), 0.0, -np.cos(np.pi / 3)]])
    for forces, ratio in ((turned, 0.75), (3.0 * np.array([[0.0, 0.0, -1.0]]), 1.5), (np.array([[3.0]]), 1.5)):
        ratios, magnitudes = Presses._ratios(presses, 1.2, 0.4, forces)
        assert ratios == pytest.approx([ratio]) and magnitudes.ravel() == pytest.approx([2.0, 3.0])


@pytest.mark.parametrize("degrees, refused", [(20, False), (60, True), (180, True)])
def test_a_force_of_another_frame_or_the_reaction_is_refused(presses, degrees, refused):
    """Of which only the part along the reconstructed force would count."""
    pixels, forces = presses
    reconstructor = Reconstructor(sensor(Material("neo_hookean", PRESTRETCH)), dtype=torch.float64)
    seen = Presses(reconstructor, pixels - reconstructor.rest_pixels, torch.ones(pixels.shape[:2], dtype=torch.float64))
    turn, apart = np.radians(degrees), np.cross(forces[1], [1.0, 0.0, 0.0])
    apart *= np.linalg.norm(forces[1]) / np.linalg.norm(apart)
    forces = np.stack([forces[0], np.cos(turn) * forces[1] + np.sin(turn) * apart, [np.nan] * 3])
    found = seen.modulus, np.log(PRESTRETCH), 0.05, KnownForces(forces)
    if refused:
        with pytest.raises(MembraneError, match="image 2: the given force points (5[5-9]|6[0-5]|17[0-9]|180) degrees away"):
            found[0](*found[1:])
    else:
        assert found[0](*found[1:])[0] > 0


def test_forces_that_scatter_leave_the_error_of_their_mean():
    """Ratios of measured to found forces, each known to a tenth: their own scatter where that is larger, else the tenth."""
    material, cavity = SimpleNamespace(modulus=0.4), SimpleNamespace(filling="liquid")
    reconstructor = SimpleNamespace(sensor=SimpleNamespace(material=material), estimator=SimpleNamespace(cavity=cavity))
    for ratios in (np.array([0.8, 1.6, 1.1, 2.1]), np.array([1.19, 1.21, 1.2, 1.2])):
        given = SimpleNamespace(
            reconstructor=reconstructor,
            _refuse_unpressed=lambda *_: None,
            _ratios=lambda *_, ratios=ratios: (ratios, np.stack([np.ones(4), ratios], 1)),
        )
        modulus, deviation, *_ = Presses.modulus(given, 0.1, 0.02, KnownForces(np.ones((4, 1))))
        assert modulus == pytest.approx(0.4 * ratios.mean())
        assert deviation / modulus == pytest.approx(max(0.1, ratios.std(ddof=1) / ratios.mean()) / 4**0.5)


@pytest.mark.filterwarnings("ignore:.*acts as a liquid")
@pytest.mark.usefixtures("calibration_grids")
def test_a_gas_of_unknown_modulus_is_found_as_one_whose_file_says_it(presses):
    """Its prestretch would else be that of a liquid, which keeps its volume."""
    pixels, forces = (values[:1] for values in presses)
    cavity = Cavity("gas", 1013.0)
    untold, told = Material("neo_hookean", 1.5), Material("neo_hookean", 1.5, shear_modulus=2 * MODULUS, thickness=0.5)
    found = [material_from_pixels(replace(sensor(m), cavity=cavity), pixels, forces).values for m in (untold, told)]
    assert found[0] == pytest.approx(found[1], rel=0.1)
    liquid = material_from_pixels(sensor(told), pixels, forces).values
    assert abs(liquid[0] / found[1][0] - 1) > 0.08


def test_the_figure_marks_one_deviation_on_either_side_of_the_prestretch():
    none, known = np.zeros((0, 2)), np.array([1.4, 0.1])
    report = Report("material", ["prestretch"], [""], known[:1], known[:1], known[1:], np.eye(1), none, none, 0.0, [])
    profile = np.array([1.1, 1.4, 1.8]), np.array([[4.0], [0.0], [1.0]])
    figure = material_figure(report, SimpleNamespace(profile=profile, forces=none, pressures=none), [])
    (span,) = figure.axes[0].patches
    assert span.get_extents().transformed(figure.axes[0].transData.inverted()).intervalx == pytest.approx([1.3, 1.5])


def test_a_report_says_how_far_points_are_off_on_either_side():
    none, off = np.zeros(0), np.array([[0.3, 0.0], [0.0, -0.5]])
    report = Report("lens", [], [], none, none, none, np.zeros((0, 0)), off, off, 0.1, [])
    assert report.lines == ["lens", "  residuals: 2 points, 0.292 px rms, at most 0.500 px"]


BAD_FORCES = {
    "magnitudes without an axis": (np.ones(2), None, r"forces is 'an array \[2\]'; expected \[2, 3\] or \[2, 1\]"),
    "of more images": (np.ones((3, 1)), None, r"forces is 'an array \[3, 1\]'"),
    "all unknown": (np.full((2, 3), np.nan), None, "NaN for all images"),
    "none": (np.array([[1.0], [0.0]]), None, "0 N for an image"),
    "other deviations": (np.ones((2, 1)), np.ones(3), r"deviations of forces is 'an array \[3\]'; expected \[2\]"),
}


@pytest.mark.parametrize("kind", BAD_FORCES)
def test_forces_of_another_shape_are_refused_before_the_work(kind):
    forces, deviations, said = BAD_FORCES[kind]
    with pytest.raises(MembraneError, match=said):
        material_from_images(sensor(Material("neo_hookean", 1.5)), torch.zeros(2, 1, 480, 640), KnownForces(forces, deviations))


def test_the_forces_of_one_image_without_a_batch_are_of_one_image():
    """Which is blank; its forces are not what is refused."""
    with pytest.raises(MembraneError, match="image 1: blank"):
        material_from_images(sensor(Material("neo_hookean", 1.5)), torch.zeros(480, 640), np.array([[1.0]]))


@pytest.mark.parametrize("overpressure", [0.0, -12.0, float("nan")])
def test_a_gauge_at_rest_that_is_no_overpressure_is_refused_before_the_work(overpressure):
    with pytest.raises(MembraneError, match="expected a positive reading at rest, inside minus outside"):
        material_from_images(sensor(Material("neo_hookean", 1.5)), torch.zeros(2, 1, 480, 640), overpressure=overpressure)


def test_rest_tells_no_prestretch():
    plain = sensor(Material("neo_hookean", 1.5))
    pixels = CAMERA.point_to_pixel(torch.from_numpy(plain.markers.positions))[None]
    found = material_from_pixels(plain, pixels)
    assert len(found.values) == 1 and found.deviations[0] > 0.25


def test_a_harmonic_membrane_is_refused():
    with pytest.raises(MembraneError, match="harmonic"):
        material_from_pixels(sensor(Material("harmonic", 1.5)), torch.zeros(1, 81, 2))


@pytest.mark.usefixtures("calibration_grids")
def test_command_finds_the_material_of_the_example_images(tmp_path):
    name = "press_on_axis"
    truth = np.load(EXAMPLES / f"{name}_truth.npz")
    (tmp_path / "forces.csv").write_text(f"image,force\n{name}.png,{np.linalg.norm(truth['force'])}\n")
    arguments = [str(EXAMPLES / "sensor.toml"), str(EXAMPLES / f"{name}.png"), "--forces", str(tmp_path / "forces.csv")]
    assert cli.main(["calibrate", "material", *arguments, "--out", str(tmp_path / "out")]) == 0
    design, made = Sensor.from_file(EXAMPLES / "sensor.toml"), Sensor.from_file(tmp_path / "out" / "sensor.toml")
    report = json.loads((tmp_path / "out" / "report.json").read_text())["parameters"]
    for key, truth in (("prestretch", design.material.prestretch), ("modulus", design.material.modulus)):
        assert abs(report[key]["value"] - truth) < 3 * report[key]["deviation"]
    assert made.material.prestretch == pytest.approx(report["prestretch"]["value"])
    assert (tmp_path / "out" / "report.png").exists()


@pytest.mark.parametrize(
    "text, message",
    [
        ("image,f\na.png,1\n", "header"),
        ("image,force\nb.png,1\n", "none of the images"),
        ("image,force\nflat_plate.png,x\n", "line 2: force = 'x'; expected a number"),
        ("image,fx,fy,fz\nflat_plate.png,1,2\n", "line 2: 3 values, flat_plate.png,1,2; expected four, image,fx,fy,fz"),
        ("image,force\n", "no forces"),
    ],
)
def test_bad_forces_are_refused(tmp_path, capsys, text, message):
    (tmp_path / "forces.csv").write_text(text)
    arguments = [str(EXAMPLES / "sensor.toml"), str(EXAMPLES / "flat_plate.png"), "--forces", str(tmp_path / "forces.csv")]
    assert cli.main(["calibrate", "material", *arguments, "--out", str(tmp_path / "out")]) != 0
    assert message in capsys.readouterr().err
