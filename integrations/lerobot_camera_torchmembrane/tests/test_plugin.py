"""LeRobot finds the plugin by its name, makes its camera and its step, and reads what the converter writes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lerobot.cameras.configs import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import DataProcessorPipeline
from lerobot.processor.converters import identity_transition
from lerobot.processor.pipeline import ProcessorStepRegistry
from lerobot.utils.import_utils import register_third_party_plugins

import torchmembrane as tm

EXAMPLES = Path(__file__).parents[3] / "examples"
SENSOR, PRESSES = EXAMPLES / "sensor.toml", ("press_on_axis", "flat_plate", "two_contacts")
POINTS, WRENCH = "observation.tactile.finger.points", "observation.tactile.finger.wrench"


@pytest.fixture(scope="module", autouse=True)
def found():
    register_third_party_plugins()
    assert "torchmembrane" in CameraConfig.get_known_choices()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    from torchmembrane.cli.main import main

    folder = tmp_path_factory.mktemp("results")
    images = [str(EXAMPLES / f"{name}.png") for name in PRESSES]
    assert main(["reconstruct", str(SENSOR), *images, "--out", str(folder)]) == 0
    return folder


def test_lerobot_makes_the_camera_and_reads_frames(tmp_path):
    video, frame = tmp_path / "press.avi", cv2.imread(str(EXAMPLES / "two_contacts.png"))
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 30, (640, 480))
    for _ in range(3):
        writer.write(frame)
    writer.release()
    made = CameraConfig.get_choice_class("torchmembrane")(sensor=str(SENSOR), index_or_path=str(video))
    (camera,) = make_cameras_from_configs({"finger": made}).values()
    with pytest.raises(ConnectionError, match="connect"):
        camera.read()
    camera.connect()
    frames = [camera.async_read() for _ in range(4)]  # one more than the file has
    camera.disconnect()
    assert all(one.shape == (480, 640, 3) and one.dtype == np.uint8 for one in frames) and not camera.is_connected
    with pytest.raises(tm.MembraneError, match="expected 640 x 480"):
        CameraConfig.get_choice_class("torchmembrane")(sensor=str(SENSOR), width=320)


def test_the_registered_step_adds_points_and_wrench_and_survives_its_configuration():
    step = ProcessorStepRegistry.get("torchmembrane_tactile")(sensor=str(SENSOR), name="finger")
    step = type(step)(**step.get_config())
    pipeline = DataProcessorPipeline([step], to_transition=identity_transition, to_output=identity_transition)
    image = cv2.cvtColor(cv2.imread(str(EXAMPLES / "two_contacts.png")), cv2.COLOR_BGR2RGB)
    seen = pipeline({"observation": {"finger": image}})["observation"]
    assert seen[POINTS].shape == (1089, 6) and seen[WRENCH].shape == (6,) and seen["finger"] is image
    torch.testing.assert_close(seen[POINTS][:, 3:].sum(0), seen[WRENCH][:3], rtol=1e-3, atol=1e-3)
    assert seen[WRENCH][2] < -1
    with pytest.raises(tm.MembraneError, match="expected one of finger"):
        pipeline({"observation": {"elsewhere": image}})


def test_a_recorded_run_loads_as_a_data_set_with_tactile_keys(results, tmp_path):
    from lerobot_camera_torchmembrane import convert

    convert([results, results], tmp_path / "set", "local/tactile", "finger", fps=30)
    dataset = LeRobotDataset("local/tactile", root=tmp_path / "set")
    assert dataset.num_episodes == 2 and len(dataset) == 2 * len(PRESSES) and dataset.meta.info["codebase_version"] == "v3.0"
    run = tm.read_results(results)
    for k, frame in enumerate(run):
        item = dataset[k]
        assert item[POINTS].shape == (1089, 6) and item[WRENCH].shape == (6,) and item["task"] == "press"
        np.testing.assert_allclose(item[WRENCH].numpy(), frame["wrench"], rtol=1e-5)
        np.testing.assert_allclose(item[POINTS][:, 3:].sum(0).numpy(), frame["force"], rtol=1e-3, atol=1e-3)
