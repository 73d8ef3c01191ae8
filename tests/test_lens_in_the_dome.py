"""A fisheye of more than 180 degrees can stand inside the dome."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmembrane.accuracy import presses
from torchmembrane.camera.model import Camera
from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.presets.draft import RimCircle, focal_of_view
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator, solid_angle

RADIUS = 12.0
FISHEYE = ("fisheye", (320, 320), (75.0, 75.0), (159.5, 159.5))


def sensor_at(base_z, lens=FISHEYE, distortion=(), grid=(17, 17)):
    """Half a sphere with 49 dots, its rim at `base_z`."""
    surface = Surface("spherical_cap", {"rim_radius": RADIUS, "height": RADIUS, "base_z": base_z})
    rings = [(angle, 2 * math.pi * k / 16) for angle in (0.4, 0.8, 1.2) for k in range(16)]
    dots = [(0.0, 0.0), *rings]
    x = [[math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)] for a, b in dots]
    camera, markers = Camera(*lens, distortion), Markers("dots", "dark", RADIUS * np.array(x) + [0, 0, base_z])
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.5)
    return Sensor("dome", "mm", camera, surface.membrane(grid), material, Cavity("liquid"), markers, surface)


@pytest.mark.parametrize("distortion", [(), (-0.012, 0.002)], ids=["plain", "distorted"])
@pytest.mark.parametrize("base_z", [4.0, 0.0, -2.0, -6.0, -9.0])
def test_images_are_what_rays_meet(base_z, distortion):
    """Depth along the axis of every pixel, against the sphere that its ray leaves: also behind the camera."""
    sensor = sensor_at(base_z, distortion=distortion)
    image = Renderer(sensor, samples=1).depth(sensor.membrane.rest[None])[0].double()
    v, u = torch.meshgrid(*[torch.arange(320.0, dtype=torch.float64)] * 2, indexing="ij")
    ray = sensor.camera.pixel_to_ray(torch.stack([u, v], -1)).direction
    along = ray[..., 2] * base_z  # the sphere's centre is on the axis
    depth = ray[..., 2] * (along + (along**2 - base_z**2 + RADIUS**2).sqrt())
    seen = depth > base_z
    both = seen & image.isfinite()
    assert (seen != image.isfinite()).double().mean() < 0.01  # along the rim alone
    assert (image - depth)[both].abs().max() < 0.15
    assert (float(depth[both].min()) < 0) == (base_z < 0)


def test_a_press_near_the_pole_and_one_at_the_side_are_simulated_and_reconstructed():
    sensor = sensor_at(-2.0)
    simulator = Simulator(sensor)
    made = replace(sensor, markers=replace(sensor.markers, rest_image=simulator.rest_image()))
    reconstructor = Reconstructor(made)
    for travel, aim in (([0.0, 0.0, -1.0], [0.0, 0.0, 0.0]), ([-0.8, 0.0, -0.6], [0.0, 0.0, -2.0])):
        stroke = stroke_to(simulator, Sphere(4.0), np.array(aim), np.array(travel), 1.5)
        (press,) = simulator.presses(stroke, ["push"])
        frame = simulator.frame(press, stroke, np.random.default_rng(0))
        found = reconstructor(frame.image)
        assert int(found.status) == 0 and frame.truth["visible_deformed"].all()
        assert np.abs(found.pixels[0].numpy() - frame.truth["uv_deformed"]).max() < 0.5
        assert (found.force[0].double() - press.force).norm() < 0.2 * press.force.norm()


def test_the_spec_sheet_s_presses_are_followed():
    simulator = Simulator(sensor_at(-2.0, grid=(9, 9)))
    assert presses.in_view(simulator).all()
    states = presses.stroke_states(simulator, 0, 3, 0.0, 0)
    assert len(states) == 3 and states[0].vertices[:, 2].min() == -2.0


def taken(sensor, move):
    """Whether the membrane is before the camera no more, moved from its rim."""
    simulator = Simulator(sensor)
    rest = simulator.membrane.rest
    free = ~simulator.membrane.fixed[:, None]
    return simulator.leaves_camera(torch.where(free, move(rest), rest))


PINHOLE = ("pinhole", (80, 80), (30.0, 30.0), (39.5, 39.5))
SMALL = ("fisheye", (80, 80), (18.75, 18.75), (39.5, 39.5))
DEEP = {
    "fisheye within, at rest": (-2.0, SMALL, lambda x: x, False),
    "fisheye within, pushed near": (-2.0, SMALL, lambda x: x * torch.tensor([1, 1, 0.1]), False),
    "fisheye within, sideways behind": (-2.0, SMALL, lambda x: x - torch.tensor([0, 0, 1.5]), False),
    "fisheye within, pushed over it": (-2.0, SMALL, lambda x: x - torch.tensor([0, 0, 14.0]), True),
    "fisheye before, pushed over it": (4.0, SMALL, lambda x: x - torch.tensor([0, 0, 20.0]), True),
    "fisheye before, pushed near": (4.0, SMALL, lambda x: x - torch.tensor([0, 0, 10.0]), False),
    "pinhole, pushed near": (4.0, PINHOLE, lambda x: x - torch.tensor([0, 0, 3.9]), False),
    "pinhole, pushed behind": (4.0, PINHOLE, lambda x: x - torch.tensor([0, 0, 5.0]), True),
}


@pytest.mark.parametrize("base_z, lens, move, expected", DEEP.values(), ids=DEEP)
def test_a_press_may_go_as_deep_as_the_lens_sees(base_z, lens, move, expected):
    assert taken(sensor_at(base_z, lens, grid=(9, 9)), move) == expected


def test_a_press_ends_at_the_port():
    sensor = sensor_at(6.0, PINHOLE, grid=(9, 9))
    sensor = replace(sensor, camera=Camera(*PINHOLE, ports=[(2.0, 2.0, 1.49)], medium_index=1.33))
    assert not taken(sensor, lambda x: x - torch.tensor([0, 0, 1.9]))
    assert taken(sensor, lambda x: x - torch.tensor([0, 0, 2.5]))


@pytest.mark.parametrize("base_z", [5.0, 0.0, -5.0, -11.0])
def test_the_solid_angle_is_that_of_the_rim_s_cone(base_z):
    membrane = sensor_at(base_z, grid=(25, 25)).membrane
    rim = math.atan2(RADIUS, base_z)
    assert solid_angle(membrane.rest[membrane.triangles]) == pytest.approx(2 * math.pi * (1 - math.cos(rim)), rel=0.01)


def test_light_comes_from_within_the_membrane_however_near_its_pole_the_camera_is():
    sensor = sensor_at(-11.5)
    lights = Renderer(sensor, samples=1).lights
    assert (lights.norm(dim=-1) < (sensor.membrane.rest.norm(dim=-1)).min()).all()


DISTANCES = [2.0, 0.0, -2.0, -11.0]


@pytest.mark.parametrize("distance", DISTANCES)
def test_a_fisheye_within_the_membrane_is_drafted(distance, tmp_path):
    path = tmp_path / "a.toml"
    numbers = ["--shape", "dome", "--radius", "12", "--distance", str(distance), "--image-size", "480,480"]
    assert main(["init", str(path), *numbers, "--lens", "fisheye", "--focal", "95"]) == 0
    sensor = Sensor.from_file(path)
    assert sensor.surface.values["base_z"] == distance
    assert sensor.camera(torch.from_numpy(sensor.markers.positions)).isfinite().all()


@pytest.mark.parametrize(
    "options, said",
    [
        ("--distance -2 --focal 300", "--distance -2: the rim behind a pinhole"),
        ("--distance 0 --view 100", "--distance 0: the rim behind a pinhole"),
        ("--distance -13 --focal 125 --lens fisheye", "the grid lies behind the camera"),
        ("--distance -2 --view 400 --lens fisheye", "field of view 400 degrees; expected at most 360"),
        ("--distance inf --focal 125 --lens fisheye", "expected a number from -1e+06 to 1e+06"),
    ],
)
def test_what_no_lens_sees_is_not_drafted(options, said, tmp_path, capsys):
    call = ["init", str(tmp_path / "a.toml"), "--shape", "dome", "--radius", "12", "--image-size", "480,480", *options.split()]
    try:
        assert main(call) == 2
    except SystemExit as error:
        assert error.code == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("distance", [20.0, 1.0, 0.0, -1.0, -20.0])
def test_a_rim_s_circle_gives_the_distance_behind_the_lens_too(distance):
    pixels = 125.0 * math.atan2(RADIUS, distance)
    circle = RimCircle(RADIUS, pixels, "fisheye")
    assert circle.distance(125.0) == pytest.approx(distance, abs=1e-8) and circle.focal(distance) == pytest.approx(125.0)


def test_a_rim_behind_what_a_fisheye_can_see_is_refused():
    with pytest.raises(MembraneError, match="200 degrees from the axis; expected less than 180"):
        RimCircle(RADIUS, 125.0 * math.radians(200), "fisheye").distance(125.0)
    assert focal_of_view("fisheye", 360, 360.0) == pytest.approx(180 / math.pi)
