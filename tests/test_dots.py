"""Dots are found, located and matched in rendered images."""

import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from kornia.filters import gaussian_blur2d
from scipy import ndimage
from scipy.spatial import cKDTree

from bench.accuracy import thresholded_dots
from torchmembrane.errors import MembraneError
from torchmembrane.markers.dots.alignment import Alignment
from torchmembrane.markers.dots.bands import bands, blur_rows
from torchmembrane.markers.dots.blobs import _maxima
from torchmembrane.markers.dots.deformation import monomial_map
from torchmembrane.markers.dots.detect import BlobDetector
from torchmembrane.markers.dots.ellipse import draw_dots
from torchmembrane.markers.dots.fit import EllipseFit
from torchmembrane.markers.dots.locator import DotLocator, membrane_mask
from torchmembrane.markers.dots.match import DotMatcher
from torchmembrane.markers.dots.pattern import DotPattern, find_dots, measure_dots
from torchmembrane.markers.dots.probability import own_evidence
from torchmembrane.markers.dots.pyramid import mean_pyramid
from torchmembrane.markers.dots.steps import NeighbourSteps
from torchmembrane.markers.spacing import partly_in_view

SIZE, CENTRE, RADIUS, PITCH = (320, 240), np.array([158.3, 119.6]), 112.0, 22.0
PATTERNS = [("square", True), ("square", False), ("hexagonal", True), ("hexagonal", False)]


class Scene(NamedTuple):
    pixels: np.ndarray
    shapes: np.ndarray
    sizes: np.ndarray
    rim: np.ndarray


def scene(arrangement="square", two_sizes=True):
    """Dots foreshortened towards a round rim."""
    i, j = (x.ravel() for x in np.meshgrid(np.arange(-9, 10), np.arange(-9, 10)))
    lattice, large = (np.stack([i, j], -1), (i + j) % 2 == 0)
    if arrangement == "hexagonal":
        lattice, large = np.stack([i + 0.5 * j, 0.75**0.5 * j], -1), (i - j) % 3 == 0
    inside = np.hypot(*lattice.T) * PITCH < RADIUS - 0.55 * PITCH
    around, large = lattice[inside] * PITCH, large[inside] | (not two_sizes)
    around = around + np.random.default_rng(0).normal(0, 0.2, around.shape)
    distance = np.hypot(*around.T)
    radial = around / np.maximum(distance, 1e-9)[:, None]
    squeeze = np.sqrt(1 - 0.6 * (distance / RADIUS) ** 2) - 1
    shapes = np.eye(2) + squeeze[:, None, None] * radial[:, :, None] * radial[:, None]
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    rim = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], -1)
    return Scene(around + CENTRE, shapes * np.where(large, 4.4, 2.7)[:, None, None], large.astype(int), rim)


