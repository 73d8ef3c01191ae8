"""An uncertain rest height adds to all deviations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.calibrate.explained import UNKNOWN, by_shapes
from torchmembrane.calibrate.presses import STRETCHES, LossProfile
from torchmembrane.calibrate.rest_error import PressesTold, at_other_height, height_effect
from torchmembrane.presets.blown_up import Stated, blown_up
from torchmembrane.sensor.parts import Cavity, Markers
from torchmembrane.sensor.record import Record

CAMERA = tm.Camera("pinhole", (640, 480), (480.0, 480.0), (320.0, 240.0))


def window():
    found = blown_up({"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0}, "mm", Stated(6.0, 12.0, 1.1, None, 0.2))
    membrane = found.surface.membrane((17, 17))
    dots = found.surface.membrane((9, 9)).rest.reshape(9, 9, 3)[2:-2, 2:-2].reshape(-1, 3).numpy()
    return tm.Sensor(
        "w", "mm", CAMERA, membrane, found.material, Cavity("liquid"), Markers("dots", positions=dots), found.surface
    )


@pytest.mark.parametrize("sensor", [window, lambda: tm.preset("bubble"), lambda: tm.preset("half_cylinder")])
def test_a_surface_of_another_height_is_lower_by_a_share_and_its_dots_stay_on_their_rays(sensor):
    sensor = sensor()
    other, kept = at_other_height(sensor, sensor.markers.positions, 0.05)
    before, after = (s.membrane.rest[:, 2] - s.membrane.rest[s.membrane.fixed, 2].mean() for s in (sensor, other))
    if sensor.name == "half_cylinder":  # its ends are rim, too
        before, after = (z - z.min() for z in (before, after))
    assert float(after.max() / before.max()) == pytest.approx(0.95, rel=5e-3) and kept.mean() > 0.9
    here, there = sensor.markers.positions[kept], other.markers.positions
    seen, was = (sensor.camera.point_to_pixel(torch.from_numpy(x)) for x in (there, here))
    assert (seen - was).abs().max() < 1e-6 and np.abs(there - here).max() > 0.05


def test_the_height_moves_the_minimum_of_a_parabola_and_the_forces():
    """Losses `(z - m)^2 / (2 v)` with the minimum at 0 and at 0.02; forces `exp(2 z + 0.3 h)`."""
    step, variance = 0.04, 0.03**2
    z = step * np.array([-1.0, 0.0, 1.0])
    own, higher = (
        PressesTold((z - m) ** 2 / (2 * variance), np.exp(2 * z + 0.3 * h)[:, None] * [1.0, 5.0])
        for m, h in ((0.0, 0), (0.02, 1))
    )
    found = height_effect(own, higher, step, variance)
    assert found[:3] == pytest.approx((0.02, 2 * step, 0.3)) and found[3:] == (0.0, 1.0)
    assert height_effect(own, higher._replace(losses=1e3 * z), step, variance).shift == pytest.approx(-3 * 0.03)


def test_results_carry_how_surely_the_sensor_s_forces_are_scaled(small_sensor, small_images):
    sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
    calibrated = replace(sensor, record=Record(uncertainty=0.2))
    plain, scaled = (tm.Reconstructor(s) for s in (sensor, calibrated))
    image = plain.read(str(small_images[-1]))
    one, other = plain(image), scaled(image)
    assert torch.equal(one.force, other.force) and one.force.norm() > 0.05
    torch.testing.assert_close(other.force_deviation, torch.hypot(one.force_deviation, 0.2 * one.force))


@pytest.mark.parametrize("apart, is_bounded", [(0.05, False), (0.5, True)])
def test_presses_that_contradict_one_another_tell_no_less_of_the_prestretch_than_none(apart, is_bounded):
    """Three images, sharp losses, so far apart in the logarithm; without any every prestretch that is tried is as likely."""
    z, middle = np.log(STRETCHES), np.log(STRETCHES).mean()
    losses = np.stack([np.abs(z - middle - side * apart / 2) / 2e-3 for side in (-1, 0, 1)], 1)
    shapes = by_shapes(LossProfile(STRETCHES, losses))
    assert (shapes.deviation == UNKNOWN) == is_bounded and shapes.deviation <= UNKNOWN
    assert UNKNOWN == pytest.approx(np.random.default_rng(0).uniform(z[0], z[-1], 10**6).std(), rel=1e-3)


def test_an_error_that_images_share_adds_to_the_variance_of_each():
    """Of two images whose losses are parabolas about other prestretches."""
    stretches = np.geomspace(1.05, 1.9, 41)
    off = np.log(stretches)[:, None] - np.log([1.3, 1.4])
    profile = LossProfile(stretches, off**2 / (2 * 0.03**2))
    alone, shared = by_shapes(profile, 0.0), by_shapes(profile, 0.05)
    np.testing.assert_allclose(shared.variances, alone.variances + 0.05**2)
    np.testing.assert_allclose(shared.each, alone.each)
    assert shared.mean == alone.mean and shared.deviation > np.hypot(shared.by_losses, 0.05) * (1 - 1e-9)
