"""Configuration of a membrane's camera."""

from dataclasses import dataclass
from pathlib import Path

import cv2
from lerobot.cameras.configs import CameraConfig, ColorMode
from lerobot.cameras.opencv import OpenCVCameraConfig

from torchmembrane import MembraneError, Sensor

from .tactile import refuse_views_apart


@CameraConfig.register_subclass("torchmembrane")
@dataclass(kw_only=True)
class TorchMembraneCameraConfig(OpenCVCameraConfig):
    """The camera inside a membrane: LeRobot's OpenCV camera with the image size of a sensor file.

    Args:
        sensor: path of the sensor file, `sensor.toml`; width and height are taken from its camera.
        index_or_path: index or path of the video device, as in OpenCV, or path of a video file, whose own rate is the default
            of `fps`.

    Raises:
        MembraneError: the sensor file is invalid, has another width or height, or has views with images of their own; the
            colours are not in the order red, green, blue; or the file is not a video or has another size.
    """

    sensor: str
    index_or_path: int | Path = 0

    @property
    def is_video(self) -> bool:
        """Whether the frames come from a file."""
        return Path(str(self.index_or_path)).is_file()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.color_mode != ColorMode.RGB:
            raise MembraneError(
                f"color_mode: {self.color_mode.value}; expected rgb, as the grey of the dots is computed from it"
            )
        sensor = Sensor.from_file(self.sensor)
        refuse_views_apart(sensor, self.sensor)
        size = sensor.image_size
        given = self.width or size[0], self.height or size[1]
        if given != tuple(size):
            raise MembraneError(f"{self.sensor}: width x height = {given[0]} x {given[1]}; expected {size[0]} x {size[1]}")
        self.width, self.height = size
        if self.is_video:
            rate = self._check_video()
            self.fps = self.fps or rate

    def _check_video(self) -> int:
        """Check the video file and return its frame rate as a whole number."""
        video = cv2.VideoCapture(str(self.index_or_path))
        rate, *found = (video.get(what) for what in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        opened = video.isOpened()
        video.release()
        if not opened:
            raise MembraneError(f"{self.index_or_path}: not readable as a video; expected a video device or a video file")
        turned = abs(self.rotation) == 90
        expected = (self.height, self.width) if turned else (self.width, self.height)
        if tuple(found) != expected:
            came, wanted = ("{:.0f} x {:.0f}".format(*each) for each in (found, expected))
            raise MembraneError(f"{self.index_or_path}: frames of {came}; expected {wanted}, of {self.sensor}")
        return max(round(rate), 1)
