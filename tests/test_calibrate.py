"""Calibration finds the truth within three reported deviations."""

import csv
import json
import subprocess
import sys
import warnings
from dataclasses import replace
from datetime import date
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from moved_sensors import moved
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from torchmembrane import MembraneError, __version__, calibrate
from torchmembrane.calibrate.camera import Views, lens_from_views, ports_from_views
from torchmembrane.calibrate.depth import rest_from_depth
from torchmembrane.calibrate.detection import find_target
from torchmembrane.calibrate.fit import fit, outline_centres, rotations, with_common_errors
from torchmembrane.calibrate.layout import layout_for_pixels, pixel_lattice
from torchmembrane.calibrate.rest import rest_from_image
from torchmembrane.calibrate.surface import correction, surface_projection
from torchmembrane.calibrate.views import rest_from_views
from torchmembrane.camera.model import Camera
from torchmembrane.camera.targets import Checkerboard, DotBoard
from torchmembrane.cli import main as cli
from torchmembrane.files.images import read_image, to_grey
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.record import Record
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.appearance import Appearance
from torchmembrane.simulate.simulator import Simulator
from torchmembrane.simulate.target_renderer import TargetRenderer
from torchmembrane.surface.shapes import spherical_cap

SIZE, NOISE = (320, 240), 40.0
LENSES = {
    "pinhole": ((132.0, 133.0), (161.2, 118.5), (-0.05, 0.01, 5e-4, -3e-4, 0.0)),
    "fisheye": ((90.0, 90.3), (160.8, 119.1), (-0.012, 0.002, 0.0, 0.0)),
}
RATIONAL = (-0.1, 0.06, 5e-4, -3e-4, 0.01, 0.1, 0.03, 0.005)
PORT, GUESS = (4.0, 3.0, 1.49, 1.33), (4.3, 2.8, 1.53, 1.36)
CHECKERS, DOTS = Checkerboard(9, 6, 3.0), DotBoard(11, 8, 2.4)
TILT, OFFSET = Rotation.from_rotvec(np.deg2rad([0.8, 0.6, 0.0])), np.array([0.05, -0.05, 0.3])  # 1 degree, 0.3 mm


def poses(board, count, depths, rng, tilt=0.45):
    """Random places of a board before a camera, its middle near the axis: rotations and translations."""
    middle = np.append(sum(board.extent) / 2, 0.0)
    for _ in range(count):
        R = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * [tilt, tilt, 0.8]).as_matrix()
        z = rng.uniform(*depths)
        yield R, np.append(rng.uniform(-0.1, 0.1, 2) * z, z) - R @ middle


def photographed(camera, board, count, depths, rng):
    """The board's points as found in noisy images of it, `[count, D, 2]`."""
    photograph, found = TargetRenderer.for_camera(camera), []
    for R, t in poses(board, 3 * count, depths, rng):
        try:
            found.append(find_target(to_grey(photograph.image(board, R, t, NOISE, rng=rng)), board))
        except MembraneError:  # not wholly in the image
            continue
        if len(found) == count:
            return np.stack(found)


def ported(values, model="fisheye", air=False):
    distance, thickness, index, medium = values
    focal, centre, _ = LENSES[model]
    return Camera(model, SIZE, focal, centre, (), [(distance, thickness, index)], 1.0 if air else medium)


def exact_views(camera, count, rng, noise=0.02):
    """Centres of the dots' outlines as the camera projects them, with noise, px."""
    pixels = []
    for R, t in poses(DOTS, count, (13, 20), rng):
        p = outline_centres(camera.point_to_pixel(torch.from_numpy(DOTS.outlines @ R.T + t))).numpy()
        pixels.append(p + noise * rng.normal(size=p.shape))
    return np.stack(pixels)


def cap_sensor(camera, spacing=1.9):
    """A cap with a square pattern of dots in two sizes."""
    x, y = (a.ravel() for a in np.meshgrid(*2 * [spacing * np.arange(-4, 5)], indexing="ij"))
    kept = np.hypot(x, y) < 7.0
    x, y = x[kept], y[kept]
    surface = Surface("spherical_cap", {"rim_radius": 9.0, "height": 5.0, "base_z": 12.0})
    radius = (81 + 25) / 10
    dots = np.stack([x, y, 17 - radius + np.sqrt(radius**2 - x**2 - y**2)], -1)
    sizes = np.where(np.arange(len(x)) % 3 == 0, "large", "small").tolist()
    material, markers = Material("neo_hookean", 1.3), Markers("dots", "dark", dots, sizes)
    return Sensor("cap", "mm", camera, surface.membrane((17, 17)), material, Cavity("liquid"), markers, surface)


