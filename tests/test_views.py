"""Several views of one membrane are reconstructed together."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.camera.rig import Rig, turns_by_noise
from torchmembrane.cli.describe import described, rest_frame
from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.jobs.inputs import Inputs, of_first_view
from torchmembrane.plot.sensor import sensor_figure
from torchmembrane.pose import ViewPose
from torchmembrane.results.status import Status
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.results.view_status import status_in_words
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.view_images import first_view_image, first_view_picture
from torchmembrane.sensor.views import View, refuse_views
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to

CAMERA = tm.Camera("pinhole", (160, 120), (100, 100), (79.5, 59.5))
BESIDE = ViewPose(np.array([0.0, -25.0, 0.0]), np.array([7.0, 0.0, 0.0]))
MIRROR = ViewPose(np.diag([-1.0, 1.0, 1.0]), np.zeros(3))  # in the plane x = 0


def cap(*views, camera=CAMERA):
    """A cap with 49 dots, symmetric to x = 0."""
    surface = Surface("spherical_cap", {"rim_radius": 8.0, "height": 4.0, "base_z": 14.0})
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-5, 5, 7)] * 2))
    dots = np.stack([x, y, 8 + np.sqrt(100 - x**2 - y**2)], -1)
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.4)
    parts = "cap", "mm", camera, surface.membrane((9, 9)), material, Cavity("liquid"), Markers("dots", "dark", dots), surface
    return Sensor(*parts, views=(View("left", camera), *views) if views else ())


@pytest.fixture(scope="module")
def press():
    """A sensor with two views, and a press: its images, its truth."""
    simulator = Simulator(cap(View("right", CAMERA, BESIDE)))
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([-0.3, 0.0, -0.95]), 1.2)
    (state,) = simulator.presses(stroke, ["push"])
    frame = simulator.frame(state, stroke, np.random.default_rng(0))
    return simulator, [frame.image, *frame.further], frame.truth, state


@pytest.fixture(scope="module")
def reconstructor(press):
    return tm.Reconstructor(press[0].at_rest())


@pytest.fixture(scope="module")
def alone(press):
    """The first view's reconstructor."""
    return tm.Reconstructor(press[0].at_rest().in_view(0))


@pytest.fixture(scope="module")
def found(reconstructor, press):
    return reconstructor(press[1])


def off(result, truth):
    """Rms distance of the markers from the truth."""
    return float(np.sqrt(((result.markers[0].numpy() - truth["dots_deformed"]) ** 2).sum(-1).mean()))


def test_the_file_keeps_views_that_have_images_of_their_own(press, tmp_path):
    sensor = press[0].at_rest()
    path = sensor.to_file(tmp_path)
    assert sorted(file.name for file in tmp_path.glob("*.png")) == ["sensor_rest_left.png", "sensor_rest_right.png"]
    again = tm.Sensor.from_file(path)
    assert again.fingerprint == sensor.fingerprint != replace(sensor, views=()).fingerprint
    assert [view.name for view in again.views] == ["left", "right"]
    np.testing.assert_array_equal(again.views[1].pose.matrix, BESIDE.matrix)
    np.testing.assert_array_equal(again.views[1].rest_image, sensor.views[1].rest_image)