def render(pixels, shapes, noise=0.02, seed=0, kept=None):
    """Grey image `[H, W]`: dark dots, 5 x 5 samples per pixel, on an unevenly lit disc; blur, noise, 8 bit."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    x, y = (u - CENTRE[0]) / RADIUS, (v - CENTRE[1]) / RADIUS
    light = 0.7 - 0.25 * (x**2 + y**2) + 0.12 * np.sin(2 * x + 1) + 0.1 * y
    cover = np.zeros_like(u)
    steps = np.arange(-2, 3) / 5
    kept = np.ones(len(pixels), bool) if kept is None else kept
    for centre, shape in zip(pixels[kept], shapes[kept], strict=True):
        (u0, v0), reach = np.round(centre).astype(int), int(min(12, np.linalg.norm(shape, 2) + 2))
        patch = np.s_[max(v0 - reach, 0) : v0 + reach + 1, max(u0 - reach, 0) : u0 + reach + 1]
        place = np.stack([u[patch], v[patch]], -1)[..., None, None, :] + np.stack(np.meshgrid(steps, steps), -1)
        inside = np.linalg.norm((place - centre) @ np.linalg.inv(shape).T, axis=-1) < 1
        cover[patch] = np.maximum(cover[patch], inside.mean((-1, -2)))
    image = np.where(x**2 + y**2 < 1, light * (1 - 0.85 * cover), 0.02)
    image = ndimage.gaussian_filter(image, 0.8) + noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.round(image.clip(0, 1) * 255) / 255


def slide(x):
    """Everything moves one way, most in the middle, nothing at the rim."""
    free = np.clip(1 - ((x - CENTRE) ** 2).sum(-1) / RADIUS**2, 0, 1)
    return free[:, None] ** 1.5 * np.array([0.8, -0.6])


def dent(x):
    """A push beside the middle."""
    free = np.clip(1 - ((x - CENTRE) ** 2).sum(-1) / RADIUS**2, 0, 1)
    near = np.exp(-((x - CENTRE - [30, 15]) ** 2).sum(-1) / (2 * (3 * PITCH) ** 2))
    return (free * near / 0.83)[:, None] * np.array([-0.5, 0.87])


def spread(x):
    """Everything moves outwards, most at 40 px from the middle."""
    away = (x - CENTRE) / 40
    return away * np.exp(0.5 * (1 - (away**2).sum(-1, keepdims=True)))


def twist(x):
    """The middle turns by one radian, the rim by nothing, in pitches."""
    around = x - CENTRE
    angle = np.clip(1 - (around**2).sum(-1) / RADIUS**2, 0, 1)
    turned = around[:, ::-1] * [-1, 1]
    return (np.cos(angle)[:, None] * around + np.sin(angle)[:, None] * turned - around) / PITCH


def press(x):
    """Everything moves to the middle, where nothing is left of the spacing, in pitches."""
    around = x - CENTRE
    return -(np.clip(1 - (around**2).sum(-1) / RADIUS**2, 0, 1) ** 2)[:, None] * around / PITCH


def deform(s, field, pitches):
    """Pixels and shapes after the flow `pitches * field`."""

    def flow(x):
        return pitches * PITCH * field(x)

    gradient = np.stack([(flow(s.pixels + e) - flow(s.pixels - e)) / 0.02 for e in 0.01 * np.eye(2)], -1)
    return s.pixels + flow(s.pixels), (np.eye(2) + gradient) @ s.shapes


def batch(*images, dtype=torch.float32):
    return torch.as_tensor(np.stack(images), dtype=dtype)[:, None]


def measured(s, seed=7):
    return measure_dots(render(s.pixels, s.shapes, seed=seed), s.pixels, s.shapes / 4.4, s.sizes, "dark")


@pytest.fixture(scope="module")
def two():
    s = scene()
    return s, DotLocator(measured(s), SIZE, "dark", s.rim)


@pytest.mark.parametrize("arrangement, two_sizes", PATTERNS)
def test_finds_the_pattern_and_no_ring(arrangement, two_sizes):
    s = scene(arrangement, two_sizes)
    image = render(s.pixels, s.shapes)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    image[abs(np.hypot(u - CENTRE[0], v - CENTRE[1]) - RADIUS - 4) < 3] = 0.5  # the rim's ring, dark within and without
    found = find_dots(image, "dark")
    distance, index = cKDTree(found.pixels).query(s.pixels)
    assert len(found.pixels) == len(s.pixels) == len(set(index))
    assert np.median(distance) < 0.05 and distance.max() < 0.25
    assert (found.sizes[index] == s.sizes).all()
    area = np.linalg.det(found.shapes[index]) / np.linalg.det(s.shapes)
    assert abs(np.sqrt(area) - 1).max() < 0.2


def test_finds_only_inside_the_mask():
    s = scene()
    mask = np.arange(SIZE[0]) < CENTRE[0] + 5
    found = find_dots(render(s.pixels, s.shapes), "dark", np.broadcast_to(mask, SIZE[::-1]))
    assert len(found.pixels) == (s.pixels[:, 0] < CENTRE[0] + 5).sum()


def test_finds_few_false_dots_in_heavy_noise():
    s = scene()
    noise = np.random.default_rng(0).normal(size=SIZE[::-1])
    found = find_dots(0.3 + 0.5 * render(s.pixels, s.shapes, noise=0) + 0.05 * noise, "dark")
    distance = cKDTree(s.pixels).query(found.pixels)[0]
    assert (distance > 2).sum() < 15
    assert (distance < 2).sum() > 0.9 * len(s.pixels)


def test_nothing_to_find_is_an_error():
    with pytest.raises(MembraneError, match="find_dots: 0 dots found"):
        find_dots(np.full(SIZE[::-1], 0.5), "dark")


@pytest.mark.parametrize("offset", [[0.0, 0.0], [8.0, -4.0]])
def test_measures_dots_predicted_up_to_half_a_pitch_off(offset):
    s = scene()
    hidden = np.isin(np.arange(len(s.pixels)), [10, 30])
    image = render(s.pixels, s.shapes, kept=~hidden)
    got = measure_dots(image, s.pixels + offset, s.shapes / np.where(s.sizes, 4.4, 2.7)[:, None, None], s.sizes, "dark")
    error = np.linalg.norm(got.pixels - s.pixels, axis=1)
    assert (np.isnan(error) == hidden).all()
    assert np.median(error[~hidden]) < 0.05 and error[~hidden].max() < 0.25
    radius = np.sqrt(np.linalg.det(got.shapes) / np.linalg.det(s.shapes))
    np.testing.assert_allclose(radius, 1, atol=0.1)


@pytest.mark.parametrize("columns", [58, 74])
def test_sizes_are_those_of_the_dots_in_view(columns):
    """Most dots are beyond the view's border or cut by it; the nearest in view have another size."""
    s = scene()
    begin = int(CENTRE[0] + RADIUS) - columns
    image = render(s.pixels, s.shapes)[:, begin:]
    seen = (s.pixels[:, 0] - begin > 8) & (s.pixels[:, 0] < SIZE[0] - 8)
    assert 0.1 * len(s.pixels) < seen.sum() < 0.4 * len(s.pixels)
    unit = s.shapes / np.where(s.sizes, 4.4, 2.7)[:, None, None]
    got = measure_dots(image, s.pixels - [begin, 0], unit, s.sizes, "dark")
    radius = np.sqrt(np.linalg.det(got.shapes) / np.linalg.det(s.shapes))
    np.testing.assert_allclose(radius, 1, atol=0.1)
    assert np.linalg.norm(got.pixels + [begin, 0] - s.pixels, axis=1)[seen].max() < 0.25


@pytest.mark.parametrize("arrangement, two_sizes", PATTERNS)
@pytest.mark.parametrize("field", [slide, dent])
def test_follows_a_smooth_flow_of_one_and_a_half_pitches(arrangement, two_sizes, field):
    s = scene(arrangement, two_sizes)
    pattern = measured(s)
    frames = [deform(s, field, pitches) for pitches in (0.0, 0.5, 1.0, 1.5)]
    images = batch(*(render(*frame, seed=k) for k, frame in enumerate(frames)))
    pixels, confidence, _ = DotLocator(pattern, SIZE, "dark", s.rim)(images)
    for k, (truth, _) in enumerate(frames):
        error = np.linalg.norm(pixels[k].numpy() - truth, axis=1)
        assert confidence[k].min() > 0.5, k
        assert error.max() < 0.5 and np.median(error) < 0.06 and np.percentile(error, 95) < 0.2, k


