"""Search for dots by soft-argmax around their predictions, ring by ring inwards from the rim."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ...control_flow import fori_loop, traced
from ..dots.flow import FlowAverages
from ..spacing import spacing, thin_out
from .argmax import Peak, window_peak
from .response import DotResponse

COARSE_TEMPERATURE, FINE_TEMPERATURE = 0.25, 0.3
"""Temperatures of the softmax, of the logarithm of the response: weights are powers of it, whatever the contrast."""
WINDOW = 2.0  # half side of a window, standard deviations of the prediction
RESPONSE_FLOOR = 0.01  # of a drawn dot's response: what is weaker is no peak
LARGEST_RELATIVE_SPREAD = 2.5  # times its spread at rest, of a peak that is half believed
LEAST_SUPPORT = 0.8  # sure nodes, weighted by distance, of a prediction that is half believed
GROWN_CERTAINTY = 0.7  # of the dots that the growth has reached, where its steps are counted
STEPS_PER_RING = 2  # steps in which the growth gains a ring: the second settles the flow from which the next is predicted
SETTLING_STEPS = 3  # steps after the growth has reached every dot
LEAST_GROWTH_RESPONSE = 0.05  # of a drawn dot's response, of a peak that is half believed in the growth


class Found(NamedTuple):
    """The dots found: `place [B, D, 2]` px, `response [B, D]` over a drawn dot's, `sharpness [B, D]` of the peak in 0..1."""

    place: Tensor
    response: Tensor
    sharpness: Tensor


class DotSearch(nn.Module):
    """Soft-argmax of the dots' responses in windows around their predictions, each on one level of the pyramid.

    Args:
        radii: radii of the dots, `[D]`, px.
        others: radii of dots of the other size at the same places, `[D]`, px, or NaN.
        coarser: level of the pyramid, as in `DotResponse`.
        error: standard deviations of the predictions, `[D]`, px.
        inside: `[1, 1, H, W]`, 1 on the membrane, else 0.

    Attributes:
        response: the filter that computes the responses and their windows.
    """

    error: Tensor
    strength: Tensor
    spread: Tensor

    def __init__(self, radii: np.ndarray, others: np.ndarray, coarser: int, error: np.ndarray, inside: Tensor):
        super().__init__()
        self.temperature = COARSE_TEMPERATURE if coarser > 0 else FINE_TEMPERATURE
        self.response = DotResponse(radii, others, coarser, WINDOW * error, inside)
        self.register_buffer("error", torch.as_tensor(error))
        self.register_buffer("strength", torch.ones(len(radii), dtype=torch.float64))
        self.register_buffer("spread", torch.ones(len(radii), dtype=torch.float64))

    def calibrate(self, levels: list[Tensor], pixels: Tensor) -> None:
        """Use the responses to a drawn pattern, given by the levels of its image, as those of certain dots at
        `pixels [D, 2]`."""
        for _ in range(2):  # the floor is relative to the strength
            peak = self._peak(self.response.maps(levels), pixels[None])
            self.strength, self.spread = peak.strength[0].clamp_min(1e-3), peak.spread[0]

    @traced
    def forward(self, maps: Sequence[Tensor], predicted: Tensor) -> Found:
        """Return the dots around `predicted [B, D, 2]` px, from the responses on each level."""
        peak = self._peak(maps, predicted)
        sharpness = torch.sigmoid(4 * (LARGEST_RELATIVE_SPREAD - peak.spread / self.spread))
        return Found(peak.place, (peak.strength / self.strength).relu(), sharpness)

    def _peak(self, maps: Sequence[Tensor], predicted: Tensor) -> Peak:
        value, middle = self.response.windows(maps, predicted)
        score = ((value / self.strength[:, None, None]).relu() + RESPONSE_FLOOR).log()
        return window_peak(score, value, middle, self.response.stride, predicted, self.error, self.temperature)


