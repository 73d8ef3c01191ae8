"""Matching: which blob of the frame is which dot, grown inwards from the rim along the smooth flow."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...control_flow import cond, fori_loop, traced, where_rows
from ..spacing import spacing, thin_out
from .deformation import FAR, LocalDeformation
from .flow import SUPPORT, FlowAverages
from .steps import NeighbourSteps, trust

SETTLING = 6  # steps after the growth has reached every dot
DOUBTS, RESETTLING = 2, 3  # how often the dots that strayed are let go, and the steps in which all settle after it
FOLLOWING = 1  # steps after dots are followed from where they were
KEPT = 0.3  # certainty of a dot that could be followed
WIDTH = 1.1  # of the local average, pitches
TOLERANCE = 0.30  # standard deviation of a prediction, pitches

State = tuple[Tensor, Tensor, Tensor]
"""Weight `[B, D]`, flow `[B, 2, D]` and strain `[B, 2, 2, D]` of the dots."""


def sectors(pixels: np.ndarray) -> np.ndarray:
    """`[7, D]` 0 or 1: the pattern cut into its middle and six outer parts."""
    around = pixels - pixels.mean(0)
    radius, angle = np.hypot(*around.T), np.arctan2(*around.T)
    part = np.where(radius < np.quantile(radius, 1 / 7), 6, ((angle / (2 * np.pi) + 0.5) * 6).astype(int) % 6)
    return (part == np.arange(7)[:, None]).astype(float)


class DotMatcher(nn.Module):
    """Assigns blobs of a frame to the dots of the rest image.

    The flow is smooth and, where `anchors` are given, zero at them. Dots are followed from where they were, or else, where
    one cannot be, searched for from the anchors on: each of a fixed number of steps predicts every dot from the sure nodes
    around it and the local deformation, takes the blob nearest to the prediction and of its size, and keeps it where the
    choice is mutual. Without anchors each part of the pattern in turn is assumed to have moved least, and the start that
    matches most is kept. Where some are lost, those that took another's blob are let go, and may find their own. What is
    returned follows from which blob is which dot's alone, not from how that was found.

    Args:
        pixels: centres `[D, 2]` of the dots at rest, px.
        log_radius: `[D]`, as the blob detector finds it at rest.
        size_tolerance: standard deviation of a dot's log radius.
        anchors: `[A, 2]` pixels of the rim, where nothing moves, or None.

    Limitations:
        See `DotLocator`.
    """

    origin: Tensor
    pixels: Tensor
    square: Tensor
    nearest: Tensor
    stiffness: Tensor
    slope: Tensor
    log_radius: Tensor
    starts: Tensor

    def __init__(self, pixels: np.ndarray, log_radius: np.ndarray, size_tolerance: float, anchors: np.ndarray | None = None):
        super().__init__()
        self.size_tolerance = size_tolerance
        nearest, mean = spacing(pixels)
        anchors = np.empty((0, 2)) if anchors is None else thin_out(np.asarray(anchors, float), 0.7 * np.median(mean))
        nodes = np.concatenate([pixels, anchors])
        self.deformation = LocalDeformation(pixels)
        self.averages = FlowAverages(pixels, nodes, WIDTH)
        self.neighbour_steps = NeighbourSteps(pixels)
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("pixels", torch.as_tensor(pixels - pixels.mean(0)))
        self.register_buffer("square", self.pixels.square().sum(-1))
        self.register_buffer("nearest", torch.as_tensor(nearest))
        self.register_buffer("stiffness", torch.as_tensor((TOLERANCE * nearest) ** -2.0))
        self.register_buffer("slope", -2 * self.stiffness)
        self.register_buffer("log_radius", torch.as_tensor(log_radius))
        starts = np.zeros((1, len(pixels))) if len(anchors) else sectors(pixels)
        self.register_buffer("starts", torch.as_tensor(starts))
        self.steps = self.averages.rings(np.column_stack([starts, np.ones((len(starts), len(anchors)))])) + 3

    def nearest_dots(self, blobs: Tensor) -> Tensor:
        """Which dot at rest is nearest to each of `blobs [B, K, 2]`, `[B, K]`."""
        return F.linear(blobs - self.origin, -2 * self.pixels, self.square).argmin(-1)

    def predict(self, weight: Tensor, flow: Tensor, strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Flow `[B, D, 2]`, gradient `[B, D, 2, 2]` and support `[B, D]` at the dots, from weight, flow and strain there."""
        gradient = self.gradient(weight, flow, strain)
        predicted, support = self.averages.along(weight, flow.mT, gradient)
        return predicted.mT, gradient.movedim(-1, 1), support

    def gradient(self, weight: Tensor, flow: Tensor, strain: Tensor) -> Tensor:
        """Gradient `[B, 2, 2, D]` of the flow at the dots, from what `predict` takes."""
        return self.averages.gradient(weight, flow.mT, strain.movedim(1, -1))

    def choose(self, predicted: Tensor, support: Tensor, blobs: Tensor, base: Tensor) -> State:
        """Each dot's blob.

        Args:
            predicted: flow `[B, 2, D]`, px.
            support: of the prediction `[B, D]`.
            blobs: `[B, 7, K]`: 1, positions and strains.
            base: `[B, D, K]`: what of the cost does not depend on the prediction.

        Returns:
            Certainty `[B, D]`, the flow to the blob `[B, 2, D]` (the prediction where lost), its strain `[B, 2, 2, D]`.
        """
        expected = self.pixels.mT + predicted
        alone = (expected * expected).sum(1) * self.stiffness + FAR * (support < SUPPORT).to(support.dtype)
        cost = torch.cat([alone[:, None], self.slope * expected], 1).mT @ blobs[:, :3] + base
        best = cost.amin(-1)
        chosen = (cost <= best[..., None]).to(cost.dtype)
        taken = torch.cat([blobs, cost.amin(1, keepdim=True)], 1) @ chosen.mT
        found, strain, rival = (taken[:, 1:] / taken[:, :1]).split([2, 4, 1], 1)
        mutual = best <= rival[:, 0] + 1e-6 * best.abs()
        weight = torch.exp(-0.5 * best) * mutual * (support / (support + 0.5))
        flow = torch.where(weight[:, None] > 0.02, found - self.pixels.mT, predicted)
        return weight, flow, strain.unflatten(1, (2, 2))

    def forward(
        self, blobs: Tensor, log_radius: Tensor, valid: Tensor, previous: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Match a batch of frames.

        The dots are followed from where they were in the frames before, or from rest without these or where half of them
        were lost. In a frame in which one cannot be followed all are searched for.

        Args:
            blobs: `[B, K, 2]`, px.
            log_radius: of the blobs `[B, K]`.
            valid: how surely each is a dot `[B, K]`, in 0..1.
            previous: pixels `[B, D, 2]` in the frames before, NaN where lost.

        Returns:
            Positions `[B, D, 2]` px, certainty `[B, D]` in 0..1 and strain `[B, D, 2, 2]`.
        """
        unstrained = self.unstrained(blobs, log_radius, valid)
        *followed, kept = self.follow(*unstrained, previous)

        def searched() -> Sequence[Tensor]:
            return self.either(kept, *followed, *self.search(blobs, log_radius, valid))

        weight, flow, strain = cond(kept, followed, searched)
        weight, flow, strain, complete = self.sure(weight, flow, strain, *unstrained)

        def doubted() -> Sequence[Tensor]:
            known, base = self.scene(self.deformation(blobs, valid), blobs, log_radius, valid)
            begun = self.from_sure(weight, flow, strain, known, base)
            return self.either(complete, weight, flow, strain, *fori_loop(self.doubt, DOUBTS, begun, known, base))

        return self.end(*cond(complete, (weight, flow, strain), doubted))

    def search(self, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> State:
        """Weight `[B, D]`, flow `[B, 2, D]` and strain `[B, 2, 2, D]` of the dots."""
        known, base, *start = self.begin(*self.scene(self.deformation(blobs, valid), blobs, log_radius, valid))
        grown = fori_loop(self.grow, self.steps, start, known, base)
        return self.best(*fori_loop(self.settle, SETTLING, grown, known, base))

    @traced
    def follow(self, known: Tensor, base: Tensor, previous: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `search`, from the frames before, in the scene that is `unstrained`; and in which frames `[B]` all dots that were
        found could be followed."""
        found, flow = torch.ones_like(self.nearest[None]) > 0, torch.zeros_like(self.pixels[None])
        if previous is not None:
            finite = previous.isfinite().all(-1)
            enough = finite.to(base.dtype).mean(-1, keepdim=True) > 0.5
            flow = torch.where((finite & enough)[..., None], previous - self.pixels - self.origin, flow)
            found = finite | ~enough
        weight, flow = found.to(base.dtype), flow.mT
        state = self.grow(weight, flow, torch.zeros_like(flow[:, None]).expand(-1, 2, -1, -1), known, base)
        for _ in range(FOLLOWING):
            state = self.settle(*state, known, base)
        weight, flow, strain = state
        return weight, flow, strain, ~(found & ~(weight >= KEPT)).any(-1)

    @traced
    def sure(
        self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the dots that are found say, the same to the last digit whether they were followed or searched for; and in which
        frames `[B]` all are found, so that none can be on another's blob."""
        complete = (weight >= KEPT).all(-1)
        weight, flow, strain = self.from_sure(weight, flow, strain, known, base)
        return weight, flow, self.averages.gradient(weight, flow, strain), complete

    @traced
    def from_sure(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """A step from the dots that are found alone: which they are and where, not how surely."""
        found = (weight >= KEPT).to(flow.dtype)
        return self.settle(found, found[:, None] * flow, torch.zeros_like(strain), known, base)

    @traced
    def unstrained(self, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """The `scene` of blobs whose arrangement says nothing."""
        eye = torch.eye(2, dtype=blobs.dtype, device=blobs.device)
        return self.scene(eye[..., None].expand(*valid.shape[:1], 2, 2, valid.shape[1]), blobs, log_radius, valid)

    @traced
    def either(self, kept: Tensor, weight: Tensor, flow: Tensor, strain: Tensor, *others: Tensor) -> State:
        """These dots in the frames `kept [B]`, the others in the others."""
        weight, flow, strain = where_rows(kept, (weight, flow, strain), others)
        return weight, flow, strain

    @traced
    def scene(self, deformation: Tensor, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """What `choose` needs to know of the blobs: `[B, 7, K]`, `[B, D, K]`."""
        strain = deformation - torch.eye(2, dtype=blobs.dtype, device=blobs.device)[..., None]
        position = (blobs - self.origin).mT
        known = torch.cat([torch.ones_like(position[:, :1]), position, strain.flatten(1, 2)], 1)
        misfit = ((self.log_radius[:, None] - (log_radius + 3 * (1 - valid))[:, None]) / self.size_tolerance).square()
        return known, misfit + self.stiffness[:, None] * position.square().sum(1, keepdim=True)

    @traced
    def begin(self, known: Tensor, base: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The scene of every start; weight, flow and strain of the dots before the first step."""
        starts = self.starts.shape[0]
        if starts > 1:
            known, base = (x[:, None].expand(-1, starts, -1, -1).flatten(0, 1) for x in (known, base))
        flow = torch.zeros_like(self.pixels.mT).expand(known.shape[0], -1, -1)
        weight, flow, strain = self.choose(flow, FAR + flow[:, 0], known, base)
        return known, base, (weight.unflatten(0, (-1, starts)) * self.starts).flatten(0, 1), flow, strain

    @traced
    def grow(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """One step outwards along the strain measured."""
        return self.choose(*self.averages.along(weight, flow, strain), known, base)

    @traced
    def settle(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """One step along the strain measured and what the neighbours' flow says of it."""
        gradient = self.averages.gradient(weight, flow, strain)
        return self.choose(*self.averages.along(weight, flow, gradient), known, base)

    @traced
    def doubt(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """Some steps more after those that took another's blob have been let go."""
        state = weight * trust(*self.neighbour_steps(self.pixels.mT + flow, weight, strain)), flow, strain
        for _ in range(RESETTLING):
            state = self.settle(*state, known, base)
        return state

    @traced
    def best(self, weight: Tensor, flow: Tensor, strain: Tensor) -> State:
        """The best start's."""
        starts = self.starts.shape[0]
        if starts == 1:
            return weight, flow, strain
        weight, flow, strain = (x.unflatten(0, (-1, starts)) for x in (weight, flow, strain))
        best = weight.sum(-1).argmax(-1)[:, None]

        def of_best(x: Tensor) -> Tensor:
            return torch.take_along_dim(x, best.reshape(-1, *(1,) * (x.ndim - 1)), 1).squeeze(1)

        return of_best(weight), of_best(flow), of_best(strain)

    @traced
    def end(self, weight: Tensor, flow: Tensor, strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, certainty and strain, as `forward` returns them."""
        return self.pixels + self.origin + flow.mT, weight, strain.movedim(-1, 1)
