"""Regions around the persistent peaks of a field on the grid, strongest first: batched, without loops over frames or vertices.

Every vertex belongs to the basin of the peak at which the steepest ascent from it ends. The pass between two peaks is the
lowest point of the best path between them, which is the lowest of the passes between adjacent basins along the path. A peak is
persistent if it is higher than the passes to all higher peaks by `PERSISTENCE` of the highest peak (Edelsbrunner, Letscher and
Zomorodian 2002).
"""

import torch
import torch.nn.functional as F
from torch import Tensor

SHARE = 0.5  # height above which a vertex belongs to a region, relative to the region's peak
CANDIDATES = 32  # number of highest peaks that are considered
PERSISTENCE = 0.15  # smallest height of a peak above the passes to higher ones, relative to the highest peak
AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def persistent_regions(height: Tensor, count: int, least: float) -> Tensor:
    """Return numbered regions: the vertices connected to a persistent peak above `SHARE` of it, up to the passes to other
    peaks.

    Args:
        height: field on the grid, `[B, m, n]`.
        count: largest number of regions.
        least: smallest height of a peak.

    Returns:
        `[B, m, n]` int64: 0 for no region, else its number, with 1 for that of the highest peak.

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
    """Return the peaks that exceed a share of the highest peak, and exceed the passes to higher ones by a share of themselves.

    Args:
        height: field on the grid, `[B, m, n]`.
        count: largest number of peaks.
        least: smallest height of a peak relative to the highest.
        apart: smallest height of a peak above the pass to a higher one, relative to its own height.

    Returns:
        Heights `[B, count]`, highest first, `-inf` if there are fewer, and indices of the vertices, `[B, count]`.

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
    """Return the highest `K` peaks among the vertices where `high [B, m n]` is true.

    Returns:
        Heights and vertices of the peaks, `[B, K]` each, highest first, with a height of `-inf` if there are fewer; the number
        of the peak in whose basin every vertex lies, `[B, m n]`; the passes between the peaks, `[B, K, K]`.
    """
    vertex, summit = torch.arange(high.shape[1], device=height.device), _summits(height)
    top, place = torch.where((summit == vertex) & high, height.flatten(1), -torch.inf).topk(min(CANDIDATES, len(vertex)))
    numbers = torch.arange(top.shape[1], device=height.device)
    basin = torch.full_like(summit, len(numbers)).scatter(1, place, numbers.expand_as(place)).gather(1, summit)
    return top, place, basin, _passes(basin, height, len(numbers))


def _summits(height: Tensor) -> Tensor:
    """Return the vertex at which the steepest ascent from every vertex ends, `[B, m n]`; of equal heights the first counts as
    higher."""
    m, n = height.shape[1:]
    wide = F.pad(height, (1, 1, 1, 1), value=-torch.inf)
    around = torch.stack([wide[:, 1 + i : 1 + i + m, 1 + j : 1 + j + n] for i, j in AROUND], 1).flatten(2)
    beside = torch.arange(-1, 2, device=height.device)
    steps = (n * beside[:, None] + beside).flatten()
    vertex = torch.arange(m * n, device=height.device)
    up = (vertex + steps[around.max(1).indices]).clamp(0, m * n - 1)
    for _ in range((m * n).bit_length()):  # every iteration doubles the distance
        up = up.gather(1, up)
    return up


def _passes(basin: Tensor, height: Tensor, count: int) -> Tensor:
    """Return the passes between peaks, `[B, K, K]`, from the basins `[B, m n]` numbered up to `K = count`."""
    flat = height.flatten(1)[:, None]
    inside = torch.where(basin[:, None] == torch.arange(count, device=basin.device)[:, None], flat, -torch.inf)
    beside = torch.minimum(_dilated(inside.unflatten(-1, height.shape[1:])).flatten(2), flat)
    passes = flat.new_full((*inside.shape[:2], count + 1), -torch.inf)
    passes = passes.scatter_reduce(2, basin[:, None].expand_as(beside), beside, "amax")[..., :count]
    for _ in range((count - 1).bit_length()):
        passes = torch.minimum(passes[..., None], passes[:, None]).amax(2)
    return passes


def _standing_apart(top: Tensor, between: Tensor, count: int, margin: Tensor) -> tuple[Tensor, Tensor]:
    """Return heights and indices `[B, count]`, highest first, of the peaks that exceed the passes to all higher peaks by a
    margin.

    Heights are `-inf` if there are fewer peaks. It does not matter whether the higher peaks are selected themselves: if the
    pass to a higher peak is too high, and that peak is not selected because its pass to a third one is too high, then the pass
    to the third one is too high as well.

    Args:
        top: heights of the peaks in descending order, `[B, K]`.
        between: passes between the peaks, `[B, K, K]`.
        count: number of peaks to return.
        margin: `[B, K]` or `[B, 1]`.
    """
    number = torch.arange(top.shape[1], device=top.device)
    too_high = (between > (top - margin)[..., None]) & (number < number[:, None])
    highest, chosen = torch.where(too_high.any(-1), -torch.inf, top).topk(min(count, top.shape[1]))
    short = count - highest.shape[1]
    return F.pad(highest, (0, short), value=-torch.inf), F.pad(chosen, (0, short))


def _dilated(height: Tensor) -> Tensor:
    """Return the maximum over every vertex and its eight neighbours, `[..., m, n]`: a separable 3 x 3 max-pooling."""
    wide = F.pad(height, (1, 1, 1, 1), value=-torch.inf)
    rows = torch.maximum(torch.maximum(wide[..., :-2, :], wide[..., 1:-1, :]), wide[..., 2:, :])
    return torch.maximum(torch.maximum(rows[..., :-2], rows[..., 1:-1]), rows[..., 2:])