def test_components_are_the_dark_spots_of_an_image():
    """Section 5: centre of gravity and area of what is darker than the threshold, in a dark and in a light image."""
    v, u = np.mgrid[:60, :90]
    spots, image = [(20.0, 15.0, 5.0), (60.5, 40.0, 8.0), (75.0, 12.5, 3.0)], np.full((60, 90), 0.8)
    inside = [(u - x) ** 2 + (v - y) ** 2 < radius**2 for x, y, radius in spots]
    image[np.any(inside, 0)] = 0.15
    image[50, 10] = 0.1  # too small for a dot
    for grey, polarity in ((image, "dark"), (1 - image, "light")):
        centre, area = thresholded_dots.components(grey + 0.02 * np.sin(7 * u + 3 * v), polarity)
        order = np.argsort(centre[:, 0])
        np.testing.assert_allclose(centre[order], [spot[:2] for spot in spots], atol=1e-9)
        assert area[order].tolist() == [spot.sum() for spot in inside]


def test_the_threshold_parts_an_image_with_least_spread():
    """Otsu's: no other level leaves less, with few dark pixels or many; unlike the mean grey where they are few."""
    rng = np.random.default_rng(0)
    for dark in (200, 3000, 9000):
        image = np.concatenate([rng.normal(0.2, 0.03, dark), rng.normal(0.7, 0.04, 10000 - dark)])

        def spread(level, image=image):
            return sum(((part - part.mean()) ** 2).sum() for part in (image[image < level], image[image >= level]))

        least = min(map(spread, np.linspace(image.min(), image.max(), 400)[1:-1]))
        found, step = thresholded_dots.otsu(image), np.ptp(image) / 256  # of the histogram
        assert min(map(spread, np.linspace(found - step, found + step, 9))) < 1.001 * least
        assert dark > 200 or spread(image.mean()) > 1.3 * least


def test_components_are_joined_by_their_sides():
    image = np.full((30, 40), 0.8)
    image[5:10, 5:10] = image[10:16, 10:16] = 0.1  # corner to corner
    assert sorted(thresholded_dots.components(image, "dark")[1].tolist()) == [25, 36]


def test_small_dots_are_looked_for_where_the_large_ones_around_went():
    """In a flow of more than half the small dots' spacing, where the nearest small one is often another."""
    s = scene("hexagonal")
    paper = thresholded_dots.ThresholdedDots(render(s.pixels, s.shapes, seed=7), s.pixels, s.sizes == 1, "dark")
    now, shapes = deform(s, slide, 0.65)
    small, large = (cKDTree(s.pixels[s.sizes == size]) for size in (0, 1))
    moved = np.linalg.norm(now - s.pixels, axis=1)
    assert moved.max() > 0.6 * small.query(small.data, k=2)[0][:, 1].mean()
    assert moved.max() < 0.45 * large.query(large.data, k=2)[0][:, 1].mean()
    error = np.linalg.norm(s.pixels + paper(render(now, shapes, seed=1)) - now, axis=1)
    assert np.nanmax(error) < 0.6 and np.isfinite(error).mean() > 0.97


def test_a_dot_that_is_not_there_is_lost_and_none_of_its_neighbours_is_taken_for_it():
    """Of another size or of its own; all others are found."""
    s = scene()
    paper = thresholded_dots.ThresholdedDots(render(s.pixels, s.shapes, seed=7), s.pixels, s.sizes == 1, "dark")
    now, shapes = deform(s, slide, 0.3)
    kept = np.ones(len(now), bool)
    kept[7::9] = False
    error = np.linalg.norm(s.pixels + paper(render(now, shapes, seed=1, kept=kept)) - now, axis=1)
    assert len(set(s.sizes[~kept])) == 2 and np.isnan(error[~kept]).all() and error[kept].max() < 0.6


def test_a_dot_is_looked_for_within_three_quarters_of_the_spacing_and_taken_once():
    """One dot alone moves by half or by nine tenths of the spacing, out of the pattern; then one up, where a lost one was."""
    v, u = np.mgrid[:260, :260]
    pixels = 40.0 * np.stack(np.meshgrid(np.arange(1, 6), np.arange(1, 6)), -1).reshape(-1, 2) + 10
    large = np.arange(25) >= 5

    def drawn(centres):
        radius = np.where(large, 6, 3)
        return np.where([(np.hypot(u - x, v - y) < r) for (x, y), r in zip(centres, radius, strict=True)], 0.1, 0.9).min(0)

    paper = thresholded_dots.ThresholdedDots(drawn(pixels), pixels, large, "dark")
    for share, found in ((0.5, True), (0.9, False)):
        moved = np.zeros_like(pixels)
        moved[24] = 40 * share
        moved[24, 0] = 0
        expected = np.where(found or (np.arange(25) != 24)[:, None], moved, np.nan)
        np.testing.assert_allclose(paper(drawn(pixels + moved)), expected, atol=1e-9)
    moved = np.zeros_like(pixels)
    moved[24, 1], moved[19] = -16, 1000  # up, to where the lost one was
    expected = np.where((np.arange(25) != 19)[:, None], moved, np.nan)
    np.testing.assert_allclose(paper(drawn(pixels + moved)), expected, atol=1e-9)


