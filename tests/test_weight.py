"""One known weight makes the forces of other presses right."""

import json
import shutil
from argparse import ArgumentTypeError
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.calibrate import weight as weight_module
from torchmembrane.cli import arguments
from torchmembrane.cli.calibrate.material import known_forces
from torchmembrane.cli.main import main
from torchmembrane.jobs.inputs import Inputs

EXAMPLES = Path(__file__).parents[1] / "examples"
NAMES = ("press_on_axis", "two_contacts", "flat_plate")
FORCES = {name: float(np.linalg.norm(np.load(EXAMPLES / f"{name}_truth.npz")["force"])) for name in NAMES}


def test_one_known_weight_gives_the_forces_of_other_presses(tmp_path, capsys, calibration_grids):
    """Of a sensor whose file has no modulus and a wrong prestretch; a plate, which asks more of the grids, with `full`."""
    text = (EXAMPLES / "sensor.toml").read_text().replace("shear_modulus = 1.0\nthickness = 1.0\n", "")
    names = NAMES
    if calibration_grids == "coarse":
        names, text = NAMES[:2], text.replace("[membrane]\n", "[membrane]\ngrid = [17, 17]\n")
    (tmp_path / "sensor.toml").write_text(text.replace("prestretch = 1.3", "prestretch = 1.1"))
    for name in ("rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copy(EXAMPLES / name, tmp_path)
    weight = f"{FORCES['press_on_axis']}N"
    call = ["calibrate", "material", str(tmp_path / "sensor.toml"), str(EXAMPLES / "press_on_axis.png"), "--weight", weight]
    assert main([*call, "--out", str(tmp_path / "out")]) == 0
    assert "forces are scaled to" in capsys.readouterr().out
    reconstructor = tm.Reconstructor.from_file(tmp_path / "out" / "sensor.toml")
    with torch.no_grad():
        found = reconstructor(reconstructor.read(*(str(EXAMPLES / f"{name}.png") for name in names)))
    assert reconstructor.sensor.force_unit == "N"
    assert found.force.norm(dim=1).numpy() == pytest.approx([FORCES[name] for name in names], rel=0.1)
    assert found.force[0].norm().item() == pytest.approx(FORCES["press_on_axis"], rel=1e-3)
    assert json.loads((tmp_path / "out" / "report.json").read_text())["parameters"]["modulus"]["value"] > 0


@pytest.fixture
def told(monkeypatch):
    """A reconstruction of three images that is made up, and the weight it is compared with."""
    sensor = tm.preset("fingertip")
    nothing = tm.Reconstruction(*torch.zeros(len(tm.Reconstruction._fields), 3, 1))
    result = nothing._replace(force=torch.tensor([[0.0, 0.0, -2.0]] * 3), force_deviation=torch.full((3, 3), 0.06))
    patches = torch.tensor([[[0, 0, -1.9], [0, 0, -0.1]]] * 3)
    result = result._replace(contact_at_rim=torch.zeros(3, 2), contact_force=patches, status=torch.zeros(3, dtype=torch.int32))

    class Made:
        def __init__(self, sensor):
            self.modulus = sensor.material.shear_modulus

        def __call__(self, images):
            return result._replace(force=result.force * self.modulus)

    def change(**fields):
        nonlocal result
        result = result._replace(**fields)

    made = replace(sensor, material=replace(sensor.material, shear_modulus=1.0))
    monkeypatch.setattr(weight_module, "Reconstructor", Made)
    material = weight_module.MaterialFit(made, *[np.zeros(2)] * 7)
    monkeypatch.setattr(weight_module, "material_from_images", lambda *_, **__: material)
    return change, lambda weight: weight_module.material_from_weight(sensor, torch.zeros(3, 1, 480, 640), weight)


def test_the_modulus_is_in_proportion_to_the_weight(told):
    _, fit = told
    for weight in (1.0, 5.0):
        found = fit(weight)
        assert found.sensor.material.shear_modulus == pytest.approx(weight / 2)
        assert found.forces == pytest.approx([weight] * 3)
    assert fit(2.0).deviation == pytest.approx(0.03 / 3**0.5)  # each known to 0.06 / 2


def test_images_are_weighed_by_their_noise_and_their_scatter_enlarges_the_deviation(told):
    """All know the force to 0.06; means weighted by the inverse squares of relative deviations, chi squared over 2."""
    change, fit = told
    force = np.array([1.9, 2.0, 2.1])
    change(force=torch.tensor([[0.0, 0.0, -f] for f in force], dtype=torch.float32))
    scaled = 2 * force * (force**2).sum() / (force**3).sum()
    found = fit(2.0)
    assert found.forces == pytest.approx(scaled, rel=1e-5)
    scatter = np.sqrt((((scaled - 2) / 0.06) ** 2).sum() / 2)
    assert scatter > 1.1 and found.deviation == pytest.approx(0.06 / np.sqrt((scaled**2).sum()) * scatter, rel=1e-4)


BOTH_AT_RIM = {"contact_at_rim": torch.ones(3, 2), "contact_force": torch.tensor([[[0, 0, -0.15]] * 2] * 3)}
"""Each less than a tenth of the force, both more."""


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (BOTH_AT_RIM, "image 1: the press reaches the rim"),
        ({"contact_at_rim": torch.tensor([[0, 0], [1.0, 0], [0, 0]])}, "image 2: the press reaches the rim"),
        ({"force_deviation": torch.full((3, 3), 1.0)}, "image 1 shows a force whose relative error is 50 %;"),
        ({"force_deviation": torch.full((3, 3), 0.2)}, "scale of forces only to 5.8%"),
        ({"status": torch.tensor([0, 0, 3])}, "image 3: the solve has not converged"),
        ({"force": torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 0.0, -4.0]])}, "image 3 shows"),
    ],
)
def test_what_tells_no_scale_is_refused(told, fields, said):
    change, fit = told
    change(**fields)
    with pytest.raises(tm.MembraneError, match=said):
        fit(2.0)