class DotGrowth(nn.Module):
    """Finds dots of one size ring by ring from the rim inwards, along the smooth flow.

    Each step predicts every dot from the certain ones around it (locally affine, with the rim at rest) and searches for it
    there. Without anchors, all dots are predicted at rest at first.

    Args:
        pixels: centres `[D, 2]` of the dots at rest, px.
        radii: radii of the dots, `[D]`, px.
        others: radii of dots of the other size at the same places, `[D]`, px, or NaN.
        anchors: fixed pixels on the rim, `[A, 2]`; `[0, 2]` if there are none.
        inside: `[1, 1, H, W]`, 1 on the membrane, else 0.
    """

    pixels: Tensor
    known: Tensor

    def __init__(self, pixels: np.ndarray, radii: np.ndarray, others: np.ndarray, anchors: np.ndarray, inside: Tensor):
        super().__init__()
        nearest, mean = spacing(pixels)
        anchors = thin_out(anchors, 0.7 * float(np.median(mean)))
        self.search = DotSearch(radii, others, 1, 0.3 * nearest, inside)
        self.averages = FlowAverages(pixels, np.concatenate([pixels, anchors]))
        known = np.full(len(pixels), 0.0 if len(anchors) else 1.0)
        self.steps = STEPS_PER_RING * rings(self.averages.kernel, np.append(known, np.ones(len(anchors)))) + SETTLING_STEPS
        self.register_buffer("pixels", torch.as_tensor(pixels))
        self.register_buffer("known", torch.as_tensor(known))

    def forward(self, levels: list[Tensor], previous: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Find the dots.

        Args:
            levels: pyramid of the image, with dark dots.
            previous: pixels `[B, D, 2]` in the preceding frames, NaN where lost, from which the search starts.

        Returns:
            Pixels `[B, D, 2]` and weight `[B, D]` in 0..1.
        """
        maps, *state = self.begin(levels, previous)
        weight, flow, _ = fori_loop(self.step, self.steps, state, *maps)
        return self.moved(flow), weight

    @traced
    def begin(self, levels: list[Tensor], previous: Tensor | None = None) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Return the responses on each level, and the initial weight, flow and flow gradient for `step`."""
        maps, batch = self.search.response.maps(levels), levels[0].shape[0]
        weight = self.known.repeat(batch, 1)
        flow = torch.zeros_like(self.pixels).repeat(batch, 1, 1)
        if previous is not None:
            kept = previous.isfinite().all(-1)
            flow = torch.where(kept[..., None], previous - self.pixels, 0.0)
            weight = torch.where(kept, 1.0, weight)
        return maps, weight, flow, torch.zeros_like(flow)[..., None].repeat(1, 1, 1, 2)

    @traced
    def step(self, weight: Tensor, flow: Tensor, gradient: Tensor, *maps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Perform one growth step; return the new weight `[B, D]`, flow `[B, D, 2]` and flow gradient `[B, D, 2, 2]`."""
        predicted, gradient, support = predict(self.averages, weight, flow, gradient)
        found = self.search(maps, self.pixels + predicted)
        believed = torch.sigmoid(10 * (support - LEAST_SUPPORT)) * found.response / (found.response + LEAST_GROWTH_RESPONSE)
        return believed * found.sharpness, found.place - self.pixels, gradient

    @traced
    def moved(self, flow: Tensor) -> Tensor:
        """Return the pixels `[B, D, 2]` of the dots displaced by a flow."""
        return self.pixels + flow


def rings(kernel: np.ndarray, weight: np.ndarray) -> int:
    """Return the number of steps in which the growth reaches all reachable dots from the nodes of `weight [N]` 1.

    Args:
        kernel: weights `[N, D]` of the averages over the nodes, the first of which are the dots.
        weight: weights of the nodes, 0 or 1, `[N]`.

    Example:
        >>> rings(np.eye(5, k=1) * 2, np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
        4
    """
    count, reached, steps = kernel.shape[1], weight, 0
    while True:
        grown = np.maximum(reached[:count], GROWN_CERTAINTY * reached @ kernel > LEAST_SUPPORT)
        if (grown == reached[:count]).all():
            return steps
        reached, steps = np.append(grown, reached[count:]), steps + 1


def predict(averages: FlowAverages, weight: Tensor, flow: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the flow that the certain dots around each dot predict, by a weighted affine least-squares fit in closed form.

    Args:
        averages: averages over the dots and anchors.
        weight: `[B, D]` in 0..1.
        flow: `[B, D, 2]`, px.
        gradient: `[B, D, 2, 2]`, to which the fit is drawn where the dots around do not fix it.

    Returns:
        Flow `[B, D, 2]` px, gradient `[B, D, 2, 2]`, and support `[B, D]`, the number of certain nodes weighted by distance.
    """
    gradient = averages.gradient(weight, flow.mT, gradient.movedim(1, -1))
    predicted, support = averages.along(weight, flow.mT, gradient)
    return predicted.mT, gradient.movedim(-1, 1), support
