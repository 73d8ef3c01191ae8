"""Assignment of blobs to dots in which neighbours agree on their motion: belief propagation between neighbours."""

from math import log

import numpy as np
import torch
from scipy.spatial import Delaunay
from torch import Tensor, nn

from ...control_flow import fori_loop, traced
from ..spacing import spacing, square_distance
from .scales import CANDIDATES, FAR, LOST, PREDICTION, REACH

DOUBT = -log(LOST)  # cost of a lost dot, and largest cost of a wrong step or size
EXCHANGES = 20  # number of exchanges of messages between all neighbours


def edges(pixels: np.ndarray) -> np.ndarray:
    """Return the pairs `[E, 2]` of neighbours among `pixels [D, 2]`: the edges of the Delaunay triangles, without the long
    ones."""
    corners = Delaunay(pixels, qhull_options="QJ Pp").simplices  # joggled: dots may be in one row
    pairs = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), 1), axis=0)
    length, pitch = np.linalg.norm(np.diff(pixels[pairs], axis=1)[:, 0], axis=1), spacing(pixels)[1]
    return np.asarray(pairs[length < REACH * pitch[pairs].max(1)])


class NeighbourAgreement(nn.Module):
    """Assigns blobs to the dots of a pattern so that the steps between neighbours are as expected.

    Each dot chooses one of its candidates or none. The choices `k` minimise `sum_d c_d(k_d) + sum_(d,e) min(|r_de|^2 / 2
    s_de^2, DOUBT)`, where `r_de` is the step from blob `k_d` to blob `k_e` minus the expected one, and `s_de` is `PREDICTION`
    times the length of the step at rest.

    The method is loopy min-sum belief propagation (Pearl 1988; Weiss and Freeman 2001) with a fixed number of exchanges of
    messages along the edges. It assumes no membrane: the steps of the flow may change by up to about half from one dot to the
    next.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
        seen: which of them are in the image at rest, `[D]` bool; the others can be lost without cost.

    Limitations:
        The choice of least cost is usually found, but not always. If the pattern is a lattice, a motion by one lattice step is
        distinguished from rest by the lattice's outline alone.
    """

    source: Tensor
    target: Tensor
    reverse: Tensor
    incoming: Tensor
    narrowness: Tensor
    pull: Tensor
    reach: Tensor
    lost: Tensor

    def __init__(self, pixels: np.ndarray, seen: np.ndarray):
        super().__init__()
        pairs, pitch = edges(pixels), spacing(pixels)[1]
        count, length = len(pairs), np.linalg.norm(pixels[pairs[:, 0]] - pixels[pairs[:, 1]], axis=1)
        source, target = np.concatenate([pairs, pairs[:, ::-1]]).T
        order, degree = np.argsort(target, kind="stable"), np.bincount(target, minlength=len(pixels))
        incoming = np.full((len(pixels), degree.max()), 2 * count)  # the last is a message that says nothing
        incoming[np.arange(degree.max()) < degree[:, None]] = order
        self.register_buffer("source", torch.as_tensor(source.copy()))
        self.register_buffer("target", torch.as_tensor(target.copy()))
        self.register_buffer("reverse", torch.as_tensor(np.roll(np.arange(2 * count), count)))
        self.register_buffer("incoming", torch.as_tensor(incoming))
        self.register_buffer("narrowness", torch.as_tensor(0.5 / (PREDICTION * np.tile(length, 2)) ** 2)[:, None, None])
        self.register_buffer("pull", torch.as_tensor((REACH * pitch) ** -2.0)[:, None])
        self.register_buffer("lost", torch.as_tensor(DOUBT * seen.astype(float))[:, None])
        self.register_buffer("reach", torch.as_tensor((REACH * pitch) ** 2)[:, None])

    def forward(self, expected: Tensor, blobs: Tensor, misfit: Tensor) -> tuple[Tensor, Tensor]:
        """Assign a blob to each dot.

        Args:
            expected: expected positions of the dots, `[B, D, 2]`, px.
            blobs: positions of the blobs, `[B, K, 2]`, px.
            misfit: misfit of the blobs' sizes, `[B, D, K]`, squared standard deviations.

        Returns:
            The assigned blobs, `[B, D, 2]` px, and whether each dot has one, `[B, D]`, 0 or 1.
        """
        places, own, pair, messages = self.begin(expected, blobs, misfit)
        (messages,) = fori_loop(self.exchange, EXCHANGES, (messages,), own, pair)
        return self.end(messages, own, places)

    @traced
    def begin(self, expected: Tensor, blobs: Tensor, misfit: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the candidates `[B, D, C, 2]`, the cost of each and, last, of none `[B, D, C + 1]`, the cost of pairs of
        candidates `[B, E, C + 1, C + 1]`, and the first messages `[B, E, C + 1]`."""
        middle = expected.mean(1, keepdim=True)
        square = square_distance(expected - middle, blobs - middle)
        cost = square * self.pull + (0.5 * misfit).clamp(max=DOUBT) + FAR * (square > self.reach).to(square.dtype)
        value, index = cost.topk(min(CANDIDATES, cost.shape[-1]), largest=False)
        places = blobs.gather(1, index.flatten(1)[..., None].expand(-1, -1, 2)).unflatten(1, index.shape[1:])
        offset = places - expected[:, :, None]
        pair = square_distance(offset.index_select(1, self.source), offset.index_select(1, self.target)) * self.narrowness
        one_lost = torch.full_like(pair[..., :1], DOUBT / 2)
        pair = torch.cat([pair.clamp(max=DOUBT), one_lost], -1)
        both_lost = torch.cat([torch.full_like(pair[..., :1, :-1], DOUBT / 2), torch.zeros_like(pair[..., :1, :1])], -1)
        own = torch.cat([value, self.lost.expand_as(value[..., :1])], -1)
        return places, own, torch.cat([pair, both_lost], -2), torch.zeros_like(pair[:, :, 0])

    @traced
    def exchange(self, messages: Tensor, own: Tensor, pair: Tensor) -> tuple[Tensor]:
        """Return the next messages `[B, E, C + 1]`, each the mean of the new and the previous message, for damping.

        The message of an edge gives, for each choice of the dot at its end, the least cost that the dot at its beginning and
        the dots behind that one can reach.
        """
        behind = self.beliefs(messages, own).index_select(1, self.source) - messages.index_select(1, self.reverse)
        told = (behind[..., None] + pair).amin(-2)
        return ((messages + told - told.amin(-1, keepdim=True)) / 2,)

    def beliefs(self, messages: Tensor, own: Tensor) -> Tensor:
        """Return the total cost of each choice, `[B, D, C + 1]`."""
        told = torch.cat([messages, torch.zeros_like(messages[:, :1])], 1)
        return own + told.index_select(1, self.incoming.flatten()).unflatten(1, self.incoming.shape).sum(2)

    @traced
    def end(self, messages: Tensor, own: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return the choices of least cost, in the form of `forward`."""
        choice = self.beliefs(messages, own).argmin(-1)
        found = choice < places.shape[2]
        taken = choice.clamp(max=places.shape[2] - 1)[..., None, None].expand(-1, -1, 1, 2)
        return places.gather(2, taken)[:, :, 0], found.to(places.dtype)