def assembled(design):
    """The sensor as it was really put together: turned by 1 degree about the rim's centre, 0.3 mm too far away."""
    pivot = np.array([0.0, 0.0, 12.0])
    return moved(design, TILT, pivot + OFFSET - TILT.apply(pivot))


def simulator_of(sensor):
    return Simulator(sensor, appearance=Appearance(noise=NOISE))


@pytest.fixture(scope="module")
def design():
    return cap_sensor(Camera("pinhole", SIZE, (150.0, 150.0), (160.4, 119.2), (), [(3.0, 2.0, 1.49)], 1.33))


@pytest.fixture(scope="module")
def truth(design):
    return assembled(design)


@pytest.fixture(scope="module")
def image(truth):
    return simulator_of(truth).rest_image()


def assert_within(values, truth, deviations, most):
    error = np.abs(np.asarray(values) - truth)
    assert (error < 3 * deviations).all(), (error, error / deviations)
    assert (deviations < most).all(), deviations


# the fit


def test_covariance_of_a_line_is_the_textbooks():
    x = np.linspace(-1, 1, 21)
    A, noise = np.stack([np.ones_like(x), x], -1), np.random.default_rng(0).normal(size=21)
    found = fit(lambda theta: A @ theta - (2 + 3 * x + noise), lambda theta: A, np.zeros(2), "line")
    left = noise - A @ np.linalg.lstsq(A, noise)[0]
    assert np.allclose(found.deviations**2, (left**2).sum() / 19 / [21, (x**2).sum()], rtol=1e-8)
    shared = with_common_errors(found, A, np.stack([0.5 * np.ones(21), 0.2 * A[:, 1]], 1))  # of the height, of the slope
    assert np.allclose(shared.covariance - found.covariance, [[0.25, 0], [0, 0.04]], atol=1e-12)


def test_what_no_datum_determines_has_a_huge_deviation():
    A = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    found = fit(lambda theta: A @ theta - [1.0, 2.1, 2.9], lambda theta: A, np.zeros(2), "sum")
    assert found.deviations.min() > 1e3 and found.covariance[0, 1] < 0
    with pytest.raises(MembraneError, match="2 data for 2 unknowns"):
        fit(lambda theta: theta, lambda theta: np.eye(2), np.zeros(2), "too little")


def test_rotations_are_scipys():
    vectors = np.array([[0.0, 0, 0], [0.3, -0.2, 1.1], [1e-9, 0, 0]])
    assert np.allclose(rotations(torch.from_numpy(vectors)), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)


def test_centre_of_an_outline_is_that_of_its_ellipse():
    """A circle seen aslant by a pinhole is an ellipse; its centre is the pole of the line at infinity."""
    R, t, r = Rotation.from_rotvec([0.7, 0.3, 0.0]).as_matrix(), np.array([1.0, -0.5, 6.0]), 1.0
    H = np.stack([R[:, 0], R[:, 1], t], 1)
    conic = np.linalg.inv(H).T @ np.diag([1, 1, -(r**2)]) @ np.linalg.inv(H)
    pole = np.linalg.solve(conic, [0, 0, 1.0])
    angle = 2 * np.pi * np.arange(8) / 8
    points = np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle], -1) @ R.T + t
    outline = torch.from_numpy(points[:, :2] / points[:, 2:])
    assert np.allclose(outline_centres(outline), pole[:2] / pole[2], atol=1e-6)
    assert np.linalg.norm(t[:2] / t[2] - pole[:2] / pole[2]) > 1e-3


# boards


@pytest.mark.parametrize("turn", [pytest.param(0.0, marks=pytest.mark.full), 2.0])
def test_board_dots_are_named_right_in_any_turn_and_when_cut(turn):
    camera = Camera("pinhole", SIZE, (150, 150), (160, 120), (-0.1, 0.02))
    R = Rotation.from_euler("xz", [0.3, turn]).as_matrix()
    t = np.array([5.0, 1.0, 13.0])
    image = TargetRenderer.for_camera(camera).image(DOTS, R, t, NOISE)
    pixels = find_target(to_grey(image), DOTS)
    expected = outline_centres(camera.point_to_pixel(torch.from_numpy(DOTS.outlines @ R.T + t))).numpy()
    visible, inside = np.isfinite(pixels).all(1), ((expected > 8) & (expected < [311, 231])).all(1)
    assert visible[inside].mean() > 0.97 and visible.sum() < len(visible)
    assert np.abs(pixels - expected)[visible].max() < 0.12


