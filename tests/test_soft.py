"""Soft locators: accuracy, laws and gradients, through rendered pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_dots import CENTRE, PATTERNS, PITCH, SIZE, batch, deform, dent, measured, render, scene, slide
from test_texture import bump, forward, photograph, still

from torchmembrane.errors import MembraneError
from torchmembrane.markers.dots.ellipse import draw_dots
from torchmembrane.markers.dots.pattern import DotPattern
from torchmembrane.markers.placement import place_markers
from torchmembrane.markers.soft import SoftLocator, SoftTextureLocator
from torchmembrane.markers.texture.patches import choose_patches
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results.store import Settings
from torchmembrane.sensor.sensor import Sensor

EXAMPLE = "examples/sensor.toml"
GRID = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), -1).reshape(-1, 2)
SMALL_SIZE = (150, 130)


@pytest.fixture(scope="module")
def two():
    s = scene()
    with torch.no_grad():
        return s, SoftLocator(measured(s), SIZE, "dark", s.rim)


def drawn(offset=(0.0, 0.0), dtype=torch.float64):
    """A square of dots of two sizes, moved: its pattern at rest and its image."""
    rest, large = 20.0 * GRID + 15, GRID.sum(1) % 2 == 0
    shapes = np.eye(2) * np.where(large, 4.0, 2.6)[:, None, None]
    image = draw_dots(rest + offset, shapes, SMALL_SIZE).to(dtype)
    return DotPattern(rest, shapes, large.astype(int)), image


def found(locate, image, previous=None):
    with torch.no_grad():
        return tuple(x.numpy() for x in locate(image, previous)[:2])


@pytest.mark.parametrize("arrangement, two_sizes", PATTERNS)
@pytest.mark.parametrize("field, most", [(slide, 1.0), (dent, 0.75)])
def test_every_dot_is_found_for_flows_up_to_a_pitch(arrangement, two_sizes, field, most):
    s = scene(arrangement, two_sizes)
    frames = [deform(s, field, pitches) for pitches in (0.0, 0.5, most)]
    images = batch(*(render(*frame, seed=k) for k, frame in enumerate(frames)))
    pixels, confidence = found(SoftLocator(measured(s), SIZE, "dark", s.rim), images)
    for k, (truth, _) in enumerate(frames):
        error = np.linalg.norm(pixels[k] - truth, axis=1)
        assert confidence[k].min() > 0.5, k
        assert np.median(error) < 0.08 and error.max() < 0.7, k


def test_dots_move_with_the_image():
    """By a shift that is no whole number of pixels: to 0.02 px."""
    pattern, image = drawn()
    locate = SoftLocator(pattern, SMALL_SIZE, "dark").double()
    rest, _ = found(locate, image)
    for offset in ((0.5, 0.0), (-1.3, 2.7), (3.1, -4.2)):
        moved, confidence = found(locate, drawn(offset)[1])
        inner = ((GRID > 0) & (GRID < [6, 5])).all(1)  # none of which has lost its neighbours to the border
        assert abs(moved - rest - offset)[0, inner].max() < 0.02 and confidence[0, inner].min() > 0.9


def test_still_dots_do_not_move(two):
    s, locate = two
    first, again = found(locate, batch(*(render(s.pixels, s.shapes, noise=0.005, seed=seed) for seed in (1, 2))))[0]
    assert abs(first - again).max() < 0.1 and np.median(abs(first - again)) < 0.01
    assert np.median(np.linalg.norm(first - s.pixels, axis=1)) < 0.06


def test_uneven_light_does_not_move_dots(two):
    s, locate = two
    image = render(s.pixels, s.shapes, noise=0)
    slope = 1 + 0.4 * (np.arange(SIZE[0]) - CENTRE[0]) / 112
    plain, lit = found(locate, batch(image, (image * slope).clip(0, 1)))[0]
    assert np.median(np.linalg.norm(plain - lit, axis=1)) < 0.02


def test_removed_dots_are_lost_and_where_their_neighbours_predict_them(two):
    s, locate = two
    truth, shapes = deform(s, dent, 0.6)
    hidden = np.random.default_rng(3).random(len(truth)) < 0.1
    pixels, confidence = found(locate, batch(render(truth, shapes, kept=~hidden)))
    error = np.linalg.norm(pixels[0] - truth, axis=1)
    assert (confidence[0, hidden] == 0).all() and confidence[0, ~hidden].min() > 0.5
    assert error[~hidden].max() < 0.4 and error[hidden].max() < 0.25 * PITCH


def test_small_dots_whose_large_ones_are_hidden_are_lost(two):
    s, locate = two
    distance, small = np.linalg.norm(s.pixels - CENTRE, axis=1), s.sizes == 0
    image = batch(render(s.pixels, s.shapes, kept=small | (distance > 60)))
    _, confidence = found(locate, image)
    assert (confidence[0, small & (distance < 35)] < 0.05).all()
    assert confidence[0, distance > 95].min() > 0.9


def test_small_dots_are_predicted_from_an_affine_flow_of_the_large_ones(two):
    s, locate = two
    gradient, shift = np.array([[0.06, -0.1], [0.12, 0.03]]), np.array([4.0, -2.0])
    moved = torch.as_tensor(s.pixels + (s.pixels - CENTRE) @ gradient.T + shift, dtype=torch.float32)
    large = locate.large
    expected = moved[locate.small]
    inner = np.linalg.norm(s.pixels[locate.small] - CENTRE, axis=1) < 50
    got = locate.predict_small(moved[None, large], torch.ones(1, len(large)))[0]
    assert (got - expected).norm(dim=-1)[inner].max() < 1.0  # of a flow of up to 11 px; the rim at rest draws it there


def test_dots_can_be_followed_from_the_frame_before(two):
    s, locate = two
    truth, shapes = deform(s, slide, 0.8)
    image = batch(render(truth, shapes))
    before = torch.as_tensor(truth, dtype=torch.float32)[None] + 1.5
    before[0, ::9] = torch.nan
    followed, sure = found(locate, image, before)
    searched, _ = found(locate, image)
    assert sure.min() > 0.5 and abs(followed - searched).max() < 0.05


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_an_image_without_dots_has_no_confidence(two, value, noise):
    _, locate = two
    image = (value + noise * np.random.default_rng(1).normal(size=SIZE[::-1])).clip(0, 1)
    pixels, confidence = found(locate, batch(image))
    assert confidence.max() < 0.05 and np.isfinite(pixels).all()


def test_values_that_are_not_finite_cost_their_frame_only(two):
    s, locate = two
    image = render(s.pixels, s.shapes)
    broken = image.copy()
    broken[100:120, 100] = np.nan
    pixels, confidence = found(locate, batch(broken, image))
    assert np.isfinite(pixels).all() and (confidence[0] == 0).all() and confidence[1].min() > 0.5


def test_a_frame_alone_equals_the_frame_in_a_batch_and_in_double_precision(two):
    s, locate = two
    images = batch(*(render(*deform(s, dent, a)) for a in (0.3, 0.7)), render(s.pixels, s.shapes) * 0)
    together, alone = found(locate, images), found(locate, images[1:2])
    for one, all in zip(alone, together, strict=True):
        np.testing.assert_allclose(one[0], all[1], atol=2e-3)
    exact, sure = found(SoftLocator(measured(s), SIZE, "dark", s.rim).double(), images[1:2].double())
    assert abs(exact - alone[0]).max() < 5e-3 and abs(sure - alone[1]).max() < 5e-3


def test_gradient_is_that_of_finite_differences():
    pattern, image = drawn((1.3, -0.8))
    locate = SoftLocator(pattern, SMALL_SIZE, "dark").double()
    weight = torch.randn(len(GRID), 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    motion = drawn((1.4, -0.8))[1] - drawn((1.2, -0.8))[1]
    image.requires_grad_()
    (locate(image)[0][0] * weight).sum().backward()
    with torch.no_grad():
        ahead, behind = ((locate(image + step * motion)[0][0] * weight).sum() for step in (1e-5, -1e-5))
    assert (image.grad * motion).sum().item() == pytest.approx((ahead - behind).item() / 2e-5, rel=1e-5)
    image.grad = None
    locate(image)[0][0, :, 0].mean().backward()
    assert (image.grad * motion).sum().item() == pytest.approx(0.2, rel=0.1)


def test_texture_is_followed_and_a_still_one_does_not_move():
    rest = photograph(still, 0)
    v, u = np.mgrid[: rest.shape[0], : rest.shape[1]]
    pixels = choose_patches(rest, ((u - 160) / 150) ** 2 + ((v - 120) / 112) ** 2 < 1, 300)
    locate = SoftTextureLocator(rest, pixels)
    images = batch(rest, photograph(bump, 1, gain=0.75, offset=0.08), 0 * rest + 0.5, rest * np.nan)
    places, confidence = found(locate, images)
    assert np.median(abs(places[0] - pixels)) < 0.02 and abs(places[0] - pixels).max() < 0.15  # the observer nulls this
    error, sure = np.linalg.norm(places[1] - forward(bump, pixels), axis=1), confidence[1] > 0.5
    assert sure.mean() > 0.85 and np.median(error[sure]) < 0.1 and error[sure].max() < 3
    assert (confidence[2:] == 0).all() and np.isfinite(places).all()


def test_gradient_of_texture_is_that_of_finite_differences():
    rest = photograph(still, 0)[60:180, 90:230]
    locate = SoftTextureLocator(rest, choose_patches(rest, np.ones(rest.shape, bool), 60)).double()
    image, generator = torch.as_tensor(rest, dtype=torch.float64).roll(1, 1)[None, None], torch.Generator().manual_seed(1)
    weight = torch.randn(locate.rest_pixels.shape, generator=generator, dtype=torch.float64)
    motion = image.roll(1, 1) - image.roll(-1, 1)  # twice what a pixel to the right makes
    image.requires_grad_()
    (locate(image)[0][0] * weight).sum().backward()
    with torch.no_grad():
        ahead, behind = ((locate(image + step * motion)[0][0] * weight).sum() for step in (1e-6, -1e-6))
    assert (image.grad * motion).sum().item() == pytest.approx((ahead - behind).item() / 2e-6, rel=1e-4)


def test_a_reconstructor_is_built_with_either_locator():
    sensor = Sensor.from_file(EXAMPLE)
    sensor = replace(sensor, membrane=sensor.surface.membrane((9, 9)))
    fit, soft = (Reconstructor(sensor, "minimum-energy", locator=name) for name in ("fit", "soft"))
    assert type(soft.observer.locator) is SoftLocator
    assert [Settings.from_reconstructor(made, "npz").locator for made in (fit, soft)] == ["fit", "soft"]
    image = fit.read("examples/two_contacts.png")
    with torch.no_grad():
        one, other = fit(image), soft(image)
    assert int(other.status[0]) == 0
    both = (one.confidence > 0.5) & (other.confidence > 0.5)
    assert both.float().mean() > 0.9 and (one.pixels - other.pixels)[both].norm(dim=-1).median() < 0.15


@pytest.mark.parametrize("build", [Reconstructor, lambda sensor, **options: place_markers(sensor, torch.zeros(0), **options)])
def test_an_unknown_locator_is_refused(build):
    sensor = Sensor.from_file(EXAMPLE)
    with pytest.raises(MembraneError, match="'sift'; expected one of fit, soft"):
        build(sensor, locator="sift")
