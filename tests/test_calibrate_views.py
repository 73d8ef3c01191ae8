"""Each step of calibration takes a sensor with several views."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from test_calibrate import CHECKERS, DOTS, NOISE, poses
from test_view_poses import POSES, off
from test_views import CAMERA, MIRROR, cap

import torchmembrane as tm
from torchmembrane.calibrate.detection import find_target
from torchmembrane.calibrate.views import _station_of_view, with_dots_of_each_view
from torchmembrane.cli.calibrate.files import reversed_target
from torchmembrane.cli.main import main
from torchmembrane.pose import ViewPose
from torchmembrane.sensor.parts import Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Simulator
from torchmembrane.simulate.target_renderer import TargetRenderer

NEAR = ViewPose(np.array([0.4, -0.3, 0.4]), np.array([0.03, -0.1, 0.05]))
"""By which the file's poses are wrong: half a degree and 0.1 mm."""


@pytest.fixture(scope="module")
def true():
    return cap(*(View(name, CAMERA, pose) for name, pose in POSES.items()))


@pytest.fixture(scope="module")
def images(true):
    """Of a camera beside the first one and of a mirror, at rest, uint8."""
    simulator = Simulator(true)
    return simulator.images(simulator.membrane.rest, np.random.default_rng(0))


@pytest.fixture
def call(true, images, tmp_path, capsys):
    """Runs a step on the design, a cap 0.3 mm too flat and 0.2 mm too far away; gives exit code, words, sensor."""
    surface = Surface("spherical_cap", {"rim_radius": 8.0, "height": 3.7, "base_z": 14.2})
    x, y = true.markers.positions.T[:2]
    radius = (64 + 3.7**2) / (2 * 3.7)
    dots = np.stack([x, y, 17.9 - radius + np.sqrt(radius**2 - x**2 - y**2)], -1)
    views = (true.views[0], *(View(name, CAMERA, ViewPose.of_matrix(p.matrix @ NEAR.matrix)) for name, p in POSES.items()))
    design = replace(
        true, membrane=surface.membrane((9, 9)), surface=surface, markers=replace(true.markers, positions=dots), views=views
    )
    path = design.to_file(tmp_path / "design.toml")
    for view, image in zip(true.views, images, strict=True):
        Image.fromarray(image).save(tmp_path / f"rest_{view.name}.png")

    def step(name, *options):
        out = tmp_path / "out"
        code = main(["calibrate", name, str(path), *map(str, options), "--out", str(out), "--force"])
        written = capsys.readouterr()
        return code, written.out + written.err, Sensor.from_file(out / "sensor.toml") if code == 0 else None

    return step


def assert_found(sensor, true, turned=0.03, moved=0.02, dots=0.05):
    for view in sensor.views[1:]:
        angle, distance = off(view.pose, POSES[view.name])
        assert angle < turned and distance < moved, (view.name, angle, distance)
        assert view.pose.determinant == POSES[view.name].determinant and view.rest_image is not None
    away, partner = cKDTree(true.markers.positions).query(sensor.markers.positions)
    assert len(set(partner)) == len(true.markers.positions) == len(away) and away.max() < dots


def test_surface_dots_and_poses_from_one_image_of_each_view(call, true, tmp_path):
    code, said, sensor = call("views", tmp_path / "rest_left.png")
    assert code == 0 and "right.turn_x" in said and "mirror.place_z" in said and "from 3 views" in said
    assert_found(sensor, true)
    (tmp_path / "motions.csv").write_text("x,y,z,turn_x,turn_y,turn_z\n0,0,0,0,0,0\n")
    code, said, _ = call("views", tmp_path / "rest_left.png", "--motions", tmp_path / "motions.csv")
    assert code == 2 and "1 frames and --motions; expected one frame, an image of each view" in said


@pytest.mark.parametrize("number", [pytest.param(0, marks=pytest.mark.full), 2])
def test_surface_and_poses_from_a_depth_image_of_a_view(call, true, tmp_path, number):
    """Of the first view, and of one whose pose in the file is wrong."""
    alone = Simulator(true.in_view(number))
    np.save(tmp_path / "depth.npy", alone.renderer.depth(alone.membrane.rest).numpy())
    name = true.views[number].name
    given = tmp_path / "depth.npy", "--image", tmp_path / "rest_left.png", "--view", name
    code, said, sensor = call("depth", *given)
    assert code == 0 and "49 dots placed on the surface" in said
    assert_found(sensor, true, dots=0.02)


def test_a_view_must_be_named_and_must_exist(call, tmp_path):
    board = "--corners", "9,6", "--square", "3"
    for options, said in (
        ((), "no --view: .*has several views; expected --view left | right | mirror"),
        (("--view", "top"), "--view top: .*has several views; expected --view left | right | mirror"),
    ):
        code, text, _ = call("camera", tmp_path / "rest_left.png", *board, *options)
        assert code == 2 and all(part in text for part in said.split(".*"))
    code = main(["calibrate", "camera", "examples/sensor.toml", "examples/rest.png", *board, "--view", "left", "--out", "no"])
    assert code == 2


