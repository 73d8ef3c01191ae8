"""Height, prestretch and pose of a sheet are found together."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchmembrane import Camera, MembraneError, Sensor
from torchmembrane.calibrate import rest_from_image
from torchmembrane.presets.blown_up import Stated, blown_up, sheet_dots
from torchmembrane.sensor.inflated import InflatedSurface
from torchmembrane.sensor.parts import Cavity, Markers
from torchmembrane.sensor.units import hectopascal
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.render import Renderer

RIM = {"outline": "rectangle", "size": [50.0, 36.0], "corner": 4.0, "base_z": 40.0}
CAMERA = Camera("pinhole", (400, 300), (320, 320), (199, 151))
TILT, OFFSET = [1.0, -1.5, 0.5], np.array([0.3, -0.2, 0.6])  # degrees, mm


def window(height, prestretch, modulus=0.25):
    """A window whose dots are a lattice on the sheet before it is blown up."""
    found = blown_up(RIM, "mm", Stated(height, None, prestretch, modulus, 0.2))
    X, sizes = sheet_dots(found.surface, 5.5)
    return Sensor(
        "w",
        "mm",
        CAMERA,
        found.surface.membrane((33, 33)),
        found.material,
        Cavity("liquid"),
        Markers("dots", "dark", X, sizes),
        found.surface,
    )


@pytest.fixture(scope="module")
def photograph():
    """The rest image of a window 6.3 mm high, of prestretch 1.16, that is tilted and shifted; and its overpressure, hPa."""
    true = window(6.3, 1.16)
    turn, pivot = Rotation.from_rotvec(TILT, degrees=True).as_matrix(), true.surface.rim.mean(0)

    def place(x):
        return (x - pivot) @ turn.T + pivot + OFFSET

    surface = InflatedSurface("inflated", {"outline": place(true.surface.rim), "height": 6.3}, true.material, "mm")
    placed = replace(
        true,
        surface=surface,
        membrane=surface.membrane((33, 33)),
        markers=replace(true.markers, positions=place(true.markers.positions)),
    )
    image = noisy(Renderer(placed)(placed.membrane.rest), 40.0, np.random.default_rng(0)).numpy().astype(np.float32)
    return image, true.surface.formed.pressure * true.material.modulus / hectopascal("mm")


@pytest.fixture(scope="module")
def found(photograph):
    image, gauge = photograph
    return rest_from_image(window(5.8, 1.1), image, gauge)


def test_height_prestretch_and_pose_are_found_with_the_gauge(found):
    off = found.fit.values - [*TILT, *OFFSET, 6.3, 1.16]
    assert np.abs(off[:3]).max() < 0.1 and np.abs(off[3:6]).max() < 0.05 and abs(off[6]) < 0.05 and abs(off[7]) < 0.01
    assert (np.abs(off) < 3 * found.fit.deviations + 1e-3).all()
    assert found.names[6:] == ["height", "prestretch"] and found.sensor.surface.shape == "inflated"
    residual = found.residuals[np.isfinite(found.residuals).all(1)]
    assert np.sqrt((residual**2).mean()) < 0.1


@pytest.mark.full
def test_without_a_gauge_the_prestretch_is_less_sure_and_without_a_modulus_the_gauge_gives_it(photograph):
    image, gauge = photograph
    alone = rest_from_image(window(5.8, 1.1), image)
    told = rest_from_image(window(5.8, 1.1), image, gauge)
    assert alone.fit.deviations[7] > told.fit.deviations[7] and abs(alone.fit.values[6] - 6.3) < 0.06
    assert abs(alone.fit.values[7] - 1.16) < 3 * alone.fit.deviations[7]
    unknown = window(5.8, 1.1)
    unknown = replace(unknown, material=replace(unknown.material, shear_modulus=None))
    made = rest_from_image(unknown, image, gauge).sensor
    held = made.surface.formed.pressure * made.material.modulus / hectopascal("mm")
    assert held == pytest.approx(gauge, rel=1e-3) and made.force_unit == "N"


def test_the_sensor_that_was_found_is_read_as_it_was_written(found, tmp_path):
    made = found.sensor
    again = Sensor.from_file(made.to_file(tmp_path))
    assert isinstance(again.surface, InflatedSurface) and (tmp_path / "sensor_rim.csv").exists()
    torch.testing.assert_close(again.membrane.rest, made.membrane.rest)


def test_an_overpressure_of_another_shape_is_refused():
    sensor = Sensor.from_file("examples/sensor.toml")
    with pytest.raises(MembraneError, match="expected an inflated surface"):
        rest_from_image(sensor, sensor.markers.rest_image, 12.0)


@pytest.mark.parametrize(
    "reading, said", [(-44.0, "expected a positive reading"), (1057.0, "expected the same to a few per cent")]
)
def test_a_gauge_that_contradicts_the_modulus_is_refused(photograph, reading, said):
    """Such as the absolute pressure."""
    with pytest.raises(MembraneError, match=said):
        rest_from_image(window(5.8, 1.1), photograph[0], reading)


def test_a_gauge_that_reads_all_of_a_gas_pressure_is_refused(photograph):
    unknown = window(5.8, 1.1)
    material, cavity = replace(unknown.material, shear_modulus=None), Cavity("gas", 1057.0)
    with pytest.raises(MembraneError, match="subtract the atmosphere's pressure"):
        rest_from_image(replace(unknown, material=material, cavity=cavity), photograph[0], 1056.0)
