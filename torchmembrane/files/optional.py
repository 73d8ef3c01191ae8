"""Optional packages: imported where they are used, with an error that names the extra to install.

Each of these functions raises that error if the package is missing, and another one if it is installed but broken.
"""

import os
from importlib import import_module
from typing import Any

from ..errors import MembraneError
from .safe_read import in_one_line


def load_pyarrow() -> tuple[Any, Any]:
    """The modules `pyarrow` and `pyarrow.parquet`.

    Raises:
        MembraneError: PyArrow is not installed.
    """
    return _load("pyarrow", "Parquet results need pyarrow", "parquet"), import_module("pyarrow.parquet")


def load_pyav() -> Any:
    """The module `av`.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _load("av", "videos need PyAV", "video")


def load_opencv(purpose: str = "calibration from boards needs OpenCV") -> Any:
    """The module `cv2`.

    Args:
        purpose: what it is needed for, as an error says it.

    Raises:
        MembraneError: OpenCV is not installed.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # its failure is reported in this package's own words
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2 = _load("cv2", purpose, "calibrate")
    if hasattr(cv2, "setLogLevel"):
        cv2.setLogLevel(0)
    return cv2


def load_edge() -> Any:
    """The module `torchmembrane_edge`.

    Raises:
        MembraneError: it is not installed: it comes with this project's repository, in `export/`.
    """
    try:
        return import_module("torchmembrane_edge")
    except ImportError as error:
        raise MembraneError(
            "exported models need torchmembrane-edge, which is not installed: pip install ./export, in the repository"
        ) from error


def load_pandas() -> Any:
    """The module `pandas`.

    Raises:
        MembraneError: pandas is not installed.
    """
    return _load("pandas", "a DataFrame of results needs pandas", "pandas")


def load_ray() -> Any:
    """The module `ray`, with `ray.data`.

    Raises:
        MembraneError: Ray is not installed.
    """
    ray = _load("ray", "clusters need Ray", "ray")
    import_module("ray.data")
    return ray


def load_rerun() -> Any:
    """The module `rerun`.

    Raises:
        MembraneError: Rerun is not installed.
    """
    return _load("rerun", "its viewer needs rerun-sdk", "rerun")


def load_rosbags() -> Any:
    """The module `rosbags.highlevel`.

    Raises:
        MembraneError: rosbags is not installed.
    """
    _load("rosbags", "bags of ROS 2 need rosbags", "ros")
    return import_module("rosbags.highlevel")


def _load(module: str, purpose: str, extra: str) -> Any:
    try:
        return import_module(module)
    except (ImportError, OSError) as error:  # OSError: from a shared library that a package contains or needs
        if isinstance(error, ModuleNotFoundError) and error.name == module:
            raise MembraneError(f'{purpose}, which is not installed: pip install "torchmembrane[{extra}]"') from error
        raise MembraneError(
            f"{purpose}, which is installed and cannot be imported ({in_one_line(error)}): install it anew, "
            f'pip install --force-reinstall "torchmembrane[{extra}]"'
        ) from error
