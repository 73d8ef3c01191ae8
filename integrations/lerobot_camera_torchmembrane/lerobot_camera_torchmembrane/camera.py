"""The camera inside a membrane as a LeRobot camera."""

import time

import cv2
import numpy as np
from lerobot.cameras.opencv import OpenCVCamera

from .config import TorchMembraneCameraConfig

FIRST_FRAME = 10.0
"""Seconds within which the first frame of a video must arrive."""


class TorchMembraneCamera(OpenCVCamera):
    """Frames `[height, width, 3]` uint8 of a membrane's camera, read by LeRobot's OpenCV camera; a video file may replace it.

    The frames of a video arrive at `fps` like those of a device, whether they are read or not, and restart after the last one.

    Args:
        config: a `TorchMembraneCameraConfig`.
    """

    def __init__(self, config: TorchMembraneCameraConfig):
        super().__init__(config)
        self._due = 0.0

    def connect(self, warmup: bool = True) -> None:
        """Open the device or the video file, and wait for a first frame.

        Args:
            warmup: whether to read a device for `warmup_s` seconds first; a video begins with its first frame.

        Raises:
            DeviceAlreadyConnectedError: the camera is already open.
            ConnectionError: the camera cannot be opened, or delivers no frame.
        """
        super().connect(warmup and not self.config.is_video)
        if self.config.is_video and not self.new_frame_event.wait(FIRST_FRAME):
            self.disconnect()
            raise ConnectionError(f"{self.config.index_or_path}: no frame can be read; expected a video file")

    def _configure_capture_settings(self) -> None:
        if not self.config.is_video:  # of a file there is nothing to set
            super()._configure_capture_settings()

    def _read_from_hardware(self) -> np.ndarray:
        if not self.config.is_video:
            return super()._read_from_hardware()
        there, frame = self.videocapture.read()
        if not there:  # the end: opened anew, as not every file can be set back
            ended, self.videocapture = self.videocapture, cv2.VideoCapture(self.index_or_path, self.backend)
            ended.release()
            frame = super()._read_from_hardware()
        self.stop_event.wait(max(self._due - time.perf_counter(), 0))
        now, interval = time.perf_counter(), 1 / self.fps
        self._due = (now if now - self._due > interval else self._due) + interval
        return frame
