"""What a solve can start from: results of the frames before, refused where they cannot be that."""

import torch
from torch import Tensor

from ..errors import MembraneError
from ..io.results import Reconstruction
from ..io.status import Status
from ..pieces import at_hand
from ..surface.membrane import Membrane

OFF_RIM = 1e-3  # largest distance of a previous result's rim from this sensor's, over the surface's size


def checked_previous(
    previous: Reconstruction, frames: int, membrane: Membrane, rest_pixels: Tensor, length_unit: str
) -> Reconstruction:
    """A previous result in the precision of `rest_pixels`, refused where it cannot be one of these frames'.

    Args:
        previous: one result for each frame.
        frames: the batch's length.
        membrane: the rest surface.
        rest_pixels: `[D, 2]` of the markers.
        length_unit: the sensor's.

    Raises:
        MembraneError: it is of another batch, grid or sensor.
    """
    expected = ((frames, *membrane.rest.shape), (frames, *rest_pixels.shape))
    given = (tuple(previous.vertices.shape), tuple(previous.pixels.shape))
    if given != expected:
        raise MembraneError(
            f"Reconstructor: previous has vertices {list(given[0])} and pixels {list(given[1])}, expected "
            f"{list(expected[0])} and {list(expected[1])}: one earlier result of this sensor and grid for each image"
        )
    previous = previous.to(rest_pixels)
    if at_hand(previous.vertices):
        off = (previous.vertices - membrane.rest)[:, membrane.fixed].abs().nan_to_num()
        if off.numel() and off.max() > OFF_RIM * membrane.size:
            raise MembraneError(
                f"Reconstructor: the rim of previous is {float(off.max()):.3g} {length_unit} off this "
                "sensor's; it is of another one, or from before a calibration: leave previous out to start from rest"
            )
    return previous


def broken_down(status: Tensor, vertices: Tensor) -> Tensor | None:
    """Statuses `[B]` with the frames whose solve broke down said; None where none did, or no gradient is asked for.

    A broken solve passes NaN to all that its gradient reaches, also what the batch's other frames share with it: so it is not
    the one to be differentiated.

    Args:
        status: `[B]`, before the solve.
        vertices: `[B, V, 3]` that it found.
    """
    if torch.compiler.is_compiling() or not isinstance(vertices, Tensor) or not vertices.requires_grad:
        return None
    broken = (status == Status.OK.value) & ~vertices.flatten(1).isfinite().all(1)
    return torch.where(broken, Status.NO_SOLUTION.value, status) if bool(broken.any()) else None
