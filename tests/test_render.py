"""Rendered geometry and brightness agree with closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.camera.model import Camera
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.appearance import LIGHT_RADIUS, Appearance, blurred, diffuse_light, noisy, vignette
from torchmembrane.simulate.pattern import Dots, Painted, Speckle, pattern_of
from torchmembrane.simulate.raster import visible_triangles
from torchmembrane.simulate.render import Renderer, render
from torchmembrane.surface.shapes import heightfield

SIZE = (160, 120)
PORT = {"ports": [(2.0, 3.0, 1.49)], "medium_index": 1.33}
CAMERAS = {
    "pinhole": Camera("pinhole", SIZE, (100, 100), (80.3, 59.1), (-0.1, 0.02, 0.001, -0.002)),
    "fisheye": Camera("fisheye", SIZE, (95, 95), (78.8, 61.0), (-0.02, 0.004)),
    "pinhole port": Camera("pinhole", SIZE, (90, 90), (80.0, 60.0), **PORT),
    "fisheye port": Camera("fisheye", SIZE, (95, 95), (80.4, 59.7), **PORT),
}
RADIUS, CENTRE = 10.0, np.array([0.0, 0.0, 12.0])  # of the cap's sphere
DOTS = [(0, 0, 1), (0.5, 0.1, 1), (-0.3, 0.5, 1), (0.1, -0.55, 1), (-0.6, -0.4, 1.2)]
PLAIN = Appearance(ambient=1.0, vignetting=0.0, blur=0.0, exposure=1.0, outside=0.0)


def cap_sensor(camera, kind="dots", image=None) -> Sensor:
    directions = np.array(DOTS) / np.linalg.norm(DOTS, axis=1, keepdims=True)
    surface = Surface("spherical_cap", {"rim_radius": 8.0, "height": 4.0, "base_z": 18.0})
    positions = None if kind == "texture" else CENTRE + RADIUS * directions
    sizes = None if kind == "texture" else ["large", "small", "small", "large", "small"]
    return make_sensor(camera, surface, Markers(kind, "dark", positions, sizes, image))


def plate_sensor(camera, positions=((0.0, 0.0, 20.0),)) -> Sensor:
    x, y = np.linspace(-20, 20, 21), np.linspace(-14, 14, 15)
    surface = Surface("heightfield", {"x": x, "y": y, "z": np.full((21, 15), 20.0)})
    return make_sensor(camera, surface, Markers("dots", "dark", np.array(positions)))


def make_sensor(camera, surface, markers) -> Sensor:
    membrane, material = surface.membrane((15, 15)), Material("neo_hookean", 1.2)
    return Sensor("test", "mm", camera, membrane, material, Cavity("liquid"), markers, surface)


def dented(X):
    """A smooth deformation of space, `[..., 3]`."""
    X = torch.as_tensor(X)
    dent = torch.exp(-((X[..., :1] - 2) ** 2 + (X[..., 1:2] - 1) ** 2) / 12)
    return X - dent * torch.tensor([0.3, -0.2, 1.5], dtype=X.dtype)


def centroid(weight, around, reach):
    u0, v0 = (int(round(c)) for c in around)
    v, u = np.mgrid[v0 - reach : v0 + reach + 1, u0 - reach : u0 + reach + 1]
    w = weight[v, u]
    return np.array([(w * u).sum(), (w * v).sum()]) / w.sum(), w.sum()


def outline(camera, position, radius):
    """Centroid and area of a dot's projected outline: a circle in the tangent plane, dropped on the sphere, deformed."""
    n = (position - CENTRE) / RADIUS
    a = np.cross(n, [0.3, 1.0, 0.2])
    a /= np.linalg.norm(a)
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    circle = radius * (np.cos(t) * a + np.sin(t) * np.cross(n, a)) + math.sqrt(RADIUS**2 - radius**2) * n + CENTRE
    p = camera.point_to_pixel(dented(circle)).numpy()
    q = np.roll(p, -1, 0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return ((p + q) * cross[:, None]).sum(0) / (3 * cross.sum()), abs(cross.sum()) / 2


@pytest.mark.parametrize("name", CAMERAS)
def test_a_dot_s_centroid_is_that_of_its_projected_outline(name):
    camera, sensor = CAMERAS[name], cap_sensor(CAMERAS[name])
    dots = Dots.from_sensor(sensor, (0.6, 0.9))
    renderer = Renderer(sensor, (25, 25), dots, PLAIN)
    image = renderer(dented(renderer.coarse_rest)).numpy()
    seen = renderer.dots(dented(renderer.coarse_rest))
    torch.testing.assert_close(seen.pixels, camera.point_to_pixel(dented(dots.positions)), atol=0.01, rtol=0)
    assert seen.visible.all()
    for position, radius, pixel in zip(dots.positions, dots.radii, seen.pixels.numpy(), strict=True):
        expected, area = outline(camera, position, radius)
        found, ink = centroid(1 - image, pixel, reach=10)
        assert np.linalg.norm(found - expected) < 0.02
        assert ink / (1 - dots.ink) == pytest.approx(area, rel=0.01)


def test_more_samples_converge():
    sensor = cap_sensor(CAMERAS["fisheye"])
    images = {s: render(sensor, sensor.membrane.rest, appearance=PLAIN, samples=s) for s in (1, 2, 4, 12)}
    errors = [(images[s] - images[12]).square().mean().sqrt() for s in (1, 2, 4)]
    assert errors[0] > 1.6 * errors[1] > 1.6**2 * errors[2] and errors[2] < 0.01


def test_every_sample_sees_the_nearest_triangle_that_faces_it():
    """Against the definition, triangle by triangle."""
    corners = 30 * torch.rand(60, 3, 2, dtype=torch.float64) - 3
    corners[7, 1] = math.nan
    depth = torch.rand(60, dtype=torch.float64)
    v, u = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    expected, nearest = torch.full((20, 24), -1), torch.full((20, 24), math.inf, dtype=torch.float64)
    for k, (a, b, c) in enumerate(corners):
        sides = [(q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        covered = (torch.stack(sides) > 0).all(0) & (depth[k] < nearest)
        expected, nearest = torch.where(covered, k, expected), torch.where(covered, depth[k], nearest)
    assert (expected >= 0).float().mean() > 0.5
    assert torch.equal(visible_triangles(corners, depth, 24, 20), expected)


def test_a_mesh_leaves_no_gaps_and_counts_no_sample_twice():
    """Vertices on samples included: each sample belongs to one triangle, so areas sum to the outline's."""
    s = torch.arange(9, dtype=torch.float64)
    v, u = torch.meshgrid(2 * s, 2 * s, indexing="ij")
    grid = torch.stack([u, v], -1)
    grid[1:-1, 1:-1] += (torch.rand(7, 7, 2, dtype=torch.float64) - 0.5) * (torch.rand(7, 7, 1) > 0.4)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    corners = torch.cat([torch.stack([a, b, c], -2).reshape(-1, 3, 2), torch.stack([a, c, d], -2).reshape(-1, 3, 2)])
    seen = visible_triangles(corners, torch.ones(len(corners)), 20, 20)
    assert (seen[:16, :16] >= 0).all() and (seen >= 0).sum() == 16**2
    alone = sum((visible_triangles(t[None], torch.ones(1), 20, 20) >= 0).long() for t in corners)
    assert alone.max() == 1


def test_lambert_s_law_and_vignetting_on_a_flat_plate():
    camera = Camera("pinhole", SIZE, (100, 100), (79.5, 59.5))
    sensor, light = plate_sensor(camera), np.array([5.0, -3.0, 2.0])
    appearance = Appearance(lights=[light], ambient=0.0, vignetting=0.3, blur=0.0, exposure=0.5)
    image = render(
        sensor, sensor.membrane.rest, pattern=Dots.from_sensor(sensor, missing=[0]), appearance=appearance, samples=2
    ).numpy()
    v, u = np.mgrid[10:110, 10:150]
    points = 20 * np.stack([(u - 79.5) / 100, (v - 59.5) / 100, np.ones(u.shape)], -1)
    ray = light - points
    expected = -ray[..., 2] / np.linalg.norm(ray, axis=-1) ** 3
    expected *= 1 - 0.3 * ((u - 79.5) ** 2 + (v - 59.5) ** 2) / (80**2 + 60**2)
    ratio = image[10:110, 10:150] / expected
    assert ratio.max() / ratio.min() < 1.001


def test_the_corner_farthest_from_the_principal_point_loses_the_share_of_vignetting():
    camera = Camera("pinhole", (160, 120), (100, 100), (40, 50))
    pixels = torch.tensor([[40.0, 50.0], [159.5, 119.5], [159.5, -0.5]], dtype=torch.float64)
    middle, farthest, other = vignette(pixels, camera, 0.3).tolist()
    assert middle == 1 and farthest == pytest.approx(0.7) and 0.7 < other < 1


def test_light_falls_with_the_square_of_the_distance_and_the_cosine():
    up, lights = torch.tensor([[0.0, 0, -1]]), torch.zeros(1, 3)
    near, far = diffuse_light(torch.tensor([[0.0, 0, 2]]), up, lights), diffuse_light(torch.tensor([[0.0, 0, 4]]), up, lights)
    tilted = diffuse_light(torch.tensor([[0.0, 0, 2]]), torch.tensor([[0.6, 0, -0.8]]), lights)
    assert near / far == pytest.approx(4) and tilted / near == pytest.approx(0.8)
    assert diffuse_light(torch.tensor([[0.0, 0, 2]]), -up, lights) == 0


def test_lights_stand_round_the_camera_half_as_far_as_the_membrane_at_most():
    """Of a membrane far away, a share of the rim's distance from the axis; of one as near as a window's, half its distance."""
    x = np.linspace(-20, 20, 9)
    for z, radius in ((60.0, LIGHT_RADIUS * np.hypot(*np.meshgrid(x, x))), (4.0, 2.0)):
        plate = heightfield(x, x, np.full((9, 9), z))
        wanted = radius if z == 4.0 else float(radius[plate.fixed.reshape(9, 9).numpy()].mean())
        lights = Appearance().lights_for(plate)
        torch.testing.assert_close(lights.norm(dim=1), torch.full((4,), wanted).double())
        torch.testing.assert_close(lights.mean(0), torch.zeros(3).double(), rtol=0, atol=1e-9)


def test_a_highlight_lies_where_the_plate_mirrors_the_light():
    camera = Camera("pinhole", SIZE, (100, 100), (79.5, 59.5))
    sensor, appearance = (
        plate_sensor(camera, [(-9.0, -5, 20)]),
        {"lights": [(6.0, 2.0, 0.0)], "exposure": 0.3, "vignetting": 0, "blur": 0},
    )
    mat, shiny = (
        render(sensor, sensor.membrane.rest, appearance=Appearance(highlight=h, **appearance), samples=1) for h in (0.0, 1.0)
    )
    v, u = divmod(int((shiny - mat).argmax()), SIZE[0])
    assert abs(u - (79.5 + 15)) <= 1 and abs(v - (59.5 + 5)) <= 1  # half way to the light: (3, 1, 20)


def test_painting_moves_with_the_material():
    """A plate shifted by six pixels: dots and grains alike, at every pixel."""
    camera = Camera("pinhole", SIZE, (100, 100), (79.5, 59.5))
    sensor = plate_sensor(camera, [(0.0, 0, 20), (5.0, 3, 20)])
    shifted = sensor.membrane.rest + torch.tensor([1.2, -0.8, 0.0])
    for pattern in (Dots.from_sensor(sensor, (1.0, 1.0)), Speckle(1.0, seed=3)):
        rest, moved = Renderer(sensor, pattern=pattern, appearance=PLAIN)(torch.stack([sensor.membrane.rest, shifted]))
        assert rest[20:100, 20:140].std() > 0.05
        torch.testing.assert_close(moved[16:96, 26:146], rest[20:100, 20:140], atol=0.02, rtol=0)


def test_missing_dots_are_not_painted_and_the_others_stay():
    sensor = cap_sensor(CAMERAS["fisheye"])
    x = sensor.membrane.rest
    full, without = (
        Renderer(sensor, appearance=PLAIN)(x),
        Renderer(sensor, pattern=pattern_of(sensor, missing=[1]), appearance=PLAIN)(x),
    )
    u, v = Renderer(sensor).dots(x).pixels[1].round().long()
    assert full[v, u] == pytest.approx(0.12, abs=1e-3) and without[v, u] == pytest.approx(1.0, abs=1e-3)
    changed = torch.nonzero(full != without)
    assert 0 < len(changed) and (changed - torch.stack([v, u])).abs().max() < 8


def test_light_dots_on_dark_ground():
    sensor = plate_sensor(CAMERAS["fisheye"])
    light = replace(sensor, markers=replace(sensor.markers, polarity="light"))
    image = render(light, light.membrane.rest, appearance=PLAIN)
    assert image[61, 79] == pytest.approx(1.0, abs=1e-3) and image[30, 30] == pytest.approx(0.2, abs=1e-3)


def test_a_dot_behind_a_ridge_is_hidden():
    """Against rays marched through the height field in closed form."""
    camera = Camera("pinhole", SIZE, (100, 100), (79.5, 59.5))
    x = np.arange(-12.0, 13.0, 1.5)
    sensor = plate_sensor(camera, np.stack([x, 0 * x, 0 * x + 20], -1))

    def height(xy):
        return 20 - 9 * np.exp(-((xy - 5) ** 2) / 3)

    renderer = Renderer(sensor, (41, 41), Dots.from_sensor(sensor, (0.3, 0.3)))
    X = renderer.coarse_rest.clone()
    X[:, 2] = torch.from_numpy(height(X[:, 0].numpy()))
    share = np.linspace(0.3, 0.98, 200)[:, None]
    hidden = (share * height(x) > height(share * x)).any(0)
    assert 0 < hidden.sum() < 5
    seen = renderer.dots(X)
    assert seen.visible.tolist() == (~hidden).tolist()
    out = renderer.dots(X + torch.tensor([8.0, 0, 0])).visible
    assert not out[-1] and out[0]  # the last one has left the image


def test_grains_are_the_same_for_a_seed_and_band_limited():
    sensor = plate_sensor(CAMERAS["fisheye"])
    one, again, other = (
        render(sensor, sensor.membrane.rest, pattern=Speckle(1.0, seed), appearance=PLAIN, samples=1) for seed in (1, 1, 2)
    )
    assert torch.equal(one, again) and (one - other).abs().max() > 0.3
    patch = one[30:94, 40:104] - one[30:94, 40:104].mean()
    power = torch.fft.fft2(patch * torch.hann_window(64)[:, None] * torch.hann_window(64)).abs().square()
    frequency = torch.fft.fftfreq(64)
    high = (frequency[:, None] ** 2 + frequency**2).sqrt() > 0.35
    assert power[high].sum() < 0.01 * power.sum()


def test_a_painted_rest_image_is_seen_again_at_rest():
    camera = CAMERAS["pinhole"]
    appearance = Appearance(blur=0.0)
    plain = cap_sensor(camera)
    image = render(plain, plain.membrane.rest, pattern=Speckle(0.8), appearance=appearance)
    sensor = cap_sensor(camera, "texture", image.numpy())
    assert isinstance(pattern_of(sensor), Painted)
    inside = render(plain, plain.membrane.rest, pattern=Dots.from_sensor(plain, missing=range(5)), appearance=appearance) > 0.4
    assert inside.float().mean() > 0.15
    again = render(sensor, sensor.membrane.rest, appearance=appearance)
    assert (again - image)[inside].square().mean().sqrt() < 0.25 * image[inside].std()


def test_a_batch_gives_what_single_frames_give():
    sensor = cap_sensor(CAMERAS["fisheye port"])
    renderer = Renderer(sensor, samples=2)
    batch = torch.stack([sensor.membrane.rest, dented(sensor.membrane.rest)])[:, None]
    images, dots = renderer(batch), renderer.dots(batch)
    assert images.shape == (2, 1, 120, 160) and dots.visible.shape == (2, 1, 5)
    for i in range(2):
        torch.testing.assert_close(images[i, 0], renderer(batch[i, 0]), atol=1e-5, rtol=0)
        torch.testing.assert_close(dots.pixels[i, 0], renderer.dots(batch[i, 0]).pixels)
    assert (images[0] - images[1]).abs().max() > 0.1


def test_blur_keeps_the_light_and_has_its_width():
    spot = torch.zeros(41, 41)
    spot[20, 20] = 1
    image, step = blurred(spot, 1.7), torch.arange(-20.0, 21)
    assert image.sum() == pytest.approx(1, abs=1e-5)
    assert (image.sum(0) * step**2).sum().sqrt() == pytest.approx(1.7, rel=0.01)


def test_noise_has_the_level_asked_for():
    grey = torch.full((200, 200), 0.5)
    grain = noisy(grey, 30.0, np.random.default_rng(0)) - grey
    assert grain.std() == pytest.approx(10**-1.5, rel=0.02) and abs(grain.mean()) < 1e-3
    assert torch.equal(noisy(grey, None, np.random.default_rng(0)), grey)


@pytest.mark.parametrize("end", [0.0, 1.0])
def test_noise_leaves_no_grey_beyond_black_and_white(end):
    """There half of the noise is cut off: of the other half the mean is its deviation over the root of two pi."""
    image = noisy(torch.full((200, 200), end), 30.0, np.random.default_rng(0))
    assert image.min() >= 0 and image.max() <= 1
    assert (image - end).abs().mean().item() == pytest.approx(10**-1.5 / (2 * np.pi) ** 0.5, rel=0.02)


def test_wrong_arguments_are_refused():
    sensor = plate_sensor(CAMERAS["pinhole"])
    away = plate_sensor(Camera("pinhole", SIZE, (100, 100), (1e4, 0)))
    for call, expected in (
        (lambda: Renderer(sensor)(torch.zeros(7, 3)), "vertices [7, 3]"),
        (lambda: Renderer(away), "in the image"),
        (lambda: Dots.from_sensor(sensor, missing=[4]), "missing"),
        (lambda: Dots.from_sensor(sensor, (0.0, 0.0)), "radii"),
        (lambda: Dots([[0, 0, 1]], [1], ground=0.0), "ground"),
        (lambda: Speckle(0.0), "size"),
        (lambda: Appearance(vignetting=2.0), "vignetting"),
        (lambda: pattern_of(cap_sensor(CAMERAS["pinhole"], "texture", np.zeros((120, 160))), missing=[0]), "no dots"),
    ):
        with pytest.raises(MembraneError, match=expected.replace("[", r"\[")):
            call()
