"""Optional packages, imported where they are used.

If a package is missing, each of these functions raises an error that names the extra to install; if the package is installed
but cannot be imported, the error says so.
"""

import os
from importlib import import_module
from typing import Any

from ..errors import MembraneError
from .safe_read import in_one_line


def load_pyarrow() -> tuple[Any, Any]:
    """Import and return the modules `pyarrow` and `pyarrow.parquet`.

    Raises:
        MembraneError: PyArrow is not installed.
    """
    return _load("pyarrow", "Parquet results need pyarrow", "parquet"), import_module("pyarrow.parquet")


def load_pyav() -> Any:
    """Import and return the module `av`.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _load("av", "videos need PyAV", "video")


def load_opencv(purpose: str = "calibration from boards needs OpenCV") -> Any:
    """Import and return the module `cv2`.

    Args:
        purpose: what the package is needed for, as the beginning of an error message.

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
    """Import and return the module `torchmembrane_edge`.

    Raises:
        MembraneError: torchmembrane-edge is not installed; it is in `export/` of this project's repository.
    """
    try:
        return import_module("torchmembrane_edge")
    except ImportError as error:
        raise MembraneError(
            "exported models need torchmembrane-edge, which is not installed: pip install ./export, in the repository"
        ) from error


def load_pandas() -> Any:
    """Import and return the module `pandas`.

    Raises:
        MembraneError: pandas is not installed.
    """
    return _load("pandas", "a DataFrame of results needs pandas", "pandas")


def load_ray() -> Any:
    """Import and return the module `ray`, with `ray.data`.

    Raises:
        MembraneError: Ray is not installed.
    """
    ray = _load("ray", "clusters need Ray", "ray")
    import_module("ray.data")
    return ray


def load_rerun() -> Any:
    """Import and return the module `rerun`.

    Raises:
        MembraneError: Rerun is not installed.
    """
    return _load("rerun", "its viewer needs rerun-sdk", "rerun")


def load_rosbags() -> Any:
    """Import and return the module `rosbags.highlevel`.

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
            f"{purpose}, which is installed but cannot be imported ({in_one_line(error)}): reinstall it, "
            f'pip install --force-reinstall "torchmembrane[{extra}]"'
        ) from error