@pytest.mark.parametrize("field", [slide, dent])
def test_threshold_and_components_follow_a_small_flow(field):
    """Section 5: the nearest component of the dot's size, large dots first; all are found, some tenths of a pixel off."""
    s = scene()
    paper = thresholded_dots.ThresholdedDots(render(s.pixels, s.shapes, seed=7), s.pixels, s.sizes == 1, "dark")
    for k, pitches in enumerate((0.0, 0.2, 0.4)):
        now, shapes = deform(s, field, pitches)
        error = np.linalg.norm(s.pixels + paper(render(now, shapes, seed=k)) - now, axis=1)
        assert np.median(error) < 0.25 and error.max() < 0.6, pitches
    far = deform(s, field, 0.4)[0] - s.pixels
    assert np.linalg.norm(far, axis=1).max() > 0.3 * PITCH


@pytest.mark.parametrize("arrangement, two_sizes", PATTERNS)
def test_dots_followed_from_the_frame_before_are_those_searched_for(monkeypatch, arrangement, two_sizes):
    """To the last digit, whether they moved little, or so far that they can no longer be followed; dots that were lost are
    found again. Where all frames can be followed nothing is searched for."""
    s = scene(arrangement, two_sizes)
    locate = DotLocator(measured(s), SIZE, "dark", s.rim)
    before, _, _ = locate(batch(render(*deform(s, slide, 0.2), seed=1)))
    before[0, ::9] = torch.nan
    moves = (0.2, 0.4, 0.8, 1.1, 1.4)
    frames = [deform(s, slide, pitches) for pitches in moves]
    images = batch(*(render(*frame, seed=k) for k, frame in enumerate(frames)))
    pixels, confidence, _ = locate(images, before.expand(len(frames), -1, -1))
    expected, sure, _ = locate(images)
    assert torch.equal(pixels, expected) and torch.equal(confidence, sure)
    assert confidence.min() > 0.5
    _, blobs, log_radius, valid = locate.begin(images)[-4:]
    kept = locate.match.follow(blobs, log_radius, valid, before.expand(len(frames), -1, -1))[3]
    assert kept[:2].all() and not kept[-1]
    monkeypatch.setattr(locate.match, "search", None)
    followed = locate(images[:2], before.expand(2, -1, -1)).pixels
    torch.testing.assert_close(followed, pixels[:2], atol=1e-4, rtol=0)


def test_dots_are_searched_for_where_the_frame_before_says_nothing_or_is_another(two):
    s, locate = two
    image = batch(render(*deform(s, dent, 0.8)))
    expected = locate(image)
    one_off = torch.as_tensor(s.pixels + [PITCH, 0], dtype=torch.float32)[None]
    for before in (torch.full_like(one_off, torch.nan), one_off):
        for got, want in zip(locate(image, before), expected, strict=True):
            assert torch.equal(got, want)


def test_removed_dots_are_lost_and_no_neighbour_takes_their_place(two):
    s, locate = two
    truth, shapes = deform(s, dent, 0.8)
    hidden = np.random.default_rng(3).random(len(truth)) < 0.1
    pixels, confidence, _ = locate(batch(render(truth, shapes, kept=~hidden)))
    assert confidence[0, hidden].max() < 0.1
    assert confidence[0, ~hidden].min() > 0.5
    error = np.linalg.norm(pixels[0].numpy() - truth, axis=1)
    assert error[~hidden].max() < 0.4
    assert error[hidden].max() < 0.4 * PITCH  # the prediction


def test_a_dot_out_of_line_with_the_flow_is_not_believed(two):
    s, locate = two
    truth, shapes = deform(s, slide, 0.3)
    same = np.where(s.sizes == s.sizes[0])[0]
    outlier = same[np.linalg.norm(s.pixels[same] - CENTRE, axis=1).argmin()]
    beside = np.argsort(np.linalg.norm(s.pixels - s.pixels[outlier], axis=1))[1]
    moved = truth.copy()
    moved[outlier] += 0.65 * (truth[beside] - truth[outlier])
    kept = np.arange(len(truth)) != beside
    _, confidence, _ = locate(batch(render(moved, shapes, kept=kept)))
    assert confidence[0, [outlier, beside]].max() < 0.5
    assert np.delete(confidence[0].numpy(), [outlier, beside]).min() > 0.5


def test_a_bar_beside_a_border_dot_is_not_taken_for_it():
    s = scene(two_sizes=False)
    kept = np.linalg.norm(s.pixels - CENTRE, axis=1) < 85
    s = s._replace(pixels=s.pixels[kept], shapes=s.shapes[kept], sizes=s.sizes[kept])
    truth, shapes = deform(s, spread, 0.65)
    corner = np.linalg.norm(s.pixels - CENTRE, axis=1).argsort()[-1]
    away = (truth[corner] - CENTRE) / np.linalg.norm(truth[corner] - CENTRE)
    frame = np.stack([away, away[::-1] * [-1, 1]], -1)
    bar = frame @ np.diag([2.2, 6.0]) @ frame.T
    image = render(np.vstack([truth, truth[corner] + 11 * away]), np.concatenate([shapes, bar[None]]))
    pixels, confidence, _ = DotLocator(measured(s), SIZE, "dark")(batch(image))
    error = np.linalg.norm(pixels[0].numpy() - truth, axis=1)
    sure = confidence[0].numpy() > 0.5
    assert error[sure].max() < 0.5 and np.delete(sure, corner).all()


