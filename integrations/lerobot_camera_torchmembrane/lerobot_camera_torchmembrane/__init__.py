"""A membrane's camera for LeRobot, what it feels as observations, and recorded runs as data sets."""

from .camera import TorchMembraneCamera
from .config import TorchMembraneCameraConfig
from .convert import convert
from .processor import TactileProcessorStep

__all__ = ["TactileProcessorStep", "TorchMembraneCamera", "TorchMembraneCameraConfig", "convert"]
