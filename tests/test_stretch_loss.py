"""Pushes cost nothing in the loss that finds the prestretch."""

import numpy as np
import pytest
import torch

from torchmembrane.calibrate.presses import Presses
from torchmembrane.calibrate.stretch_loss import continued
from torchmembrane.camera.model import Camera
from torchmembrane.estimators.force_balance.gauss_newton import State
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press

FLAT = Surface("spherical_cap", {"rim_radius": 20.0, "height": 10.0, "base_z": 30.0})
CAMERA = Camera("pinhole", (640, 480), (330.0, 330.0), (320.0, 240.0))
PRESTRETCH, NOISE = 1.3, 0.05
STRETCHES = PRESTRETCH * np.exp(np.linspace(-0.12, 0.12, 9))


@pytest.fixture(scope="module")
def light():
    """A light press of a flat cap, with six draws of noise, and what explains each at `STRETCHES`."""
    dome, down = FLAT.membrane((33, 33)), torch.tensor([0.1, -0.2, -1.0], dtype=torch.float64)
    dots = dome.rest.reshape(33, 33, 3)[3:-3:2, 3:-3:2].reshape(-1, 3).numpy()
    ball = Sphere(5.0).touching(dome, down / down.norm())
    state = press(dome, ElasticEnergy(dome, "neo_hookean", PRESTRETCH, 1.0), [[ball, ball.moved(1.2 * down / down.norm())]])
    material, markers = Material("neo_hookean", 1.5), Markers("dots", "dark", dots)
    sensor = Sensor("cap", "mm", CAMERA, FLAT.membrane((17, 17)), material, Cavity("liquid"), markers)
    reconstructor = Reconstructor(sensor, dtype=torch.float64)
    noise = torch.randn((6, len(dots), 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels = CAMERA.point_to_pixel(carried(state.vertices, dome, dots)) + NOISE * noise
    presses = Presses(reconstructor, pixels - reconstructor.rest_pixels, torch.ones(pixels.shape[:2], dtype=torch.float64))
    solutions = [presses.explained(stretch, 1.0) for stretch in STRETCHES]
    return presses.observation, solutions, continued(solutions, presses.observation)


def off(losses):
    """Rms of the logarithms of the prestretches of least loss over the truth, by parabolas through three."""
    z, found = np.log(STRETCHES / PRESTRETCH), []
    for column in torch.stack(losses, -1).numpy():
        i = min(max(int(np.argmin(column)), 1), len(z) - 2)
        before, at, after = column[i - 1 : i + 2]
        found.append(z[i] + (z[1] - z[0]) / 2 * (before - after) / (before - 2 * at + after))
    return np.sqrt(np.mean(np.square(found)))


def test_without_its_pushes_a_light_press_tells_the_prestretch_better(light):
    best = light[2]
    beside, whole = off([found.unexplained for _, found in best]), off([found.objective for _, found in best])
    assert beside < 0.02 and beside < 0.95 * whole


def test_pushes_cost_nothing_and_pulls_what_they_cost(light):
    observation, solutions, _ = light
    estimator, found = solutions[4]
    measured, seen = estimator.equations.bearings.measured(observation), observation.confidence.sum(-1)
    state = State(found.vertices - estimator.membrane.rest, found.pressure, found.moved)
    traction, normal = estimator.gauss_newton.tractions(*state[:2])
    angles = estimator.equations.bearings.angles(state.u, measured, state.moved)[0]
    misfit = estimator.gauss_newton.misfit(angles, state.pressure, measured)
    _, _, pushes, others = estimator.equations.loss(traction, normal, measured.noise_level)
    beside = misfit + others
    torch.testing.assert_close((found.unexplained, found.objective), (beside / seen, (beside + pushes) / seen))
    assert (beside > 0).all() and (pushes > 0).all()
    pulled = misfit + estimator.equations.loss(-traction, normal, measured.noise_level).others
    assert (pulled > 10 * beside).all()


def test_a_solve_that_ended_elsewhere_is_led_to_what_its_neighbours_found(light):
    observation, solutions, best = light
    estimator, found = (best := continued(best, observation))[4]  # until no neighbour knows better
    measured = estimator.equations.bearings.measured(observation)
    at_rest = estimator.at_rest(observation.confidence)
    stuck = estimator.equilibrium(*at_rest, at_rest.u, measured)
    assert (stuck.objective > 2 * found.objective).all()
    led = continued([best[3], (estimator, stuck), best[5]], observation)[1][1]
    assert led.objective.numpy() == pytest.approx(found.objective.numpy(), rel=0.1)
    for (_, before), (_, after) in zip(solutions, best, strict=True):
        assert (after.objective <= before.objective).all()