def test_boards_say_what_is_wrong():
    for make in (lambda: Checkerboard(2, 5, 1.0), lambda: DotBoard(5, 5, 1.0), lambda: DotBoard(9, 9, 1.0, 0.4)):
        with pytest.raises(MembraneError, match="expected"):
            make()
    grey = np.full(SIZE[::-1], 0.5, np.float32)
    with pytest.raises(MembraneError, match="no checkerboard of 9 x 6"):
        find_target(grey, CHECKERS)


# lens and ports


@pytest.mark.parametrize("model", LENSES)
def test_lens_is_found_within_three_deviations(model):
    focal, centre, distortion = LENSES[model]
    camera = Camera(model, SIZE, focal, centre, distortion)
    pixels = photographed(camera, CHECKERS, 7, (15, 24), np.random.default_rng(0))
    guess = Camera(model, SIZE, (120, 120), (160, 120), (), [PORT[:3]], 1.33)
    found = lens_from_views(guess, CHECKERS, Views(pixels, np.zeros(7, bool)))
    values, deviations = found.fit.values[: len(found.names)], found.fit.deviations[: len(found.names)]
    assert_within(values, np.concatenate([focal, centre, distortion]), deviations, [0.3] * 4 + [np.inf] * len(distortion))
    assert found.camera.ports == guess.ports and found.camera.focal.tolist() == values[:2].tolist()


def test_eight_coefficients_are_found_where_the_design_has_eight():
    """One by one they are hardly known; the lens that they make is, as OpenCV projects it."""
    cv2 = pytest.importorskip("cv2")
    rng, focal, centre = np.random.default_rng(0), (132.0, 133.0), (161.2, 118.5)
    camera = Camera("pinhole", SIZE, focal, centre, RATIONAL)
    points = torch.from_numpy(CHECKERS.points - [12.0, 7.5, 0.0])
    turns = torch.from_numpy(rng.uniform(-0.5, 0.5, (12, 3)))
    where = torch.from_numpy(np.column_stack([rng.uniform(-6, 6, (12, 2)), rng.uniform(13, 20, 12)]))
    pixels = camera.point_to_pixel(points @ rotations(turns).mT + where[:, None]).numpy()
    pixels += rng.normal(scale=0.02, size=pixels.shape)
    guess = Camera("pinhole", SIZE, (120, 120), (160, 120), [0.0] * 8)
    found = lens_from_views(guess, CHECKERS, Views(pixels, np.zeros(12, bool))).camera
    assert len(found.distortion) == 8 and found.distortion[5:].abs().max() > 1e-3
    u, v = np.meshgrid(np.linspace(20, 300, 15), np.linspace(20, 220, 11))
    rays = camera.pixel_to_ray(torch.from_numpy(np.stack([u, v], -1).reshape(-1, 2))).direction
    K = np.array([[found.focal[0], 0, found.centre[0]], [0, found.focal[1], found.centre[1]], [0, 0, 1]])
    seen, _ = cv2.projectPoints(rays.numpy(), np.zeros(3), np.zeros(3), K, found.distortion.numpy())
    assert np.abs(seen[:, 0] - np.stack([u, v], -1).reshape(-1, 2)).max() < 0.3


def test_ports_are_found_from_images_in_air_and_in_the_medium():
    rng = np.random.default_rng(1)
    sets = [photographed(ported(PORT, air=air), DOTS, 2, (14, 18), rng) for air in (True, False)]
    views = Views(np.concatenate(sets), np.arange(4) >= 2)
    found = ports_from_views(ported(GUESS), DOTS, views)
    assert found.names == ["port_distance", "port_thickness", "port_index", "medium_index"]
    assert_within(found.fit.values[:4], PORT, found.fit.deviations[:4], [0.05, 0.05, 0.05 * 1.49, 0.05 * 1.33])
    assert np.allclose([*found.camera.ports[0], float(found.camera.medium_index)], found.fit.values[:4])


