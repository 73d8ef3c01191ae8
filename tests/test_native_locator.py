"""Compiled and tensor steps of the location of dots agree."""

import copy
import pickle

import numpy as np
import pytest
import torch

from torchmembrane.machine_code import using
from torchmembrane.markers.dots.detect import BlobDetector
from torchmembrane.markers.dots.ellipse import draw_dots
from torchmembrane.markers.dots.locator import DotLocator
from torchmembrane.markers.dots.pattern import DotPattern
from torchmembrane.markers.dots.pyramid import mean_pyramid
from torchmembrane.markers.noise import pixel_noise
from torchmembrane.markers.observer import MarkerObserver

SIZE, COUNT, FRAMES = (210, 190), 42, 3
GENERATOR = np.random.default_rng(0)
PIXELS = 26.0 * np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), -1).reshape(-1, 2) + 24.0
PIXELS += GENERATOR.normal(0, 1.5, PIXELS.shape)
LARGE = np.arange(COUNT) % 3 == 0
SHAPES = np.where(LARGE, 7.0, 4.0)[:, None, None] * np.array([[1.1, 0.1], [0.0, 0.9]])


@pytest.fixture(scope="module")
def locator():
    return DotLocator(DotPattern(PIXELS, SHAPES, LARGE.astype(int)), SIZE, "dark")


@pytest.fixture(scope="module")
def images():
    """Noisy images of the dots a little off; in the second some are missing, in the third there are false ones."""
    frames, there, false = [], np.ones(COUNT, bool), np.array([[60.0, 52.0], [120.0, 110.0], [90.0, 91.0]])
    for frame in range(FRAMES):
        moved = PIXELS + [2.0 * frame, -1.0] + GENERATOR.normal(0, 0.5, PIXELS.shape)
        there[:] = True if frame != 1 else GENERATOR.random(COUNT) > 0.1
        drawn = draw_dots(moved[there], SHAPES[there], SIZE)
        if frame == 2:
            drawn = drawn * draw_dots(false, np.tile(3.0 * np.eye(2), (3, 1, 1)), SIZE)
        frames.append(0.8 * drawn + 0.1)
    generator = torch.Generator().manual_seed(0)
    batch = torch.cat(frames).float()
    return batch + 0.01 * torch.randn(batch.shape, generator=generator)


def both(function, *given):
    """By machine code and by tensor operations."""
    found = function(*given)
    with using(False):
        return found, function(*given)


def agree(found, wanted, *tolerances):
    for one, other, tolerance in zip(found, wanted, tolerances, strict=True):
        assert one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance)


def test_noise_and_means_of_pixels_are_those_of_tensor_operations(images):
    agree(*both(lambda x: [pixel_noise(x)], images.clamp(0.02, 0.9)), 1e-6)
    odd = images[..., :-3, :-1]
    agree(*both(mean_pyramid, odd), 0, 0, 0)


def test_the_status_of_images_is_that_of_tensor_operations(images):
    bright, bad, negative, infinite = (
        torch.ones(1, 1, *images.shape[2:]),
        images[:1].clone(),
        images[:1].clone(),
        images[:1].clone(),
    )
    bright[..., :2, :2] = 0
    bad[0, 0, 5, 7], negative[0, 0, 9, 9], infinite[0, 0, 3, 3] = torch.nan, -0.1, torch.inf
    flat, dim = torch.full_like(bright, 0.3), images[:1] * 0.02
    cases = torch.cat([images.clamp(0, 1), bright, bad, negative, infinite, flat, dim])
    found, wanted = both(lambda x: MarkerObserver.check(None, x), cases)
    assert found.tolist() == wanted.tolist() and len(set(found.tolist())) == 3


@pytest.mark.parametrize(
    ("radii", "pitch", "way"), [([4.0, 7.0], 26.0, "paired"), ([4.0, 7.0], 7.0, "same"), ([3.0, 9.0], 5.0, "spread")]
)
def test_responses_and_blobs_are_those_of_tensor_operations(images, radii, pitch, way):
    inside = torch.ones(1, 1, *images.shape[2:], dtype=torch.float64)
    inside[..., :9], inside[..., 150:, :] = 0, 0
    detector = BlobDetector(np.array(radii), pitch, 60, inside).float()
    ratio = {2**scale.level / scale.cell for scale in detector.scales}
    assert {"paired": 0.5, "same": 1.0, "spread": 2.0}[way] in ratio
    levels = mean_pyramid(images)
    for scale in detector.scales:
        agree(*both(lambda x, scale=scale: [scale(x)], levels), 2e-6)
    found, wanted = both(detector, levels)
    real = wanted[2] > 0.02
    assert real.sum() > 60
    agree([x[real] for x in found], [x[real] for x in wanted], 2e-3, 1e-4, 1e-4)