def test_regions_share_one_image(press, found, tmp_path):
    """Left and right half of an image of 320 x 120 px show what two cameras of 160 x 120 px show."""
    whole = tm.Camera("pinhole", (320, 120), (100, 100), (79.5, 59.5))
    other = tm.Camera("pinhole", (320, 120), (100, 100), (239.5, 59.5)).in_mode((160, 0, 160, 120))
    first = whole.in_mode((0, 0, 160, 120))
    views = View("left", first, is_region=True), View("right", other, BESIDE, is_region=True)
    sensor = replace(cap(camera=first), views=views)
    simulator = Simulator(sensor)
    (image,) = simulator.images(press[3].vertices, np.random.default_rng(0))
    np.testing.assert_array_equal(image, np.concatenate(press[1], 1))
    path = simulator.at_rest().to_file(tmp_path)
    again = tm.Sensor.from_file(path)
    assert again.fingerprint == simulator.at_rest().fingerprint and again.image_size == (320, 120)
    assert [view.region for view in again.views] == [(0, 0, 160, 120), (160, 0, 160, 120)]
    assert sorted(file.name for file in tmp_path.glob("*.png")) == ["sensor_rest.png"]
    reconstructor = tm.Reconstructor(again)
    mesh = Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz"))
    assert mesh.image_part.tolist() == [0, 0, 320, 120] and mesh.first_region(image).shape == (120, 160)
    one, two = found, reconstructor(image)
    for name in ("vertices", "force", "pixels", "residual"):
        torch.testing.assert_close(getattr(one, name), getattr(two, name), rtol=2e-3, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "right"', 'name = "left"', "View: name is 'left'; expected another name"),
        ('name = "right"\n', "", r"\[camera\[1\]\] name is missing"),
        ('name = "right"', 'name = "to the right"', "expected a name of letters"),
        ('name = "right"', 'name = "right"\nside = "beside"', '"inside" or "outside"'),
        ('name = "right"', 'name = "right"\nregion = [0, 0, 200, 120]', "within the calibrated image of 160 x 120"),
        (
            'name = "right"',
            'name = "right"\nregion = [0, 0, 160, 120]',
            "View 'left': no region; expected one, as other views have one",
        ),
        ('name = "left"', 'name = "left"\nside = "outside"', "'inside' of the first view"),
        ("[0.0, 1.0, 0.0, 0.0]", "[0.0, 2.0, 0.0, 0.0]", "orthogonal rows"),
        (", [0.0, 0.0, 0.0, 1.0]]", "]", "4 rows of 4 finite numbers"),
        (
            "[markers]",
            '[markers]\nrest_image = "sensor_rest_left.png"',
            "because view 'left' has no region of a shared image: give each",
        ),
    ],
)
def test_what_is_no_view_is_refused_in_words(press, tmp_path, old, new, said):
    path = press[0].at_rest().to_file(tmp_path)
    text = path.read_text()
    at = text.rindex(old) if old.startswith(("[0", ", [0")) else text.index(old)
    path.write_text(text[:at] + new + text[at + len(old) :])
    with pytest.raises(tm.MembraneError, match=said):
        tm.Sensor.from_file(path)


def test_views_need_listed_dots_and_an_estimator_that_takes_them(press):
    sensor = press[0].at_rest()
    image = Markers("dots", "dark", rest_image=sensor.markers.rest_image)
    with pytest.raises(tm.MembraneError, match="dots with their positions"):
        replace(sensor, markers=image)
    with pytest.raises(tm.MembraneError, match="views for minimum-energy is 2; expected 1"):
        tm.Reconstructor(sensor, "minimum-energy")


def test_a_mirror_shows_the_image_reversed():
    """The cap is symmetric to the mirror, the lens to its image's middle: what the mirror shows is the image reversed."""
    simulator = Simulator(cap(View("mirror", CAMERA, MIRROR)))
    direct, mirrored = simulator.view_images(simulator.membrane.rest, np.random.default_rng(0))
    assert direct.std() > 30
    np.testing.assert_allclose(mirrored.astype(float), direct[:, ::-1], atol=2.01)


def test_a_view_from_outside_sees_the_outer_side():
    """From beyond the cap, looking back: all dots of a dome that bulges towards the camera are seen, none as from within."""
    back = ViewPose(np.array([180.0, 0.0, 0.0]), np.array([0.0, 0.0, 36.0]))
    outside, wrong = (View("back", CAMERA, back, side=side) for side in ("outside", "inside"))
    assert bool(Simulator(cap(outside)).rest_dots.visible.all())
    with pytest.raises(tm.MembraneError, match="view back.*: 0 of 49 markers are seen"):
        tm.Reconstructor(cap(wrong))
    sensor = cap(outside).in_view(1)
    assert float((sensor.membrane.rest_normals * sensor.membrane.rest).sum(-1).min()) > 0  # away from its camera


