"""The camera, the step and the converter as LeRobot uses them."""

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import requires

import cv2
import numpy as np
import pytest
import torch
from conftest import EXAMPLES
from lerobot.cameras.configs import CameraConfig, Cv2Rotation
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import DataProcessorPipeline
from lerobot.processor.converters import identity_transition
from lerobot.processor.pipeline import ProcessorStepRegistry
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from lerobot_camera_torchmembrane.versions import refuse_untested

import torchmembrane as tm
from torchmembrane.integrations.rerun import RerunLog
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.sensor.views import View

VERTICES = 81


@pytest.fixture
def camera_of(sensor):
    """LeRobot's camera of a video file."""
    made = []

    def camera(video, **options):
        config = CameraConfig.get_choice_class("torchmembrane")(sensor=str(sensor), index_or_path=video, **options)
        made.extend(make_cameras_from_configs({"finger": config}).values())
        return made[-1]

    yield camera
    for each in made:
        if each.is_connected:
            each.disconnect()


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """A video of 8 frames at 20 Hz, the k-th of grey level 30 k."""
    path = tmp_path_factory.mktemp("counted") / "counted.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20, (640, 480))
    for k in range(8):
        writer.write(np.full((480, 640, 3), 30 * k, np.uint8))
    writer.release()
    return path


def number(frame):
    return round(frame.mean() / 30)


@pytest.mark.parametrize("version", ["0.4.4", "0.5.1", "0.7.0", "1.6.0"])
def test_a_lerobot_that_was_not_tested_is_refused_in_words(version):
    with pytest.raises(ImportError, match=rf"tested with lerobot 0\.6, and {version} is installed"):
        refuse_untested(version)


def test_corrections_of_the_tested_lerobot_are_taken():
    for version in ("0.6.0", "0.6.12", "0.6.1.post1"):
        refuse_untested(version)


def test_an_install_asks_for_no_version_of_lerobot():
    """What it asked for, pip would install over the user's."""
    assert "lerobot" in requires("lerobot_camera_torchmembrane")


def test_a_video_comes_as_a_device_does(camera_of, counted):
    """Frames pass at the file's rate whether they are read or not, in order, and the first follows the last."""
    camera = camera_of(counted)
    assert camera.fps == 20
    camera.connect()
    began, numbers = time.perf_counter(), [number(camera.async_read(timeout_ms=2000)) for _ in range(17)]
    assert time.perf_counter() - began == pytest.approx(16 / 20, rel=0.3)
    steps = np.diff(numbers) % 8
    assert (steps >= 1).all() and steps.sum() == pytest.approx(16, abs=3) and {0, 7} <= set(numbers)
    before = camera.read_latest()
    assert camera.read_latest() is before  # a look takes nothing away
    time.sleep(0.2)
    assert (number(camera.read_latest()) - number(before)) % 8 in (3, 4, 5)
    assert camera.read().shape == (480, 640, 3) and camera.read().dtype == np.uint8


def test_a_camera_says_what_lerobot_s_do_when_it_is_not_open_or_open_already(camera_of, counted):
    camera = camera_of(counted)
    for read in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            read()
    camera.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        camera.connect()
    camera.disconnect()
    assert not camera.is_connected
    camera.connect()  # again


def test_a_camera_takes_what_lerobot_s_opencv_camera_takes(camera_of, counted, presses, sensor):
    options = dict(fourcc="MJPG", rotation=180, backend=0, warmup_s=2)
    camera = camera_of(counted, fps=5, **options)
    assert (camera.fps, camera.width, camera.height) == (5, 640, 480) and camera.config.rotation == Cv2Rotation.ROTATE_180
    turned = counted.with_name("turned.avi")
    writer = cv2.VideoWriter(str(turned), cv2.VideoWriter_fourcc(*"MJPG"), 20, (640, 480))
    writer.write(cv2.rotate(cv2.cvtColor(presses[0], cv2.COLOR_RGB2BGR), cv2.ROTATE_180))
    writer.release()
    camera = camera_of(turned, rotation=180)
    camera.connect()
    assert np.abs(camera.read_latest().astype(int) - presses[0]).mean() < 3


def test_what_does_not_fit_the_sensor_file_is_refused(camera_of, counted, tmp_path):
    with pytest.raises(tm.MembraneError, match="320 x 480; expected 640 x 480"):
        camera_of(counted, width=320)
    with pytest.raises(tm.MembraneError, match="frames of 640 x 480; expected 480 x 640"):
        camera_of(counted, rotation=90)
    with pytest.raises(tm.MembraneError, match="color_mode: bgr; expected rgb"):
        camera_of(counted, color_mode="bgr")
    broken = tmp_path / "broken.avi"
    broken.write_bytes(b"no video")
    with pytest.raises(tm.MembraneError, match="not readable as a video"):
        camera_of(broken)