def test_dots_that_one_view_alone_shows_are_added(true, images):
    """Without a third of the list the sensor gets it back, each dot once."""
    kept = np.arange(49) % 3 > 0
    fewer = replace(true, markers=replace(true.markers, positions=true.markers.positions[kept], sizes=["small"] * kept.sum()))
    found = with_dots_of_each_view(fewer, [image / 255 for image in images]).markers
    away, partner = cKDTree(true.markers.positions).query(found.positions)
    assert sorted(partner) == list(range(49)) and away.max() < 0.05 and len(found.sizes) == 49


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_station_sees_points_as_its_view_does(true, number):
    """Also of a mirror, whose pose is a rotation after a reflection of x."""
    station, X = _station_of_view(true, number), true.markers.positions
    pose = true.views[number].pose
    np.testing.assert_allclose(station.points(X), pose.inverse.points(X), atol=1e-12)
    motion = np.concatenate([station.rotation, station.position])
    np.testing.assert_allclose(station.pose(motion).matrix, pose.matrix, atol=1e-12)
    upright = torch.from_numpy(pose.inverse.points(X) * station.flip)
    np.testing.assert_allclose(station.project(upright), CAMERA.point_to_pixel(torch.from_numpy(pose.inverse.points(X))))


def boards(camera, board, count, depths):
    """Images of a board in different poses, uint8."""
    photograph, rng = TargetRenderer.for_camera(camera), np.random.default_rng(5)
    return [photograph.image(board, R, t, NOISE, rng=rng) for R, t in poses(board, count, depths, rng)]


def test_the_lens_of_a_mirror_in_a_region_of_a_shared_image(tmp_path, capsys):
    """The right half is a mirror's: the board is seen reversed; the other view's lens stays as it was."""
    whole = tm.Camera("pinhole", (640, 240), (130.0, 130.0), (160.0, 120.0))
    other = tm.Camera("pinhole", (640, 240), (130.0, 130.0), (480.0, 120.0)).in_mode((320, 0, 320, 240))
    first = whole.in_mode((0, 0, 320, 240))
    views = View("direct", first, is_region=True), View("mirror", other, MIRROR, is_region=True)
    path = replace(cap(camera=first), views=views).to_file(tmp_path / "design.toml")
    camera = tm.Camera("pinhole", (320, 240), (150.0, 151.0), (150.4, 119.2))
    for number, image in enumerate(boards(camera, CHECKERS, 4, (17, 24))):
        shared = np.concatenate([np.full_like(image, 90), image[:, ::-1]], 1)
        Image.fromarray(shared).save(tmp_path / f"{number}.png")
    given = [str(path), f"{tmp_path}/?.png", "--corners", "9,6", "--square", "3", "--out", str(tmp_path / "out")]
    assert main(["calibrate", "camera", *given, "--view", "mirror"]) == 0
    assert "view 'mirror': lens: pinhole, 4 images" in capsys.readouterr().out
    direct, mirror = Sensor.from_file(tmp_path / "out" / "sensor.toml").views
    np.testing.assert_allclose(mirror.camera.focal, [150, 151], atol=0.7)
    np.testing.assert_allclose(mirror.camera.centre, [319 - 150.4, 119.2], atol=0.7)
    assert mirror.region == (320, 0, 320, 240) and mirror.camera.mode.image_size == (640, 240)
    assert direct.camera.focal.tolist() == [130, 130] and direct.region == (0, 0, 320, 240)


def test_a_mirror_shows_a_board_of_dots_reversed():
    """Each dot of the mirrored image is the board's dot of the same place; its three marks alone are not recognised there."""
    (image,) = boards(tm.Camera("pinhole", (320, 240), (150.0, 151.0), (150.4, 119.2)), DOTS, 1, (15, 20))
    mirrored = np.ascontiguousarray(image[:, ::-1]) / 255
    u, v = find_target(image / 255, DOTS).T
    np.testing.assert_allclose(reversed_target(mirrored, DOTS), np.stack([319 - u, v], -1), atol=1e-6)
    with pytest.raises(tm.MembraneError, match="three large dots are not recognised"):
        find_target(mirrored, DOTS)


def test_ports_of_one_view(tmp_path, capsys):
    """Those of the named view change, the other camera's stay; images that are named after the other one are left out."""
    lens, port = ("pinhole", (320, 240), (150.0, 150.0), (160.0, 120.0)), [(4.0, 3.0, 1.49)]
    guess = tm.Camera(*lens, ports=[(4.3, 3.0, 1.49)], medium_index=1.33)
    path = replace(cap(View("right", guess, POSES["right"]), camera=guess), name="ported").to_file(tmp_path / "design.toml")
    for number, image in enumerate(boards(tm.Camera(*lens, ports=port, medium_index=1.33), DOTS, 3, (13, 17))):
        Image.fromarray(image).save(tmp_path / f"{number}_right.png")
        Image.fromarray(image[:, ::-1]).save(tmp_path / f"{number}_left.png")
    given = [str(path), "--medium", f"{tmp_path}/?_*.png", "--dots", "11,8", "--pitch", "2.4", "--out", str(tmp_path / "out")]
    assert (
        main(["calibrate", "ports", *given, "--view", "right", "--held", "port_thickness", "port_index", "medium_index"]) == 0
    )
    assert "3 images left out, as their names are those of other views than 'right'" in capsys.readouterr().out
    left, right = Sensor.from_file(tmp_path / "out" / "sensor.toml").views
    assert left.camera.ports[0].distance == 4.3 and abs(right.camera.ports[0].distance - 4.0) < 0.1