def test_rays_of_a_rig_pass_through_the_points_whose_pixels_they_are():
    port = tm.Camera("fisheye", (640, 480), (180, 180), (310, 250), ports=[(2, 3, 1.49)], medium_index=1.33)
    rig = Rig(
        [CAMERA, port, CAMERA], [ViewPose(np.eye(3), np.zeros(3)), BESIDE, ViewPose(MIRROR.rotation, np.array([30.0, 1, 0]))]
    )
    points = (torch.rand(4, 7, 3, dtype=torch.float64) * torch.tensor([6, 6, 4]) + torch.tensor([2, -3, 14])).repeat(1, 3, 1)
    origin, direction = rig.pixel_to_ray(rig.point_to_pixel(points))
    miss = torch.linalg.cross(points - origin, direction)
    torch.testing.assert_close(miss, torch.zeros_like(miss), rtol=0, atol=1e-9)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(4, 21).double())


def test_one_view_that_has_moved_too_far_is_enough():
    rig = Rig([CAMERA, CAMERA], [ViewPose(np.eye(3), np.zeros(3)), BESIDE])
    far = torch.zeros(4, 2, 4)
    far[1, 0, 0], far[2, 1, 1], far[3, :, 0] = 50.0, -50.0, 50.0
    assert rig.is_displaced(far.flatten(1)).tolist() == [False, True, True, True]


@pytest.mark.parametrize("ports", [(), ((0.5, 4.0, 1.49), (6.0, 1.0, 1.6))])
def test_rays_turn_by_the_noise_of_pixels_about_points_on_them(ports):
    """By how far a ray to a neighbouring pixel misses the point, over its distance; behind a port rays shift as well."""
    camera = tm.Camera("pinhole", (160, 120), (100, 100), (79.5, 59.5), ports=list(ports), medium_index=1.33 if ports else 1.0)
    points = torch.rand(1, 9, 3, dtype=torch.float64) * torch.tensor([10, 8, 4]) + torch.tensor([-5, -4, 9])
    pixels, step = camera.point_to_pixel(points), 1e-4
    turned = turns_by_noise(camera, pixels, points, 0.04 * torch.eye(2).double().expand(9, 2, 2))
    distance = (points - camera.pixel_to_ray(pixels).origin).norm(dim=-1)[..., None]
    for k in range(2):
        origin, direction = camera.pixel_to_ray(pixels + step * torch.eye(2).double()[k])
        miss = origin - points + ((points - origin) * direction).sum(-1, keepdim=True) * direction
        across = turned[:, :, k] - (turned[:, :, k] * direction).sum(-1, keepdim=True) * direction
        torch.testing.assert_close(across, 0.2 / step * miss / distance, rtol=1e-3, atol=1e-6)


def test_two_views_see_what_one_infers(found, alone, press):
    """Both views' markers are found and explained; the surface is nearer to the truth than that of the first view alone."""
    simulator, images, truth, state = press
    assert found.status.tolist() == [0] and list(found.pixels.shape) == [1, 2, 49, 2]
    assert list(found.confidence.shape) == [1, 2, 49] and list(found.residual.shape) == [1, 2]
    assert list(found.camera_motion.shape) == [1, 2, 4] and list(found.markers.shape) == [1, 49, 3]
    seen = found.confidence[0] > 0.5
    assert seen.float().mean() > 0.9
    pixels = torch.from_numpy(truth["uv_deformed"])
    assert float((found.pixels[0] - pixels)[seen].norm(dim=-1).median()) < 0.1
    assert off(found, truth) < 0.6 * off(alone(images[0]), truth)


