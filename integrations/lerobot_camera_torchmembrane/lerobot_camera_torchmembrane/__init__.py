"""A membrane's camera for LeRobot, what it feels as observations, and data sets with what was felt.

`convert` and `add` import what LeRobot's extra `dataset` brings; everything else does without.
"""

from .versions import refuse_untested

refuse_untested()

from .camera import TorchMembraneCamera  # noqa: E402
from .config import TorchMembraneCameraConfig  # noqa: E402
from .processor import TactileProcessorStep  # noqa: E402

__all__ = ["TactileProcessorStep", "TorchMembraneCamera", "TorchMembraneCameraConfig"]
