"""Episodes recorded by LeRobot with a robot without hardware: with the step, and alone, what was felt added afterwards."""

import json
import sys

import numpy as np
import pytest
import torch
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import RobotProcessorPipeline
from lerobot.processor.converters import observation_to_transition, transition_to_observation
from lerobot.scripts import lerobot_record
from lerobot_camera_torchmembrane import TactileProcessorStep, TorchMembraneCameraConfig
from lerobot_camera_torchmembrane.commands import lerobot_add

import torchmembrane as tm

IMAGE, WRENCH = "observation.images.finger", "observation.tactile.finger.wrench"
WRENCH_NAMES = ["finger.Fx", "finger.Fy", "finger.Fz", "finger.Mx", "finger.My", "finger.Mz"]
ARGUMENTS = ["--dataset.single_task=press", "--dataset.num_episodes=2", "--dataset.episode_time_s=1.5"]
ARGUMENTS += [
    "--dataset.reset_time_s=0",
    "--dataset.fps=5",
    "--dataset.push_to_hub=false",
    "--play_sounds=false",
    "--dataset.repo_id=local/press",
]


@pytest.fixture(scope="module")
def recorded(sensor, video, tmp_path_factory):
    """Folder of a data set as LeRobot's command records it, with images alone."""
    import fake_robot  # noqa: F401

    root = tmp_path_factory.mktemp("recorded") / "press"
    cameras = f"{{finger: {{type: torchmembrane, sensor: {sensor}, index_or_path: {video}, fps: 10}}}}"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", ["lerobot-record", "--robot.type=fake_robot", f"--robot.cameras={cameras}",
                                      "--teleop.type=fake_teleop", f"--dataset.root={root}", *ARGUMENTS])  # fmt: skip
        lerobot_record.main()
    return root


@pytest.fixture(scope="module")
def added(recorded, sensor):
    assert lerobot_add([str(recorded), "--sensor", f"finger={sensor}"]) == 0
    return recorded.with_name("press_tactile")


def test_the_command_records_the_camera_s_images(recorded):
    dataset = LeRobotDataset("local/press", root=recorded)
    assert dataset.num_episodes == 2 and len(dataset) > 4 and dataset[0][IMAGE].shape == (3, 480, 640)
    assert dataset.features["observation.state"]["names"] == ["joint.pos"]


def test_the_step_records_the_wrench_of_every_frame(sensor, video, tmp_path):
    import fake_robot

    step = TactileProcessorStep(sensor=str(sensor), name="finger")
    pipeline = RobotProcessorPipeline(
        steps=[step], to_transition=observation_to_transition, to_output=transition_to_observation
    )
    cameras = {"finger": TorchMembraneCameraConfig(sensor=str(sensor), index_or_path=video)}
    dataset = DatasetRecordConfig(
        repo_id="local/press", root=tmp_path / "set", single_task="press", num_episodes=1, fps=5, episode_time_s=3,
        push_to_hub=False, video=False,
    )  # fmt: skip
    config = lerobot_record.RecordConfig(
        fake_robot.FakeRobotConfig(cameras=cameras), dataset, fake_robot.FakeTeleopConfig(), play_sounds=False
    )
    lerobot_record.record(config, robot_observation_processor=pipeline)
    dataset = LeRobotDataset("local/press", root=tmp_path / "set")
    assert dataset.features["observation.state"]["names"] == ["joint.pos", *WRENCH_NAMES, "finger.status"]
    tracker, items = tm.Tracker(tm.Reconstructor.from_file(sensor)), [dataset[k] for k in range(len(dataset))]
    found = [tracker(item[IMAGE]).frame(0)["wrench"] for item in items]  # they were kept losslessly
    states = torch.stack([item["observation.state"] for item in items]).numpy()
    assert len(states) > 5 and (states[:, 7] == 0).all() and np.ptp(states[:, 3]) > 0.5  # N, of several presses
    np.testing.assert_allclose(states[:, 1:7], found, rtol=1e-3, atol=1e-3)


def test_what_is_added_is_what_a_tracker_finds_in_the_recorded_images(recorded, added, sensor):
    before, after = LeRobotDataset("local/press", root=recorded), LeRobotDataset("local/press", root=added)
    assert after.num_episodes == before.num_episodes and len(after) == len(before)
    tracker, episode = tm.Tracker(tm.Reconstructor.from_file(sensor)), None
    for k in range(len(after)):
        old, new = before[k], after[k]
        torch.testing.assert_close(new[IMAGE], old[IMAGE], rtol=0, atol=0)
        assert new["action"] == old["action"] and new["episode_index"] == old["episode_index"]
        if old["episode_index"] != episode:
            tracker.reset()
        episode, frame = old["episode_index"], tracker(old[IMAGE]).frame(0)
        np.testing.assert_allclose(new[WRENCH], frame["wrench"], rtol=1e-5)
        assert new["observation.tactile.finger.status"] == frame["status"]
        contacts = new["observation.tactile.finger.contacts"].reshape(4, 6)
        np.testing.assert_allclose(contacts[:, 3:], np.nan_to_num(frame["contact_force"]), rtol=1e-5)
    assert frame["wrench"][2] < -1


def test_statistics_of_what_is_added_are_those_of_its_values_and_survive_lerobot_s_tools(added, tmp_path):
    dataset = LeRobotDataset("local/press", root=added)
    values = torch.stack([dataset[k][WRENCH] for k in range(len(dataset))]).numpy()
    told = json.loads((added / "meta/stats.json").read_text())[WRENCH]
    for name in ("mean", "min", "max"):
        np.testing.assert_allclose(told[name], getattr(values, name)(0), rtol=1e-4, atol=1e-5)
    kept = delete_episodes(dataset, [0], output_dir=tmp_path / "kept", repo_id="local/kept")
    second = values[[dataset[k]["episode_index"] == 1 for k in range(len(dataset))]]
    np.testing.assert_allclose(kept.meta.stats[WRENCH]["mean"], second.mean(0), rtol=1e-4, atol=1e-5)


def test_the_command_refuses_what_it_cannot_add_to(recorded, added, sensor, tmp_path, capsys):
    def refused(*arguments):
        assert lerobot_add([str(each) for each in arguments]) == 2
        return capsys.readouterr().err

    there = recorded, "--sensor", f"finger={sensor}"
    assert "exists; expected the folder of a new data set" in refused(*there)
    assert "no data set of LeRobot" in refused(tmp_path, "--sensor", f"finger={sensor}", "--out", tmp_path / "new")
    assert "has images of finger" in refused(recorded, "--sensor", f"thumb={sensor}", "--out", tmp_path / "new")
    assert f"has {WRENCH} already" in refused(added, "--sensor", f"finger={sensor}", "--out", tmp_path / "new")
    for wrong in ([f"{sensor}"], ["finger="], [f"finger={sensor}", f"finger={sensor}"]):
        with pytest.raises(SystemExit):
            lerobot_add([str(recorded), *(part for each in wrong for part in ("--sensor", each))])
