"""Matching: assigns the blobs of a frame to dots, assuming a smooth flow."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...control_flow import cond, fori_loop, traced, where_rows
from ..native_frames import found_by, is_native
from ..spacing import spacing
from .agreement import NeighbourAgreement
from .alignment import Alignment
from .deformation import LocalDeformation
from .flow import SUPPORT, FlowAverages
from .native_flow import choices
from .native_match import bases, followed, sure_states
from .probability import LEAST, own_evidence
from .scales import FAR, LOST, PREDICTION, STEPS
from .steps import NeighbourSteps

FOUND = 0.3  # certainty above which a dot counts as found

State = tuple[Tensor, Tensor, Tensor]
"""Weight `[B, D]`, flow `[B, 2, D]` and strain `[B, 2, 2, D]` of the dots."""


class DotMatcher(nn.Module):
    """Assigns blobs of a frame to the dots of the rest image.

    The flow is only assumed to be smooth. Dots are followed from their previous positions. If one cannot be followed, all are
    searched for: the pattern is aligned with the blobs as a whole (`Alignment`), then neighbours agree on their blobs
    (`NeighbourAgreement`), repeatedly from the positions found before. A few steps then predict every dot from the confident
    dots around it and the local deformation, choose the nearest blob of its size, and keep it if the choice is mutual. If some
    dots are lost, those that took another's blob are released and may find their own. The result depends only on which blob
    belongs to which dot, not on how this was found.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
        log_radius: natural logarithms of the radii, px, that the blob detector finds at rest, `[D]`.
        size_tolerance: standard deviation of a dot's log radius.
        seen: which of them are in the image at rest, `[D]` bool.

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
    numbers: Tensor
    seen: Tensor

    def __init__(self, pixels: np.ndarray, log_radius: np.ndarray, size_tolerance: float, seen: np.ndarray):
        super().__init__()
        self.size_tolerance = size_tolerance
        nearest, _ = spacing(pixels)
        self.alignment = Alignment(pixels - pixels.mean(0), seen)
        self.agreement = NeighbourAgreement(pixels, seen)
        self.deformation = LocalDeformation(pixels)
        self.averages = FlowAverages(pixels, pixels)
        self.neighbour_steps = NeighbourSteps(pixels, seen)
        self.register_buffer("seen", torch.as_tensor(seen))
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("pixels", torch.as_tensor(pixels - pixels.mean(0)))
        self.register_buffer("square", self.pixels.square().sum(-1))
        self.register_buffer("nearest", torch.as_tensor(nearest))
        self.register_buffer("stiffness", torch.as_tensor((PREDICTION * nearest) ** -2.0))
        self.register_buffer("slope", -2 * self.stiffness)
        self.register_buffer("log_radius", torch.as_tensor(log_radius))
        self.register_buffer("numbers", torch.tensor([SUPPORT, LOST, FAR], dtype=torch.float64))

    def chooser(self) -> tuple[np.ndarray, ...]:
        """Return the buffers of `choose`, as machine code takes them."""
        return self.pixels.numpy(), self.stiffness.numpy(), self.numbers.numpy()

    def of_scene(self) -> tuple[Any, ...]:
        """Return the buffers of `base`, as machine code takes them."""
        return self.log_radius.numpy(), self.stiffness.numpy(), self.origin.numpy(), self.size_tolerance

    def following(self) -> tuple[Any, ...]:
        """Return the buffers of `follow` and `sure`, as machine code takes them."""
        return self.averages.constants(), self.chooser(), self.seen.numpy(), self.origin.numpy(), FOUND

    def nearest_dots(self, blobs: Tensor) -> Tensor:
        """Return the dot at rest that is nearest to each of `blobs [B, K, 2]`, `[B, K]`."""
        return F.linear(blobs - self.origin, -2 * self.pixels, self.square).argmin(-1)

    def predict(self, weight: Tensor, flow: Tensor, strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return flow `[B, D, 2]`, gradient `[B, D, 2, 2]` and support `[B, D]` at the dots, from weight, flow and strain of
        the dots."""
        gradient = self.gradient(weight, flow, strain)
        predicted, support = self.averages.along(weight, flow.mT, gradient)
        return predicted.mT, gradient.movedim(-1, 1), support

    def gradient(self, weight: Tensor, flow: Tensor, strain: Tensor) -> Tensor:
        """Return the gradient `[B, 2, 2, D]` of the flow at the dots, from the arguments of `predict`."""
        return self.averages.gradient(weight, flow.mT, strain.movedim(1, -1))

    def choose(self, predicted: Tensor, support: Tensor, blobs: Tensor, base: Tensor) -> State:
        """Choose a blob for each dot.

        Args:
            predicted: predicted flow, `[B, 2, D]`, px.
            support: support of the prediction, `[B, D]`.
            blobs: 1, positions and strains of the blobs, `[B, 7, K]`.
            base: the part of the cost that does not depend on the prediction, `[B, D, K]`.

        Returns:
            Certainty `[B, D]`, the flow to the blob `[B, 2, D]` (the prediction if lost), and its strain `[B, 2, 2, D]`.
        """
        if is_native(predicted, support, blobs, base, self.pixels):
            given = predicted, support, blobs, base
            taken = found_by(choices, self.chooser(), given, 7, len(self.pixels))
            return taken[:, 0], taken[:, 1:3], taken[:, 3:].unflatten(1, (2, 2))
        expected = self.pixels.mT + predicted
        alone = (expected * expected).sum(1) * self.stiffness + FAR * (support < SUPPORT).to(support.dtype)
        cost = torch.cat([alone[:, None], self.slope * expected], 1).mT @ blobs[:, :3] + base
        best = cost.amin(-1)
        chosen = (cost <= best[..., None]).to(cost.dtype)
        taken = torch.cat([blobs, cost.amin(1, keepdim=True)], 1) @ chosen.mT
        found, strain, rival = (taken[:, 1:] / taken[:, :1]).split([2, 4, 1], 1)
        mutual = best <= rival[:, 0] + 1e-6 * best.abs()
        weight = torch.exp(-0.5 * best) * mutual * (support / (support + 0.5))
        flow = torch.where(weight[:, None] > LOST, found - self.pixels.mT, predicted)
        return weight, flow, strain.unflatten(1, (2, 2))

    def forward(
        self, blobs: Tensor, log_radius: Tensor, valid: Tensor, previous: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Match a batch of frames.

        The dots are followed from the previous frames, or from rest if there are none or half of the dots were lost. In a frame
        in which a dot cannot be followed, all are searched for.

        Args:
            blobs: positions of the blobs, `[B, K, 2]`, px.
            log_radius: log radii of the blobs, `[B, K]`.
            valid: probability that each blob is a dot, `[B, K]`, in 0..1.
            previous: pixels in the previous frames, `[B, D, 2]`, NaN for lost dots.

        Returns:
            Positions `[B, D, 2]` px, certainty `[B, D]` in 0..1 and strain `[B, D, 2, 2]`.
        """
        *followed, kept, weight, flow, strain, complete = self.follow(blobs, log_radius, valid, previous)

        def searched() -> Sequence[Tensor]:
            better = self.better(kept, *followed, *self.search(blobs, log_radius, valid, previous))
            return self.sure(*better, *self.unstrained(blobs, log_radius, valid))

        weight, flow, strain, complete = cond(kept, (weight, flow, strain, complete), searched)

        def doubted() -> Sequence[Tensor]:
            known, base = self.scene(self.deformation(blobs, valid), blobs, log_radius, valid)
            begun = self.from_sure(weight, flow, strain, known, base)
            return self.either(complete, weight, flow, strain, *fori_loop(self.doubt, STEPS, begun, known, base))

        return self.end(*cond(complete, (weight, flow, strain), doubted))

    def search(self, blobs: Tensor, log_radius: Tensor, valid: Tensor, previous: Tensor | None = None) -> State:
        """Search for all dots, also near previous pixels; return weight `[B, D]`, flow `[B, 2, D]`, strain `[B, 2, 2, D]`."""
        deformation = self.deformation(blobs, valid)
        known, base = self.scene(deformation, blobs, log_radius, valid)
        place, blobs, misfit = self.begin(blobs, log_radius, valid, previous)
        place = self.alignment(place, blobs, misfit, deformation, valid)
        for _ in range(STEPS):
            place, support = self.expected(place, *self.agreement(place, blobs, misfit))
        weight, flow, strain = fori_loop(self.settle, STEPS, self.chosen(place, support, known, base), known, base)
        return weight, flow, strain

    @traced
    def begin(
        self, blobs: Tensor, log_radius: Tensor, valid: Tensor, previous: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the previous positions of the dots `[B, D, 2]` and the blobs `[B, K, 2]`, px relative to the pattern's mean at
        rest, and the misfit of the blobs' sizes `[B, D, K]`; without gradients."""
        flow, found = self.flow_before(previous)
        place, _ = self.expected(self.pixels.expand_as(flow), self.pixels + flow, found.to(flow.dtype))
        misfit = self.misfit(log_radius, valid).detach()
        place = torch.where(found[..., None], self.pixels + flow, place)
        return place.expand(len(blobs), -1, -1), (blobs - self.origin).detach(), misfit

    @traced
    def expected(self, place: Tensor, blob: Tensor, found: Tensor) -> tuple[Tensor, Tensor]:
        """Return the expected positions of the dots `[B, D, 2]`, and the number of found neighbours they are based on `[B, D]`.

        Neighbours that are `found [B, D]` at their `blob [B, D, 2]` contribute their distances from the `place [B, D, 2]` where
        they were expected before.
        """
        flow = (found[..., None] * (blob - place)).mT
        gradient = self.averages.gradient(found, flow, torch.zeros_like(flow[:, None]).expand(-1, 2, -1, -1))
        away, support = self.averages.along(found, flow, gradient)
        return torch.where((support > SUPPORT)[..., None], place + away.mT, place), support

    @traced
    def chosen(self, place: Tensor, support: Tensor, known: Tensor, base: Tensor) -> State:
        """Return the blobs nearest to the `place [B, D, 2]` where the dots are expected."""
        return self.choose((place - self.pixels).mT, support, known, base)

    def flow_before(self, previous: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the flow `[B, D, 2]` of the dots in the previous frames, and which were found `[B, D]`.

        Without previous frames, or if half of the dots were lost, the flow is zero, and the dots visible at rest count as
        found.
        """
        found, flow = self.seen[None], torch.zeros_like(self.pixels[None])
        if previous is None:
            return flow, found
        finite = previous.isfinite().all(-1)
        enough = finite.to(flow.dtype).mean(-1, keepdim=True) > 0.5
        flow = torch.where((finite & enough)[..., None], previous - self.pixels - self.origin, flow)
        return flow, (finite & enough) | (found & ~enough)  # onnxruntime chooses between numbers only

    @traced
    def follow(self, blobs: Tensor, log_radius: Tensor, valid: Tensor, previous: Tensor | None = None) -> tuple[Tensor, ...]:
        """Follow the dots from their previous pixels (without them, from rest), in the `unstrained` scene.

        Returns:
            Weight `[B, D]`, flow `[B, 2, D]` and strain `[B, 2, 2, D]`, as `search` does; `[B]` bool, whether every dot that
            was found in the previous frame was found again; and the four results of `sure` for these dots.
        """
        before = blobs.new_full((1, *self.pixels.shape), torch.nan) if previous is None else previous
        if is_native(blobs, log_radius, valid, before, self.pixels):
            given = blobs, log_radius, valid, before
            found = found_by(followed, (self.of_scene(), self.following()), given, 16, len(self.pixels))
            return *_parts(found[:, :8]), *_parts(found[:, 8:])
        known, base = self.unstrained(blobs, log_radius, valid)
        flow, found = self.flow_before(previous)
        weight, flow = found.to(base.dtype), flow.mT
        state = self.grow(weight, flow, torch.zeros_like(flow[:, None]).expand(-1, 2, -1, -1), known, base)
        weight, flow, strain = self.settle(*state, known, base)
        kept = ~(found & ~(weight >= FOUND)).any(-1)
        return weight, flow, strain, kept, *self.sure(weight, flow, strain, known, base)

    @traced
    def sure(
        self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the result that follows from the found dots alone, equal to the last digit for followed and searched dots; and
        in which frames `[B]` all are found, so that none can be at another's blob."""
        if is_native(weight, flow, known, base, self.pixels):
            return _parts(found_by(sure_states, self.following(), (weight, flow, known, base), 8, len(self.pixels)))
        complete = ((weight >= FOUND) | ~self.seen).all(-1)
        weight, flow, strain = self.from_sure(weight, flow, strain, known, base)
        return weight, flow, self.averages.gradient(weight, flow, strain), complete

    @traced
    def from_sure(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """Take a step from the found dots alone: it uses which they are and where, not their certainty."""
        found = (weight >= FOUND).to(flow.dtype)
        return self.settle(found, found[:, None] * flow, torch.zeros_like(strain), known, base)

    @traced
    def unstrained(self, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return the `scene` of blobs without measured strain."""
        if is_native(blobs, log_radius, valid, self.pixels):
            known = F.pad(F.pad((blobs - self.origin).mT, (0, 0, 1, 0), value=1.0), (0, 0, 0, 4))
            return known, self.base(blobs, log_radius, valid)
        eye = torch.eye(2, dtype=blobs.dtype, device=blobs.device)
        return self.scene(eye[..., None].expand(*valid.shape[:1], 2, 2, valid.shape[1]), blobs, log_radius, valid)

    @traced
    def either(self, kept: Tensor, weight: Tensor, flow: Tensor, strain: Tensor, *others: Tensor) -> State:
        """Return these dots in the frames `kept [B]`, and the others in the remaining frames."""
        weight, flow, strain = where_rows(kept, (weight, flow, strain), others)
        return weight, flow, strain

    @traced
    def better(self, kept: Tensor, weight: Tensor, flow: Tensor, strain: Tensor, *others: Tensor) -> State:
        """Return these dots in the frames `kept [B]` and where their total certainty is at least that of the others."""
        return self.either(kept | (weight.sum(-1) >= others[0].sum(-1)), weight, flow, strain, *others)

    @traced
    def scene(self, deformation: Tensor, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return the properties of the blobs that `choose` needs: `[B, 7, K]`, `[B, D, K]`."""
        strain = deformation - torch.eye(2, dtype=blobs.dtype, device=blobs.device)[..., None]
        position = (blobs - self.origin).mT
        known = torch.cat([torch.ones_like(position[:, :1]), position, strain.flatten(1, 2)], 1)
        return known, self.base(blobs, log_radius, valid)

    def base(self, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> Tensor:
        """Return the part `[B, D, K]` of the cost of `choose` that does not depend on the prediction."""
        if is_native(blobs, log_radius, valid, self.pixels):
            return found_by(bases, self.of_scene(), (blobs, log_radius, valid), len(self.pixels), blobs.shape[1])
        square = (blobs - self.origin).mT.square().sum(1, keepdim=True)
        return self.misfit(log_radius, valid) + self.stiffness[:, None] * square

    def misfit(self, log_radius: Tensor, valid: Tensor) -> Tensor:
        """Return the misfit of the blobs' sizes to the dots, `[B, D, K]`, squared standard deviations; blobs that are no dots
        fit none."""
        no_dot = -2 * valid.clamp_min(LEAST).log()
        return ((self.log_radius[:, None] - log_radius[:, None]) / self.size_tolerance).square() + no_dot[:, None]

    @traced
    def grow(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """Take one step outwards along the measured strain."""
        return self.choose(*self.averages.along(weight, flow, strain), known, base)

    @traced
    def settle(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """Take one step along the measured strain and the gradient of the neighbours' flow."""
        gradient = self.averages.gradient(weight, flow, strain)
        return self.choose(*self.averages.along(weight, flow, gradient), known, base)

    @traced
    def doubt(self, weight: Tensor, flow: Tensor, strain: Tensor, known: Tensor, base: Tensor) -> State:
        """Release the dots that took another's blob, and take some more steps."""
        own = own_evidence(*self.neighbour_steps(self.pixels.mT + flow, weight, strain))
        state = weight * torch.sigmoid(own), flow, strain
        for _ in range(STEPS):
            state = self.settle(*state, known, base)
        return state

    @traced
    def end(self, weight: Tensor, flow: Tensor, strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, certainty and strain in the form of `forward`."""
        return self.pixels + self.origin + flow.mT, weight, strain.movedim(-1, 1)


def _parts(found: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return weight, flow, strain and a property of frames from `found [B, 8, D]` of `native_match`."""
    return found[:, 0], found[:, 1:3], found[:, 3:7].unflatten(1, (2, 2)), found[:, 7, 0] > 0
