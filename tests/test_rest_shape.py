"""An inflated sheet passes the test of rest shapes; others fail."""

from dataclasses import replace

import numpy as np
import pytest

from torchmembrane import Camera, MembraneError, Sensor
from torchmembrane.accuracy.rest_shape import rest_shape
from torchmembrane.cli.main import main
from torchmembrane.cli.rest_words import rest_in_words
from torchmembrane.presets.blown_up import Stated, blown_up, sheet_dots
from torchmembrane.sensor.factories import cavity_filling
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.surface.membrane import Membrane

RIM = {"outline": "rectangle", "size": [50.0, 36.0], "corner": 4.0, "base_z": 40.0}
RUBBER = Material("neo_hookean", 1.06 * 1.036, None, 0.2551, 0.2 / 1.036**2)  # at rest, what the sheet of 1.06 is in the mean


@pytest.fixture(scope="module")
def window():
    found = blown_up(RIM, "mm", Stated(6.0, 12.0, 1.06, None, 0.2))
    markers = Markers("dots", positions=sheet_dots(found.surface, 5.0)[0])
    camera = Camera("pinhole", (320, 240), (250, 250), (160, 120))
    return Sensor("w", "mm", camera, found.surface.membrane((33, 33)), found.material, Cavity("liquid"), markers, found.surface)


def with_heights(window, heights):
    """The window's sensor with a surface of other heights over the same grid, dots on it."""
    formed = window.surface.formed
    X = formed.sheet.copy()
    X[..., 2] = 40 + np.where(np.isnan(formed.cells.places), heights(X[..., 0], X[..., 1]), 0.0)
    surface = Surface("grid", {"vertices": X, "fixed": ~np.isnan(formed.cells.places)})
    membrane = surface.membrane((33, 33))
    positions = np.take_along_axis(membrane.rest.numpy(), np.arange(5, 1080, 30)[:, None], 0)
    return replace(window, surface=surface, membrane=membrane, material=RUBBER, markers=Markers("dots", positions=positions))


def test_a_sheet_that_is_given_as_a_grid_is_found_again(window):
    sheet = replace(window, surface=Surface.from_membrane(window.membrane), material=RUBBER)
    found = rest_shape(sheet)
    assert found.left_over < 0.1 and found.nearest.distance < 0.002 * window.membrane.size
    assert found.nearest.height == pytest.approx(6.0, rel=0.01) and found.nearest.least == pytest.approx(1.035, abs=0.003)
    assert found.nearest.pressure * 1e4 == pytest.approx(12.0, rel=0.05)
    assert not [line for line in rest_in_words(sheet) if "are wrong" in line or "expected below" in line]


def test_a_sheet_is_its_own_equilibrium_and_has_no_other(window):
    found = rest_shape(window)
    assert found.left_over < 1e-6 and found.nearest is None and found.pressure * 1e4 == pytest.approx(12.0, rel=1e-5)


def test_a_dent_counts_towards_the_distance_from_the_nearest_sheet(window):
    """Of a sheet pressed in by 0.8 mm in the middle, by the points of the sheet of the height that is said."""
    X = window.surface.formed.vertices.copy()
    X[..., 2] -= 0.8 * np.exp(-(X[..., 0] ** 2 + X[..., 1] ** 2) / 20)
    membrane = Surface.from_membrane(Membrane(X)).membrane((33, 33))
    dented = replace(window, surface=Surface.from_membrane(membrane), membrane=membrane, material=RUBBER)
    nearest = rest_shape(dented).nearest
    off = window.surface.of_height(nearest.height).membrane((33, 33)).closest_points(X.reshape(-1, 3)).distance
    assert nearest.most == pytest.approx(off.max(), rel=0.1) and nearest.most > 0.4
    assert nearest.distance == pytest.approx((off**2).mean() ** 0.5, rel=0.1)


def test_a_prestretch_below_what_inflation_alone_gives_is_said(window):
    sheet = replace(window, surface=Surface.from_membrane(window.membrane), material=RUBBER)
    said = "less than inflation alone gives such a sheet, 1.0"
    assert said not in "\n".join(rest_in_words(sheet))
    assert f"a prestretch of 1.02 at rest is {said}" in "\n".join(
        rest_in_words(replace(sheet, material=replace(RUBBER, prestretch=1.02)))
    )