@pytest.mark.parametrize(
    "pitch, exchanged, said",
    [
        (2.0, True, "in air and in the medium are not exchanged"),
        (0.2, False, "in the sensor's length unit"),
        (20.0, False, "which scales"),
    ],
)
def test_ports_from_a_wrong_pitch_or_exchanged_images_are_refused(pitch, exchanged, said):
    """Of a pitch in cm the camera that fits best sees the points elsewhere; one ten times too large makes all lengths so."""
    rng = np.random.default_rng(1)
    pixels = np.concatenate([exact_views(ported(PORT, air=air), 3, rng) for air in (True, False)])
    board = DotBoard(DOTS.columns, DOTS.rows, pitch * DOTS.pitch / 2.0)
    with pytest.raises(MembraneError, match=said):
        ports_from_views(ported(GUESS), board, Views(pixels, (np.arange(6) >= 3) ^ exchanged))


def test_in_the_medium_thickness_and_index_are_not_identifiable():
    rng = np.random.default_rng(2)
    found = ports_from_views(ported(GUESS), DOTS, Views(exact_views(ported(PORT), 3, rng), np.ones(3, bool)))
    covariance, deviations = found.fit.covariance, found.fit.deviations
    assert covariance[1, 2] / deviations[1] / deviations[2] < -0.95
    assert deviations[1] > 0.15 and deviations[0] < 0.05 and deviations[3] < 0.005
    assert_within(found.fit.values[:4], PORT, deviations[:4], np.inf)


def test_in_air_the_distance_of_a_plate_is_not_seen():
    rng = np.random.default_rng(3)
    found = ports_from_views(ported(GUESS), DOTS, Views(exact_views(ported(PORT, air=True), 3, rng), np.zeros(3, bool)))
    assert found.names == ["port_distance", "port_thickness", "port_index"]
    assert abs(found.fit.values[0] - GUESS[0]) < 1e-3 and abs(found.fit.deviations[0] / (0.2 * GUESS[0]) - 1) < 0.3
    assert_within(found.fit.values[1:3], PORT[1:3], found.fit.deviations[1:3], [0.05, 0.05])


def test_a_mistaken_dot_is_left_out_and_what_is_held_stays():
    rng = np.random.default_rng(4)
    pixels = exact_views(ported(PORT), 4, rng)
    pixels[1, 7] += [9.0, -4.0]
    held = (4.3, 3.0, 1.49, 1.36)
    views = Views(pixels, np.ones(4, bool))
    found = ports_from_views(ported(held), DOTS, views, ["port_thickness", "port_index"])
    assert found.names == ["port_distance", "medium_index"] and found.camera.ports[0][1:] == (3.0, 1.49)
    assert (
        np.isnan(found.residuals[1, 7]).all()
        and np.isfinite(found.residuals).all(-1).sum() == np.isfinite(pixels).all(-1).sum() - 1
    )
    assert_within(found.fit.values[:2], [4.0, 1.33], found.fit.deviations[:2], [0.05, 0.05])
    with pytest.raises(MembraneError, match="'focal' cannot be held"):
        ports_from_views(ported(held), DOTS, views, ["focal"])


# rest surface and dots


def test_tilt_and_offset_are_found_from_one_rest_image(design, truth, image):
    found = rest_from_image(design, image)
    expected = [*np.rad2deg(TILT.as_rotvec()), *OFFSET]
    assert_within(found.fit.values, expected, found.fit.deviations, [0.1] * 3 + [0.05] * 3)
    off = lambda sensor: np.linalg.norm(sensor.markers.positions - truth.markers.positions, axis=1)  # noqa: E731
    assert off(found.sensor).max() < 0.03 < 0.2 < off(design).min()
    gap = found.sensor.surface.membrane((17, 17)).closest_points(truth.membrane.rest.numpy()).distance
    assert gap.max() < 0.03


def test_a_calibrated_sensor_reconstructs_its_rest(design, truth, image):
    """Without nulling in the image, the error of the pose is an error of the surface; with the pose found, it is gone."""
    pixels = truth.camera.point_to_pixel(torch.from_numpy(truth.markers.positions))
    off = {}
    for name, sensor in (("before", design), ("after", rest_from_image(design, image).sensor)):
        bare = replace(sensor, markers=replace(sensor.markers, rest_image=None))
        result = Reconstructor(bare).from_pixels(pixels)
        off[name] = float(
            (result.markers[0].double() - torch.from_numpy(truth.markers.positions)).norm(dim=-1).square().mean().sqrt()
        )
    assert off["before"] > 0.25 and off["after"] < 0.03