def test_a_list_and_a_stack_are_the_same(reconstructor, found, press):
    one, stacked = reconstructor(press[1]), reconstructor(np.stack([np.stack(press[1])] * 2))
    for name in ("vertices", "force", "pixels", "residual"):
        batch, single = getattr(stacked, name)[1:], getattr(one, name)
        torch.testing.assert_close(batch, single, rtol=2e-3, atol=1e-3, equal_nan=True)
    for wrong, said in ((press[1][0], "expected a list of 2 batches"), (press[1][:1], "images of 1 views; expected 2")):
        with pytest.raises(tm.MembraneError, match=said):
            reconstructor(wrong)


def test_a_stack_of_views_may_be_any_array(reconstructor, press):
    """Of reversed axes, and of another byte order, as files of other machines have it."""
    images = np.stack(press[1])
    expected = reconstructor(images)
    for array in (images[:, ::-1].copy()[:, ::-1], images.astype(">u2") * 257):
        found = reconstructor(array)
        torch.testing.assert_close(found.vertices, expected.vertices, rtol=0, atol=1e-5)


def test_the_order_of_the_views_does_not_matter(press, found):
    """The other view as the first: the same surface in that view's frame."""
    simulator, images, truth, state = press
    sensor, inverse = simulator.at_rest(), BESIDE.inverse
    other = sensor.in_view(1)
    other = replace(other, membrane=Surface.from_membrane(other.membrane).membrane((9, 9)), surface=None)
    swapped = replace(other, views=(View("right", CAMERA), View("left", CAMERA, inverse, sensor.markers.rest_image)))
    got = tm.Reconstructor(swapped)(images[::-1])
    back = BESIDE.points(got.vertices[0])
    assert float((back - found.vertices[0]).norm(dim=-1).max()) < 0.02 * 1.2
    np.testing.assert_allclose(BESIDE.vectors(got.force[0]).numpy(), found.force[0].numpy(), atol=0.03 * found.force.norm())


def test_regions_of_images_of_two_sizes_are_refused_by_the_name_of_the_view():
    sizes = {"left": (400, 300), "right": (400, 300), "back": (640, 480)}
    wholes = {name: tm.Camera("pinhole", size, (200, 200), (199.5, 149.5)) for name, size in sizes.items()}
    views = [View(name, whole.in_mode((0, 0, 160, 120)), is_region=True) for name, whole in wholes.items()]
    refuse_views(views[:2], has_listed_dots=True)
    with pytest.raises(MembraneError, match=r"View 'back': image_size .*\[640, 480\].*\[400, 300\], as in view 'left'"):
        refuse_views(views, has_listed_dots=True)


def test_the_first_view_of_a_picture_is_its_region_wherever_that_lies():
    whole = tm.Camera("pinhole", (400, 300), (200, 200), (199.5, 149.5))
    views = [View(name, whole.in_mode((left, 130, 160, 120)), is_region=True) for name, left in (("a", 210), ("b", 20))]
    grey = np.arange(300 * 400).reshape(300, 400) % 251
    expected = grey[130:250, 210:370]
    np.testing.assert_array_equal(first_view_picture(grey, views), expected)
    np.testing.assert_array_equal(first_view_picture(np.stack([grey] * 3, -1), views)[..., 1], expected)
    np.testing.assert_array_equal(first_view_image(torch.from_numpy(grey)[None, None], views), expected)
    apart = [View("a", CAMERA), View("b", CAMERA)]
    assert first_view_picture([grey, None], apart) is grey and first_view_picture([None, grey], apart) is None
    assert first_view_picture(grey, ()).shape == first_view_image(torch.from_numpy(grey)[None, None], ()).shape == (300, 400)