def test_dots_that_took_anothers_blob_are_let_go_and_find_their_own():
    """Of a twist by which the growth from the rim comes inwards askew, all dots are found, whatever the noise."""
    s = scene("hexagonal", two_sizes=True)
    truth, shapes = deform(s, twist, 0.36)
    images = batch(*(render(truth, shapes, seed=seed) for seed in range(4)))
    pixels, confidence, _ = DotLocator(measured(s), SIZE, "dark", s.rim)(images)
    assert confidence.min() > 0.5 and np.linalg.norm(pixels.numpy() - truth, axis=-1).max() < 0.5


def test_dots_smeared_over_half_the_spacing_are_found(two):
    """A camera in motion; the deformation that neighbours show is then blurred as well."""
    s, locate = two
    pixels, confidence, _ = locate(batch(ndimage.uniform_filter1d(render(s.pixels, s.shapes, noise=0), 13, axis=1)))
    error = np.linalg.norm(pixels[0].numpy() - s.pixels, axis=1)[confidence[0].numpy() > 0.5]
    assert len(error) > 0.9 * len(s.pixels) and error.max() < PITCH / 4


@pytest.mark.parametrize(
    "off, lost, believed", [(0.3, True, False), (0.3, False, True), (0.0, True, True), (0.7, False, False)]
)
def test_a_dot_on_the_blob_of_a_lost_neighbour_is_not_believed(off, lost, believed):
    """Out of line with those around; the same where all are found; in line beside a lost one; far out of line."""
    rest = PITCH * np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    pixels = torch.tensor(rest.T.copy())[None]
    pixels[0, 0, 12] += off * PITCH
    sure, flat = torch.full((1, 25), 0.95, dtype=torch.float64), torch.zeros(1, 2, 2, 25, dtype=torch.float64)
    sure[0, 13] = 0.0 if lost else 0.95
    trust = torch.sigmoid(own_evidence(*NeighbourSteps(rest, np.ones(25, bool))(pixels, sure, flat)))[0]
    assert (trust[12] > 0.6) == believed and (believed or trust[12] < 0.5)
    assert np.delete(trust.numpy(), 12).min() > 0.8


@pytest.mark.parametrize("arrangement, two_sizes", PATTERNS)
def test_what_cannot_be_followed_is_lost_and_not_wrong(arrangement, two_sizes):
    s = scene(arrangement, two_sizes)
    frames = [deform(s, field, amount) for field, amount in [(twist, 0.6), (twist, 0.8), (press, 0.6), (slide, 2.5)]]
    images = batch(*(render(*frame, seed=k) for k, frame in enumerate(frames)))
    pixels, confidence, _ = DotLocator(measured(s), SIZE, "dark", s.rim)(images)
    for k, (truth, _) in enumerate(frames):
        error = np.linalg.norm(pixels[k].numpy() - truth, axis=1)
        assert ((error > 0.3 * PITCH) & (confidence[k].numpy() > 0.5)).sum() <= 1, k


def test_missing_and_false_dots_do_not_cost_the_others(two):
    s, locate = two
    truth, shapes = deform(s, dent, 0.8)
    generator = np.random.default_rng(3)
    hidden = generator.random(len(truth)) < 0.1
    false = CENTRE + generator.uniform(-70, 70, (60, 2))
    false = false[cKDTree(truth).query(false)[0] > 0.5 * PITCH][:5]
    places = np.vstack([truth[~hidden], false])
    pixels, confidence, _ = locate(batch(render(places, np.concatenate([shapes[~hidden], shapes[: len(false)]]))))
    assert len(false) == 5 and confidence[0, ~hidden].min() > 0.5
    assert np.linalg.norm(pixels[0].numpy() - truth, axis=1)[~hidden].max() < 0.5


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_an_image_without_dots_has_no_confidence(two, value, noise):
    _, locate = two
    image = (value + noise * np.random.default_rng(1).normal(size=SIZE[::-1])).clip(0, 1)
    pixels, confidence, _ = locate(batch(image))
    assert confidence.max() < 0.05 and torch.isfinite(pixels).all()


def test_a_saturated_highlight_does_not_move_the_dots(two):
    s, locate = two
    truth, shapes = deform(s, slide, 0.4)
    image = render(truth, shapes, noise=0.0)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    glare = 1 + 2 * np.exp(-((u - 180) ** 2 + (v - 110) ** 2) / (2 * 20**2))
    plain, lit = locate(batch(image, (image * glare).clip(0, 1)))[0]
    assert (plain - lit).norm(dim=-1).max() < 0.2
    assert (plain - lit).norm(dim=-1).median() < 0.01


def test_a_frame_alone_equals_the_frame_in_a_batch(two):
    s, locate = two
    images = batch(*(render(*deform(s, f, a)) for f, a in [(slide, 0.3), (dent, 0.9), (slide, 1.2)]))
    together = locate(images)
    for k in range(3):
        for one, many in zip(locate(images[k : k + 1]), together, strict=True):
            torch.testing.assert_close(one[0], many[k], atol=2e-4, rtol=0)


def test_float32_agrees_with_float64():
    s = scene()
    image = render(*deform(s, dent, 1.0))
    pattern = measured(s)
    single = DotLocator(pattern, SIZE, "dark", s.rim)(batch(image))
    double = DotLocator(pattern, SIZE, "dark", s.rim).double()(batch(image, dtype=torch.float64))
    assert (single[0] - double[0]).abs().max() < 2e-3
    assert (single[1] - double[1]).abs().max() < 1e-2