@pytest.fixture(scope="module")
def sensor_of(tmp_path_factory):
    """A file of the example's sensor with two views: both the left part of one image, or each with images of its own."""

    def path_of(is_region):
        one = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
        lens = one.camera.focal.tolist(), one.camera.centre.tolist(), one.camera.distortion.tolist()
        part = tm.Camera(one.camera.model, (740, 480), *lens).in_mode((0, 0, 640, 480))
        camera = part if is_region else one.camera
        views = tuple(View(name, camera, rest_image=one.markers.rest_image, is_region=is_region) for name in ("a", "b"))
        markers = replace(one.markers, rest_image=None)
        two = replace(one, membrane=one.surface.membrane((9, 9)), camera=camera, markers=markers, views=views)
        return two.to_file(tmp_path_factory.mktemp("views") / "sensor.toml")

    return path_of


def test_a_camera_of_views_that_share_an_image_gives_the_whole_image(sensor_of):
    config = CameraConfig.get_choice_class("torchmembrane")(sensor=str(sensor_of(is_region=True)), fps=30)
    assert (config.width, config.height) == (740, 480)


def test_views_with_images_of_their_own_are_refused(sensor_of):
    path = str(sensor_of(is_region=False))
    for make in (
        lambda: CameraConfig.get_choice_class("torchmembrane")(sensor=path, fps=30),
        lambda: ProcessorStepRegistry.get("torchmembrane_tactile")(sensor=path, name="finger"),
    ):
        with pytest.raises(tm.MembraneError, match="the views a, b have images of their own"):
            make()


@pytest.fixture(scope="module")
def step(sensor):
    step = ProcessorStepRegistry.get("torchmembrane_tactile")(sensor=str(sensor), name="finger")
    return type(step)(**step.get_config())


@pytest.fixture(scope="module")
def expected(sensor, presses):
    """What a tracker gives for the last of the presses."""
    return tm.Tracker(tm.Reconstructor.from_file(sensor))(presses[2]).frame(0)


def through(step, observation):
    step.reset()
    pipeline = DataProcessorPipeline([step], to_transition=identity_transition, to_output=identity_transition)
    return pipeline({"observation": observation})["observation"]