@pytest.mark.parametrize(
    "heights",
    [
        lambda x, y: 6 * ((1 - (x / 25) ** 2) * (1 - (y / 18) ** 2)).clip(0),
        pytest.param(lambda x, y: 6 * np.cos(np.pi * x / 50).clip(0) * np.cos(np.pi * y / 36).clip(0), marks=pytest.mark.full),
    ],
)
def test_another_surface_in_the_same_rim_leaves_forces_over_and_lies_apart(window, heights):
    wrong = with_heights(window, heights)
    found, words = rest_shape(wrong), "\n".join(rest_in_words(wrong))
    assert found.left_over > 0.2 and found.nearest.distance > 0.004 * window.membrane.size
    assert found.pressure < 0.85 * found.nearest.pressure
    assert "expected below 15%" in words and "depths and forces by this file are wrong" in words


def test_the_gauge_at_rest_is_compared_with_the_model(window):
    agrees, differs = (rest_in_words(window, gauge)[-1] for gauge in (12.5, 15.0))
    assert agrees.endswith("= 12 hPa") and "forces are 0.80 of the true ones" in differs
    relative = replace(window, material=replace(window.material, shear_modulus=None))
    modulus = window.material.modulus
    assert f"= {modulus:.4g} N/mm" in rest_in_words(relative, 12.0)[-1]


def test_check_does_not_praise_dots_that_were_placed_from_the_image(tmp_path, capsys):
    sensor = Sensor.from_file("examples/sensor.toml")
    placed = replace(sensor, markers=Markers("dots", rest_image=sensor.markers.rest_image))
    assert main(["check", str(placed.to_file(tmp_path)), "--overpressure", "2404hPa"]) == 0
    said = capsys.readouterr().out
    assert "does not tell whether the rest surface is right" in said and "px (rms" not in said
    assert "reconstructed: ok" not in said and "the gauge reads 2404 hPa" in said


@pytest.fixture(scope="module")
def flat(window):
    """A flat square of 32 mm, 25 mm from the camera, of simple numbers, which sum to no pressure at all."""
    x = (np.arange(17) - 8.0) * 2
    surface = Surface("heightfield", {"x": x, "y": x, "z": np.full((17, 17), 25.0)})
    positions = np.stack([*(a.ravel() for a in np.meshgrid(x[2:-2:2], x[2:-2:2])), np.full(49, 25.0)], 1)
    markers, material = Markers("dots", positions=positions), Material("neo_hookean", 1.2, None, 0.3, 0.4)
    return replace(window, surface=surface, membrane=surface.membrane((17, 17)), material=material, markers=markers)


@pytest.mark.parametrize("prestretch", [1.0, 1.2])
@pytest.mark.parametrize("modulus", [0.3, None])
@pytest.mark.parametrize("gauge", [None, 0.0, 20.0])
def test_a_membrane_without_a_pressure_is_told_without_one(flat, prestretch, modulus, gauge):
    sensor = replace(flat, material=replace(flat.material, prestretch=prestretch, shear_modulus=modulus))
    assert rest_shape(sensor).pressure == 0 and rest_shape(sensor).left_over < 1e-6
    said = rest_in_words(sensor, gauge)
    assert "no overpressure; forces of 0.0%" in said[0]
    assert ("0 hPa at rest" in said[-1]) == (gauge is not None), said


def test_a_gauge_that_reads_nothing_is_told(window):
    assert "shape or prestretch is wrong, or the gauge is not connected" in rest_in_words(window, 0.0)[-1]


@pytest.mark.parametrize("pressure, is_wrong", [(1013.0, False), (700.0, False), (12.0, True), (101.3, True), (101300.0, True)])
def test_a_gas_that_leaves_no_pressure_of_the_surroundings_is_told(window, recwarn, pressure, is_wrong):
    """A gauge's reading of 12 hPa in place of the absolute pressure, kPa or Pa in place of hPa."""
    cavity_filling(replace(window, cavity=Cavity("gas", pressure)), window.membrane, warn=True)
    said = [
        str(warning.message)
        for warning in recwarn
        if "expected the gas' absolute pressure in hPa, about 1025" in str(warning.message)
    ]
    assert len(said) == is_wrong


def test_a_gas_needs_a_volume(flat):
    gas = replace(flat, cavity=Cavity("gas", 1013.0))
    with pytest.raises(MembraneError, match=r"expected the volume of the gas, .*: add volume to \[cavity\]"):
        cavity_filling(gas, gas.membrane)
    assert cavity_filling(replace(gas, cavity=Cavity("gas", 1013.0, 2e4)), gas.membrane).gas[1] == 2e4
