"""Wrong matches: markers whose displacement does not belong with their neighbours'."""

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import MembraneError
from .neighbourhood import Neighbourhood
from .spacing import spacing

TOLERANCE = 0.2  # of the distance to the nearest marker: what a press may put between a displacement and its neighbours' fit
FEWEST_NEIGHBOURS = 6


class MismatchScreen(nn.Module):
    """Trust in matched markers: 1 where a robust local affine fit to its neighbours bears a displacement out, 0 where not.

    Args:
        pixels: rest pixels `[D, 2]` of the markers.
        anchors: pixels `[A, 2]` on the rim, where nothing moves.

    Raises:
        MembraneError: fewer than 6 markers.

    Limitations:
        Wrong where a third of a neighbourhood, or all of it alike, is mismatched, and where the flow has a step of more
        than a fifth of the spacing (a fold).

    Example:
        >>> pixels = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
        >>> displacement = torch.full((1, 25, 2), 0.5, dtype=torch.float64)
        >>> displacement[0, 12, 0] = 1.5  # the pixel of its neighbour
        >>> screen = MismatchScreen(pixels, np.zeros((0, 2)))
        >>> screen(displacement, torch.ones(1, 25).double())[0, 11:14].tolist()
        [1.0, 0.0, 1.0]
    """

    tolerance: Tensor

    def __init__(self, pixels: np.ndarray, anchors: np.ndarray):
        super().__init__()
        pixels = np.asarray(pixels, float)
        if len(pixels) < FEWEST_NEIGHBOURS:
            raise MembraneError(f"MismatchScreen: {len(pixels)} markers; expected at least {FEWEST_NEIGHBOURS}")
        self.neighbourhood = Neighbourhood(pixels, np.asarray(anchors, float))
        self.register_buffer("tolerance", torch.from_numpy(TOLERANCE * spacing(pixels)[0])[:, None])

    def forward(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        """The confidence times the trust in each marker.

        Args:
            displacement: `[B, D, 2]`, px.
            confidence: `[B, D]` in 0..1, 0 = lost.

        Returns:
            `[B, D]` in 0..1; below 0.5 a marker is taken for mismatched.
        """
        flow = torch.where(confidence[..., None] > 0, displacement, 0.0)
        return confidence * self.neighbourhood(flow, confidence, self.tolerance).trust(flow)
