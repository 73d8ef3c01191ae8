"""Presses show what the paper's figures of them show."""

from typing import NamedTuple

import pytest
import torch

from torchmembrane.estimators.base import Equilibrium, Problem
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy
from torchmembrane.estimators.paper.estimator import PaperEstimator
from torchmembrane.markers.locator import isotropic
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.presets import preset
from torchmembrane.sensor.factories import cavity_filling, elastic_energy
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.indenters import Cylinder, Sphere
from torchmembrane.simulate.quasi_static import Press, carried, press
from torchmembrane.surface.membrane import Membrane

FINE, GRID, NOISE = (41, 41), (17, 17), 0.05


class Shown(NamedTuple):
    """A press of a sensor, its truth on the solver's grid `[V, 3]`, and what the estimators find of it."""

    sensor: Sensor
    membrane: Membrane
    state: Press
    truth: torch.Tensor
    paper: Equilibrium
    least: Equilibrium
    balance: Equilibrium

    def error(self, found):
        return float((found.vertices[0] - self.truth).norm() / (self.truth - self.membrane.rest).norm())

    def force(self):
        return (self.balance.traction[0] * self.membrane.rest_area[:, None]).sum(0)


def shown(name, *strokes):
    """Bodies, the ways they go and how far, without friction."""
    sensor = preset(name)
    fine, membrane = sensor.membrane.resampled(FINE), sensor.membrane.resampled(GRID)
    paths = []
    for body, way, depth in strokes:
        travel = torch.nn.functional.normalize(torch.tensor(way, dtype=torch.float64), dim=0)
        start = body.touching(fine, travel)
        paths.append([start, start.moved(depth * travel)])
    state = press(fine, elastic_energy(sensor, fine), paths, **cavity_filling(sensor, fine)._asdict())
    dots, pixel = torch.from_numpy(sensor.markers.positions), sensor.camera.point_to_pixel
    noise = NOISE * torch.randn(len(dots), 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen = pixel(carried(state.vertices, fine, dots)) + noise
    problem = Problem(
        camera=sensor.camera,
        membrane=membrane,
        elasticity=elastic_energy(sensor, membrane),
        **cavity_filling(sensor, membrane)._asdict(),
        markers=membrane.closest_points(dots.numpy()),
        positions=dots,
        rest_pixels=pixel(dots),
        vertex_pixels=pixel(membrane.rest),
        rest_covariance=isotropic(dots[:, 0], 2 * NOISE),
    )
    found = []
    for kind in (PaperEstimator, MinimumEnergy, ForceBalance):
        estimator = kind.from_problem(problem)
        found.append(estimator(estimator.prepare(sensor.camera, seen[None], torch.ones(1, len(dots), dtype=torch.float64))))
        assert estimator.is_converged(found[-1]).all()
    return Shown(sensor, membrane, state, carried(state.vertices, fine, membrane.rest), *found)


def test_a_point_indenter_seen_from_the_side():
    """Fig. 12: all find a dent where it is, both of least energy a fraction of its depth; the liquid is kept."""
    one = shown("fingertip", (Sphere(2.0, translation=(0, 0, 6)), (-0.35, -0.1, -1.0), 2.0))
    assert one.error(one.balance) < 0.06 and 0.4 < one.error(one.least) < one.error(one.paper) < 0.9
    rest, deepest = one.membrane.rest, (one.truth - one.membrane.rest).norm(dim=-1).argmax()
    sunk, in_truth = one.balance.vertices[0, deepest, 2] - rest[deepest, 2], (one.truth - rest)[deepest, 2]
    assert in_truth < -1 and abs(sunk - in_truth) < 0.1
    assert in_truth < 0.5 * in_truth < (one.least.vertices[0] - rest)[deepest, 2] < 0
    normal, bulge = one.membrane.rest_normals[deepest], {}
    for name, x in (("truth", one.truth), ("paper", one.paper.vertices[0]), ("least", one.least.vertices[0])):
        bulge[name] = ((rest - x)[deepest] * normal).sum()
    assert 0 < bulge["paper"] < bulge["least"] < 0.5 * bulge["truth"]
    assert (one.force() - one.state.force).norm() < 0.1 * one.state.force.norm()
    for found in (one.least, one.balance):
        torch.testing.assert_close(found.volume, one.membrane.rest_volume[None], rtol=1e-6, atol=0)
    torch.testing.assert_close(one.paper.volume, one.membrane.rest_volume[None], rtol=1e-3, atol=0)  # linear


SQUEEZE = Cylinder(3.0, axis=(1, 0, 0), translation=(0, 0, 24))


def middle(one, x):
    """The cross-section half way along the cylinder, `[n, 2]`: y and z, from one rim to the other in y."""
    section = x.reshape(*one.membrane.grid, 3)[one.membrane.grid[0] // 2, :, 1:]
    return section if section[0, 0] < section[-1, 0] else section.flip(0)


def test_a_half_cylinder_squeezed_on_one_side_seen_from_its_end():
    """Fig. 13: the side at y > 0 goes in, the other side and the top give way outwards."""
    one = shown("half_cylinder", (SQUEEZE, (0.0, -0.8, -0.6), 2.5))
    assert one.error(one.balance) < 0.12 and 0.3 < one.error(one.least) < 0.7 and one.error(one.paper) < 0.85
    rest, n = middle(one, one.membrane.rest), one.membrane.grid[1]
    left, top, right = (slice(2, n // 3), n // 2, slice(-n // 3, -2))
    shares = {0.8: one.balance.vertices[0], 0.3: one.least.vertices[0], 0.2: one.paper.vertices[0], 1.0: one.truth}
    for share, found in shares.items():
        moved = middle(one, found) - rest
        assert moved[right, 0].min() < -1.5 * share and moved[left, 0].max() < 0 < moved[top, 1]
    torch.testing.assert_close(middle(one, one.balance.vertices[0]), middle(one, one.truth), rtol=0, atol=0.5)


def test_a_half_cylinder_squeezed_on_both_sides_seen_from_its_end():
    """Fig. 13: both sides go in alike, the top rises."""
    one = shown("half_cylinder", *((SQUEEZE, (0.0, way, -0.6), 1.2) for way in (-0.8, 0.8)))
    assert one.error(one.balance) < 0.12 and 0.3 < one.error(one.least) < 0.7 and one.error(one.paper) < 0.85
    for found, rise in ((one.balance.vertices[0], 1.5), (one.least.vertices[0], 0.5), (one.paper.vertices[0], 0.2)):
        section = middle(one, found)
        moved, mirrored = section - middle(one, one.membrane.rest), section.flip(0) * torch.tensor([-1.0, 1.0])
        assert moved[-6:-2, 0].min() < -0.5 and moved[2:6, 0].max() > 0.5 and moved[len(moved) // 2, 1] > rise
        torch.testing.assert_close(section, mirrored, rtol=0, atol=0.1)


def test_a_larger_sensor_filled_with_air():
    """Fig. 15: place, force and shape of a press; pressure times volume of the air is kept, not its volume."""
    one = shown("bubble", (Sphere(7.0, translation=(0, 0, 45)), (-0.3, 0.2, -1.0), 5.0))
    assert one.membrane.size > 2 * preset("fingertip").membrane.size and one.sensor.cavity.filling == "gas"
    assert one.error(one.balance) < 0.1 and 0.5 < one.error(one.least) < one.error(one.paper) < 1
    assert (one.force() - one.state.force).norm() < 0.12 * one.state.force.norm()
    found, truth = one.balance.vertices[0], one.truth
    assert (found - truth).norm(dim=-1).max() < 0.15 * (truth - one.membrane.rest).norm(dim=-1).max()
    pressure, air = cavity_filling(one.sensor, one.membrane).gas
    rise = one.balance.volume - one.membrane.rest_volume
    assert rise < -0.005 * air
    rest_pressure = rest_balance(one.membrane, elastic_energy(one.sensor, one.membrane))[0]
    assert float((pressure + one.balance.pressure - rest_pressure) * (air + rise)) == pytest.approx(pressure * air, rel=1e-4)