def test_a_trace_of_force_at_the_rim_does_no_harm(told):
    change, fit = told
    change(contact_at_rim=torch.tensor([[0, 1.0]] * 3))
    assert fit(2.0).sensor.material.shear_modulus == pytest.approx(1.0)


@pytest.mark.parametrize("text", ["200", "g", "-2N", "2 pounds", ""])
def test_a_weight_needs_its_unit(text):
    with pytest.raises(ArgumentTypeError, match="expected"):
        arguments.weight(text)


def test_a_weight_is_the_same_in_all_of_its_units():
    """Of 200 g under standard gravity."""
    for text in ("0.2 kg", "200 g", "1961.33 mN", "1.96133N"):
        assert arguments.weight(text) == pytest.approx(1.96133, rel=1e-12)


def test_a_weight_beside_a_table_is_the_force_of_the_images_that_the_table_lacks(tmp_path):
    images = Inputs([tmp_path / f"{name}.png" for name in "abc"], [])
    (tmp_path / "forces.csv").write_text("image,fx,fy,fz,deviation\nb.png,0,3,-4,0.1\n")
    both = known_forces(SimpleNamespace(forces=tmp_path / "forces.csv", weight=2.0), images)
    np.testing.assert_allclose(both.forces, [[2.0], [5.0], [2.0]])
    np.testing.assert_array_equal(both.deviations, [np.nan, 0.1, np.nan])
    np.testing.assert_array_equal(known_forces(SimpleNamespace(forces=None, weight=2.0), images).forces, np.full((3, 1), 2.0))
    assert known_forces(SimpleNamespace(forces=None, weight=None), images) is None


@pytest.mark.usefixtures("calibration_grids")
def test_an_image_that_is_not_pressed_tells_no_modulus(tmp_path, capsys):
    (tmp_path / "forces.csv").write_text("image,force\nrest.png,1\nflat_plate.png,1\n")
    for given in (["--weight", "2N"], [str(EXAMPLES / "flat_plate.png"), "--forces", str(tmp_path / "forces.csv")]):
        call = ["calibrate", "material", str(EXAMPLES / "sensor.toml"), str(EXAMPLES / "rest.png"), *given]
        assert main([*call, "--out", str(tmp_path / "out")]) == 2
        assert "calibrate material: rest.png shows hardly any force" in capsys.readouterr().err


def test_every_image_that_contradicts_the_others_is_named(monkeypatch):
    sensor = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
    forces, deviations = np.array([1.0, 1.02, 1.6, 0.99, 0.4]), np.full(5, 0.05)
    found = SimpleNamespace(sensor=sensor)
    monkeypatch.setattr(weight_module, "material_from_images", lambda *_, **__: found)
    monkeypatch.setattr(weight_module, "_told", lambda *_: (forces, deviations))
    with pytest.raises(tm.MembraneError, match="image 3 shows 1.6, image 5 shows 0.4 times the others' force"):
        weight_module.material_from_weight(sensor, torch.zeros(5, 1, 480, 640), 1.0)
