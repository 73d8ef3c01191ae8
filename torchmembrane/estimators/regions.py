"""Regions around the persistent peaks of a field on the grid, strongest first: batched, without a loop over frames or vertices.

Every vertex lies in the basin of the peak that the steepest way up from it ends on. The lowest height on the best path between
two peaks, the pass, is the least of those between neighbouring basins on the way. A lower peak stands for itself if it is
higher than the pass to a higher one by `PERSISTENCE` of the highest (Edelsbrunner, Letscher and Zomorodian 2002).
"""

import torch
import torch.nn.functional as F
from torch import Tensor

SHARE = 0.5  # of a region's peak: what lies above it, around the peak, is the region
CANDIDATES = 32  # peaks that are looked at, the highest
PERSISTENCE = 0.15  # of the highest peak, by which a peak stands above the pass to a higher one, or it is no contact
AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


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
    n, flat = height.shape[2], height.flatten(1)
    vertex = torch.arange(flat.shape[1], device=height.device)
    top, place, basin, between = _peaks(height, flat >= least)
    top, chosen = _standing_apart(top, between, count, PERSISTENCE * top.amax(1, keepdim=True))
    place, top = place.gather(1, chosen)[..., None], top[..., None]
    passes = F.pad(between, (0, 1), value=-torch.inf).gather(1, chosen[..., None].expand(-1, -1, between.shape[2] + 1))
    passes = torch.minimum(passes.gather(2, basin[:, None].expand(-1, count, -1)), flat[:, None])
    passes = torch.where(top > -torch.inf, passes, -torch.inf)
    distance = (vertex // n - place // n).square() + (vertex % n - place % n).square()
    nearest = torch.where(passes >= passes.amax(1, keepdim=True), distance, len(vertex) ** 2).min(1, keepdim=True).indices
    peak, connected = top.squeeze(2).gather(1, nearest.squeeze(1)), passes.gather(1, nearest).squeeze(1)
    region = torch.where(connected > SHARE * peak, nearest.squeeze(1) + 1, 0)
    return region.reshape(height.shape)


def persistent_peaks(height: Tensor, count: int, least: float, apart: float) -> tuple[Tensor, Tensor]:
    """Peaks, each judged by itself: at least `least` of the highest, and by `apart` of itself above the passes to higher ones.

    Args:
        height: `[B, m, n]`.
        count: how many at most.
        least: smallest peak, over the highest.
        apart: how much of itself a peak stands above the pass to a higher one.

    Returns:
        Heights `[B, count]`, highest first, `-inf` where there are no more, and vertices `[B, count]`, row by row.

    Example:
        >>> heights, vertices = persistent_peaks(torch.tensor([[[0.0, 10, 3, 4, 3.9, 1, 2, 0]]]), 3, 0.1, 0.3)
        >>> heights.tolist(), vertices[0, :2].tolist()
        ([[10.0, 2.0, -inf]], [1, 6])
    """
    top, place, _, between = _peaks(height, height.flatten(1) > 0)
    top = torch.where(top >= least * top.amax(1, keepdim=True), top, -torch.inf)
    top, chosen = _standing_apart(top, between, count, apart * top)
    return top, place.gather(1, chosen)


def _peaks(height: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the highest peaks where it is `high [B, m n]`: heights and vertices `[B, K]`, highest first, heights of `-inf` where
    there are no more; whose basin every vertex is in, `[B, m n]`; the passes between them, `[B, K, K]`."""
    vertex, summit = torch.arange(high.shape[1], device=height.device), _summits(height)
    top, place = torch.where((summit == vertex) & high, height.flatten(1), -torch.inf).topk(min(CANDIDATES, len(vertex)))
    numbers = torch.arange(top.shape[1], device=height.device)
    basin = torch.full_like(summit, len(numbers)).scatter(1, place, numbers.expand_as(place)).gather(1, summit)
    return top, place, basin, _passes(basin, height, len(numbers))


def _summits(height: Tensor) -> Tensor:
    """The vertex that the steepest way up from every vertex ends on, `[B, m n]`; of equal heights the first is the higher."""
    m, n = height.shape[1:]
    wide = F.pad(height, (1, 1, 1, 1), value=-torch.inf)
    around = torch.stack([wide[:, 1 + i : 1 + i + m, 1 + j : 1 + j + n] for i, j in AROUND], 1).flatten(2)
    beside = torch.arange(-1, 2, device=height.device)
    steps = (n * beside[:, None] + beside).flatten()
    vertex = torch.arange(m * n, device=height.device)
    up = (vertex + steps[around.max(1).indices]).clamp(0, m * n - 1)
    for _ in range((m * n).bit_length()):  # each time twice as far
        up = up.gather(1, up)
    return up


def _passes(basin: Tensor, height: Tensor, count: int) -> Tensor:
    """The lowest height on the best path between peaks, `[B, K, K]`, from the basins `[B, m n]` numbered up to `K = count`."""
    flat = height.flatten(1)[:, None]
    inside = torch.where(basin[:, None] == torch.arange(count, device=basin.device)[:, None], flat, -torch.inf)
    beside = torch.minimum(_dilated(inside.unflatten(-1, height.shape[1:])).flatten(2), flat)
    passes = flat.new_full((*inside.shape[:2], count + 1), -torch.inf)
    passes = passes.scatter_reduce(2, basin[:, None].expand_as(beside), beside, "amax")[..., :count]
    for _ in range((count - 1).bit_length()):
        passes = torch.minimum(passes[..., None], passes[:, None]).amax(2)
    return passes


def _standing_apart(top: Tensor, between: Tensor, count: int, margin: Tensor) -> tuple[Tensor, Tensor]:
    """Heights and indices `[B, count]`, highest first, of peaks `top [B, K]` that stand above the passes `between [B, K, K]`
    to higher ones by `margin [B, K]` or `[B, 1]`; heights of `-inf` where there are no more.

    `top` goes down. It makes no difference whether the higher ones stand: where the pass to one is too high that does not, the
    pass from there to a third is too high, and so is the one to the third.
    """
    number = torch.arange(top.shape[1], device=top.device)
    too_high = (between > (top - margin)[..., None]) & (number < number[:, None])
    highest, chosen = torch.where(too_high.any(-1), -torch.inf, top).topk(min(count, top.shape[1]))
    short = count - highest.shape[1]
    return F.pad(highest, (0, short), value=-torch.inf), F.pad(chosen, (0, short))


def _dilated(height: Tensor) -> Tensor:
    """The highest of every vertex and its eight neighbours, `[..., m, n]`: as a 3 x 3 max-pooling, which looks at nine each."""
    wide = F.pad(height, (1, 1, 1, 1), value=-torch.inf)
    rows = torch.maximum(torch.maximum(wide[..., :-2, :], wide[..., 1:-1, :]), wide[..., 2:, :])
    return torch.maximum(torch.maximum(rows[..., :-2], rows[..., 1:-1]), rows[..., 2:])
