"""Detection of wrong matches: markers whose displacement contradicts that of their neighbours."""

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import MembraneError
from .neighbourhood import Neighbourhood
from .spacing import spacing

TOLERANCE = 0.2  # largest deviation from the neighbours' fit that a press causes, over the distance to the nearest marker
FEWEST_NEIGHBOURS = 6


class MismatchScreen(nn.Module):
    """Trust in matched markers: 1 where a robust local affine fit to the neighbours confirms a displacement, 0 where it does
    not.

    Args:
        pixels: pixels of the markers at rest, `[D, 2]`.
        anchors: fixed pixels on the rim, `[A, 2]`.

    Raises:
        MembraneError: there are fewer than 6 markers.

    Limitations:
        The result is wrong where a third of a neighbourhood is mismatched, or all of it in the same way, and where the flow has
        a step of more than a fifth of the spacing (a fold).

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
        """Return the confidence of each marker multiplied by the trust in it.

        Args:
            displacement: `[B, D, 2]`, px.
            confidence: `[B, D]` in 0..1, 0 for lost markers.

        Returns:
            `[B, D]` in 0..1; a marker below 0.5 is considered mismatched.
        """
        flow = torch.where(confidence[..., None] > 0, displacement, 0.0)
        return confidence * self.neighbourhood(flow, confidence, self.tolerance).trust(flow)
