"""Presses tell the height of an inflated rest surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.calibrate.known_modulus import KnownForces
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.calibrate.rest_error import LEAST_HEIGHT_ERROR, PressesTold, StatedHeight, height_told
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.presets.blown_up import Stated, blown_up
from torchmembrane.sensor.factories import elastic_energy
from torchmembrane.sensor.parts import Cavity, Markers
from torchmembrane.sensor.units import hectopascal
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press

CAMERA = tm.Camera("pinhole", (640, 480), (480.0, 480.0), (320.0, 240.0))
HEIGHT, STRETCH, MODULUS = 6.0, 1.15, 0.06


def test_the_height_of_least_loss_is_found_beside_what_was_stated():
    """Losses `(z - k h)^2 / (2 v) + (h - 0.4)^2 / (2 s^2)`, forces `exp(2 z + 0.3 h)`."""
    variance, step, k, s, reach = 0.03**2, 0.04, 0.02, 0.2, 0.5
    z = step * np.array([-1.0, 1.0])

    def told(h):
        losses = (z - k * h) ** 2 / (2 * variance) + (h - 0.4) ** 2 / (2 * s**2)
        return PressesTold(losses, np.exp(2 * z + 0.3 * h)[:, None] * [1.0, 5.0])

    stated = StatedHeight(0.1, -0.3, reach)
    found = height_told(told(0.0), told(-reach), told(reach), step, variance, stated)
    assert found[:3] == pytest.approx((k, 2 * step, 0.3))
    own = 1 / (s**2 + (LEAST_HEIGHT_ERROR / stated.error) ** 2)  # of the presses; of what was stated 1
    assert found.mean == pytest.approx((0.4 * own - 0.3) / (own + 1)) and found.deviation == pytest.approx((own + 1) ** -0.5)


def test_a_height_of_no_effect_stays_as_it_was_stated():
    flat = PressesTold(np.zeros(2), np.ones((2, 1)))
    found = height_told(flat, flat, flat, 0.04, 0.03**2, StatedHeight(0.1, 0.2))
    assert (found.mean, found.deviation, found.shift) == (0.2, 1.0, 0.0)


def test_what_was_stated_stays_the_same_length_above_a_surface_that_rises():
    before, height = StatedHeight(0.1, 0.5), 6.0
    after = before.after(1.2, 0.25)
    raised = height * (1 + before.error * 1.2)
    assert after.error * raised == pytest.approx(before.error * height) and after.reach == pytest.approx(0.5)
    assert raised * (1 + after.error * after.mean) == pytest.approx(height * (1 + before.error * before.mean))


def test_rounds_look_closer_and_closer_even_where_the_presses_tell_nothing():
    height = StatedHeight(0.1)
    reaches = [height.reach, *((height := height.after(1.0, 1.0)).reach for _ in range(3))]
    assert (np.diff(reaches) < -0.1).all() and height.is_settled(0.9, 1.0) and not height.is_settled(0.9, 0.04)


def window(height, stretch=1.1):
    found = blown_up(
        {"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0}, "mm", Stated(height, None, stretch, MODULUS, 1.0)
    )
    membrane = found.surface.membrane((17, 17))
    dots = found.surface.membrane((33, 33)).rest.reshape(33, 33, 3)[3:-3:3, 3:-3:3].reshape(-1, 3).numpy()
    return tm.Sensor(
        "w", "mm", CAMERA, membrane, found.material, Cavity("liquid"), Markers("dots", positions=dots), found.surface
    )


@pytest.mark.full
def test_presses_mend_a_height_that_was_stated_wrongly():
    """A window 6 mm high; the file says 5 mm, known to 1.2 mm, and another prestretch."""
    true = window(HEIGHT, STRETCH)
    membrane, dots = true.surface.membrane((25, 25)), true.markers.positions
    elasticity, pixels, forces = elastic_energy(true, membrane), [], []
    for direction in ((0.2, 0.0, -0.98), (-0.3, 0.3, -0.906)):
        direction = torch.tensor(direction, dtype=torch.float64)
        ball = Sphere(7.0).touching(membrane, direction)
        state = press(membrane, elasticity, [[ball, ball.moved(2.5 * direction)]])
        pixels.append(CAMERA.point_to_pixel(carried(state.vertices, membrane, dots)))
        forces.append(state.force.norm().item())
    gauge = float(rest_balance(membrane, elasticity)[0]) / hectopascal("mm")
    told = window(5.0)
    rays = CAMERA.pixel_to_ray(CAMERA.point_to_pixel(torch.from_numpy(dots)))
    origins, directions = rays.origin.numpy(), rays.direction.numpy()
    distance = told.surface.membrane((65, 65)).ray_points(origins, directions).distance
    kept = np.isfinite(distance)
    placed = (origins + distance[:, None] * directions)[kept]
    sensor = replace(told, markers=Markers("dots", positions=placed, sizes=["large"] + ["small"] * (kept.sum() - 1)))
    known = KnownForces(np.array(forces)[:, None])
    seen = torch.stack(pixels)[:, kept]
    found = material_from_pixels(sensor, seen, known, overpressure=gauge, noise=0.05, rest_error=0.24)
    assert abs(found.height[0] - HEIGHT) < 2 * found.height[1] < 1.0, found.height
    assert (np.abs(found.values - [STRETCH, MODULUS]) < 2 * found.deviations).all(), (found.values, found.deviations)
    made = found.sensor
    assert made.surface.formed.height == pytest.approx(found.height[0], rel=1e-3)
    assert made.markers.sizes[0] == "large" and len(made.markers.positions) == kept.sum()
    where = CAMERA.point_to_pixel(torch.from_numpy(made.markers.positions))
    assert (where - CAMERA.point_to_pixel(torch.from_numpy(placed))).abs().max() < 1e-6
