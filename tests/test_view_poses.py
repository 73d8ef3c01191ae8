"""Poses of several views are found from rest images of the same dots.

Images are rendered, with the poses of the file far from the truth.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from test_views import BESIDE, CAMERA, MIRROR, cap

import torchmembrane as tm
from torchmembrane.calibrate.view_poses import _partners, placed_view, recognised, with_found
from torchmembrane.cli.draft_views import looking_at
from torchmembrane.cli.main import main
from torchmembrane.markers.dots.pattern import DotPattern
from torchmembrane.pose import ViewPose
from torchmembrane.sensor.parts import Surface
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Simulator

POSES = {"right": BESIDE, "mirror": ViewPose(MIRROR.rotation, np.array([3.0, 0.0, 0.0]))}
OFF = ViewPose(np.array([5.0, -6.0, 3.0]), np.array([1.2, -0.7, 1.5]))
"""By which the file's poses are wrong: 8 degrees and 2 mm."""


def wrong(pose):
    return ViewPose.of_matrix(pose.matrix @ OFF.matrix)


@pytest.fixture(scope="module")
def images():
    """Of a camera beside the first one and of a mirror, at rest."""
    simulator = Simulator(cap(*(View(name, CAMERA, pose) for name, pose in POSES.items())))
    return simulator.images(simulator.membrane.rest, np.random.default_rng(0))


def test_dots_are_partners_if_each_is_the_others_nearest_within_a_third_of_the_pitch():
    """The first two expected dots have the same nearest one; the last one's is too far away."""
    expected, found = (np.array([[u, 0.0] for u in row]) for row in ([0, 0.5, 1, 2, 3, 4, 5, 6], [6.4, 0.3, 1.3, 2.1, 3, 4, 5]))
    assert _partners(expected, found, cKDTree(found)).tolist() == [-1, 1, 2, 3, 4, 5, 6, -1]


def off(found, true):
    """How far a pose is off: degrees, and length of the centre's shift."""
    error = np.linalg.inv(true.matrix) @ found.matrix
    return np.rad2deg(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))), np.linalg.norm(
        found.translation - true.translation
    )


def test_calibrate_rest_finds_where_each_view_stands(images, tmp_path, capsys):
    """Through the sensor's own file and the command; reflections stay reflections."""
    path = cap(*(View(name, CAMERA, wrong(pose)) for name, pose in POSES.items())).to_file(tmp_path / "design.toml")
    for name, image in zip(("left", *POSES), images, strict=True):
        Image.fromarray(image).save(tmp_path / f"rest_{name}.png")
    call = ["calibrate", "rest", str(path), str(tmp_path / "rest_left.png"), "--out", str(tmp_path / "out")]
    assert main(call) == 0
    said = capsys.readouterr().out
    assert "view 'right' stands at 7.0" in said and "mirror.tilt_x" in said and "right.offset_z" in said
    sensor = tm.Sensor.from_file(tmp_path / "out" / "sensor.toml")
    for view in sensor.views[1:]:
        turned, moved = off(view.pose, POSES[view.name])
        assert turned < 0.03 and moved < 0.01 and view.pose.determinant == POSES[view.name].determinant
    result = tm.Reconstructor(sensor)(images)
    assert result.status.tolist() == [0] and float(result.displacement.norm(dim=-1).max()) < 0.01
    (tmp_path / "rest_mirror.png").unlink()
    assert main([*call, "--force"]) == 2 and "rest_mirror.png" in capsys.readouterr().err