def test_a_robot_s_observation_gets_plain_numbers(step, presses, expected):
    seen = through(step, {"finger": presses[2], "joint.pos": 1.0})
    names = [f"finger.{each}" for each in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")]
    np.testing.assert_allclose([seen[name] for name in names], expected["wrench"], rtol=1e-6)
    assert seen["finger.status"] == 0 and seen["finger"] is presses[2] and all(type(seen[name]) is float for name in names)
    declared = step.transform_features({PipelineFeatureType.OBSERVATION: {"finger": (480, 640, 3)}})
    assert declared[PipelineFeatureType.OBSERVATION].keys() == seen.keys() - {"joint.pos"}
    dark = through(step, {"finger": 0 * presses[2]})
    assert dark["finger.status"] == tm.Status.BLANK and [dark[name] for name in names] == [0] * 6


def test_a_policy_s_observation_gets_tensors(step, presses, expected):
    """Alone and as a batch of one, channels first, in 0..1."""
    image = torch.from_numpy(presses[2]).permute(2, 0, 1) / 255
    for batch in ((), (1,)):
        seen = through(step, {"observation.images.finger": image.expand(*batch, 3, 480, 640)})
        felt = {key.rpartition(".")[2]: value for key, value in seen.items() if ".tactile.finger." in key}
        sizes = {"wrench": (6,), "contacts": (24,), "status": (1,), "points": (VERTICES, 6)}
        assert {name: tuple(value.shape) for name, value in felt.items()} == {
            name: (*batch, *size) for name, size in sizes.items()
        }
        wrench, points = (felt[name].reshape(sizes[name]) for name in ("wrench", "points"))
        np.testing.assert_allclose(wrench, expected["wrench"], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(points[:, 3:].sum(0), wrench[:3], rtol=1e-3, atol=1e-3)
        contacts = felt["contacts"].reshape(4, 6)
        np.testing.assert_allclose(contacts[:, :3], np.nan_to_num(expected["contact_points"]), atol=1e-3)
    declared = step.transform_features({PipelineFeatureType.OBSERVATION: {}})[PipelineFeatureType.OBSERVATION]
    assert {key: each.shape for key, each in declared.items()} == {
        f"observation.tactile.finger.{name}": size for name, size in sizes.items()
    }
    assert all(isinstance(each, PolicyFeature) for each in declared.values())


def test_an_observation_without_the_image_is_refused(step, presses):
    with pytest.raises(tm.MembraneError, match="expected finger or observation.images.finger"):
        through(step, {"elsewhere": presses[2]})


def test_recorded_runs_load_as_a_data_set(sensor, tmp_path):
    from conftest import PRESSES
    from lerobot_camera_torchmembrane.commands import to_lerobot

    from torchmembrane.cli.main import main

    run, root = tmp_path / "run", tmp_path / "set"
    assert main(["reconstruct", str(sensor), *(str(EXAMPLES / f"{name}.png") for name in PRESSES), "--out", str(run)]) == 0
    arguments = [str(run), str(run), "--root", str(root), "--name", "finger", "--fps", "30"]
    assert to_lerobot(arguments) == 0 and to_lerobot(arguments) == 2  # there is one now
    dataset = LeRobotDataset("local/tactile", root=root)
    assert dataset.num_episodes == 2 and len(dataset) == 2 * len(PRESSES) and dataset.meta.info.codebase_version == "v3.0"
    for k, frame in enumerate(tm.read_results(run)):
        item = {key.rpartition(".")[2]: value for key, value in dataset[k].items() if ".tactile.finger." in key}
        np.testing.assert_allclose(item["wrench"].numpy(), frame["wrench"], rtol=1e-5)
        np.testing.assert_allclose(item["points"][:, 3:].sum(0).numpy(), frame["force"], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(item["contacts"].reshape(4, 6)[0, 3:], frame["contact_force"][0], rtol=1e-5)


def test_an_image_that_cannot_be_read_keeps_its_place_in_time(sensor, tmp_path):
    from conftest import PRESSES
    from lerobot_camera_torchmembrane.commands import to_lerobot

    from torchmembrane.cli.main import main

    images = [tmp_path / f"press_{number}.png" for number in (1, 2, 10)]
    for path, name in zip(images, PRESSES, strict=True):
        shutil.copy(EXAMPLES / f"{name}.png", path)
    images[1].write_bytes(b"cut off")
    run, root = tmp_path / "run", tmp_path / "set"
    assert main(["reconstruct", str(sensor), *map(str, images), "--out", str(run)]) == 1
    assert to_lerobot([str(run), "--root", str(root), "--name", "finger", "--fps", "30"]) == 0
    dataset, results = LeRobotDataset("local/tactile", root=root), tm.read_results(run)
    status = [int(dataset[k]["observation.tactile.finger.status"]) for k in range(3)]
    wrench = [dataset[k]["observation.tactile.finger.wrench"].numpy() for k in range(3)]
    assert len(dataset) == 3 and status == [0, -1, 0] and not wrench[1].any()
    np.testing.assert_allclose([wrench[0], wrench[2]], [frame["wrench"] for frame in results], rtol=1e-5)
    assert float(dataset[2]["timestamp"]) == pytest.approx(2 / 30)


def test_a_data_set_folder_is_loaded_by_datasets_offline(sensor, tmp_path):
    from conftest import PRESSES
    from datasets import load_dataset

    from torchmembrane.cli.main import main

    images, run = [str(EXAMPLES / f"{name}.png") for name in PRESSES], str(tmp_path / "run")
    assert main(["reconstruct", str(sensor), *images, "--out", run]) == 0
    assert main(["view", run, "--dataset", str(tmp_path / "set"), "--images", str(EXAMPLES)]) == 0
    assert main(["view", run, "--dataset", str(tmp_path / "bare")]) == 0
    for name in ("set", "bare"):
        loaded = load_dataset(str(tmp_path / name), split="train", cache_dir=str(tmp_path / "cache"))
        for row, frame in zip(loaded, tm.read_results(run), strict=True):
            np.testing.assert_allclose(row["wrench"], frame["wrench"], rtol=1e-6)
            np.testing.assert_allclose(row["vertices"], frame["vertices"], rtol=1e-6)
            if name == "set":
                assert np.array_equal(row["image"], cv2.imread(str(EXAMPLES / f"{row['name']}.png"), cv2.IMREAD_UNCHANGED))


def test_the_viewer_takes_the_version_that_lerobot_allows(sensor, expected, tmp_path):
    reconstructor = tm.Reconstructor.from_file(sensor)
    with RerunLog(
        Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz")), tmp_path / "press.rrd"
    ) as log:
        log.add(0, expected)
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "press.rrd")], check=True)


def test_without_lerobot_s_data_sets_the_plugin_works_and_its_commands_name_what_is_missing():
    script = (
        "import sys; sys.modules['datasets'] = None\n"
        "import lerobot_camera_torchmembrane\n"
        "from lerobot_camera_torchmembrane.commands import lerobot_add\n"
        "sys.exit(lerobot_add(['runs/press', '--sensor', 'finger=sensor.toml']))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2 and 'pip install "lerobot[dataset]"' in done.stderr, done.stderr
