"""Projection inverts rays; refraction obeys Snell and Fermat."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize, minimize_scalar
from torch.func import functional_call

from torchmembrane.camera.distortion import distort
from torchmembrane.camera.folds import fold_in_image, refuse_folds
from torchmembrane.camera.model import Camera
from torchmembrane.errors import MembraneError

PORTS = {"air": [], "port": [(2.0, 3.0, 1.49)], "stack": [(2.0, 1.0, 1.49), (3.5, 0.5, 1.52), (4.0, 1.0, 1.4)]}
LENSES = {
    "pinhole": ("pinhole", (400.0, 404.0), ()),
    "pinhole k1": ("pinhole", (400.0, 404.0), (-0.2,)),
    "pinhole k1-k3": ("pinhole", (400.0, 404.0), (-0.3, 0.1, 1e-3, -2e-3, -0.01)),
    "pinhole k1-k6": ("pinhole", (400.0, 404.0), (3.6, 2.6, 1e-3, -2e-3, 0.13, 3.9, 4.2, 0.74)),
    "fisheye": ("fisheye", (170.0, 172.0), ()),
    "fisheye k1-k4": ("fisheye", (170.0, 172.0), (-0.02, 0.004, -0.003, 0.0005)),
}


def camera_of(lens, behind="air", **changes):
    model, focal, distortion = LENSES[lens]
    arguments = dict(model=model, image_size=(640, 480), focal=focal, centre=(320.3, 238.8), distortion=distortion)
    return Camera(**arguments | dict(ports=PORTS[behind], medium_index=1.33) | changes)


def assert_close(actual, expected, tolerance):
    assert torch.isfinite(actual).all()
    assert (actual - expected).abs().max() < tolerance


@pytest.fixture(params=LENSES)
def lens(request):
    return request.param


@pytest.fixture(params=PORTS)
def ports(request):
    return request.param


def pixels_near(batch, spread=200.0):
    generator = torch.Generator().manual_seed(0)
    centre = torch.tensor([320.3, 238.8], dtype=torch.float64)
    return centre + spread * (2 * torch.rand(*batch, 2, generator=generator, dtype=torch.float64) - 1)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (400,)])
def test_pixel_to_ray_to_point_and_back(lens, ports, batch):
    camera, pixels = camera_of(lens, ports), pixels_near(batch, 150.0)
    rays = camera.pixel_to_ray(pixels)
    assert rays.origin.shape == rays.direction.shape == (*batch, 3)
    assert_close(rays.direction.norm(dim=-1), 1.0, 1e-14)
    assert_close(rays.origin[..., :2], 0.0, 1e-300)
    for t in (30.0, 80.0):
        assert_close(camera.point_to_pixel(rays.origin + t * rays.direction), pixels, 1e-9)


def test_point_lies_on_the_ray_of_its_pixel(lens, ports):
    camera = camera_of(lens, ports)
    generator = torch.Generator().manual_seed(1)
    points = torch.tensor([12.0, 9.0, 14.0]) * (torch.rand(300, 3, generator=generator, dtype=torch.float64) - 0.5)
    points[:, 2] += 15.0
    rays = camera.pixel_to_ray(camera.point_to_pixel(points))
    offset = points - rays.origin
    t = (offset * rays.direction).sum(-1, keepdim=True)
    assert (t > 0).all()
    assert_close(offset, t * rays.direction, 1e-10)


def test_pinhole_distortion_is_opencvs():
    camera = camera_of("pinhole k1-k3")
    x, y, z = 4.0, -3.0, 11.0
    k1, k2, p1, p2, k3 = LENSES["pinhole k1-k3"][2]
    a, b = x / z, y / z
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 400.0 * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)) + 320.3
    v = 404.0 * (b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b) + 238.8
    assert np.allclose(camera.point_to_pixel(torch.tensor([x, y, z], dtype=torch.float64)).numpy(), [u, v], atol=1e-10)


RATIONAL = {
    "wide": (3.6, 2.6, 1e-3, -2e-3, 0.13, 3.9, 4.2, 0.74),
    "strong": (10.2, 5.1, 1e-4, 2e-4, 0.2, 10.6, 8.6, 1.2),
    "mild": (-0.2, 0.05, 1e-3, -1e-3, 0.01, 0.15, 0.03, 0.002),
    "no divisor": (-0.2, 0.05, 1e-3, -1e-3, 0.01, 0.0, 0.0, 0.0),
    "divisor alone": (0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0),
}


@pytest.mark.parametrize("distortion", RATIONAL.values(), ids=RATIONAL)
def test_eight_coefficients_are_opencvs_rational_model(distortion):
    cv2 = pytest.importorskip("cv2")
    camera = Camera("pinhole", (640, 480), (300.0, 303.0), (320.3, 238.8), distortion)
    points = torch.from_numpy(np.random.default_rng(0).uniform([-20, -15, 12], [20, 15, 30], (500, 3)))
    K = np.array([[300.0, 0, 320.3], [0, 303.0, 238.8], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), K, np.array(distortion))
    pixels = camera.point_to_pixel(points)
    assert_close(pixels, torch.from_numpy(expected[:, 0]), 1e-9)
    assert_close(camera.pixel_to_ray(pixels).direction, points / points.norm(dim=-1, keepdim=True), 1e-9)


@pytest.mark.parametrize("count", [12, 14])
def test_opencvs_longer_vectors_are_the_eight_where_the_others_are_zero(count):
    eight = RATIONAL["mild"]
    longer = camera_of("pinhole", distortion=[*eight, *[0.0] * (count - 8)])
    assert longer.distortion.tolist() == list(eight)


def test_the_divisor_s_zero_is_a_fold():
    """1 - 0.5 r^2 is zero at r = 1.414: the image runs away before, and comes back from the other side behind it."""
    camera = camera_of("pinhole", distortion=(0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0), centre=(0.0, 0.0), focal=(1.0, 1.0))
    points = torch.tensor([[1.0, 0.0, 1.0], [1.38, 0.0, 1.0], [1.43, 0.0, 1.0], [3.0, 0.0, 1.0]], dtype=torch.float64)
    pixels = camera.point_to_pixel(points)
    assert pixels.isnan().all(-1).tolist() == [False, False, True, True]
    near = camera.point_to_pixel(torch.tensor([0.5, 0.0, 1.0], dtype=torch.float64))
    assert_close(near[0], 0.5 / 0.875, 1e-12)
    assert_close(camera.pixel_to_ray(near).direction[0], math.sin(math.atan(0.5)), 1e-9)


FOLDS = {
    "pinhole k1": ("pinhole", [-0.5], (2 / 3) * (2 / 3) ** 0.5),
    "pinhole, as reported": ("pinhole", [-5.0, 2.0, -1.0, 3.0], None),
    "pinhole k3": ("pinhole", [0.0, 0.0, 0.0, 0.0, -3.0], (6 / 7) * (1 / 21) ** (1 / 6)),
    "pinhole, tangential": ("pinhole", [0.0, 0.0, 0.9, 0.0], None),
    "pinhole, divisor": ("pinhole", [0.0, 0.0, 0.0, 0.0, 0.0, 1.5, 0.0, 0.0], 0.5 / 1.5**0.5),
    "fisheye k1": ("fisheye", [-0.5], (2 / 3) * (2 / 3) ** 0.5),
    "fisheye, as reported": ("fisheye", [-5.0, 2.0, -1.0, 3.0], None),
    "fisheye k4": ("fisheye", [0.0, 0.0, 0.0, -1.0], (8 / 9) * (1 / 9) ** (1 / 8)),
}


@pytest.mark.parametrize("model, distortion, radius", FOLDS.values(), ids=FOLDS)
def test_a_fold_within_the_image_is_found_where_it_is(model, distortion, radius):
    """By the closed form of the radius at which `r (1 + k r^(2n))`, or `r / (1 + k r^2)`, turns."""
    camera = Camera(model, (640, 480), (300.0, 300.0), (320.0, 240.0), distortion)
    found = fold_in_image(camera)
    assert found == pytest.approx(300 * radius, abs=3) if radius else 0 < found < 200
    with pytest.raises(MembraneError, match=rf"folds back {found:.0f} px from the centre, within the image"):
        refuse_folds(camera, torch.tensor([[0.0, 0.0, 9.0]]))


@pytest.mark.parametrize(
    "model, distortion",
    [
        ("pinhole", []),
        ("pinhole", [-0.28, 0.07]),
        ("pinhole", [-0.2, 0.1, 1e-3, 1e-3]),
        ("pinhole", RATIONAL["wide"]),
        ("pinhole", RATIONAL["mild"]),
        ("fisheye", []),
        ("fisheye", [0.0034, 0.0007, -0.002, 0.0002]),
        ("fisheye", [-0.012, 0.002]),
    ],
)
def test_lenses_that_do_not_fold_in_the_image_are_taken(model, distortion):
    camera = Camera(model, (640, 480), (300.0, 300.0), (320.0, 240.0), distortion)
    assert fold_in_image(camera) == math.inf
    refuse_folds(camera, torch.tensor([[0.0, 0.0, 9.0]]))


def test_a_fisheye_may_fold_beyond_its_circle_where_it_shows_all_of_the_membrane():
    camera = Camera("fisheye", (640, 480), (160.0, 160.0), (320.0, 240.0), [-0.06, 0.0, 0.0, 0.0])
    assert 240 < fold_in_image(camera) < 320
    refuse_folds(camera, torch.tensor([[5.0, 0.0, 1.0]], dtype=torch.float64))
    with pytest.raises(MembraneError, match="within the image"):
        refuse_folds(camera, torch.tensor([[3.0, 0.0, -5.0]], dtype=torch.float64))


@pytest.mark.parametrize("centre", [(320.0, 240.0), (320.0, 300.0), (420.0, 240.0)])
def test_a_fisheye_s_circle_is_the_largest_about_its_centre_that_fits_into_the_image(centre):
    """It may fold beyond that, not before: of a centre off the middle the circle ends at the nearer border."""
    u, v = centre
    reach = min(u, v, 639 - u, 479 - v)
    points = torch.tensor([[1.0, 0.0, 5.0]], dtype=torch.float64)
    for share, fits in ((0.9, False), (1.15, True)):
        focal = share * reach / (2 / 3 * 5.0**0.5)  # of t - t^3 / 15 the largest value, at t = root of 5
        camera = Camera("fisheye", (640, 480), (focal, focal), centre, [-1 / 15, 0.0, 0.0, 0.0])
        assert fold_in_image(camera) == pytest.approx(share * reach, abs=2)
        if fits:
            refuse_folds(camera, points)
        else:
            with pytest.raises(MembraneError, match="within the image"):
                refuse_folds(camera, points)


def test_a_fold_that_is_cropped_away_is_none():
    camera = Camera("pinhole", (640, 480), (400.0, 400.0), (320.0, 240.0), [-0.3])
    assert fold_in_image(camera) < math.inf
    assert fold_in_image(camera.in_mode((160, 120, 320, 240))) == math.inf


def test_eight_coefficients_are_written_as_onnx():
    """The lens by itself, in batches, as the runtime of exported models computes it."""
    from onnxruntime import InferenceSession

    from torchmembrane.onnx.export import Piece
    from torchmembrane.onnx.trace import traced_model

    camera = camera_of("pinhole k1-k6").float()

    class Lens(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.camera = camera

        def ray(self, pixels):
            return self.camera.pixel_to_ray(pixels).direction

    pixels = pixels_near((3, 50), 230.0).float()
    model = traced_model(Piece(Lens(), Lens.ray), {"pixels": pixels}, ["direction"])
    (found,) = InferenceSession(model.SerializeToString()).run(["direction"], {"pixels": pixels.numpy()})
    assert_close(torch.from_numpy(found), camera.pixel_to_ray(pixels).direction, 1e-5)
    assert "Loop" not in {node.op_type for node in model.graph.node}


def test_what_a_lens_can_image():
    points = torch.tensor([[0.0, 0.0, 9.0], [9.0, 0.0, 0.0], [9.0, 0.0, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    lenses = [(model, behind) for model in ("pinhole", "fisheye") for behind in ("air", "port")]
    can = {lens: camera_of(*lens).can_image(points).tolist() for lens in lenses}
    assert can["pinhole", "air"] == [True, False, False, False, True]
    assert can["fisheye", "air"] == [True, True, True, False, True]
    assert can["pinhole", "port"] == can["fisheye", "port"] == [True, False, False, False, False]


def test_derivative_of_the_distortion_is_its_derivative():
    """Newton converges with a slightly wrong one too, only slower."""
    k1, k2, p1, p2, k3 = torch.tensor(LENSES["pinhole k1-k3"][2], dtype=torch.float64)
    xy = torch.tensor([0.4, -0.3], dtype=torch.float64)
    _, a, b, c = distort(xy, [k1, k2, k3], p1, p2)
    jacobian = torch.func.jacrev(lambda xy: distort(xy, [k1, k2, k3], p1, p2)[0])(xy)
    assert_close(torch.stack([a, b, b, c]).reshape(2, 2), jacobian, 1e-14)


@pytest.mark.parametrize("z", [5.0, 0.0, -2.0])
def test_fisheye_distortion_is_opencvs_also_behind_the_image_plane(z):
    x, y = 4.0, -3.0
    theta = np.arctan2(5.0, z)
    k1, k2, k3, k4 = LENSES["fisheye k1-k4"][2]
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    expected = [170.0 * theta_d * 0.8 + 320.3, -172.0 * theta_d * 0.6 + 238.8]
    camera, point = camera_of("fisheye k1-k4"), torch.tensor([x, y, z], dtype=torch.float64)
    assert np.allclose(camera.point_to_pixel(point).numpy(), expected, atol=1e-10)
    direction = camera.pixel_to_ray(torch.tensor(expected, dtype=torch.float64)).direction
    assert_close(direction, point / point.norm(), 1e-12)


def test_a_shorter_distortion_is_padded_with_zeros(lens):
    model, _, distortion = LENSES[lens]
    if distortion:
        count = 4 if model == "fisheye" else 8 if len(distortion) > 5 else 5
        longer = camera_of(lens, distortion=[*distortion, 0.0, 0.0, 0.0, 0.0][:count])
        assert torch.equal(longer.distortion, camera_of(lens).distortion)


def test_apparent_depth_of_water_near_the_axis():
    """From h above water of index n, a point at depth d seems to lie at h + d / n."""
    film, n, h, d = (1e-9, 1.0), 1.33, 3.0, 10.0
    camera = Camera("pinhole", (640, 480), (400, 400), (320, 240), ports=[(h - film[0], *film)], medium_index=n)
    pixel = camera.point_to_pixel(torch.tensor([1e-4, 0.0, h + d], dtype=torch.float64))
    assert abs((pixel[0].item() - 320) / (400 * 1e-4 / (h + d / n)) - 1) < 1e-8
    rays = camera.pixel_to_ray(torch.tensor([320.0, 240.0], dtype=torch.float64))
    assert abs(rays.origin[2].item() - (h - n * h)) < 1e-8  # from below, the eye seems to be n times as far away


@pytest.mark.parametrize("rho", [0.5, 6.0, 25.0])
def test_light_takes_the_fastest_way_through_one_surface(rho):
    h, d, n = 3.0, 10.0, 1.33

    def optical_path(crossing):
        return math.hypot(crossing, h) + n * math.hypot(rho - crossing, d)

    crossing = minimize_scalar(optical_path, bounds=(0, rho), method="bounded", options={"xatol": 1e-12}).x
    camera = Camera("pinhole", (640, 480), (400, 400), (0, 0), ports=[(h - 1e-9, 1e-9, 1.0)], medium_index=n)
    pixel = camera.point_to_pixel(torch.tensor([0.6 * rho, 0.8 * rho, h + d], dtype=torch.float64))
    expected = 400 * crossing / h * torch.tensor([0.6, 0.8], dtype=torch.float64)
    assert_close(pixel, expected, 1e-4)  # the minimiser's accuracy: the square root of rounding


@pytest.mark.parametrize("name", ["port", "stack"])
def test_light_takes_the_fastest_way_through_all_layers(name):
    faces, index, z = [0.0], [], 17.0
    for distance, thickness, n in PORTS[name]:
        faces += [distance, distance + thickness]
        index += [1.0, n]
    heights, index, rho = np.diff([*faces, z]), np.array([*index, 1.33]), 9.0
    heights, index = heights[heights > 0], index[heights > 0]

    def optical_path_and_gradient(crossings):
        steps = np.diff([0.0, *crossings, rho])
        lengths = np.hypot(heights, steps)
        return index @ lengths, -np.diff(index * steps / lengths)

    start = rho * np.cumsum(heights)[:-1] / z
    crossings = minimize(optical_path_and_gradient, start, jac=True, options={"gtol": 1e-12}).x
    camera = camera_of("pinhole", name, focal=(400.0, 400.0), centre=(0.0, 0.0))
    pixel = camera.point_to_pixel(torch.tensor([0.0, rho, z], dtype=torch.float64))
    fastest = torch.tensor([0.0, 400 * crossings[0] / heights[0]], dtype=torch.float64)
    assert_close(pixel, fastest, 1e-6)
    ray = camera.pixel_to_ray(fastest)
    for depth, crossing in ((faces[-1], crossings[-1]), (z, rho)):  # where it leaves the last layer, and the point itself
        t = (depth - ray.origin[2]) / ray.direction[2]
        expected = torch.tensor([0.0, crossing, depth], dtype=torch.float64)
        assert_close(ray.origin + t * ray.direction, expected, 1e-6)


@pytest.mark.parametrize("name", ["port", "stack"])
def test_the_optical_length_is_stationary_along_the_ray_of_a_pixel(lens, name):
    """Fermat at the last face: the optical length from the lens to a point of the ray by way of where the ray crosses it.

    What lies before the face is the way of least time from the lens to the crossing, found by a minimiser of its own.
    """
    camera, far = camera_of(lens, name), sum(PORTS[name][-1][:2])
    faces, index = [0.0], []
    for distance, thickness, n in PORTS[name]:
        faces += [distance, distance + thickness]
        index += [1.0, n]
    heights, index = np.diff(faces), np.array(index)
    heights, index = heights[heights > 0], index[heights > 0]

    def to_face(rho):
        def optical_path_and_gradient(crossings):
            steps = np.diff([0.0, *crossings, rho])
            lengths = np.hypot(heights, steps)
            return index @ lengths, -np.diff(index * steps / lengths)

        start = rho * np.cumsum(heights)[:-1] / far
        return minimize(optical_path_and_gradient, start, jac=True, options={"gtol": 1e-12}).fun

    for pixel in pixels_near((3,), 150.0):
        origin, direction = (a.numpy() for a in camera.pixel_to_ray(pixel))
        crossing = origin + (far - origin[2]) / direction[2] * direction
        point, radius, h = crossing + 7.0 * direction, np.hypot(*crossing[:2]), 1e-4
        outwards = np.array([*crossing[:2] / radius, 0.0])
        through = [to_face(radius + s) + 1.33 * np.linalg.norm(point - crossing - s * outwards) for s in (h, 0.0, -h)]
        assert abs(through[0] - through[2]) < 2e-6 * h and through[0] + through[2] > 2 * through[1]
        assert radius > 0.3 and abs(crossing[0] * direction[1] - crossing[1] * direction[0]) < 1e-12


def test_layers_of_air_do_nothing(lens):
    through_air = camera_of(lens, ports=[(2.0, 3.0, 1.0), (6.0, 1.0, 1.0)], medium_index=1.0)
    points = torch.tensor([[1.0, 2.0, 9.0], [-6.0, 3.0, 12.0], [0.0, 0.0, 8.0]], dtype=torch.float64)
    pixels = camera_of(lens).point_to_pixel(points)
    assert_close(through_air.point_to_pixel(points), pixels, 1e-10)
    assert_close(through_air.pixel_to_ray(pixels).origin, 0.0, 1e-12)


def test_a_stack_differs_from_air_and_a_medium_without_ports_does_not(lens):
    point = torch.tensor([4.0, 2.0, 12.0], dtype=torch.float64)
    pixel = camera_of(lens, medium_index=1.33).point_to_pixel(point)
    assert torch.equal(pixel, camera_of(lens, medium_index=1.0).point_to_pixel(point))
    assert (camera_of(lens, "stack").point_to_pixel(point) - pixel).norm() > 5


def test_values_and_gradients_are_continuous_across_the_axis(lens, ports):
    camera = camera_of(lens, ports)
    offsets = torch.tensor([0.0, 1e-300, 1e-20, 1e-16, 1e-12, 1e-9, 1e-6], dtype=torch.float64)
    points = torch.stack([offsets, offsets, torch.full_like(offsets, 12.0)], -1).requires_grad_()
    jacobian = torch.func.vmap(torch.func.jacrev(camera.point_to_pixel))(points)
    assert_close(jacobian, jacobian[-1:].expand_as(jacobian), 1e-3 if "k1-k3" in lens else 1e-4)
    pixels = camera.centre + offsets[:, None]
    jacobian = torch.func.vmap(torch.func.jacrev(lambda p: camera.pixel_to_ray(p).direction))(pixels)
    assert_close(jacobian, jacobian[-1:].expand_as(jacobian), 1e-7)
    assert_close(camera.pixel_to_ray(camera.centre).direction, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1e-15)
    assert_close(camera.point_to_pixel(torch.tensor([0.0, 0.0, 12.0]).double()), camera.centre, 1e-12)


def test_gradients_are_exact(lens, ports):
    camera = camera_of(lens, ports)
    points = torch.tensor([[3.0, -2.0, 11.0], [0.0, 0.0, 9.0], [-7.0, 1.0, 12.0]], dtype=torch.float64)
    pixels = camera.point_to_pixel(points).detach().requires_grad_()
    assert torch.autograd.gradcheck(camera.point_to_pixel, points.requires_grad_(), atol=1e-6)
    assert torch.autograd.gradcheck(camera.pixel_to_ray, pixels, atol=1e-6)


@pytest.mark.parametrize("ports", ["port", "stack"])
def test_second_derivatives_behind_ports_are_exact(ports):
    camera, point = camera_of("fisheye", ports), torch.tensor([3.0, -2.0, 11.0], dtype=torch.float64)
    assert torch.autograd.gradgradcheck(camera.point_to_pixel, point.requires_grad_(), atol=1e-6)


class RayPoint(torch.nn.Module):
    """The point at t = 20 on a pixel's ray, as a forward that functional_call can reach."""

    def __init__(self, camera):
        super().__init__()
        self.camera = camera

    def forward(self, pixels):
        origin, direction = self.camera.pixel_to_ray(pixels)
        return origin + 20 * direction