def test_a_camera_given_to_a_region_is_that_of_the_region_s_pixels():
    whole = tm.Camera("pinhole", (640, 480), (400, 410), (320, 240))
    view = View("right", whole.in_mode((320, 96, 320, 300)), is_region=True)
    lens = tm.Camera("pinhole", (320, 300), (405, 402), (3.5, 147.0), (-0.1, 0.02, 0.001, -0.002))
    found, points = view.with_camera(lens), torch.tensor([[1.0, 2.0, 20.0], [4.0, -3.0, 25.0]], dtype=torch.float64)
    assert found.region == view.region and found.camera.mode.image_size == (640, 480)
    torch.testing.assert_close(found.camera.point_to_pixel(points), lens.point_to_pixel(points))


def test_where_all_views_fail_the_frame_has_the_gravest_of_their_reasons(reconstructor):
    """Values that are none before blank images, these before too few markers, and these before another scene."""
    gravest = [Status.BAD_VALUES, Status.BLANK, Status.TOO_FEW_MARKERS, Status.UNLIKE_REST]
    pairs = torch.tensor([[int(one), int(other)] for one in gravest for other in gravest])
    flow = reconstructor.observer.from_pixels(reconstructor.rest_pixels[None], None, None)
    many = [value.expand(len(pairs), *value.shape[1:]) for value in flow[:3]]
    found = reconstructor.observer.judge(*many, pairs)
    expected = [gravest[min(i, j)] for i in range(4) for j in range(4)]
    assert found.status.tolist() == expected and (found.confidence == 0).all()


def test_a_view_that_fails_is_left_out_and_named(reconstructor, alone, press):
    """Its confidence is zero, the frame's status says so, and the answer is that of the others."""
    left, right = press[1]
    blank = np.full_like(left, 30)
    got = reconstructor([np.stack([left, blank, blank]), np.stack([blank, right, blank])])
    assert got.status.tolist() == [10, 10, 4] and tm.Status(10).has_surface
    assert (got.confidence[0, 1] == 0).all() and (got.confidence[1, 0] == 0).all() and (got.confidence[0, 0] > 0).any()
    assert got.pixels[0, 1].isnan().all() and got.vertices[2].isnan().all()
    assert float((got.vertices[0] - alone(left).vertices[0]).norm(dim=-1).max()) < 0.05


def test_markers_that_one_view_sees_count_as_much(reconstructor, press):
    """Every third dot is hidden from one view, every other third from the other: nothing is missing, the shape stays right."""
    truth = press[2]
    pixels, sure = torch.from_numpy(truth["uv_deformed"])[None], torch.ones(1, 2, 49)
    whole = reconstructor.from_pixels(pixels, sure)
    sure[:, 0, 0::3], sure[:, 1, 1::3] = 0, 0
    part = reconstructor.from_pixels(pixels, sure)
    assert part.status.tolist() == whole.status.tolist() == [0] and float(part.coverage[0]) == float(whole.coverage[0])
    assert off(part, truth) < 1.5 * off(whole, truth) + 0.005


def test_a_marker_that_two_views_see_at_one_place_is_kept_whatever_its_neighbours_do(reconstructor):
    """One dot moves by its spacing, alone: both views see it at one place; one takes it for its neighbour; one sees it."""
    moved, neighbour = 24, 25
    dots = reconstructor.rest_markers[:49].clone()
    dots[moved] += torch.tensor([0.6, 0.6, -1.7])
    pixels = reconstructor.camera.point_to_pixel(dots.repeat(2, 1)).unflatten(0, (2, 49))
    wrong = pixels.clone()
    wrong[1, moved] = reconstructor.rest_pixels[1, neighbour]
    one = torch.ones(2, 49)
    one[1, moved] = 0
    for given, confidence, kept in ((pixels, None, [True, True]), (wrong, None, [False, False]), (pixels, one, [False, False])):
        flow = reconstructor.observer.from_pixels(given, confidence, None)
        sure = reconstructor.observer.by_view(flow.confidence)[0] > 0.5
        assert sure[:, moved].tolist() == kept
        others = torch.arange(49) != moved
        assert sure[:, others].all()
        with_three = reconstructor.observer.by_view(
            reconstructor.observer.from_pixels(pixels.repeat(3, 1, 1, 1), None, None)[1]
        )
        assert (with_three > 0.5).all()


