"""How the losses become non-convex from step to step: every frame lowers its own scale `tau`, as fast as its surface allows.

The loss of compressive traction is quadratic up to the scale `tau`, and saturates beyond it. If `tau` falls slowly, the steps
stay in the basin of the one minimum that the smooth problem has (graduated non-convexity, GNC). How slowly it must fall differs
from frame to frame: while a step still moves the surface far, `tau` falls by a seventh; the less the surface moves, compared
with its displacement from rest, the faster `tau` falls. The scale of the markers' loss and the prior of the camera's motion
follow `tau`.
"""

from typing import TypeVar

from torch import Tensor

Scalar = TypeVar("Scalar", float, Tensor)

RATE = 0.85
"""Ratio of `tau` to that of the step before while the surface moves by much."""
STILL = 0.002
"""The `scaled_step` at which `tau` falls by the square of `RATE`."""
OUTLIER_DECAY_POWER = 1.3
"""The scale of the markers' loss is proportional to this power of `tau`: it starts at twenty times its last value."""
FIRM = 0.008
"""Rms displacement from rest, relative to the surface's size, above which the steps of a press are compared with the size
alone."""
LIGHT = 4e-4
"""The same, below which the steps are compared with this displacement: markers' noise displaces a surface by about as much."""
LEAST_MOVE = 1e-9
"""Relative displacement below which a surface stands still; keeps quotients finite."""
TINY = 1e-30
"""Keeps quotients by a tolerance of zero finite."""
LARGEST_STRETCH = 0.3
"""Largest relative change of an edge of the grid in one step."""
SETTLING_STEPS = 8
"""Number of relaxed steps for frames that have not settled before; at most half of all steps."""
RELAXATION = 0.5
"""Share of these steps that is taken (the iteration of Krasnosel'skii and Mann). Where the weights jump between two values from
step to step, whole steps would go to and fro for ever."""


def scaled_step(moved: Scalar, displacement: Scalar) -> Scalar:
    """Return how far a step moves the surface, on the scale by which `tau` falls and a frame settles, `[...]`.

    For a firm press it is the rms displacement in the step, relative to the surface's size. A light touch displaces the whole
    surface by little, so that all its steps are short on that scale; they are compared with the displacement from rest instead.

    Args:
        moved: rms displacement in the step, relative to the size, `[...]`.
        displacement: rms displacement from rest after the step, relative to the size, `[...]`.

    Example:
        >>> scaled_step(1e-5, 0.0)
        0.0002
    """
    scaled: Scalar = moved * ((displacement**2 + FIRM**2) / (displacement**2 + LIGHT**2)) ** 0.5
    return scaled


def falling(moved: Scalar) -> Scalar:
    """Return the ratio of the next `tau` to the present one after a step with the `scaled_step` `moved > 0`, `[...]`.

    Example:
        >>> falling(0.002) == RATE ** 2
        True
    """
    ratio: Scalar = RATE ** (1 + STILL / moved)
    return ratio


def share_of_next(moved: Scalar, tol: float) -> Scalar:
    """Return the share of the next step that a frame takes after a step with the `scaled_step` `moved`, `[...]`.

    A frame has settled after a step no longer than `tol`. After a step of at least twice this length, it takes the whole next
    step, and after a shorter one less of it: the answer does not jump where rounding decides whether the frame has settled. The
    caller limits the share to the range from 0 to 1.

    Args:
        moved: the `scaled_step`, relative to the size, `[...]`.
        tol: the `scaled_step` with which a frame has settled, relative to the size.

    Example:
        >>> round(share_of_next(1.5e-4, 1e-4), 9)
        0.5
    """
    share: Scalar = (moved - tol) / (tol + TINY)
    return share


def outlier_scale(last: Scalar, ratio: Scalar) -> Scalar:
    """Return the scale of the markers' loss from its `last` value and the ratio of `tau` to its last value, `[...]`.

    Example:
        >>> outlier_scale(2.5, 1.0)
        2.5
    """
    scale: Scalar = last * ratio**OUTLIER_DECAY_POWER
    return scale


def settling_of(steps: int) -> int:
    """Return how many of at most `steps` steps are relaxed so that a frame settles."""
    return min(SETTLING_STEPS, steps // 2)