@pytest.mark.parametrize("lens", ["pinhole k1-k3", "pinhole k1-k6", "fisheye k1-k4"])
def test_gradients_reach_every_parameter(lens):
    camera = camera_of(lens, "stack")
    points = torch.tensor([[3.0, -2.0, 11.0], [-7.0, 1.0, 12.0]], dtype=torch.float64)
    pixels = camera.point_to_pixel(points)
    for module, prefix, argument in ((camera, "", points), (RayPoint(camera), "camera.", pixels)):
        for name, value in camera.named_buffers():

            def image(parameter, module=module, key=prefix + name, argument=argument):
                return functional_call(module, {key: parameter}, (argument,))

            value = value.clone().requires_grad_()
            assert torch.autograd.gradcheck(image, value, atol=1e-5)
            assert torch.autograd.grad(image(value).sum(), value)[0].abs().max() > 0


def test_gradient_of_focal_against_a_difference():
    camera, points = camera_of("fisheye k1-k4", "port"), torch.tensor([[3.0, -2.0, 11.0]], dtype=torch.float64)
    focal, h = camera.focal.clone().requires_grad_(), 1e-3
    functional_call(camera, {"focal": focal}, (points,))[0, 0].backward()
    sides = [functional_call(camera, {"focal": camera.focal + s}, (points,))[0, 0] for s in (h, -h)]
    assert_close(focal.grad[0], (sides[0] - sides[1]) / (2 * h), 1e-9)
    assert focal.grad[1] == 0


