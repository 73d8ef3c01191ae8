"""Rasterisation: the visible triangle of a projected mesh at each sample, and values that are linear on triangles.

All triangles are cut into spans of rows at once.
"""

from typing import NamedTuple

import torch
from torch import Tensor


def visible_triangles(corners: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """Return the nearest triangle that covers each point `(u, v)` of a grid of `height x width` integers.

    A triangle covers the points on its edges that face left or up, so that neighbours neither overlap nor leave gaps.

    Args:
        corners: corners of the triangles, `[T, 3, 2]`. Only triangles whose corners turn from +u to +v are visible, as those of
            an outward surface seen from inside, and none with a NaN corner.
        depth: depth of each triangle, `[T]`.
        width: width of the image.
        height: height of the image.

    Returns:
        Indices of triangles, int64 `[height, width]`, -1 where there is no triangle.

    Limitations:
        Triangles that intersect each other are ordered by `depth`, not at each point.

    Example:
        >>> corners = torch.tensor([[[0.0, 0], [3, 0], [0, 3]]])
        >>> visible_triangles(corners, torch.ones(1), 4, 3)
        tensor([[ 0,  0,  0, -1],
                [ 0,  0, -1, -1],
                [ 0, -1, -1, -1]])
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
    """Return every row that a triangle crosses: triangle, row, and the two u between which it lies there, `[S]` each.

    Edges are evaluated from their upper end in every triangle, so that both triangles of an edge have it at the same u.
    """
    corners = corners.gather(1, corners[..., 1].argsort(dim=1, stable=True)[..., None].expand(-1, -1, 2))
    top, middle, bottom = corners.unbind(1)
    first = top[:, 1].ceil().clamp_min(0).long()
    rows = (bottom[:, 1].ceil().clamp_max(height).long() - first).clamp_min(0)
    triangle = torch.arange(len(rows), device=rows.device).repeat_interleave(rows)
    before = rows.cumsum(0) - rows
    row = torch.arange(len(triangle), device=rows.device) - (before - first).index_select(0, triangle)
    long, upper, lower = _line(top, bottom), _line(top, middle), _line(middle, bottom)
    above = row < middle[:, 1].index_select(0, triangle)
    one = _u_at(long.index_select(0, triangle), row)
    other = _u_at(torch.where(above[:, None], upper.index_select(0, triangle), lower.index_select(0, triangle)), row)
    return triangle, row, torch.minimum(one, other), torch.maximum(one, other)


def _line(upper: Tensor, lower: Tensor) -> Tensor:
    """Return `(u, v, du/dv)` of the edge that goes down from `upper [T, 2]` to `lower [T, 2]`."""
    du, dv = (lower - upper).unbind(-1)
    return torch.cat([upper, (du / torch.where(dv > 0, dv, 1.0))[:, None]], -1)


def _u_at(line: Tensor, v: Tensor) -> Tensor:
    """Return the u of lines `[S, 3]` at `v [S]`."""
    return line[:, 0] + (v - line[:, 1]) * line[:, 2]


class LinearOnTriangles(NamedTuple):
    """Values that are linear on triangles in the image: `value + slope (place - corner)`, float32.

    Attributes:
        value: values at the first corner of each triangle, `[T, C]`.
        slope: derivatives of the values with respect to image position, `[T, C, 2]`.
        corner: first corner of each triangle, `[T, 2]`.
    """

    value: Tensor
    slope: Tensor
    corner: Tensor

    @classmethod
    def from_corners(cls, corners: Tensor, values: Tensor) -> "LinearOnTriangles":
        """Construct from corners `[T, 3, 2]` and the values at them, `[T, 3, C]`."""
        (a, b), (c, d) = ((corners[:, k] - corners[:, 0]).unbind(-1) for k in (1, 2))
        det = a * d - b * c
        inverse = torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2)) / torch.where(det == 0, 1.0, det)[:, None, None]
        rise = (values[:, 1:] - values[:, :1]).mT
        return cls(values[:, 0].float(), (rise @ inverse.mT).float(), corners[:, 0].float())

    def at(self, triangle: Tensor, place: Tensor) -> Tensor:
        """Return the values `[S, C]` at points `place [S, 2]` of the image, each in `triangle [S]`."""
        value, slope, corner = (field.index_select(0, triangle) for field in self)  # faster than by brackets
        step = place - corner
        return value + (slope[..., 0] * step[:, :1] + slope[..., 1] * step[:, 1:])