def test_light_dots_are_dark_dots_of_the_negative(two):
    s, locate = two
    image = render(*deform(s, dent, 0.7))
    inverse = measure_dots(1 - render(s.pixels, s.shapes, seed=7), s.pixels, s.shapes / 4.4, s.sizes, "light")
    light = DotLocator(inverse, SIZE, "light", s.rim)
    for a, b in zip(locate(batch(image)), light(1 - batch(image)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=0)


def test_a_shifted_image_shifts_the_pixels():
    s = scene()
    locate = DotLocator(measured(s), SIZE, "dark")
    image = render(*deform(s, dent, 0.5), noise=0.0)
    shifted = np.roll(image, (-4, 6), (0, 1))
    pixels, confidence, _ = locate(batch(image, shifted))
    assert confidence.min() > 0.5
    difference = pixels[1] - pixels[0] - torch.tensor([6.0, -4.0])
    assert difference.norm(dim=-1).median() < 0.01 and difference.norm(dim=-1).max() < 0.1


def test_the_pixels_are_differentiable_in_the_image():
    s = scene()
    locate = DotLocator(measured(s), SIZE, "dark", s.rim).double()
    image = batch(render(*deform(s, slide, 0.5)), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(len(s.pixels), 2, generator=generator, dtype=torch.float64)
    direction = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    slope = torch.autograd.functional.jvp(lambda x: (locate(x)[0] * weight).sum(), image, direction)[1]
    ahead, behind = ((locate(image + e * direction)[0] * weight).sum() for e in (1e-6, -1e-6))
    torch.testing.assert_close(slope, (ahead - behind) / 2e-6, rtol=1e-3, atol=0)


def test_levels_of_the_pyramid_keep_the_mean():
    image = torch.rand(2, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    for level in mean_pyramid(image):
        torch.testing.assert_close(level.mean((1, 2, 3)), image.mean((1, 2, 3)))


@pytest.mark.parametrize("sigma", [1.1, 2.7])
def test_the_products_are_the_gaussian_of_a_part_of_the_image(sigma):
    image = torch.rand(2, 1, 30, 41, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    rows, columns = np.arange(-1, 20), np.arange(11, 42)
    left, right = (torch.tensor(blur_rows(n, sigma, k)) for n, k in ((30, rows), (41, columns)))
    side = 2 * int(np.ceil(2.5 * sigma)) + 1
    whole = gaussian_blur2d(image, (side, side), (sigma, sigma), border_type="replicate")
    expected = whole[..., rows.clip(0, 29)[:, None], columns.clip(0, 40)]
    torch.testing.assert_close(left @ image @ right.T, expected)


@pytest.mark.parametrize("size", [12, 90, 130])
def test_the_bands_are_the_matrix(size):
    matrix, x = blur_rows(size, 1.3, np.arange(-1, size - 3)), np.random.default_rng(0).normal(size=(size, 4))
    blocks, columns = bands(matrix)
    assert blocks.shape[-1] < 45
    np.testing.assert_allclose((blocks @ x[columns]).reshape(-1, 4)[: len(matrix)], matrix @ x, atol=1e-12)


@pytest.mark.parametrize("radius", [2.5, 4.5, 9.0])
def test_windows_hold_the_pixels_around_each_dot_at_their_places(radius):
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    pixels = np.random.default_rng(0).uniform(60, 180, (7, 2))
    fit = EllipseFit(pixels, np.broadcast_to(radius * np.eye(2), (7, 2, 2)), SIZE, 0.45).double()
    values, middle = fit.windows(mean_pyramid(batch(u + 1000 * v, dtype=torch.float64)), torch.tensor(pixels)[None])
    place = middle[..., None] + fit.stride[..., None] * fit.linear[1:]
    torch.testing.assert_close(values, place[..., 0, :] + 1000 * place[..., 1, :])
    assert (middle - torch.tensor(pixels)).abs().max() <= 0.5 * fit.stride.max() + 1e-9


def test_the_mapping_takes_monomials_of_a_point_to_its_image():
    A, x = (torch.randn(2, n, dtype=torch.float64, generator=torch.Generator().manual_seed(n)) for n in (2, 3))
    (a, b), (c, d), (u, v), one = *A, x, torch.ones(3, dtype=torch.float64)
    entries = torch.stack([a, b, c, d, a * a + c * c, a * b + c * d, b * b + d * d, one[0]])
    y = A @ x
    got = (entries @ monomial_map()).reshape(4, 6) @ torch.stack([u, v, u * u, u * v, v * v, one])
    torch.testing.assert_close(got, torch.stack([*y, y.square().sum(0), one]))


def test_the_fit_does_not_run_off_to_a_neighbour():
    pixels = CENTRE + PITCH * np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), -1).reshape(-1, 2)
    shapes = np.broadcast_to(2.7 * np.eye(2), (25, 2, 2))
    levels = mean_pyramid(batch(render(pixels, shapes), dtype=torch.float64))
    begin = torch.tensor(pixels + [9.0, 0.0])[None]
    fit = EllipseFit(pixels, shapes, SIZE, 0.45).double()
    centre, *_ = fit(levels, begin, torch.tensor(shapes)[None], torch.zeros(1), 8)
    assert (centre - begin).abs().max() <= 2.7 + 1 + 1e-9


def test_images_of_anything_and_any_size_are_searched_or_refused():
    """Few dots or none that are alike, edges, images smaller than a dot: one error, and no warning of numpy's."""
    rng, refused = np.random.default_rng(0), 0
    shapes, sizes = np.tile(np.eye(2), (12, 1, 1)), np.ones(12, int)
    for number, size in enumerate(rng.integers(1, 60, (90, 2))):
        image = (rng.random(size), (rng.random(size) > 0.5) * 1.0, np.full(size, rng.random()))[number % 3]
        listed = rng.random((12, 2)) * size[::-1], shapes, sizes
        for search in (partial(find_dots, image), partial(measure_dots, image, *listed)):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    search(polarity="dark")
                except MembraneError as error:
                    refused += "dots found, expected at least 6" in str(error)
    assert refused > 150


def test_a_membrane_outside_the_image_is_refused():
    s = scene()
    with pytest.raises(MembraneError, match="dots are not in the image of 320 x 240 px"):
        membrane_mask(s.pixels + 1e4, s.pixels[:4] + 1e4, (320, 240))


def test_wrong_arguments_are_named():
    s = scene()
    pattern = DotPattern(s.pixels, s.shapes, s.sizes)
    with pytest.raises(MembraneError, match="polarity is 'black'"):
        DotLocator(pattern, SIZE, "black")
    with pytest.raises(MembraneError, match=f"{len(s.pixels)} dots, {len(s.pixels) - 1} of them at finite pixels"):
        s.pixels[4] = np.nan
        DotLocator(pattern, SIZE, "dark")


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 1, 2), (5, 7, 9), (4, 20, 30)])
def test_maxima_are_the_values_that_a_maximum_filter_leaves(shape):
    values = np.random.default_rng(0).integers(0, 6, shape) / 5
    expected = (values == ndimage.maximum_filter(values, (3, 3, 3))) & (values > 0.5)
    np.testing.assert_array_equal(_maxima(values, 0.5), np.argwhere(expected))


