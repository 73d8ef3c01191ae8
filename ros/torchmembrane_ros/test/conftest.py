import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100)  # of this run alone
ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT), str(Path(__file__).parents[1])]

import torch  # noqa: E402

torch.set_num_threads(1)


def pytest_report_header():
    packages = ("ros-rclpy", "ros-rmw-fastrtps-cpp", "ros-sensor-msgs", "numpy", "torch")
    return ", ".join([f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in packages)])