@pytest.mark.parametrize(
    "name, pressed",
    [
        ("rest", False),
        ("press_on_axis", True),
        pytest.param("flat_plate", True, marks=pytest.mark.full),
        pytest.param("two_contacts", True, marks=pytest.mark.full),
    ],
)
def test_a_pressed_image_is_noticed_to_be_no_rest(name, pressed):
    sensor = Sensor.from_file("examples/sensor.toml")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        rest_from_image(sensor, read_image(f"examples/{name}.png"))
    assert [("something presses the membrane" in str(one.message)) for one in said] == [True] * pressed


def test_misplaced_dots_are_nulled(design):
    shift, wrong = np.array([0.12, -0.08]), [3, 20]
    dots = design.markers.positions.copy()
    radius, centre = 10.6, 17 - 10.6
    dots[wrong, :2] += shift
    dots[wrong, 2] = centre + np.sqrt(radius**2 - (dots[wrong, :2] ** 2).sum(1))
    made = replace(design, markers=replace(design.markers, positions=dots))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # they are no press
        found = rest_from_image(design, simulator_of(made).rest_image())
    assert np.linalg.norm(found.sensor.markers.positions - dots, axis=1).max() < 0.03
    assert (np.linalg.norm(found.shifts, axis=1) > 0.1).nonzero()[0].tolist() == wrong


MOTIONS = np.array([[0.0, 0, 0, 0, 0, 0], [1.5, 0, 0, 0, -3, 0], [0, -1.5, 0, -3, 0, 0]])


@pytest.fixture(scope="module")
def views(truth, image):
    """Images by a camera that moves by `MOTIONS`."""
    images = [image]
    for motion in MOTIONS[1:]:
        back = Rotation.from_rotvec(np.deg2rad(motion[3:])).inv()
        images.append(simulator_of(moved(truth, back, -back.apply(motion[:3]))).rest_image())
    return images


def test_unlisted_dots_are_found_from_several_views(design, truth, image, views):
    motions, images = MOTIONS, views
    rough = motions + [[0] * 6, [0, 0, 0, 0.3, -0.2, 0.3], [0.03, 0, -0.05, 0.2, 0.3, -0.3]]
    unlisted = replace(design, markers=Markers("dots", "dark", rest_image=image))
    found = rest_from_views(unlisted, images, rough, 0.005)
    true = np.concatenate([motions[1:, 3:], motions[1:, :3]], 1).ravel()
    assert_within(found.fit.values[:12], true, found.fit.deviations[:12], [0.1, 0.1, 0.1, 0.05, 0.05, 0.05] * 2)
    partner = cKDTree(truth.markers.positions).query(found.dots)[1]
    assert len(set(partner)) == len(found.dots) == len(truth.markers.positions)
    error = np.abs(found.dots - truth.markers.positions[partner])
    assert (error < 3 * found.deviations).mean() > 0.98
    inner = np.linalg.norm(found.dots[:, :2], axis=1) < 6
    assert error[inner].max() < 0.1 and found.sensor.markers.sizes == [truth.markers.sizes[k] for k in partner]


@pytest.mark.parametrize("travel, error", [(1.5, 0.2), (1.5, np.inf), (0.05, None), (0.0, None)])
def test_views_whose_travel_tells_no_scale_are_refused(design, views, travel, error):
    motions = MOTIONS * [travel / 1.5, 1, 1, 1, 1, 1]
    with pytest.raises(MembraneError, match=rf"travelled by {travel:g} mm, known to .* expected to a tenth at least"):
        rest_from_views(design, views, motions, error)


@pytest.mark.parametrize("scale", [0.3, pytest.param(2.54, marks=pytest.mark.full), 1000.0])
def test_motions_in_another_unit_are_refused(design, views, scale):
    with pytest.raises(MembraneError, match="calibrate views: the (surface would be moved|dots lie)|dots found"):
        rest_from_views(design, views, MOTIONS * [*[scale] * 3, 1, 1, 1])