@pytest.mark.parametrize("radius", [5.0, 6.2])
def test_large_dots_close_together_are_each_found(radius):
    pixels = 40.0 + 15.3 * np.stack(np.meshgrid(np.arange(12), np.arange(9)), -1).reshape(-1, 2) @ [[1.0, 0.2], [-0.2, 1.0]]
    shapes, inside = np.tile(radius * np.eye(2), (len(pixels), 1, 1)), torch.ones(1, 1, *SIZE[::-1], dtype=torch.float64)
    detect = BlobDetector(np.full(len(pixels), radius), 14.0, len(pixels), inside)
    blobs, _, _ = detect.double()(mean_pyramid(draw_dots(pixels, shapes, SIZE)))
    within = np.all((pixels > 10) & (pixels < np.array(SIZE) - 11), 1)
    assert cKDTree(blobs[0].numpy()).query(pixels[within])[0].max() < 1.5


def test_dots_are_looked_for_two_pitches_off_also_where_the_rim_is_far():
    pixels = 120.0 + 14.0 * np.stack(np.meshgrid(np.arange(6), np.arange(5)), -1).reshape(-1, 2)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    rim = pixels.mean(0) + 105 * np.stack([np.cos(angle), np.sin(angle)], -1)
    mask = membrane_mask(pixels, rim, SIZE)[0, 0].numpy() > 0
    for way in ([-28, 0], [28, 0], [0, -28], [0, 28], [20, 20]):
        u, v = (pixels + way).astype(int).T
        assert mask[v, u].all()
    assert not mask[5, 5]


def whole(pixels, pitches=0.0, degrees=0.0, shear=0.0, scale=1.0):
    """A pattern that moves as a whole, its edge as well; a shift in pitches."""
    a = np.deg2rad(degrees)
    matrix = scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ [[1, shear], [0, 1]]
    middle = pixels.mean(0)
    return middle + (pixels - middle) @ matrix.T + pitches * PITCH * np.array([0.8, -0.6]), matrix


@pytest.mark.parametrize("motion", [dict(pitches=1.0), dict(pitches=1.9), dict(degrees=15), dict(shear=0.25), dict(scale=0.8)])
@pytest.mark.parametrize("two_sizes", [True, False])
def test_a_pattern_that_moves_as_a_whole_is_followed_with_its_outline(two_sizes, motion):
    s = scene("square", two_sizes)
    inner = np.linalg.norm(s.pixels - CENTRE, axis=1) < 62
    rest, shapes = s.pixels[inner], s.shapes[inner]
    moved, matrix = whole(rest, **motion)
    locate = DotLocator(DotPattern(rest, shapes, s.sizes[inner]), SIZE, "dark")
    pixels, confidence, _ = locate(batch(render(moved, matrix @ shapes, noise=0.01)))
    assert np.linalg.norm(pixels[0].numpy() - moved, axis=1).max() < 0.3 and confidence.min() > 0.5