def test_a_knocked_view_is_found_by_its_own_motion(reconstructor, found, press):
    """The second image is 2 px to the right: that view has moved, the first has not, and the answer stays."""
    left, right = press[1]
    knocked = reconstructor([left, np.roll(right, 2, axis=1)])
    motion = knocked.camera_motion[0]
    assert abs(float(motion[1, 0]) - 2) < 0.1 and float(motion[0, :2].norm()) < 0.1
    assert knocked.status.tolist() == [0]
    assert float((knocked.vertices - found.vertices).norm(dim=-1).max()) < 0.06
    assert status_in_words(knocked.frame(0), ["left", "right"]) == "ok; view right has moved since the rest image"
    assert status_in_words(found.frame(0), ["left", "right"]) == "ok"


def test_noise_spreads_from_all_views(reconstructor, found):
    """With a second view the depth is known better."""
    both = reconstructor.standard_deviations(found)
    one = reconstructor.standard_deviations(found._replace(confidence=found.confidence * torch.tensor([1.0, 0.0])[:, None]))
    assert float(both.vertices.max()) < 0.8 * float(one.vertices.max())


def test_check_says_and_draws_each_view(reconstructor, press):
    sensor = reconstructor.sensor
    frame = rest_frame(reconstructor)
    said = "\n".join(described(sensor, reconstructor, frame))
    assert "view 'right' from 7, 0, 0 mm along -0.42262, 0, 0.90631, inside: sees 49 of 49" in said
    assert "view 'left': 49 found in its rest image" in said and "rest images reconstructed: ok" in said
    fine = replace(sensor, membrane=sensor.surface.membrane((25, 25)))
    assert ["coarse for several views" in "\n".join(described(each)) for each in (sensor, fine, sensor.in_view(0))] == [1, 0, 0]
    titles = [axes.get_title() for axes in sensor_figure(sensor, reconstructor, frame).axes]
    assert titles[2:] == ["Rest image of view left", "Rest image of view right"]


def test_commands_take_an_image_of_each_view(press, tmp_path, capsys):
    """simulate writes NAME_VIEW.png, reconstruct takes them; results keep the views apart, in files and tables."""
    out, found = tmp_path / "out", tmp_path / "found"
    press[0].at_rest().to_file(out)
    for number in range(2):
        for name, image in zip(("left", "right"), press[1], strict=True):
            Image.fromarray(image).save(out / f"press{number}_{name}.png")
    (out / "press1_right.png").unlink()
    images = f"{out}/press*.png"
    assert main(["reconstruct", str(out / "sensor.toml"), images, "--out", str(found), "--workers", "1", "--figures"]) == 0
    assert "press1_right.png" in capsys.readouterr().err  # its frame is the left view's alone
    results = tm.read_results(found)
    assert results.names == ["press0_left", "press1_left"] and [int(each["status"]) for each in results] == [0, 10]
    assert results.mesh.view_names == "left right" and results.mesh.views == 2 and results.mesh.rest_pixels.shape == (2, 49, 2)
    frame = results["press0_left"]
    assert frame["pixels"].shape == (2, 49, 2) and frame["residual"].shape == (2,) and (found / "press0_left.png").exists()
    row = (found / "summary.csv").read_text().splitlines()[1]
    assert row.startswith("press0_left,") and ",49,49," in row
    with pytest.raises(MembraneError, match="of no view"):
        of_first_view(Inputs([tmp_path / "press_left.png", tmp_path / "other.png"], []), ["left", "right"])