def test_rest_surface_and_dots_are_found_from_a_depth_image(design, truth, image):
    simulator = simulator_of(truth)
    exact = simulator.renderer.depth(simulator.membrane.rest).numpy()
    X = simulator.membrane.rest.numpy()
    X = X[np.linalg.norm(X[:, :2], axis=1).argmin()]
    u, v = truth.camera.point_to_pixel(torch.from_numpy(X)).round().int().tolist()
    assert abs(exact[v, u] - X[2]) < 0.02 and np.isnan(exact[0, 0])
    depth = exact + 0.1 * np.random.default_rng(0).normal(size=exact.shape)
    found = rest_from_depth(design, depth, image)
    radius = np.linalg.norm(design.surface.membrane((65, 65)).rest.numpy()[:, :2], axis=1)
    vertices = found.sensor.surface.values["vertices"].reshape(-1, 3)
    gap = truth.surface.membrane((129, 129)).closest_points(vertices).distance
    assert (gap < 3 * found.surface.deviations)[radius < 8].mean() > 0.97
    assert gap[radius < 8].mean() < 0.02 < 0.15 < np.abs(found.projection.signed_distance).mean()
    assert np.median(found.deviations) == pytest.approx(0.1 / 12, rel=0.3)  # of means of 12 x 12 depths
    assert cKDTree(truth.markers.positions).query(found.sensor.markers.positions)[0].max() < 0.06


def test_a_corrected_surface_is_as_sure_as_the_points_that_move_it():
    """Its offsets are linear in the points' distances: independent deviations of these add up in quadrature."""
    flat, rng = spherical_cap(12.0, 0.5, 20.0, (7, 7)), np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-6, 6, (14, 2)), np.full(14, 20.5)])
    projection, variances = surface_projection(flat, points), rng.uniform(0.5, 2.0, 14) ** 2
    each = [correction(flat, projection._replace(signed_distance=one), variances) for one in np.eye(14)]
    slopes = np.stack([found.offsets for found in each], 1)
    assert (slopes < -0.05).any()  # of what is extrapolated
    np.testing.assert_allclose(each[0].deviations, np.sqrt(slopes**2 @ variances), rtol=0.03)  # normals are nearly parallel


@pytest.mark.parametrize("factor, said", [(0.001, "--unit 1000 times as large"), (10.0, "--unit 0.1 times as large")])
def test_depths_in_another_unit_are_refused_with_the_unit(design, truth, image, factor, said):
    simulator = simulator_of(truth)
    depth = simulator.renderer.depth(simulator.membrane.rest).numpy()
    with pytest.raises(
        MembraneError, match=r"squares of 24 px have depths near the designed surface; expected 12 or .*" + said
    ):
        rest_from_depth(design, factor * depth, image)
    with pytest.raises(MembraneError, match="there is none within the rim"):
        rest_from_depth(design, np.full(depth.shape, np.inf), image)


# fabrication layout


def test_dots_laid_out_for_a_wanted_pattern_are_seen_where_they_were_wanted(design):
    pixels, sizes = pixel_lattice(design, 20.0)
    dots = layout_for_pixels(design, pixels, sizes)
    x, y, z = dots.positions.T
    assert np.abs(np.sqrt(x**2 + y**2 + (z - 6.4) ** 2) - 10.6).max() < 2e-3  # on the cap's sphere
    assert np.abs(dots.normals - (dots.positions - [0, 0, 6.4]) / 10.6).max() < 2e-3
    assert set(np.diff(np.unique(pixels[:, 0])).round(9)) == {20.0} and len(pixels) > 40
    made = replace(design, markers=Markers("dots", "dark", dots.positions, sizes))
    found = rest_from_image(made, simulator_of(made).rest_image())
    assert np.nanmax(np.abs(found.pixels - pixels)) < 0.12
    with pytest.raises(MembraneError, match="misses the rest surface"):
        layout_for_pixels(design, np.array([[5.0, 5.0]]), ["small"])


def test_dots_that_stand_off_the_surface_are_not_laid_out(design):
    pins = replace(design, markers=replace(design.markers, height=2.0))
    for lay_out in (lambda: pixel_lattice(pins, 20.0), lambda: layout_for_pixels(pins, np.array([[160.0, 120.0]]), ["small"])):
        with pytest.raises(MembraneError, match="calibrate layout: height of the markers is 2.0; expected 0"):
            lay_out()