def matched(pixels, moved, generator):
    """How many dots at `pixels` find their blob at `moved`, how many another, how many have one; some blobs are missing, some
    false."""
    there = generator.random(len(moved)) > 0.05
    false = generator.uniform(moved.min(0) - PITCH, moved.max(0) + PITCH, (len(moved) // 10, 2))
    blobs = torch.as_tensor(np.concatenate([moved[there] + generator.normal(0, 0.5, (there.sum(), 2)), false]))[None]
    match = DotMatcher(pixels, np.zeros(len(pixels)), 0.45, np.ones(len(pixels), bool)).double()
    found, sure, _ = match(blobs, torch.zeros_like(blobs[..., 0]), torch.ones_like(blobs[..., 0]))
    right = (np.linalg.norm(found[0].numpy() - moved, axis=1) < 3) & there
    return right.sum(), ((sure[0].numpy() > 0.3) & ~right).sum(), there.sum()


@pytest.mark.parametrize("arrangement", ["square", "hexagonal", "random"])
def test_neighbours_agree_on_a_drag_of_two_pitches_with_missing_and_false_blobs(arrangement):
    generator = np.random.default_rng(2)
    pixels = scene("square" if arrangement == "random" else arrangement).pixels
    if arrangement == "random":
        pixels = pixels + generator.uniform(-6, 6, pixels.shape)
    away = ((pixels - CENTRE - [20, 10]) ** 2).sum(1) / (2 * (4 * PITCH) ** 2)
    moved = pixels + 2 * PITCH * np.exp(-away)[:, None] * [0.6, 0.8]
    right, wrong, there = matched(pixels, moved, generator)
    assert right >= there - 1 and wrong <= 3


@pytest.mark.parametrize("seen_share", [1.0, 0.6])
def test_a_lattice_is_laid_on_its_blobs_by_its_outline(seen_share):
    rest = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), -1).reshape(-1, 2) * PITCH
    rest = rest - rest.mean(0)
    seen = np.argsort(np.argsort(rest[:, 0])) < seen_share * len(rest)
    moved, _ = whole(rest, pitches=2.0, degrees=2)
    blobs = torch.as_tensor(moved)[None]
    eye, one = torch.eye(2).double()[None, ..., None].expand(1, 2, 2, len(rest)), torch.ones(1, len(rest)).double()
    lay = Alignment(rest, seen).double()
    place = lay(
        torch.as_tensor(rest)[None],
        blobs[:, seen],
        torch.zeros(1, len(rest), seen.sum()).double(),
        eye[..., seen],
        one[:, seen],
    )
    assert np.linalg.norm(place[0].numpy() - moved, axis=1)[seen].max() < 0.25 * PITCH


def test_dots_beyond_the_border_of_the_image_do_not_move_those_in_it():
    rest = np.stack(np.meshgrid(np.arange(-3, 18), np.arange(-3, 14)), -1).reshape(-1, 2) * PITCH + [9.0, 5.0]
    shapes = np.tile(3.4 * np.eye(2), (len(rest), 1, 1))
    away = ((rest - CENTRE) ** 2).sum(1) / (2 * (2.5 * PITCH) ** 2)
    moved = rest + 0.5 * PITCH * np.exp(-away)[:, None] * [0.6, 0.8]
    seen = np.all((rest > 8) & (rest < np.array(SIZE) - 9), 1)
    locate = DotLocator(DotPattern(rest, shapes, np.ones(len(rest), int)), SIZE, "dark")
    image = draw_dots(moved, shapes, SIZE).float()
    pixels, confidence, _ = locate(image)
    assert np.linalg.norm(pixels[0].numpy() - moved, axis=1)[seen].max() < 0.3 and confidence[0, seen].min() > 0.5
    assert seen.sum() < 0.6 * len(rest)


@pytest.mark.parametrize("beyond", [4.0, 6.0])
def test_a_dot_whose_middle_leaves_the_image_is_lost_though_its_edge_is_seen(beyond):
    """Large dots; all move to the left until the first column is so many pixels beyond the border."""
    spacing, radius = 30.0, 10.5
    rest = np.stack(np.meshgrid(np.arange(7), np.arange(5)), -1).reshape(-1, 2) * spacing + [spacing / 2, 35.0]
    shapes = np.tile(radius * np.eye(2), (len(rest), 1, 1))
    moved = rest - [spacing / 2 + beyond, 0.0]
    locate = DotLocator(DotPattern(rest, shapes, np.ones(len(rest), int)), SIZE, "dark")
    pixels, confidence, _ = locate(draw_dots(moved, shapes, SIZE).float())
    gone = moved[:, 0] < 0
    assert gone.sum() == 5 and (confidence[0, gone] < 0.5).all() and (confidence[0, ~gone] > 0.5).all()
    assert np.linalg.norm(pixels[0].numpy() - moved, axis=1)[~gone].max() < 0.3


def test_a_blob_that_is_probably_no_dot_costs_the_logarithm_of_its_probability():
    match = DotMatcher(scene().pixels, np.zeros(len(scene().pixels)), 0.45, np.ones(len(scene().pixels), bool)).double()
    radius, valid = torch.tensor([[0.0, 0.3, -0.2]]).double(), torch.tensor([[1.0, 0.6, 0.02]]).double()
    more = match.misfit(radius, valid) - match.misfit(radius, torch.ones_like(valid))
    torch.testing.assert_close(more, (-2 * valid.log())[:, None].expand_as(more))


def test_a_dot_is_partly_in_view_where_its_outline_reaches_into_the_image_s_rows_and_columns():
    """Slanted ellipses of all kinds about the image's border, by points of their outlines."""
    rng = np.random.default_rng(0)
    pixels, shapes = rng.uniform(-10, 30, (400, 2)), rng.uniform(-6, 6, (400, 2, 2))
    angle = np.linspace(0, 2 * np.pi, 4001)
    outline = pixels[:, None] + np.stack([np.cos(angle), np.sin(angle)], -1) @ shapes.swapaxes(1, 2)
    expected = ((outline.max(1) > 0) & (outline.min(1) < [19, 11])).all(1)
    assert 100 < expected.sum() < 300
    np.testing.assert_array_equal(partly_in_view(pixels, shapes, (20, 12)), expected)
