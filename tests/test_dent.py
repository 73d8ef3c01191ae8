"""From a dent the steps find dents that look like mounds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.force_balance.starts import DENT, REACH
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.surface.shapes import spherical_cap

DOME = spherical_cap(12, 9, 30, (17, 17))
SLACK = 1.1


@pytest.fixture(scope="module")
def estimator() -> ForceBalance:
    positions = spherical_cap(12, 9, 30, (13, 13)).rest[~spherical_cap(12, 9, 30, (13, 13)).fixed]
    return ForceBalance(
        DOME, ElasticEnergy(DOME, "neo_hookean", 1.3), DOME.closest_points(positions.numpy()), positions, noise=1e-3
    )


def dented(estimator: ForceBalance, middles: list[int], push: float = 1.0, u: torch.Tensor | float = 0.0) -> torch.Tensor:
    """How far every vertex of the dome, displaced by `u`, is moved, `[V, 3]`, when what is within a seventh of its size of some
    is pushed."""
    rest = estimator.membrane.rest
    near = (torch.cdist(rest, rest[middles]) < DOME.size / 7).any(1)
    traction = -push * estimator.reference * near.double()[:, None] * DOME.rest_normals
    rays = torch.nn.functional.normalize(estimator.equations.bearings.positions, dim=-1)[None]
    measured = estimator.equations.bearings.measured(Observation(torch.zeros_like(rays), rays, torch.ones_like(rays[..., 0])))
    held = estimator.gauss_newton.traction
    estimator.gauss_newton.traction = lambda state, measured: traction[None]
    try:
        state = estimator.at_rest(measured.weight)
        return (estimator.dent(state.u + u, *state[1:], measured).u - u)[0]
    finally:
        estimator.gauss_newton.traction = held


def vertex_near(x: float, y: float) -> int:
    return int((DOME.rest[:, :2] - torch.tensor([x, y])).square().sum(1).argmin())


@pytest.mark.parametrize("middles", [[vertex_near(0, 0)], [vertex_near(5, 0)], [vertex_near(-8, 0), vertex_near(8, 0)]])
def test_the_middle_of_a_contact_is_dented_inwards_along_the_normals(estimator, middles):
    """Nearly as deep as `DENT` says, half where another contact draws the middle aside; far from one, hardly at all."""
    move, step = dented(estimator, middles), DOME.size / 16
    depth = -(move * DOME.rest_normals).sum(-1)
    torch.testing.assert_close(move, -depth[:, None] * DOME.rest_normals, rtol=0, atol=1e-9)
    distance = torch.cdist(DOME.rest, DOME.rest[middles])
    for near in distance.T:
        least = 0.75 if len(middles) == 1 else 0.5
        assert least * DENT * DOME.size < depth[near < 1.5 * step].max() <= DENT * DOME.size
    if len(middles) == 1:  # half way between two is a middle as well
        assert depth[distance[:, 0] > 3 * DENT * DOME.size + 2 * step].max() < 0.1 * DENT * DOME.size
    assert (depth[DOME.fixed] == 0).all()


def test_a_surface_that_is_already_pressed_in_is_dented_along_the_normals_at_rest(estimator):
    """Its own normals cross each other where it is deep: a dent along them would fold it."""
    top = vertex_near(0, 0)
    deep = torch.exp(-(DOME.rest - DOME.rest[top]).square().sum(-1) / (2 * (0.1 * DOME.size) ** 2))
    move = dented(estimator, [top], u=-0.3 * DOME.size * deep[:, None] * DOME.rest_normals)
    assert move.norm(dim=-1).max() > 0.5 * DENT * DOME.size
    torch.testing.assert_close(torch.linalg.cross(move, DOME.rest_normals), torch.zeros_like(move), rtol=0, atol=1e-9)


def test_a_dent_is_a_bell_whose_standard_deviation_is_its_width(estimator):
    """Ridges of a contact's square around it: what its depth falls to at one and at one and a half widths."""
    vertex = vertex_near(0, 0)
    depth = -(dented(estimator, [vertex]) * DOME.rest_normals).sum(-1)
    away = (DOME.rest - DOME.rest[vertex]).norm(dim=-1) / (DENT * DOME.size)
    near = (away > 0.5) & (away < 1.8)
    assert near.sum() > 12
    torch.testing.assert_close(depth[near] / depth.max(), torch.exp(-away[near].square() / 2), rtol=0.2, atol=0.02)


def test_contacts_nearer_than_their_reach_have_one_middle(estimator):
    apart = 0.5 * REACH * DOME.size / 2
    depth = dented(estimator, [vertex_near(-apart, 0), vertex_near(apart, 0)]).norm(dim=-1)
    assert (DOME.rest[depth.argmax(), :2]).norm() < DOME.size / 16


def test_no_push_no_dent(estimator):
    assert dented(estimator, [vertex_near(0, 0)], push=0.0).abs().max() < 1e-9


def pressed_bubble(depth: float) -> tuple[tm.Sensor, dict]:
    """A bubble of little prestretch, a ball of a seventh of its size pressed in so far over it, on another grid."""
    sensor = tm.preset("bubble")
    sensor = replace(
        sensor,
        material=replace(sensor.material, prestretch=SLACK),
        membrane=sensor.surface.membrane((17, 17)),
    )
    simulator, size = Simulator(sensor, (38, 38)), sensor.membrane.size
    aim = sensor.membrane.rest[sensor.membrane.fixed].mean(0).numpy()
    stroke = stroke_to(simulator, Sphere(size / 7), aim, np.array([0.0, 0.0, -1.0]), depth * size)
    (state,) = simulator.presses(stroke, ("push",))
    return sensor, simulator.frame(state, stroke, np.random.default_rng(0)).truth


def solved(reconstructor: tm.Reconstructor, truth: dict) -> tm.Reconstruction:
    with torch.no_grad():
        return reconstructor.from_pixels(torch.as_tensor(truth["uv_deformed"]).float())


def errors(found: tm.Reconstruction, truth: dict) -> tuple[float, float]:
    """Of the markers over their displacement, and of the force, relative."""
    rest, pressed = truth["dots_nominal"], truth["dots_deformed"]
    off = np.linalg.norm(found.markers[0].numpy() - pressed) / np.linalg.norm(pressed - rest)
    return float(off), float(np.linalg.norm(found.force[0].numpy() - truth["force"]) / np.linalg.norm(truth["force"]))


SHALLOW = [pytest.param(depth, 0.15, marks=pytest.mark.full) for depth in (0.04, 0.06)]


@pytest.mark.parametrize(
    "depth, largest", [*SHALLOW, (0.08, 0.15), pytest.param(0.2, 0.1, marks=pytest.mark.full), (0.31, 0.1)]
)
def test_a_pit_in_a_slack_bubble_is_not_taken_for_a_mound(depth, largest):
    """From hardly visible to nearly a third of the size deep."""
    sensor, truth = pressed_bubble(depth)
    surface, force = errors(solved(tm.Reconstructor(sensor, check_rest=False), truth), truth)
    assert surface < largest and force < 0.1


def test_without_the_dent_a_pit_in_a_slack_bubble_is_taken_for_a_mound():
    sensor, truth = pressed_bubble(0.06)
    reconstructor = tm.Reconstructor(sensor, check_rest=False)
    reconstructor.estimator.dent = None
    without, _ = errors(solved(reconstructor, truth), truth)
    assert without > 0.3
