"""What a membrane's camera is configured by."""

from dataclasses import dataclass

from lerobot.cameras.configs import CameraConfig, ColorMode

from torchmembrane import MembraneError, Sensor


@CameraConfig.register_subclass("torchmembrane")
@dataclass(kw_only=True)
class TorchMembraneCameraConfig(CameraConfig):
    """The camera inside of a membrane.

    Args:
        sensor: path of the sensor file, `sensor.toml`; width and height are its camera's.
        index_or_path: of the video device, as OpenCV takes it, or a video file.

    Raises:
        MembraneError: the sensor file is wrong, or says another width or height.
    """

    sensor: str
    index_or_path: int | str = 0
    color_mode: ColorMode = ColorMode.RGB

    def __post_init__(self) -> None:
        size = Sensor.from_file(self.sensor).camera.image_size
        given = self.width or size[0], self.height or size[1]
        if given != tuple(size):
            raise MembraneError(f"{self.sensor}: width x height = {given[0]} x {given[1]}; expected {size[0]} x {size[1]}")
        self.width, self.height = size
