"""Texture patches follow a known warp, or say that they cannot."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from torchmembrane.errors import MembraneError
from torchmembrane.markers.neighbourhood import Neighbourhood, inverse_2x2
from torchmembrane.markers.soft import SoftTextureLocator
from torchmembrane.markers.texture.locator import TextureLocator
from torchmembrane.markers.texture.patches import choose_patches
from torchmembrane.markers.texture.pyramid import low_pass_pyramid

HEIGHT, WIDTH = 240, 320
CENTRE = np.array([165.0, 115.0])
V, U = np.mgrid[:HEIGHT, :WIDTH]
VIGNETTE = 1 - 0.5 * ((U - 190) ** 2 + (V - 100) ** 2) / 220**2
VISIBLE = ((U - 160) / 150) ** 2 + ((V - 120) / 112) ** 2 < 1


def speckle(points, seed, waves=120):
    """Paint-like blotches in 0.15..0.85 at points [..., 2], px: random waves of 5 to 40 px, pushed to two greys."""
    random = np.random.default_rng(seed)
    length = np.exp(random.uniform(np.log(5), np.log(40), waves))
    angle, phase = random.uniform(0, 2 * np.pi, (2, waves))
    field = np.zeros(points.shape[:-1], np.float32)
    for k, a, p in zip(2 * np.pi / length, angle, phase, strict=True):
        field += np.cos((k * (points @ [np.cos(a), np.sin(a)]) + p).astype(np.float32))
    return 0.5 + 0.35 * np.tanh(3 * field / np.sqrt(waves / 2))


def bump(points):
    """Image to material under a push of 17 px that also turns and stretches; points [..., 2], px."""
    away = points - CENTRE
    bell = np.exp(-(away**2).sum(-1, keepdims=True) / (2 * 32.0**2))
    return points - bell * (np.array([16.0, -5.0]) + away @ np.array([[0.1, -0.12], [0.12, 0.05]]))


def still(points):
    return points


def photograph(back, seed, noise=0.01, gain=1.0, offset=0.0, texture=1):
    """Image [H, W] of the speckle through image-to-material map `back`: anti-aliased, vignetted, noisy, quantised."""
    image = np.zeros((HEIGHT, WIDTH))
    for du, dv in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        image += speckle(back(np.stack([U + du, V + dv], -1)), texture) / 4
    image = gain * image * VIGNETTE + offset + noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.round(255 * image.clip(0, 1)) / 255


def forward(back, pixels):
    """Where material points at rest pixels [D, 2] are seen: the inverse of `back` by fixed-point iteration."""
    seen = pixels.copy()
    for _ in range(200):
        seen = seen + pixels - back(seen)
    assert np.abs(back(seen) - pixels).max() < 1e-6
    return seen


def batch(*images, dtype=torch.float32):
    return torch.tensor(np.stack(images), dtype=dtype)[:, None]


@pytest.fixture(scope="module")
def rest():
    return photograph(still, 0)


@pytest.fixture(scope="module")
def pressed():
    return photograph(bump, 1, gain=0.75, offset=0.08)


@pytest.fixture(scope="module")
def pixels(rest):
    return choose_patches(rest, VISIBLE, 500)


@pytest.fixture(scope="module")
def locator(rest, pixels):
    return TextureLocator(rest, pixels)


def errors(locator, image, true):
    """Distance [D] to the true pixels and confidence [D]."""
    with torch.no_grad():
        found, confidence, _ = locator(batch(image))
    assert torch.isfinite(found).all() and (confidence >= 0).all() and (confidence <= 1).all()
    return np.linalg.norm(found[0].numpy() - true, axis=1), confidence[0].numpy()


@pytest.mark.parametrize("size", [(24, 32), (25, 35)])
def test_levels_are_every_other_pixel_of_the_binomial_low_pass(size):
    image = np.random.default_rng(0).random(size)
    for k, level in enumerate(low_pass_pyramid(torch.tensor(image)[None, None])):
        for axis in (0, 1):
            image = correlate1d(image, np.array([1, 4, 6, 4, 1]) / 16, axis, mode="nearest")
        image = image if k == 0 else image[::2, ::2]
        np.testing.assert_allclose(level[0, 0].numpy(), image, atol=1e-12)


def test_patches_are_textured_inside_the_mask_and_spread_evenly(rest):
    half = np.where(U < 160, rest, 0.4)
    chosen = choose_patches(half, VISIBLE, 500)
    u, v = chosen.astype(int).T
    assert VISIBLE[v, u].all() and (u < 175).all()
    distance = np.linalg.norm(chosen[:, None] - chosen, axis=-1) + 1e9 * np.eye(len(chosen))
    assert distance.min() > 0.8 * np.sqrt(VISIBLE.sum() / 500)
    lattice = np.argwhere(VISIBLE & (U < 145) & (U > 20))[::97, ::-1]
    assert np.linalg.norm(lattice[:, None] - chosen, axis=-1).min(1).max() < 25


def test_stripes_are_no_texture():
    with pytest.raises(MembraneError, match="choose_patches: .* textured places"):
        choose_patches(0.5 + 0.3 * np.sin(U / 3.0), VISIBLE)


@pytest.mark.parametrize("kind", [TextureLocator, SoftTextureLocator])
def test_shapes_are_checked(rest, pixels, kind):
    with pytest.raises(MembraneError, match="mask"):
        choose_patches(rest, VISIBLE.T)
    with pytest.raises(MembraneError, match=f"{kind.__name__}: pixels from"):
        kind(rest, pixels + 100.0)
    with pytest.raises(MembraneError, match=rf"{kind.__name__}: .* D > 16"):
        kind(rest, pixels[:5])
    with pytest.raises(MembraneError, match="not resized"):
        kind(rest, pixels)(torch.zeros(1, 1, HEIGHT // 2, WIDTH // 2))


def test_follows_a_large_smooth_warp(locator, pressed, pixels):
    error, confidence = errors(locator, pressed, forward(bump, pixels))
    kept = confidence > 0
    assert kept.mean() > 0.99
    assert np.median(error[kept]) < 0.05 and np.percentile(error[kept], 95) < 0.2 and error[confidence > 0.5].max() < 1


@pytest.mark.parametrize("shift", [(0.5, 0.25), (-7.3, 4.6), (25.4, -22.7)])
def test_subpixel_shift_is_unbiased(locator, pixels, shift):
    inner = np.linalg.norm((pixels - [160, 120]) / [120, 85], axis=1) < 1
    with torch.no_grad():
        found, confidence, _ = locator(batch(photograph(lambda points: points - shift, 2)))
    error = (found[0].numpy() - pixels - shift)[inner & (confidence[0].numpy() > 0)]
    assert len(error) > 0.99 * inner.sum()
    assert np.abs(error.mean(0)).max() < 0.01 and np.sqrt((error**2).mean()) < 0.03


def test_still_membrane_does_not_move(locator, rest, pixels):
    assert errors(locator, rest, pixels)[0].max() < 1e-3
    assert np.sqrt((errors(locator, photograph(still, 3), pixels)[0] ** 2).mean()) < 0.03


def test_integer_shift_is_followed_exactly(locator, rest, pixels):
    inner = np.linalg.norm((pixels - [160, 120]) / [110, 80], axis=1) < 1
    error, _ = errors(locator, np.roll(rest, (-8, 12), (0, 1)), pixels + [12, -8])
    assert error[inner].max() < 2e-3


def test_gain_and_offset_of_the_light_do_not_matter(locator, pressed):
    with torch.no_grad():
        found, confidence, _ = locator(batch(pressed, 0.6 * pressed + 0.3))
    assert (found[0] - found[1]).norm(dim=-1)[confidence[0] > 0].max() < 1e-2


@pytest.mark.parametrize("seed", [5, 6])
def test_overwritten_region_is_lost_and_does_not_drag_the_rest(locator, pressed, pixels, seed):
    distance = np.linalg.norm(forward(bump, pixels) - [150, 130], axis=1)
    covered = (U - 150) ** 2 + (V - 130) ** 2 < 35**2
    image = np.where(covered, photograph(still, seed, texture=seed), pressed)
    error, confidence = errors(locator, image, forward(bump, pixels))
    assert (confidence[distance < 30] < 0.5).all() and (confidence[distance < 30] == 0).mean() > 0.9
    assert (confidence[distance > 50] > 0).mean() > 0.98
    assert error[confidence > 0.5].max() < 3 and np.median(error[distance > 50]) < 0.03


def test_lost_pixels_are_what_the_neighbours_predict(locator, pixels):
    image = photograph(lambda points: points - [9.0, -5.0], 7)
    image[(U - 160) ** 2 + (V - 120) ** 2 < 40**2] = 0.5
    error, confidence = errors(locator, image, pixels + [9.0, -5.0])
    hidden = np.linalg.norm(pixels + [9.0, -5.0] - [160, 120], axis=1) < 20
    assert hidden.sum() > 4 and (confidence[hidden] == 0).all()
    assert np.median(error[hidden]) < 0.7 and error[hidden].max() < 3


def test_affine_flow_is_predicted_and_outliers_have_zero_weight(pixels):
    gradient, shift = torch.tensor([[0.1, -0.2], [0.3, 0.05]]), torch.tensor([3.0, -2.0])
    flow = (torch.tensor(pixels, dtype=torch.float32) @ gradient.T + shift)[None]
    broken = flow.clone()
    broken[:, ::6] += 20.0
    local = Neighbourhood(pixels, np.zeros((0, 2))).float()(broken, torch.ones(1, len(pixels)), 0.3)
    inner = np.linalg.norm((pixels - [160, 120]) / [120, 85], axis=1) < 1
    error = (local.flow - flow).norm(dim=-1)[:, inner]
    assert error.median() < 0.15 and error.quantile(0.95) < 0.6
    assert (local.gradient - gradient)[:, inner].abs().median() < 0.02


def test_inverse_of_two_by_two():
    matrix = torch.tensor([[[2.0, 0.7], [-0.4, 1.5]], [[0.1, 3.0], [2.0, 0.5]]])
    torch.testing.assert_close(inverse_2x2(matrix) @ matrix, torch.eye(2).expand(2, 2, 2))


def test_small_static_thing_is_not_followed(locator, rest, pressed, pixels):
    true = forward(bump, pixels)
    image = np.where((U - 172) ** 2 + (V - 110) ** 2 < 17**2, rest, pressed)
    error, confidence = errors(locator, image, true)
    assert error[confidence > 0.5].max() < 3 and (confidence > 0).mean() > 0.95


def test_clipped_highlight_is_survived(locator, pressed, pixels):
    image = np.clip(pressed + 1.2 * np.exp(-((U - 200) ** 2 + (V - 90) ** 2) / (2 * 12.0**2)), 0, 1)
    error, confidence = errors(locator, image, forward(bump, pixels))
    assert (confidence > 0).mean() > 0.93 and error[confidence > 0.5].max() < 2


@pytest.mark.parametrize("image", [0.0 * U, 0.0 * U + 0.5, U / WIDTH, np.random.default_rng(4).random(U.shape)])
def test_image_without_the_texture_is_all_lost_but_finite(locator, image, pixels):
    error, confidence = errors(locator, image, pixels)
    assert (confidence == 0).all() and np.isfinite(error).all()


def test_lost_patches_near_the_rim_stay_with_the_anchors(rest, locator, pixels):
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    rim = np.stack([160 + 152 * np.cos(angle), 120 + 114 * np.sin(angle)], 1)
    image = batch(np.where(U < 60, 0.3, photograph(lambda points: points - [9.0, 0.0], 1)))
    near = np.linalg.norm(pixels[:, None] - rim, axis=-1).min(1) < 12
    near &= pixels[:, 0] < 30
    with torch.no_grad():
        held, confidence, _ = TextureLocator(rest, pixels, rim)(image)
        free, _, _ = locator(image)
    moved = [(found[0, near] - torch.tensor(pixels[near])).norm(dim=-1) for found in (held, free)]
    assert near.sum() > 2 and (confidence[0, near] == 0).all()
    assert moved[0].median() < 2 < 6 < moved[1].median()


def test_a_frame_alone_equals_the_frame_in_a_batch(locator, rest, pressed):
    with torch.no_grad():
        together = locator(batch(pressed, rest, np.zeros_like(rest)))
        alone = locator(batch(pressed))
    for one, all in zip(alone, together, strict=True):
        torch.testing.assert_close(one[0], all[0], atol=2e-4, rtol=0)


def test_float32_agrees_with_float64(rest, pixels, locator, pressed):
    with torch.no_grad():
        found, confidence, _ = locator(batch(pressed))
        exact, sure, _ = TextureLocator(rest, pixels).double()(batch(pressed, dtype=torch.float64))
    assert (found - exact)[sure > 0].abs().max() < 1e-3 and (confidence - sure).abs().max() < 1e-3


def test_gradient_sees_the_motion(rest, pixels):
    """The gradient is that of finite differences, and d pixels / d image . d image / d shift is nearly 1."""
    inner = torch.as_tensor(np.linalg.norm((pixels - [160, 120]) / [120, 85], axis=1) < 1)
    locator = TextureLocator(rest, pixels).double()
    image, right, left = (
        batch(photograph(lambda points, e=e: points - [e, 0.0], 0, noise=0.0), dtype=torch.float64) for e in (0.3, 0.4, 0.2)
    )
    motion = (right - left) / 0.2
    image.requires_grad_()
    locator(image)[0][0, inner, 0].mean().backward()
    with torch.no_grad():
        ahead, behind = (locator(image + step * motion)[0][0, inner, 0].mean() for step in (1e-3, -1e-3))
    slope = (image.grad * motion).sum().item()
    assert slope == pytest.approx((ahead - behind).item() / 2e-3, rel=1e-2)
    assert slope == pytest.approx(1, abs=0.05)
