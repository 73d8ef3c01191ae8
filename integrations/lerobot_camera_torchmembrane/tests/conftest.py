import platform
import shutil
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import pytest
import torch
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.import_utils import register_third_party_plugins

EXAMPLES = Path(__file__).parents[3] / "examples"
PRESSES = ("press_on_axis", "flat_plate", "two_contacts")
sys.path.insert(0, str(Path(__file__).parent))
torch.set_num_threads(1)


def pytest_report_header():
    packages = ("lerobot", "torch", "torchvision", "numpy", "rerun-sdk")
    return ", ".join([f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in packages)])


@pytest.fixture(scope="session", autouse=True)
def plugin():
    """LeRobot finds it by its name."""
    register_third_party_plugins()
    assert "torchmembrane" in CameraConfig.get_known_choices()


@pytest.fixture(scope="session")
def sensor(tmp_path_factory):
    """The example's sensor file, on a grid of 9 x 9."""
    folder = tmp_path_factory.mktemp("sensor")
    for name in ("rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copy(EXAMPLES / name, folder)
    said = (EXAMPLES / "sensor.toml").read_text().replace("[membrane]", "[membrane]\ngrid = [9, 9]")
    (folder / "sensor.toml").write_text(said)
    return folder / "sensor.toml"


@pytest.fixture(scope="session")
def presses():
    """Three images as LeRobot's cameras give them, RGB `[H, W, 3]` uint8."""
    return [cv2.cvtColor(cv2.imread(str(EXAMPLES / f"{name}.png")), cv2.COLOR_BGR2RGB) for name in PRESSES]


@pytest.fixture(scope="session")
def video(tmp_path_factory, presses):
    """Three presses one after another, each held for a second, at 10 Hz, nearly lossless."""
    path = tmp_path_factory.mktemp("video") / "press.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480))
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 100)
    for image in presses:
        for _ in range(10):
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path
