"""Which triangle of a projected mesh is seen at every sample of an image: spans of rows, all triangles at once."""

import torch
from torch import Tensor


def visible_triangles(corners: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """The nearest triangle that covers each point `(u, v)` of a grid of `height x width` integers.

    A triangle covers the points on its edges that face left or up, so that neighbours neither overlap nor leave gaps.

    Arguments: `corners [T, 3, 2]`: only triangles that turn from +u to +v are seen, which those of an outward surface do from
    inside, and none with a corner that is NaN; `depth [T]`, one for each triangle.
    Returns indices of triangles, int64 `[height, width]`, -1 where there is none. Wrong where triangles pierce each other.
    """
    u, v = corners.unbind(-1)
    turns = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (v[:, 1] - v[:, 0]) * (u[:, 2] - u[:, 0])
    kept = torch.nonzero(turns > 0).squeeze(-1)  # NaN is not
    kept = kept[depth[kept].argsort(stable=True)]
    triangle, row, left, right = _spans(corners[kept], height)
    start, end = (side.ceil().clamp(0, width).long() for side in (left, right))
    length = (end - start).clamp_min(0)
    before = length.cumsum(0) - length
    sample = (row * width + start - before).repeat_interleave(length)
    sample += torch.arange(len(sample), device=sample.device)
    nearest = torch.full((height * width,), len(kept), device=sample.device)
    nearest.scatter_reduce_(0, sample, triangle.repeat_interleave(length), "amin")
    return torch.cat([kept, kept.new_tensor([-1])])[nearest].view(height, width)


def _spans(corners: Tensor, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Every row that a triangle meets: triangle, row, and the u between which it lies there, `[S]` each.

    Edges are followed from their upper end, by whichever triangle, so that both triangles of an edge see it at the same u.
    """
    corners = corners.gather(1, corners[..., 1].argsort(dim=1, stable=True)[..., None].expand(-1, -1, 2))
    top, middle, bottom = corners.unbind(1)
    first = top[:, 1].ceil().clamp_min(0).long()
    rows = (bottom[:, 1].ceil().clamp_max(height).long() - first).clamp_min(0)
    triangle = torch.arange(len(rows), device=rows.device).repeat_interleave(rows)
    before = rows.cumsum(0) - rows
    row = torch.arange(len(triangle), device=rows.device) - (before - first)[triangle]
    long, upper, lower = _line(top, bottom), _line(top, middle), _line(middle, bottom)
    above = row < middle[triangle, 1]
    one = _u_at(long[triangle], row)
    other = _u_at(torch.where(above[:, None], upper[triangle], lower[triangle]), row)
    return triangle, row, torch.minimum(one, other), torch.maximum(one, other)


def _line(upper: Tensor, lower: Tensor) -> Tensor:
    """`(u, v, du/dv)` of the edge that goes down from `upper [T, 2]` to `lower [T, 2]`."""
    du, dv = (lower - upper).unbind(-1)
    return torch.cat([upper, (du / torch.where(dv > 0, dv, 1.0))[:, None]], -1)


def _u_at(line: Tensor, v: Tensor) -> Tensor:
    return line[:, 0] + (v - line[:, 1]) * line[:, 2]