def test_lengths_scale_with_the_listed_surface(images):
    """Images tell no scale: all lengths of the list 2 % larger, and the camera stands 2 % farther away."""
    design, factor = cap(View("right", CAMERA, wrong(BESIDE))), 1.02
    surface = Surface("spherical_cap", {key: factor * value for key, value in design.surface.values.items()})
    markers = replace(design.markers, positions=factor * design.markers.positions)
    larger = replace(design, membrane=surface.membrane((9, 9)), surface=surface, markers=markers)
    one, two = (placed_view(each, 1, images[1] / 255)[0].views[1].pose for each in (design, larger))
    np.testing.assert_allclose(two.translation, factor * one.translation, atol=2e-3)
    np.testing.assert_allclose(two.rotation, one.rotation, atol=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_dots_are_recognised_from_a_pose_far_off(seed):
    """Wherever the camera is by up to 15 degrees and a fifth of its distance, with a seventh of the dots unseen: what is
    expected then lies on what is found."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=3), rng.normal(size=3)
    turn = ViewPose(15 * axis / np.linalg.norm(axis), 3 * shift / np.linalg.norm(shift))
    sensor = cap(View("right", CAMERA, BESIDE))
    view = sensor.in_view(1)
    X = view.markers.positions
    centre = X.mean(0)
    true = turn.vectors(X - centre) + centre + turn.translation
    pixels = CAMERA.point_to_pixel(torch.from_numpy(true)).numpy()
    kept = rng.permutation(len(X))[:42]
    pattern = DotPattern(pixels[kept], np.tile(np.eye(2), (42, 1, 1)), np.ones(42, int))
    motion, pivot = recognised(view, pattern)
    np.testing.assert_allclose(ViewPose(np.rad2deg(motion[:3]), motion[3:]).points(X - pivot) + pivot, true, atol=1e-3)
    with pytest.raises(tm.MembraneError, match="of 49 dots are recognised among 42 found"):
        recognised(view, pattern._replace(pixels=rng.random((42, 2)) * [160, 120]))


def test_an_image_that_does_not_show_the_dots_is_named(images):
    sensor = cap(View("right", CAMERA, BESIDE))
    with pytest.raises(tm.MembraneError, match="view 'right': .* dots"):
        placed_view(sensor, 1, np.zeros((120, 160)))


def test_another_surface_of_the_first_view_places_the_others_again(images):
    """A material changes no pose; a surface 2 % larger stands 2 % farther from every camera."""
    sensor, _ = placed_view(cap(View("right", CAMERA, BESIDE)), 1, images[1] / 255)
    alone = sensor.in_view(0)
    stiffer = with_found(sensor, replace(alone, material=replace(alone.material, shear_modulus=0.5)))
    assert stiffer.material.shear_modulus == 0.5 and stiffer.views[1].pose is sensor.views[1].pose
    assert with_found(alone, alone) is alone
    surface = Surface("spherical_cap", {key: 1.02 * value for key, value in alone.surface.values.items()})
    markers = replace(alone.markers, positions=1.02 * alone.markers.positions)
    larger = with_found(sensor, replace(alone, membrane=surface.membrane((9, 9)), surface=surface, markers=markers))
    np.testing.assert_allclose(larger.views[1].pose.translation, 1.02 * sensor.views[1].pose.translation, atol=3e-3)


def test_a_camera_looks_at_a_point_upright():
    rng = np.random.default_rng(0)
    for point, place in rng.normal(size=(10, 2, 3)):
        pose = looking_at(point, place)
        ahead = pose.inverse.points(point)
        np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(point - place)], atol=1e-12)
        assert pose.determinant == 1 and pose.rotation[1, 0] == pytest.approx(0) and pose.rotation[1, 1] > 0
    with pytest.raises(tm.MembraneError, match="right above or below"):
        looking_at(np.array([0.0, 5.0, 0.0]), np.zeros(3))


def test_init_places_a_second_camera_by_its_rest_image(tmp_path, capsys):
    """The ruler is off by 2 mm in each direction, the photograph says where the camera stands; the dots are those in it."""
    shape = "--shape cap --radius 8 --height 3 --distance 24 --focal 330".split()
    real, mine = tmp_path / "real.toml", tmp_path / "mine.toml"
    assert main(["init", str(real), *shape, "--image-size", "320,240", "--views", "left", "right=12,1,3"]) == 0
    assert "view 'right' sees" in capsys.readouterr().out
    simulator = Simulator(tm.Sensor.from_file(real))
    for name, image in zip(("left", "right"), simulator.images(simulator.membrane.rest, np.random.default_rng(0)), strict=True):
        Image.fromarray(image).save(tmp_path / f"rest_{name}.png")
    rest = ["--rest", str(tmp_path / "rest_left.png")]
    assert main(["init", str(mine), *shape, *rest, "--views", "left", "right=14,-1,1"]) == 0
    assert "view 'right' found at" in capsys.readouterr().out
    found, true = (tm.Sensor.from_file(path).views[1].pose for path in (mine, real))
    turned, moved = off(found, true)
    assert turned < 0.05 and moved < 0.03
    for given, said in (
        (["left"], "expected the first view's name, and NAME=X,Y,Z"),
        (["left", "right"], "NAME=X,Y,Z of each other one"),
        (["one", "right=12,1,3"], "does not end with '_one', the first view's; expected NAME_one.png"),
    ):
        assert main(["init", str(tmp_path / "no.toml"), *shape, *rest, "--views", *given]) == 2
        assert said in capsys.readouterr().err