def test_a_list_of_blobs_is_completed_by_blobs_of_no_strength(locator):
    blobs, _, strength = locator.detect(mean_pyramid(draw_dots(PIXELS[[9, 18, 24]], SHAPES[[9, 18, 24]], SIZE).float()))
    assert strength.shape[1] > COUNT and int((strength > 1e-3).sum()) == 3 and bool(blobs.isfinite().all())


def test_validity_is_that_of_tensor_operations(locator, images):
    blobs, _, strength = locator.detect(mean_pyramid(images))
    agree(*both(lambda *given: [locator.validity(*given)], blobs, strength), 1e-5)


def before(locator):
    """Previous pixels: near the dots in the first frame, some lost in the second, most lost in the third."""
    previous = torch.as_tensor(PIXELS).float() + torch.arange(FRAMES)[:, None, None]
    previous[1, 5:9], previous[2, 3:30] = torch.nan, torch.nan
    return previous


@pytest.mark.parametrize("is_tracked", [False, True])
def test_followed_and_sure_dots_are_those_of_tensor_operations(locator, images, is_tracked):
    scene, match = locator.begin(images)[3:], locator.match
    previous = before(locator) if is_tracked else None
    found, wanted = both(match.unstrained, *scene)
    agree(found, wanted, 1e-5, 1e-4)
    followed = both(match.follow, *scene, previous)
    agree(*followed, 2e-4, 1e-3, 1e-5, 0, 2e-4, 1e-3, 1e-4, 0)
    assert len(set(followed[1][3].tolist())) == 2
    sure = both(match.sure, *followed[1][:3], *wanted)
    agree(*sure, 2e-4, 1e-3, 1e-4, 0)
    assert len(set(sure[1][3].tolist())) == 2


def test_outlines_and_judged_dots_are_those_of_tensor_operations(locator, images):
    place, certainty, strain = locator.match(*(scene := locator.begin(images)[3:]))
    strain = strain + 0.1 * torch.as_tensor(GENERATOR.normal(size=strain.shape)).float()
    agree(*both(lambda *given: [locator.outlines(*given)], certainty, place, 4 * strain), 1e-4)
    shape = locator.shapes.expand(FRAMES, -1, -1, -1)
    fitted = locator.fit(mean_pyramid(images), place, shape, torch.full((FRAMES,), 0.01), 3)
    uneven = torch.as_tensor(GENERATOR.uniform(0, 1, certainty.shape)).float()
    faint = fitted._replace(contrast=fitted.contrast * (1 - 0.7 * uneven), explained=fitted.explained - 0.3 * uneven.roll(3, 1))
    unlike = fitted._replace(misfit=fitted.misfit + 20 * uneven.square())
    torn = fitted._replace(centre=fitted.centre + 3.0 * (uneven > 0.96)[..., None])
    for dots, size in ((fitted, SIZE), (fitted, (140, 120)), (faint, SIZE), (unlike, SIZE), (torn, SIZE)):
        (pixels, confidence), (expected, wanted) = both(locator.judged, dots, strain, *scene, size)
        assert float((confidence - wanted).abs().max()) <= 1 / 256 and float((confidence != wanted).float().mean()) < 0.02
        torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-3)
        assert dots is fitted or int(((wanted > 0.02) & (wanted < 0.95)).sum()) > 5


def test_dots_are_located_as_by_tensor_operations(locator, images):
    for previous in (None, before(locator)):
        found, wanted = both(locator, images, previous)
        sure = wanted.confidence > 0.5
        assert bool(((found.confidence > 0.5) == sure).all()) and 0.8 < float(sure.float().mean()) < 1
        torch.testing.assert_close(found.pixels[sure], wanted.pixels[sure], rtol=0, atol=1e-3)
        torch.testing.assert_close(found.confidence, wanted.confidence, rtol=0, atol=1 / 128)


def test_a_frame_of_nan_changes_no_other(locator, images):
    spoiled = images.clone()
    spoiled[1] = torch.nan
    found, wanted = locator(spoiled), locator(images)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one[::2], other[::2], rtol=0, atol=0)


def test_threads_that_share_the_frames_of_a_batch_locate_alike(locator, images):
    threads, alone = torch.get_num_threads(), locator(images)
    try:
        torch.set_num_threads(2)
        agree(locator(images), alone, 0, 0, 0)
    finally:
        torch.set_num_threads(threads)


def test_gradients_are_left_to_tensors_and_copies_locate_alike(locator, images):
    traced = images[:1].clone().requires_grad_()
    locator(traced).pixels.sum().backward()
    assert float(traced.grad.abs().max()) > 0
    for other in (copy.deepcopy(locator), pickle.loads(pickle.dumps(locator))):
        agree(other(images), locator(images), 0, 0, 0)