# from Python


def test_the_public_names_are_loaded_when_asked_for():
    assert set(calibrate.__all__) <= set(dir(calibrate)) and len(set(calibrate.__all__)) == len(calibrate.__all__)
    assert all(getattr(calibrate, name).__name__ == name for name in calibrate.__all__)
    with pytest.raises(AttributeError, match="no attribute 'lens_from_hearsay'"):
        _ = calibrate.lens_from_hearsay
    code = "import sys, torchmembrane.calibrate; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split() == ["False"]


# the command


def run(capsys, *arguments):
    code = cli.main(["calibrate", *map(str, arguments)])
    return code, *capsys.readouterr()


def test_command_rest_writes_a_sensor_a_report_and_a_figure(design, image, tmp_path, capsys):
    path = replace(design, record=Record("B2", uncertainty=0.03)).to_file(tmp_path / "design")
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(tmp_path / "rest.png")
    code, said, _ = run(capsys, "rest", path, tmp_path / "rest.png", "--out", tmp_path / "out")
    assert code == 0 and "tilt_x" in said and "±" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    tilt = report["parameters"]["tilt_x"]
    assert abs(tilt["value"] - 0.8) < 3 * tilt["deviation"] and tilt["unit"] == "degrees"
    assert Image.open(tmp_path / "out" / "report.png").size[0] > 1000
    sensor = Sensor.from_file(tmp_path / "out" / "sensor.toml")
    assert sensor.markers.rest_image is not None and sensor.camera.ports == design.camera.ports
    by = f"torchmembrane {__version__}, calibrate rest"
    assert sensor.record == Record("B2", date.today(), 1, by, 0.03)


def test_command_camera_leaves_out_images_without_a_board(design, tmp_path, capsys):
    camera = Camera("pinhole", SIZE, (150.0, 150.0), (160.4, 119.2))
    photograph, rng = TargetRenderer.for_camera(camera), np.random.default_rng(5)
    for k, (R, t) in enumerate(poses(CHECKERS, 4, (17, 24), rng)):
        Image.fromarray(photograph.image(CHECKERS, R, t, NOISE, rng=rng)).save(tmp_path / f"{k}.png")
    Image.new("L", SIZE, 100).save(tmp_path / "empty.png")
    options = ("--corners", "9,6", "--square", "3", "--out", tmp_path / "out")
    code, said, _ = run(capsys, "camera", design.to_file(tmp_path / "design"), tmp_path, *options)
    assert code == 0 and "empty.png left out" in said and "4 images" in said
    found = Sensor.from_file(tmp_path / "out" / "sensor.toml").camera
    assert np.abs(found.focal.numpy() - 150).max() < 1 and len(found.ports) == 1


@pytest.mark.parametrize(
    "asked, said",
    [
        ((10, 7), "one of 9 x 6 inner corners, that is 10 x 7 squares, is there: count corners .*, --corners 9,6"),
        ((7, 10), "one of 6 x 9 inner corners, that is 7 x 10 squares, is there"),
        ((7, 5), "one of . x . inner corners is there"),
        ((12, 9), "with a light margin$"),
    ],
)
def test_squares_that_were_counted_for_corners_are_said(asked, said):
    camera, rng = Camera("pinhole", SIZE, (150.0, 150.0), (160.4, 119.2)), np.random.default_rng(5)
    R, t = next(iter(poses(CHECKERS, 1, (17, 24), rng)))
    image = TargetRenderer.for_camera(camera).image(CHECKERS, R, t, NOISE, rng=rng) / 255
    assert find_target(image, CHECKERS).shape == (54, 2)
    with pytest.raises(MembraneError, match=f"no checkerboard of {asked[0]} x {asked[1]} inner corners found; .*{said}"):
        find_target(image, Checkerboard(*asked, 3.0))


def test_command_camera_says_why_no_image_shows_the_board(design, tmp_path, capsys):
    camera = Camera("pinhole", SIZE, (150.0, 150.0), (160.4, 119.2))
    photograph, rng = TargetRenderer.for_camera(camera), np.random.default_rng(5)
    for k, (R, t) in enumerate(poses(CHECKERS, 3, (17, 24), rng)):
        Image.fromarray(photograph.image(CHECKERS, R, t, NOISE, rng=rng)).save(tmp_path / f"{k}.png")
    options = ("--corners", "10,7", "--square", "3", "--out", tmp_path / "out")
    code, _, errors = run(capsys, "camera", design.to_file(tmp_path / "design"), tmp_path, *options)
    assert code == 2 and "no image of 3 shows" in errors and "--corners 9,6" in errors


