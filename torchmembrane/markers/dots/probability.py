"""The probability that a dot is at its fitted position.

The alternatives are: nothing; something fainter than the dots of this frame; or another dot. Each has odds against the dot
itself, and the probability is `1 / (1 + sum of the odds)`.
"""

import math

import torch
from torch import Tensor

from .fit import FittedDots
from .scales import LOST, PREDICTION, SHADE

PIXELS = 10.0
"""Effective number of independent pixels of a window: residuals of a fit are correlated, unlike noise."""
PARAMETERS = 4.0
"""Number of parameters of a dot besides its background: contrast, position and size."""
CONTRAST_DEVIATION = 0.22
"""Standard deviation of the contrasts of dots, and of other objects, relative to the contrast of the clearer dots."""
STEP_DEVIATION = 0.12
"""Standard deviation of the steps between found neighbours, relative to their lengths."""
TEAR = 0.004
"""Mean of the measure of `Seams` for an intact pattern."""
LEAST = 1e-6
"""Keeps logarithms finite."""


def dot_evidence(explained: Tensor) -> Tensor:
    """Return the log odds of a dot against nothing, from the share of a window's variance that the dot explains.

    They follow Schwarz's criterion (1978) for a model with `PARAMETERS` more parameters: `-PIXELS / 2 log(1 - explained) -
    PARAMETERS / 2 log PIXELS`.

    Example:
        >>> [round(x, 1) for x in dot_evidence(torch.tensor([0.0, 0.6, 0.95])).tolist()]
        [-4.6, -0.0, 10.4]
    """
    return -0.5 * PIXELS * (1 - explained).clamp_min(LEAST).log() - 0.5 * PARAMETERS * math.log(PIXELS)


def contrast_evidence(contrast: Tensor, middle: float = 0.5) -> Tensor:
    """Return the log odds of a dot against something fainter, from its contrast relative to the frame's clearer dots.

    Both have normal distributions with `CONTRAST_DEVIATION` and means that differ by 1; `middle` is half way between the means.

    Example:
        >>> contrast_evidence(torch.tensor([1.0, 0.5, 0.0])).round().tolist()
        [10.0, 0.0, -10.0]
    """
    return (contrast - middle) / CONTRAST_DEVIATION**2


def own_evidence(found: Tensor, error: Tensor) -> Tensor:
    """Return the log odds of a dot being itself against being another dot.

    The prior is the share `found [B, D]`, in 0..1, of the surrounding dots. The relative error of the steps to them, `error [B,
    D]`, is normal with `STEP_DEVIATION` for the right dot, and up to `PREDICTION` for another.

    Example:
        >>> [round(x, 1) for x in own_evidence(torch.tensor([1.0, 1.0, 0.5]), torch.tensor([0.0, 0.3, 0.3])).tolist()]
        [5.1, 1.9, -2.0]
    """
    odds = (found + LOST) / (1 - found + LOST)
    density = 0.5 * (PREDICTION / STEP_DEVIATION) ** 2
    return odds.log() + math.log(density) - 0.5 * (error / STEP_DEVIATION).square()


def whole_evidence(tear: Tensor) -> Tensor:
    """Return the log odds of an intact pattern around a dot against a torn one, from the measure `[B, D]` of `Seams`.

    For an intact pattern the measure has an exponential distribution with mean `TEAR`; for a torn one it is uniform in 0..1.
    The prior odds of a torn one are `LOST`.

    Example:
        >>> [round(x, 1) for x in whole_evidence(torch.tensor([0.0, 0.038, 0.08])).tolist()]
        [9.4, -0.1, -10.6]
    """
    return -math.log(LOST * TEAR) - tear / TEAR


def probability(*evidence: Tensor) -> Tensor:
    """Return the probability of a dot from its evidence against each alternative, log odds `[B, D]`.

    Example:
        >>> round(float(probability(torch.tensor(3.0), torch.tensor(2.0))), 3)
        0.844
    """
    return torch.sigmoid(-torch.logsumexp(-torch.stack(evidence), 0))


def alone(dots: FittedDots) -> Tensor:
    """Return the probability that each dot is at its fitted position, from its own window, `[B, D]` in 0..1."""
    one = torch.ones_like(dots.misfit)
    return probability(*_there(dots), own_evidence(one, 0 * one) - 0.5 * dots.misfit)


def among_neighbours(dots: FittedDots, found: Tensor, error: Tensor, *others: Tensor) -> Tensor:
    """Return the probability that each dot is at its fitted position, from its window and its neighbours, `[B, D]` in 0..1.

    Args:
        dots: fitted dots.
        found: share of the surrounding dots that is found, `[B, D]`, in 0..1.
        error: relative error of the steps to them, `[B, D]`.
        others: evidence against further alternatives, log odds `[B, D]`.
    """
    return probability(*_there(dots), own_evidence(found, error) - 0.5 * dots.misfit, *others)


def _there(dots: FittedDots) -> tuple[Tensor, Tensor]:
    """Return the evidence of a dot against nothing and against something fainter."""
    clearer = dots.contrast.topk(dots.contrast.shape[1] // 2, -1).values
    level = clearer.mean(-1, keepdim=True).clamp_min(0) + SHADE
    return dot_evidence(dots.explained), contrast_evidence(dots.contrast / level)