def test_a_changed_image_of_any_view_is_done_again(press, tmp_path, capsys):
    """The hash in a frame's result is that of all views' files."""
    out, found = tmp_path / "out", tmp_path / "found"
    press[0].at_rest().to_file(out)
    files = [out / f"press_{name}.png" for name in ("left", "right")]
    for file, image in zip(files, press[1], strict=True):
        Image.fromarray(image).save(file)
    call = ["reconstruct", str(out / "sensor.toml"), f"{out}/press*.png", "--out", str(found), "--workers", "1"]
    assert main(call) == 0
    first = tm.read_results(found)["press_left"]["residual"]
    assert main(call) == 0
    said = capsys.readouterr()
    assert "done again" not in said.out + said.err
    Image.fromarray(np.roll(press[1][1], 2, axis=1)).save(files[1])
    assert main(call) == 0
    said = capsys.readouterr()
    assert "press_left.png: changed, done again" in said.out + said.err
    assert "view right: its camera has moved since the rest image, in 1 frames" in said.out + said.err
    assert "ok; view right has moved" in (found / "summary.csv").read_text()
    assert not np.array_equal(tm.read_results(found)["press_left"]["residual"], first)


def test_simulate_writes_an_image_for_each_view(press, tmp_path, capsys):
    file = press[0].sensor.to_file(tmp_path / "sensor")
    call = f"simulate {file} --indenter sphere --radius 3 --depth 0.5 --out {tmp_path / 'out'}".split()
    assert main(call) == 0 and "press_left.png, " in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert names == {"press_left.png", "press_right.png", "sensor_rest_left.png", "sensor_rest_right.png"}
    assert len(tm.Sensor.from_file(tmp_path / "out" / "sensor.toml").views) == 2


def test_material_is_not_calibrated_from_pixels_of_several_views(press):
    """What is found of one camera would leave the others as they were."""
    with pytest.raises(MembraneError, match="calibrate material: views is 2; expected 1"):
        material_from_pixels(press[0].sensor, torch.as_tensor(press[2]["uv_deformed"])[None])


def test_markers_that_a_view_does_not_see_at_rest_count_for_nothing():
    """Half of the dots turn away from a view from the side, behind a port: wherever it is told to see them, the answer is that
    of the dots that it sees, and as near to the truth as this coarse grid comes."""
    side = ViewPose(np.array([0.0, -75.0, 0.0]), np.array([17.0, 0.0, 9.0]))
    lens = tm.Camera("fisheye", (160, 120), (90, 90), (79.5, 59.5), ports=[(0.5, 0.5, 1.49)], medium_index=1.33)
    simulator = Simulator(cap(View("side", lens, side)))
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    (state,) = simulator.presses(stroke, ["push"])
    pixels = simulator.dots(state.vertices).pixels
    both = tm.Reconstructor(simulator.sensor)
    seen = both.observer.each[1].seen_at_rest
    assert 8 <= int(seen.sum()) < 40
    sure = torch.stack([torch.ones(49), seen.float()])
    expected = both.from_pixels(pixels.nan_to_num(), sure)
    wild = torch.where(seen[:, None], pixels[1], 1e4 * torch.rand(49, 2, dtype=torch.float64))
    beside = torch.where(seen[:, None], pixels[1], both.rest_pixels[1] + 1.0)
    for given, confidence in ((wild, torch.ones(2, 49)), (beside, None), (torch.where(seen[:, None], wild, torch.nan), None)):
        got = both.from_pixels(torch.stack([pixels[0], given]), confidence)
        for name, value in expected._asdict().items():
            torch.testing.assert_close(getattr(got, name), value, rtol=0, atol=0, equal_nan=True, msg=name)
    assert expected.status.tolist() == [0] and (expected.confidence[0, 1] > 0).sum() <= seen.sum()
    assert float((expected.force[0].double() - state.force).norm() / state.force.norm()) < 0.25
    deviations = both.standard_deviations(expected)
    assert all(bool(value.isfinite().all()) for value in deviations)