def test_command_views_takes_one_motion_for_each_image(design, image, tmp_path, capsys):
    path = design.to_file(tmp_path / "design")
    for k in range(3):
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(tmp_path / f"view{k}.png")
    (tmp_path / "motions.csv").write_text("x,y,z,turn_x,turn_y,turn_z\n0,0,0,0,0,0\n1,0,0,0,0,0\n")
    given = tmp_path / "view*.png", "--motions", tmp_path / "motions.csv", "--out", tmp_path / "out"
    code, _, errors = run(capsys, "views", path, *given)
    assert code == 2 and f"{tmp_path / 'motions.csv'}: 2 lines of motions; expected 3, one for each image" in errors


def test_command_layout_writes_for_machine_and_eye(design, tmp_path, capsys):
    path = replace(design, name="<a & b>").to_file(tmp_path / "design")
    code, said, _ = run(capsys, "layout", path, "--pitch", 25, "--out", tmp_path / "out")
    assert code == 0 and "layout.csv" in said
    made = Sensor.from_file(tmp_path / "out" / "sensor.toml")
    with (tmp_path / "out" / "layout.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(made.markers.positions)
    places = np.array([[float(row[key]) for key in "xyz"] for row in rows])
    assert np.allclose(places + [0, 0, 12.0], made.markers.positions, atol=2e-5)
    drawing = ElementTree.parse(tmp_path / "out" / "layout.svg").getroot()
    assert len(drawing.findall("{*}ellipse")) == len(rows) and drawing.get("width").endswith("mm")
    (tmp_path / "wanted.csv").write_text("u,v,size\n160,120,large\n180,120,tiny\n")
    code, _, errors = run(capsys, "layout", path, "--pixels", tmp_path / "wanted.csv", "--out", tmp_path / "no")
    assert code == 2 and "small or large" in errors
    code, _, errors = run(capsys, "pattern", path, "--out", tmp_path / "no")  # the step's former name
    assert code == 2 and "--pixels" in errors


@pytest.mark.parametrize(
    "step, options, words",
    [
        (
            "layout",
            ("--pitch", "1e300"),
            "pitch = 1e+300; expected 4 px or more, so that dots are distinguishable, at most 1120",
        ),
        ("layout", ("--pitch", "4"), "dots; expected at most 2000, as a sensor file lists"),
        ("layout", ("--pixels", "far.csv"), "the ray of pixel [1e+300, 240.0] (dot 0) misses the rest surface"),
        ("layout", ("--pixels", "/dev/zero"), "/dev/zero: not readable (it is a device); expected CSV"),
        (
            "views",
            ("rest.png", "rest.png", "--motions", "far.motions"),
            "far.motions, line 3: x = 1e300; expected a coordinate up to 1e+06",
        ),
        ("depth", ("far.npy", "--image", "rest.png"), "far.npy: depths up to 1e+300; expected at most 1e+06: check --unit 1"),
        ("depth", ("text.npy", "--image", "rest.png"), "text.npy: not readable"),
        ("rest", ("small.png",), "small.png: the image is 16 x 12 px, expected 640 x 480"),
    ],
)
def test_values_that_calibrate_nothing_are_refused_in_one_line(tmp_path, capsys, monkeypatch, step, options, words):
    example = Path("examples").resolve()
    monkeypatch.chdir(tmp_path)
    Path("rest.png").symlink_to(example / "rest.png")
    Path("far.csv").write_text("u,v,size\n1e300,240,large\n360,240,small\n")
    Path("far.motions").write_text("x,y,z,turn_x,turn_y,turn_z\n0,0,0,0,0,0\n1e300,0,0,0,0,0\n")
    Path("text.npy").write_text("no array")
    np.save("far.npy", np.full((480, 640), 1e300))
    Image.new("L", (16, 12)).save("small.png")
    assert cli.main(["calibrate", step, str(example / "sensor.toml"), *options, "--out", "out"]) == 2
    begun, line = capsys.readouterr().err.splitlines()
    assert begun.startswith(f"calibrate {step}: ") and words in line and not Path("out").exists()
