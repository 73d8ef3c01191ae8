"""Formulas of the soft locators agree with closed forms and twins."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from test_dots import CENTRE, PITCH, RADIUS, SIZE, batch, deform, dent, measured, render, scene, slide
from test_soft import GRID, SMALL_SIZE, drawn, found
from test_texture import photograph, still

from torchmembrane.markers.dots.ellipse import draw_dots
from torchmembrane.markers.dots.flow import FlowAverages
from torchmembrane.markers.soft import SoftLocator, SoftTextureLocator
from torchmembrane.markers.soft.argmax import window_peak
from torchmembrane.markers.soft.locator import _other_radii
from torchmembrane.markers.soft.response import DISC_RESPONSE, SIGMA_RATIO, DotResponse, disc_response, pyramid
from torchmembrane.markers.soft.search import LARGEST_RELATIVE_SPREAD, DotGrowth, DotSearch, Found, predict
from torchmembrane.markers.soft.texture import PatchCorrelation
from torchmembrane.markers.texture.patches import choose_patches

INNER = ((GRID > 0) & (GRID < [6, 5])).all(1)
ONE = torch.ones(1, dtype=torch.float64)


@pytest.fixture(scope="module")
def square():
    """A square of dots of two sizes: what locates them, their rest pixels, and the image at rest."""
    pattern, image = drawn()
    return SoftLocator(pattern, SMALL_SIZE, "dark").double(), torch.as_tensor(pattern.pixels), image


def test_the_peak_of_a_gaussian_is_the_product_with_that_of_the_prediction():
    """Weights N(peak, T a^2) N(predicted, reach^2): mean, standard deviation and mean of a value in closed form."""
    temperature, stride = 0.5, torch.tensor([1.0, 2.0], dtype=torch.float64)
    step = torch.arange(-12.0, 13.0, dtype=torch.float64)
    middle = torch.tensor([[[30.0, 40.0], [50.0, 20.0]]], dtype=torch.float64)
    predicted, reach = middle + torch.tensor([1.5, -0.7]), torch.tensor([2.0, 5.0], dtype=torch.float64)
    u, v = (middle[..., k, None, None] + stride[:, None, None] * s for k, s in enumerate((step[None, :], step[:, None])))
    peak, a = middle + torch.tensor([-1.2, 2.3]), stride * 2.5
    score = -((u - peak[..., 0, None, None]) ** 2 + (v - peak[..., 1, None, None]) ** 2) / (2 * a[:, None, None] ** 2)
    at = window_peak(score, u + 3 * v, middle, stride, predicted, reach, temperature)
    precise, loose = 1 / (temperature * a**2), 1 / reach**2
    variance = 1 / (precise + loose)
    mean = variance[:, None] * (precise[:, None] * peak + loose[:, None] * predicted)
    torch.testing.assert_close(at.place, mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(at.spread, (2 * variance).sqrt()[None], rtol=1e-3, atol=0)
    torch.testing.assert_close(at.strength, mean[..., 0] + 3 * mean[..., 1], rtol=0, atol=1e-3)


@pytest.mark.parametrize("ratio", [0.7, 2**0.5, 2.0])
def test_the_response_to_a_disc_is_the_integral_of_the_laplacian_over_it(ratio):
    sigma = 1.7
    rho = (np.arange(20000) + 0.5) / 20000 * ratio * sigma
    gaussian = np.exp(-(rho**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    laplacian = (rho**2 / sigma**4 - 2 / sigma**2) * gaussian
    integral = -(sigma**2) * (laplacian * 2 * np.pi * rho).sum() * (rho[1] - rho[0])
    assert disc_response(np.array(ratio * sigma), np.array(sigma)) == pytest.approx(integral, rel=1e-6)
    assert integral <= DISC_RESPONSE + 1e-9


def responses(radii, others=None, coarser=0, reach=4.0, inside=None):
    radii = np.asarray(radii, float)
    inside = torch.ones(1, 1, 120, 140, dtype=torch.float64) if inside is None else inside
    others = np.full(len(radii), np.nan) if others is None else np.asarray(others, float)
    return DotResponse(radii, others, coarser, np.full(len(radii), reach), inside)


def disc(radius, at=(70.0, 60.0)):
    """A dark disc on grey, of contrast 1."""
    return draw_dots(np.array([at]), radius * np.eye(2)[None], (140, 120)) / 0.9


def test_responses_are_differences_of_gaussians():
    response, image = responses([2.8]), torch.rand(1, 1, 120, 140, generator=torch.Generator().manual_seed(0)).double()
    (rung,) = response.rungs[0]
    above, below = (ndimage.gaussian_filter(image[0, 0].numpy(), SIGMA_RATIO**s, truncate=3.5) for s in (rung + 1, rung - 1))
    (maps,) = response.maps(pyramid(image))
    twin = (above - below) / 1.02  # of the mean's weight, the least share is added
    assert abs(maps[0, 0].numpy() - twin)[20:-20, 20:-20].max() < 0.01 * abs(twin).max()
    assert rung == round(np.log(2.8 / 2**0.5) / np.log(SIGMA_RATIO))


def test_a_dot_answers_most_at_its_own_scale_and_a_slope_not_at_all():
    radii = 2.2 * SIGMA_RATIO ** np.arange(-2, 3)
    middle, response = torch.tensor([[[70.0, 60.0]]]).double(), responses([2.2])
    at = [float(response.windows(response.maps(pyramid(disc(r))), middle).value[0, 0, 4, 4]) for r in radii]
    assert np.argmax(at) == 2 and at[2] > 0
    u = torch.arange(140.0).double().expand(1, 1, 120, 140)
    (flat,) = response.maps(pyramid(0.01 * u + 0.5))
    assert flat[..., 30:-30, 30:-30].abs().max() < 1e-3


def test_what_is_off_the_membrane_has_no_say():
    """Beside its edge a constant has next to no response; without the shares it would be as strong as a dot."""
    inside = torch.zeros(1, 1, 120, 140, dtype=torch.float64)
    inside[..., 70:] = 1
    response = responses([2.8], inside=inside)
    (maps,) = response.maps(pyramid(inside))
    assert (maps * (1 - inside)).abs().max() == 0
    assert maps[..., 72:].abs().max() < 0.03


@pytest.mark.parametrize("coarser, strides", [(-1, (1, 2)), (0, (1, 4)), (1, (2, 8))])
def test_windows_hold_the_maps_about_the_pixel_next_to_the_centre(coarser, strides):
    response = responses([2.0, 7.0], [7.0, 2.0], coarser, 5.0)
    levels = pyramid(torch.rand(2, 1, 120, 140, generator=torch.Generator().manual_seed(1)).double())
    maps, half = response.maps(levels), response.half_width
    centre = torch.tensor([[70.3, 60.8], [71.9, 58.2]], dtype=torch.float64).expand(2, 2, 2)
    windows = response.windows(maps, centre)
    for dot, stride in enumerate(strides):
        k = response.levels.index(int(np.log2(stride)))
        at = np.round(centre[0, dot].numpy() / stride).astype(int)
        assert response.stride[dot] == stride and (windows.middle[:, dot].numpy() == stride * at).all()
        patch = maps[k][:, :, at[1] - half : at[1] + half + 1, at[0] - half : at[0] + half + 1]
        radius, other_radius = np.array([(2.0, 7.0), (7.0, 2.0)][dot]) / stride
        scales = np.array([radius, other_radius]) / 2**0.5
        own, other = (response.rungs[response.levels[k]].index(r) for r in np.round(np.log(scales) / np.log(SIGMA_RATIO)))
        share = min(disc_response(other_radius, scales[0]) / DISC_RESPONSE, 0.75)
        torch.testing.assert_close(windows.value[:, dot], patch[:, own] - share * patch[:, other])
    near = response.windows(maps, torch.full((2, 2, 2), -9.0).double())
    assert (near.middle[0] == torch.tensor(strides)[:, None] * half).all()
    far = response.windows(maps, torch.full((2, 2, 2), 999.0).double()).middle
    sides = [maps[response.levels.index(int(np.log2(s)))].shape[-2:] for s in strides]
    assert far[0].tolist() == [[s * (w - 1 - half), s * (h - 1 - half)] for s, (h, w) in zip(strides, sides, strict=True)]


def test_dots_of_the_other_size_are_hardly_seen():
    for radius, other in ((4.0, 2.5), (2.5, 4.0)):
        response, middle = responses([radius], [other]), torch.tensor([[[70.0, 60.0]]]).double()
        alone, half = responses([radius]), response.half_width

        def peak(of, size, middle=middle, half=half):
            return float(of.windows(of.maps(pyramid(disc(size))), middle).value[0, 0, half, half])

        assert abs(peak(response, other)) < 0.45 * peak(response, radius)  # of one size alone: 0.6 and 0.8
        assert peak(response, radius) > 0.4 * peak(alone, radius)


def dot_search():
    search = DotSearch(np.array([4.0]), np.array([np.nan]), 0, np.array([5.0]), torch.ones(1, 1, 120, 140).double()).double()
    search.calibrate(pyramid(disc(4.0) * 2 - 2), torch.tensor([[70.0, 60.0]]).double())
    return search


@pytest.mark.parametrize("contrast", [2.0, 1.0, 0.5])
def test_a_dot_s_response_is_its_contrast_and_its_place_does_not_depend_on_it(contrast):
    search = dot_search()
    image = contrast * (disc(4.0, (71.4, 59.2)) - 1)
    maps, truth = search.response.maps(pyramid(image)), torch.tensor([71.4, 59.2])
    first = search(maps, torch.tensor([[[70.0, 60.0]]]).double())
    seen = search(maps, first.place)
    assert float(seen.response) == pytest.approx(contrast / 2, rel=0.03)
    assert 0.04 < (first.place[0, 0] - truth).norm() < 0.15  # drawn to the prediction
    assert (seen.place[0, 0] - truth).norm() < 0.02
    assert float(seen.sharpness) > 0.98


def test_two_dots_are_no_sharp_peak_and_no_dot_is_none():
    search, middle = dot_search(), torch.tensor([[[70.0, 60.0]]]).double()
    pair = disc(4.0, (63.5, 60.0)) + disc(4.0, (76.5, 60.0)) - 2
    seen = search(search.response.maps(pyramid(2 * pair)), middle)
    assert float(seen.sharpness) < 0.1 < LARGEST_RELATIVE_SPREAD and (seen.place - middle).abs().max() < 0.2
    empty = search(search.response.maps(pyramid(0 * pair)), middle)
    assert float(empty.response) < 1e-6 and float(empty.sharpness) < 0.5
    light = search(search.response.maps(pyramid(2 - 2 * disc(4.0))), middle)
    assert float(light.sharpness) < 0.01  # a ring is dark


def test_an_affine_flow_is_predicted_as_it_is():
    """Where the gradient is known; where it is not, as a least-squares fit finds it: towards it with each repetition."""
    pixels = 20.0 * GRID
    averages = FlowAverages(pixels, pixels).double()
    gradient = torch.tensor([[0.05, -0.12], [0.2, 0.03]], dtype=torch.float64)
    flow = (torch.as_tensor(pixels) @ gradient.T + torch.tensor([3.0, -2.0]))[None]
    weight = torch.ones(1, len(GRID), dtype=torch.float64)
    known = gradient.expand(1, len(GRID), 2, 2)
    predicted, again, support = predict(averages, weight, flow, known)
    inner = torch.as_tensor(INNER)
    assert (predicted - flow)[:, inner].norm(dim=-1).max() < 2e-3 * flow.norm(dim=-1).max()
    torch.testing.assert_close(again[:, inner], known[:, inner], rtol=0, atol=1e-2)
    torch.testing.assert_close(support[0], torch.as_tensor(averages.kernel).sum(0))
    found, error = torch.zeros_like(known), []
    for _ in range(3):
        _, found, _ = predict(averages, weight, flow, found)
        error.append(float((found - known)[:, inner].abs().max()))
    assert error[0] > 2 * error[1] > 4 * error[2] and error[2] < 0.02


def growth(anchors):
    pixels = 20.0 * GRID + 15
    inside = torch.ones(1, 1, 130, 150, dtype=torch.float64)
    return DotGrowth(pixels, np.full(len(GRID), 4.0), np.full(len(GRID), np.nan), anchors, inside).double()


def test_growth_begins_at_the_rim_or_where_the_dots_were():
    rim = 20.0 * np.stack(np.meshgrid(np.arange(-1, 8), np.arange(-1, 7)), -1).reshape(-1, 2) + 15
    rim = rim[(abs(rim - [75, 65]) > [65, 55]).any(1)]
    levels = pyramid(torch.zeros(2, 1, 130, 150).double())
    for anchors, known in ((rim, 0.0), (rim[:0], 1.0)):
        grown = growth(anchors)
        _, weight, flow, gradient = grown.begin(levels)
        assert (weight == known).all() and weight.shape == (2, 42) and not flow.any() and not gradient.any()
        before = grown.pixels.expand(2, -1, -1) + torch.tensor([1.0, 2.0]).double()
        before[0, 5] = torch.nan
        _, weight, flow, _ = grown.begin(levels, before)
        assert weight[0, 5] == known and (weight[1] == 1).all()
        assert not flow[0, 5].any() and (flow[1] == torch.tensor([1.0, 2.0])).all()


def test_growth_gains_a_ring_with_each_step_and_reaches_the_middle():
    s = scene()
    large = s.sizes == 1
    locate = SoftLocator(measured(s), SIZE, "dark", s.rim)
    depth = np.linalg.norm(s.pixels[large] - CENTRE, axis=1)
    levels, _ = locate.begin(batch(render(s.pixels, s.shapes)))
    maps, *state = locate.growth.begin(levels)
    reached = []
    with torch.no_grad():
        for _ in range(locate.growth.steps):
            state = locate.growth.step(*state, *maps)
            reached.append(depth[state[0][0].numpy() > 0.5].min(initial=RADIUS))
    assert (np.diff(reached) <= 0).all() and reached[0] > 50 and reached[-1] < 20
    assert state[0].min() > 0.9


def test_growth_does_not_believe_what_is_not_there():
    """Where nothing answers, a weight of 0: not what the support alone would make it."""
    grown = growth(np.zeros((0, 2)))
    grown.search.calibrate(pyramid((drawn()[1] / 0.5 + 0.15).log()), grown.pixels)
    maps, *state = grown.begin(pyramid(torch.zeros(1, 1, 130, 150).double()))
    assert grown.step(*state, *maps)[0].max() < 1e-6


@pytest.mark.parametrize("field, pitches, share", [(slide, 0.8, 0.1), (dent, 0.6, 0.1)])
def test_large_dots_are_found_first_and_predict_the_small_ones(field, pitches, share):
    """On a rendered press, from the large ones alone: off by a tenth of the spacing at most, where they moved by half of it."""
    s = scene()
    locate = SoftLocator(measured(s), SIZE, "dark", s.rim)
    truth, shapes = deform(s, field, pitches)
    large, small = (s.sizes == 1), (s.sizes == 0)
    with torch.no_grad():
        hidden_small = batch(render(truth, shapes, kept=large))
        for image in (batch(render(truth, shapes)), hidden_small):
            levels, _ = locate.begin(image)
            place, weight = locate.growth(levels)
            predicted = locate.predict_small(place, weight)[0].numpy()
            assert np.linalg.norm(place[0].numpy() - truth[large], axis=1).max() < 0.15 * PITCH and weight.min() > 0.1
            assert np.linalg.norm(predicted - truth[small], axis=1).max() < share * PITCH
        found_small = locate.find_small(locate.begin(batch(render(truth, shapes)))[0], torch.as_tensor(predicted)[None])
    assert np.linalg.norm(found_small[0].numpy() - truth[small], axis=1).max() < 0.05 * PITCH
    assert np.linalg.norm(s.pixels[small] - truth[small], axis=1).max() > 4 * share * PITCH


def test_small_dots_are_predicted_along_the_gradient_of_the_large_ones_flow():
    """From the large ones where they truly are: to 1.2 % of the spacing, median; without a second pass it is 1.7 %."""
    s = scene()
    locate, (truth, _) = SoftLocator(measured(s), SIZE, "dark", s.rim), deform(s, slide, 0.8)
    moved = torch.as_tensor(truth, dtype=torch.float32)[None]
    predicted = locate.predict_small(locate.of_large(moved), torch.ones(1, len(locate.large)))[0].numpy()
    assert np.median(np.linalg.norm(predicted - truth[s.sizes == 0], axis=1)) < 0.012 * PITCH


def test_values_of_large_and_small_dots_are_joined_in_the_pattern_s_order(square):
    locate, rest, _ = square
    both = torch.arange(2.0 * len(rest)).reshape(1, -1, 2)
    assert (locate.join(locate.of_large(both), both[:, locate.small]) == both).all()
    assert (locate.is_small.nonzero()[:, 0] == locate.small).all()


def test_radii_of_the_other_size_are_those_around():
    radii = np.where(GRID.sum(1) % 2 == 0, 4.0, 2.6) * (1 + 0.1 * GRID[:, 0])
    others = _other_radii(20 * GRID, radii, GRID.sum(1) % 2 == 0)
    around = np.where(GRID.sum(1) % 2 == 0, 2.6, 4.0) * (1 + 0.1 * GRID[:, 0])
    assert abs(others / around - 1)[INNER].max() < 0.06
    assert np.isnan(_other_radii(20 * GRID, radii, np.ones(42, bool))).all()


def test_light_dots_are_dark_ones_of_the_negative(square):
    locate, _, _ = square
    light = SoftLocator(drawn()[0], SMALL_SIZE, "light").double()
    moved = drawn((2.2, -1.4))[1] * 0.6 + 0.2
    for one, other in zip(found(locate, moved), found(light, 1 - moved), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def seen_as(square, moved=0.0, dot=17, **changed):
    """What is judged where all dots are found, moved alike, and one is changed."""
    locate, rest, _ = square
    fields = dict(place=(rest + moved)[None].clone(), response=torch.ones(1, 42).double(), sharpness=torch.ones(1, 42).double())
    for name, value in changed.items():
        fields[name][0, dot] = value if name != "place" else fields[name][0, dot] + torch.tensor(value).double()
    return Found(**fields)


@pytest.mark.parametrize(
    "changed, least, most",
    [
        (dict(), 0.99, 1.0),
        (dict(response=0.6), 0.9, 0.99),  # fainter than the others, but a dot
        (dict(response=0.45), 0.3, 0.6),  # half as likely one as not
        (dict(response=0.3), 0.0, 0.05),
        (dict(sharpness=0.5), 0.4, 0.55),
        (dict(sharpness=0.0), 0.0, 0.0),
        (dict(place=(2.0, 0.0)), 0.99, 1.0),  # a tenth of the spacing
        (dict(place=(0.0, 10.0)), 0.0, 0.0),  # half of it
    ],
)
def test_confidence_falls_with_what_speaks_against_a_dot(square, changed, least, most):
    locate, rest, _ = square
    moved = torch.tensor([3.0, -2.0]).double()
    pixels, confidence, _ = locate.judge(seen_as(square, moved, **changed), ONE.bool())
    assert least <= float(confidence[0, 17]) <= most
    others = torch.arange(42) != 17
    assert confidence[0, others].min() > 0.95 and (pixels[0, others] - rest[others] - moved).abs().max() < 1e-9
    if most == 0:
        assert (pixels[0, 17] - rest[17] - moved).norm() < 0.1  # where its neighbours put it


def test_confidence_falls_with_the_frame(square):
    locate, _, _ = square
    seen = seen_as(square)
    assert (locate.judge(seen, ~ONE.bool())[1] == 0).all()
    faint = seen._replace(response=0.2 * seen.response)
    assert 0.4 < float(locate.judge(faint, ONE.bool())[1].median()) < 0.6
    few = seen._replace(sharpness=(torch.arange(42) % 8 == 0).double()[None])
    assert (locate.judge(few, ONE.bool())[1] == 0).all()
    five = (torch.arange(42) == locate.large[::4, None]).any(0).double()[None]  # large ones, so that none needs to be led
    assert 0 < five.sum() < 7 and locate.decide(seen.place, seen.place, five, ONE.bool())[1].max() < 0.1
    third = seen._replace(sharpness=seen.sharpness * (torch.arange(42) < 14))
    assert locate.judge(third, ONE.bool())[1][0, :7].min() > 0.5
    led = seen._replace(sharpness=locate.is_small.double()[None])
    assert locate.judge(led, ONE.bool())[1].max() < 0.01  # small ones without large ones


def test_a_dot_that_is_off_is_put_where_its_neighbours_are(square):
    locate, rest, _ = square
    seen = seen_as(square, 1.5, place=(9.0, -9.0))
    settled = locate.settle(seen)[0] - rest
    assert (settled[17] - 1.5).norm() < 0.1 and (settled - 1.5).norm(dim=-1)[torch.arange(42) != 17].max() < 1e-6
    blunt = locate.settle(seen_as(square, 1.5, place=(2.0, 0.0), sharpness=0.5))[0] - rest
    assert (blunt[17] - torch.tensor([2.5, 1.5])).norm() < 0.1  # halfway


def test_correlation_ignores_light_and_follows_the_flow_s_gradient():
    rest = ndimage.gaussian_filter(np.random.default_rng(3).random((90, 110)), 1.5)
    rest = torch.as_tensor((rest - rest.min()) / np.ptp(rest))
    centre = torch.tensor([[40.0, 45.0], [62.0, 40.0]], dtype=torch.float64)
    patches = PatchCorrelation(rest[None, None], centre, 7, 4).double()
    gradient = torch.tensor([[0.05, -0.2], [0.15, 0.1]], dtype=torch.float64)
    affine, offset = torch.eye(2).double() + gradient, torch.tensor([2.0, -3.0]).double()
    at = np.linalg.solve(affine.numpy(), np.stack(np.mgrid[:90, :110][::-1], -1).reshape(-1, 2).T - offset.numpy()[:, None])
    image = torch.as_tensor(ndimage.map_coordinates(rest.numpy(), at[::-1], order=3, mode="nearest").reshape(90, 110))
    truth = centre @ gradient.T + offset
    for gain, light in ((1.0, 0.0), (0.4, 0.3)):
        for wrong in ([1.5, -1.0], [0.0, 0.0]):
            flow = (truth + torch.tensor(wrong).double())[None]
            found_flow, peak = patches((gain * image + light)[None, None], flow, gradient.expand(1, 2, 2, 2))
            assert (found_flow - truth).norm(dim=-1).max() < (0.25 if any(wrong) else 0.05)
            assert peak.strength.min() > 0.8 and peak.strength.max() <= 1 + 1e-6
    _, plain = patches(image[None, None], truth[None], torch.zeros(1, 2, 2, 2).double())
    assert plain.strength.max() < 0.95 * peak.strength.min()


def test_texture_moves_with_the_image():
    rest = photograph(still, 0)[40:200, 60:260]
    locate = SoftTextureLocator(rest, choose_patches(rest, np.ones(rest.shape, bool), 80))
    at = locate.rest_pixels.numpy()
    inner = (abs(at - [100, 80]) < [65, 45]).all(1)
    for shift in ((9, -6), (-12, 5)):
        pixels, confidence = found(locate, batch(np.roll(rest, shift, (1, 0))))
        error = abs(pixels[0] - at - shift)[inner]
        assert confidence[0, inner].min() > 0.99 and error.max() < 0.2 and np.median(error) < 0.04


def test_texture_that_is_covered_or_stays_behind_is_lost():
    rest = photograph(still, 0)[40:200, 60:260]
    locate = SoftTextureLocator(rest, choose_patches(rest, np.ones(rest.shape, bool), 200))
    at, shift = locate.rest_pixels.numpy(), np.array([6, -4])
    middle = np.linalg.norm(at - [100, 80], axis=1)
    here, broken = np.s_[80 - 20 : 80 + 16, 100 - 14 : 100 + 26], np.roll(rest, shift, (1, 0))
    covered, behind = broken.copy(), broken.copy()
    covered[here] = np.random.default_rng(0).random(covered[here].shape)
    behind[80 - 15 : 80 + 16, 100 - 15 : 100 + 16] = rest[80 - 15 : 80 + 16, 100 - 15 : 100 + 16]
    broken[3, 5] = np.nan
    pixels, confidence = found(locate, batch(covered, behind, broken))
    assert (confidence[0, middle < 6] == 0).all() and confidence[0, (middle > 45) & (middle < 60)].min() > 0.9
    assert abs(pixels[0] - at - shift)[middle < 6].max() < 1
    assert (confidence[1, middle < 5] < 0.05).all() and (middle < 5).any()
    assert (confidence[2] == 0).all()
