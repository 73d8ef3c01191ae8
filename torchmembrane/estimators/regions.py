"""Regions around the persistent peaks of a field on the grid, strongest first: batched, without a loop over frames or vertices.

From a peak the field is climbed down by grey-scale reconstruction (Vincent 1993): dilated by eight neighbours and cut off under
the field, a fixed number of times, what begins as the peak alone becomes the height of the lowest pass on the best path to it.
A lower peak stands for itself if it is higher than that pass by `PERSISTENCE` of the highest.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

SHARE = 0.5  # of a region's peak: what lies above it, around the peak, is the region
CANDIDATES = 16  # local maxima that are looked at, the highest
PERSISTENCE = 0.15  # of the highest peak, by which a peak stands above the pass to a higher one, or it is no contact


def persistent_regions(height: Tensor, count: int, least: float) -> Tensor:
    """Numbered regions: what is joined with a persistent peak above `SHARE` of it, on its side of the passes to the others.

    Args:
        height: `[B, m, n]`.
        count: how many regions at most.
        least: the smallest peak, in the unit of the height.

    Returns:
        `[B, m, n]` int64, 0 none, else the number of the region, the highest peak's first.

    Example:
        >>> persistent_regions(torch.tensor([[[0.0, 4, 10, 9, 4, 8, 7, 7.2, 0]]]), 4, 0.5).tolist()
        [[[0, 0, 1, 1, 0, 2, 2, 2, 0]]]
    """
    m, n = height.shape[1:]
    vertex = torch.arange(m * n, device=height.device)
    local = height == _dilated(height)
    top, place = torch.where(local & (height >= least), height, -torch.inf).flatten(1).topk(min(CANDIDATES, m * n))
    at_peak = (place[..., None] == vertex) & (top > -torch.inf)[..., None]
    passes = _passes(at_peak.unflatten(-1, (m, n)), height).flatten(2)
    between = passes.gather(2, place[:, None].expand(-1, place.shape[1], -1))
    top, chosen = _standing_apart(top, between, count)
    place = place.gather(1, chosen)[..., None]
    passes = torch.where(top[..., None] > -torch.inf, passes.gather(1, chosen[..., None].expand(-1, -1, m * n)), -torch.inf)
    distance = (vertex // n - place // n).square() + (vertex % n - place % n).square()
    nearest = torch.where(passes >= passes.amax(1, keepdim=True), distance, m * m * n * n).argmin(1)
    peak, connected = top.gather(1, nearest), passes.gather(1, nearest[:, None]).squeeze(1)
    region = torch.where((connected > SHARE * peak) & (peak > -torch.inf), nearest + 1, 0)
    return region.reshape(height.shape)


def _standing_apart(top: Tensor, between: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Heights and indices `[B, count]` of the persistent ones, highest first, of peaks `top [B, K]` with passes `between
    [B, K, K]` them; heights of `-inf` where there are no more."""
    margin, standing, heights, chosen = PERSISTENCE * top.amax(1, keepdim=True), top, [], []
    for _ in range(count):
        highest, k = standing.max(1, keepdim=True)
        heights.append(highest)
        chosen.append(k)
        to_it = between.gather(1, k[..., None].expand(-1, -1, top.shape[1])).squeeze(1)
        standing = torch.where(standing - to_it >= margin, standing, -torch.inf)
    return torch.cat(heights, 1), torch.cat(chosen, 1)


def _passes(peaks: Tensor, height: Tensor) -> Tensor:
    """The lowest height on the best path from where `peaks [B, K, m, n]` hold to every vertex, `[B, K, m, n]`."""
    reached = torch.where(peaks, height[:, None], -torch.inf)
    for _ in range(max(height.shape[1:])):
        reached = torch.minimum(_dilated(reached), height[:, None])
    return reached


def _dilated(height: Tensor) -> Tensor:
    """The highest of every vertex and its eight neighbours, `[..., m, n]`: as a 3 x 3 max-pooling, which looks at nine each."""
    wide = F.pad(height, (1, 1, 1, 1), value=-torch.inf)
    rows = torch.maximum(torch.maximum(wide[..., :-2, :], wide[..., 1:-1, :]), wide[..., 2:, :])
    return torch.maximum(torch.maximum(rows[..., :-2], rows[..., 1:-1]), rows[..., 2:])