def test_float32_agrees_with_float64(lens, ports):
    exact, single = camera_of(lens, ports), camera_of(lens, ports).float()
    pixels = pixels_near((200,), 150.0).float()
    rays, coarse = exact.pixel_to_ray(pixels.double()), single.pixel_to_ray(pixels)
    assert coarse.direction.dtype == torch.float32
    assert_close(coarse.direction, rays.direction, 2e-6)
    assert_close(coarse.origin, rays.origin, 1e-5)
    points = rays.origin + 20 * rays.direction
    assert_close(single.point_to_pixel(points.float()), pixels, 1e-3)


def test_behind_the_camera_is_nan(ports):
    points = torch.tensor([[1.0, 1.0, -5.0], [0.0, 0.0, -5.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    for lens in ("pinhole", "pinhole k1-k3"):
        assert camera_of(lens, ports).point_to_pixel(points).isnan().all()
    visible = ~camera_of("fisheye", ports).point_to_pixel(points).isnan().all(-1)
    assert visible.tolist() == ([True, False, True, False] if ports == "air" else [False] * 4)


def test_before_the_last_far_face_is_nan():
    points = torch.tensor([[0.5, 0.0, 4.99], [0.5, 0.0, 5.01]], dtype=torch.float64)
    assert camera_of("pinhole", "port").point_to_pixel(points).isnan().all(-1).tolist() == [True, False]


def test_outside_the_fisheye_is_nan():
    camera = camera_of("fisheye", focal=(100.0, 100.0), centre=(0.0, 0.0))
    pixels = torch.tensor([[90.0, 0.0], [170.0, 0.0], [310.0, 0.0], [315.0, 0.0]], dtype=torch.float64)
    assert camera.pixel_to_ray(pixels).direction.isnan().all(-1).tolist() == [False, False, False, True]
    ported = camera_of("fisheye", "port", focal=(100.0, 100.0), centre=(0.0, 0.0))
    assert ported.pixel_to_ray(pixels).direction.isnan().all(-1).tolist() == [False, True, True, True]


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_where_the_distortion_folds_back_is_nan(model):
    """r (1 - 0.3 r^2) turns at r = 1.054 with the value 0.703; past it OpenCV answers with another point's pixel."""
    camera = Camera(model, (640, 480), (100, 100), (0, 0), (-0.3,))
    radius = torch.tensor([0.9, 1.03, 1.1, 1.8], dtype=torch.float64)
    angle = radius if model == "fisheye" else radius.atan()
    points = torch.stack([angle.sin(), 0 * angle, angle.cos()], -1)
    assert camera.point_to_pixel(points).isnan().all(-1).tolist() == [False, False, True, True]
    pixels = torch.tensor([[60.0, 0.0], [70.0, 0.0], [71.0, 0.0], [500.0, 0.0], [math.nan, 0.0]], dtype=torch.float64)
    direction = camera.pixel_to_ray(pixels).direction
    assert direction.isnan().any(-1).tolist() == [False, False, True, True, True]


def test_nan_stays_where_it_is_also_in_gradients(lens, ports):
    camera = camera_of(lens, ports)
    points = torch.tensor([[1.0, 1.0, -50.0], [0.0, 0.0, -3.0], [2.0, 1.0, 11.0]], dtype=torch.float64)
    pixels = torch.tensor([[1e7, 0.0], [320.3, 238.8], [200.0, 200.0]], dtype=torch.float64)
    for function, value in ((camera.point_to_pixel, points), (lambda p: camera.pixel_to_ray(p).direction, pixels)):
        value.requires_grad_()
        image = function(value)
        torch.where(image.isnan(), 0.0, image).sum().backward()
        assert torch.isfinite(value.grad).all()
        assert value.grad[2].abs().max() > 0


def test_paper_looks_at_the_inverted_image():
    """Eq. 1 has `u = -f x / z, v = -f y / z`: the image behind the lens, from which a pixel goes the other way."""
    points, camera = torch.tensor([[3.0, -2.0, 11.0]], dtype=torch.float64), camera_of("pinhole", focal=(400.0, 400.0))
    inverted = -400.0 * points[:, :2] / points[:, 2:]
    assert_close(camera.point_to_pixel(points), camera.centre - inverted, 1e-10)


def test_state_dict_carries_the_parameters(lens, ports):
    camera = camera_of(lens, ports)
    other = camera_of(lens, ports, focal=(1.0, 1.0), centre=(0.0, 0.0), medium_index=1.0)
    other.load_state_dict(camera.state_dict())
    point = torch.tensor([3.0, -2.0, 11.0], dtype=torch.float64)
    assert torch.equal(other.point_to_pixel(point), camera.point_to_pixel(point))
    assert [tuple(port) for port in camera.ports] == PORTS[ports]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"model": "orthographic"}, "model is 'orthographic'; expected 'pinhole'"),
        ({"image_size": (640,)}, "image_size is [640]; expected width and height"),
        ({"image_size": (640, 0)}, "image_size is [640, 0]"),
        ({"focal": (400.0,)}, "focal is [400.0]; expected two values"),
        ({"focal": (400.0, -400.0)}, "focal is [400.0, -400.0]; expected positive"),
        ({"centre": (1.0, math.nan)}, "centre is [1.0, nan]; expected finite"),
        ({"distortion": [0.1] * 6}, "at most k1 k2 p1 p2 k3"),
        ({"distortion": [0.1] * 7}, "at most k1 k2 p1 p2 k3, or these and k4 k5 k6"),
        ({"distortion": [0.1] * 9}, "at most k1 k2 p1 p2 k3, or these and k4 k5 k6"),
        ({"distortion": [0.0] * 11 + [1e-3]}, "thin prisms and tilt are not modelled"),
        ({"distortion": [0.0] * 12 + [0.0, 1e-3]}, "thin prisms and tilt are not modelled"),
        ({"distortion": [0.0] * 13}, "at most k1 k2 p1 p2 k3, or these and k4 k5 k6"),
        ({"model": "fisheye", "distortion": [0.1] * 8}, "at most k1 k2 k3 k4"),
        ({"model": "fisheye", "distortion": [0.1] * 5}, "at most k1 k2 k3 k4"),
        ({"distortion": [math.inf]}, "distortion is [inf]; expected finite"),
        ({"medium_index": 0.9}, "medium_index is 0.9; expected 1 (air) or more"),
        ({"medium_index": math.nan}, "medium_index is nan"),
        ({"ports": [(2.0, 3.0)]}, "ports[0] is [2.0, 3.0]; expected distance, thickness"),
        ({"ports": [(2.0, 0.0, 1.5)]}, "ports[0].thickness is 0.0"),
        ({"ports": [(2.0, 3.0, 0.9)]}, "ports[0].index is 0.9"),
        ({"ports": [(0.0, 3.0, 1.5)]}, "ports[0].distance is 0.0; expected more than 0"),
        (
            {"ports": [(2.0, 3.0, 1.5), (4.0, 1.0, 1.5)]},
            "ports[1].distance is 4.0; expected more than 0 and at least 5.0",
        ),
    ],
)
def test_constructor_refuses(changes, words):
    with pytest.raises(MembraneError) as caught:
        camera_of("pinhole", **changes)
    assert words in str(caught.value)
