"""A membrane's camera for LeRobot, its tactile results as observations, and data sets with tactile results.

`convert` and `add` need LeRobot's extra `dataset`; the other modules do not.
"""

from .versions import refuse_untested

refuse_untested()

from .camera import TorchMembraneCamera  # noqa: E402
from .config import TorchMembraneCameraConfig  # noqa: E402
from .processor import TactileProcessorStep  # noqa: E402

__all__ = ["TactileProcessorStep", "TorchMembraneCamera", "TorchMembraneCameraConfig"]
