"""The camera inside of a membrane, as LeRobot reads cameras."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import ColorMode
from lerobot.cameras.opencv import OpenCVCamera, OpenCVCameraConfig

from .config import TorchMembraneCameraConfig


class TorchMembraneCamera(Camera):
    """Frames `[height, width, 3]` uint8 of a membrane's camera, read by LeRobot's own OpenCV camera.

    Args:
        config: a `TorchMembraneCameraConfig`. A video file's frames come one after another, from its start again at its end.
    """

    def __init__(self, config: TorchMembraneCameraConfig):
        super().__init__(config)
        self.config, self.color_mode = config, config.color_mode
        place = config.index_or_path
        self.video = isinstance(place, str) and Path(place).is_file()
        self.source: cv2.VideoCapture | OpenCVCamera | None = None

    @property
    def is_connected(self) -> bool:
        """Whether frames can be read."""
        return self.source is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Video devices as LeRobot's OpenCV camera finds them."""
        return OpenCVCamera.find_cameras()

    def connect(self, warmup: bool = True) -> None:
        """Open the device or the video file.

        Raises:
            ConnectionError: it cannot be opened.
        """
        config = self.config
        if self.video:
            self.source = cv2.VideoCapture(str(config.index_or_path))
            if not self.source.isOpened():
                self.source = None
                raise ConnectionError(f"{config.index_or_path}: cannot be read; expected a video file")
            return
        size = dict(fps=config.fps, width=config.width, height=config.height, color_mode=config.color_mode)
        source = OpenCVCamera(OpenCVCameraConfig(index_or_path=config.index_or_path, **size))
        source.connect(warmup)
        self.source = source

    def read(self) -> np.ndarray:
        """The next frame."""
        source = self._connected()
        return source.read() if isinstance(source, OpenCVCamera) else self._next(source)

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest frame that was not read, waited for at most so long."""
        source = self._connected()
        return source.async_read(timeout_ms) if isinstance(source, OpenCVCamera) else self._next(source)

    def disconnect(self) -> None:
        """Close the device or the video file."""
        source, self.source = self._connected(), None
        source.disconnect() if isinstance(source, OpenCVCamera) else source.release()

    def _connected(self) -> "cv2.VideoCapture | OpenCVCamera":
        if self.source is None:
            raise ConnectionError(f"{self.config.index_or_path}: not connected; call connect() first")
        return self.source

    def _next(self, video: cv2.VideoCapture) -> np.ndarray:
        there, frame = video.read()
        if not there:
            video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            there, frame = video.read()
        if not there:
            raise ConnectionError(f"{self.config.index_or_path}: no frame can be read; expected a video file")
        return frame if self.color_mode == ColorMode.BGR else cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
