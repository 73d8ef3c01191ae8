"""Wrong matches are flagged, right ones are not."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from torchmembrane import MembraneError
from torchmembrane.camera.model import Camera
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy
from torchmembrane.estimators.minimum_energy.flow import FlowInterpolation
from torchmembrane.estimators.paper.bilinear import BilinearFlow
from torchmembrane.estimators.paper.estimator import PaperEstimator
from torchmembrane.markers.screening import MismatchScreen
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press
from torchmembrane.surface.shapes import spherical_cap

CAMERA = Camera("fisheye", (640, 480), (168, 168), (320, 240))
SHARE = 0.05


@pytest.fixture(scope="module")
def pressed():
    """Rest pixels, anchors, noisy pixels, dots at rest and now: a ball of radius 3 pressed 3 mm, off the axis."""
    fine = spherical_cap(12, 9, 3, (31, 31))
    travel = torch.tensor([-0.4, 0.2, -0.9], dtype=torch.float64)
    ball = Sphere(3.0, translation=(0, 0, -0.5)).touching(fine, travel)
    state = press(
        fine, ElasticEnergy(fine, "neo_hookean", 1.3), [[ball, ball.moved(3.0 * torch.nn.functional.normalize(travel, dim=0))]]
    )
    dots = spherical_cap(12, 9, 3, (13, 13)).rest.reshape(13, 13, 3)[1:-1, 1:-1].reshape(-1, 3)
    moved = carried(state.vertices, fine, dots)
    noise = 0.05 * torch.randn(len(dots), 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    anchors = CAMERA.point_to_pixel(fine.rest[fine.fixed])
    return CAMERA.point_to_pixel(dots), anchors, CAMERA.point_to_pixel(moved) + noise, dots, moved


def mismatched(rest, pixels, seed):
    """5 % of the markers take the pixel of one of their four neighbours; which they are."""
    rng = np.random.default_rng(seed)
    bad = rng.choice(len(rest), round(SHARE * len(rest)), replace=False)
    near = cKDTree(rest).query(rest[bad], k=5)[1][:, 1:]
    wrong = pixels.clone()
    wrong[bad] = pixels[near[np.arange(len(bad)), rng.integers(0, 4, len(bad))]]
    flags = torch.zeros(len(rest), dtype=torch.bool)
    flags[bad] = True
    return wrong, flags


def test_mismatched_markers_are_flagged_and_no_others(pressed):
    rest, anchors, pixels, _, _ = pressed
    screen = MismatchScreen(rest.numpy(), anchors.numpy())
    one = torch.ones(1, len(rest), dtype=torch.float64)
    assert (screen((pixels - rest)[None], one) > 0.5).all()
    for seed in range(20):
        wrong, flags = mismatched(rest, pixels, seed)
        assert torch.equal(screen((wrong - rest)[None], one)[0] < 0.5, flags)


def test_a_lost_marker_has_zero_weight_and_stays_lost(pressed):
    rest, anchors, pixels, _, _ = pressed
    screen = MismatchScreen(rest.numpy(), anchors.numpy())
    confidence = torch.ones(2, len(rest), dtype=torch.float64)
    confidence[1, [3, 60, 61]] = 0
    displacement = (pixels - rest).expand(2, -1, -1).clone()
    displacement[1, [3, 60, 61]] = torch.nan
    got = screen(displacement, confidence)
    assert (got[1, [3, 60, 61]] == 0).all() and (got[confidence > 0] > 0.5).all()
    torch.testing.assert_close(got[:1], screen(displacement[:1], confidence[:1]))


def test_an_affine_flow_is_believed_whatever_its_size():
    rng = np.random.default_rng(0)
    pixels = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1).reshape(-1, 2) * 30.0 + rng.uniform(-4, 4, (81, 2))
    screen = MismatchScreen(pixels, np.zeros((0, 2)))
    flow = torch.from_numpy(pixels @ np.array([[0.2, 0.05], [-0.1, 0.15]]) + [40.0, -10.0])[None]
    torch.testing.assert_close(screen(flow, torch.ones(1, 81).double()), torch.ones(1, 81).double())


@pytest.mark.parametrize("estimator", ["paper", "minimum-energy", "force-balance"])
def test_the_surface_error_grows_by_less_than_a_fifth(pressed, estimator):
    rest, anchors, pixels, dots, moved = pressed
    dome = spherical_cap(12, 9, 3, (13, 13))
    points, elasticity = dome.closest_points(dots.numpy()), ElasticEnergy(dome, "neo_hookean", 1.3)
    vertex_pixels = CAMERA.point_to_pixel(dome.rest)

    def error(observed, confidence):
        if estimator == "force-balance":
            balance = ForceBalance(dome, elasticity, points, dots, 0.1 / 168)
            x = balance(balance.prepare(CAMERA, observed, confidence)).vertices
        else:
            kind, flow_kind = (PaperEstimator, BilinearFlow) if estimator == "paper" else (MinimumEnergy, FlowInterpolation)
            flow = flow_kind(dome, points)(observed - rest, confidence)
            least = kind(dome, elasticity, CAMERA.pixel_to_ray(vertex_pixels))
            x = least(Observation(*CAMERA.pixel_to_ray(vertex_pixels + flow), confidence)).vertices
        u = (x - dome.rest)[:, torch.from_numpy(points.vertices.astype(int))]
        placed = dots + (torch.from_numpy(points.weights)[..., None] * u).sum(-2)
        return (placed - moved).square().sum((-1, -2)).sqrt()

    screen = MismatchScreen(rest.numpy(), anchors.numpy())
    observed = torch.stack([pixels] + [mismatched(rest, pixels, seed)[0] for seed in range(3)])
    one = torch.ones(observed.shape[:2], dtype=torch.float64)
    screened = screen(observed - rest, one)
    clean, *spoiled = error(observed, torch.where(screened > 0.5, screened, 0.0))
    assert max(spoiled) < 1.2 * clean
    if estimator != "force-balance":  # force balance has robust weights of its own
        assert min(error(observed, one)[1:]) > 1.2 * clean


def test_too_few_markers_are_refused():
    with pytest.raises(MembraneError, match="5 markers; expected at least 6"):
        MismatchScreen(np.zeros((5, 2)), np.zeros((4, 2)))
