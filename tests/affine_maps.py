"""Local affine maps between matched points (eqs. 15-17, Appendix C)."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchmembrane.surface.topology import corners


class AffineMap(NamedTuple):
    """`p' = A p + b`: `A [..., q, p]`, `b [..., q]`."""

    A: Tensor
    b: Tensor


def affine_fit(points: Tensor, images: Tensor, inverse_moment: Tensor | None = None) -> AffineMap:
    """Least-squares affine map between matched points (eqs. 15-17, 47-52).

    Arguments: `points [..., n, p]`, `images [..., n, q]`; `inverse_moment [..., p, p]` is `G^-1` where it is known beforehand.
    `A = F^T G^-1`, `F = sum p p'^T - n pbar p'bar^T`, `G = sum p p^T - n pbar pbar^T`, and `b = p'bar - A pbar`
    (eq. 17 prints the opposite sign, that of Appendix C's `A x - b`).
    Wrong when the points are collinear (or, in space, coplanar): `G` is singular there.
    """
    mean, image_mean = points.mean(-2), images.mean(-2)
    centred = points - mean[..., None, :]
    if inverse_moment is None:
        inverse_moment = torch.linalg.inv(centred.mT @ centred)
    F = centred.mT @ (images - image_mean[..., None, :])
    A = F.mT @ inverse_moment
    return AffineMap(A, image_mean - (A @ mean[..., None]).squeeze(-1))


def weighted_affine_fit(points: Tensor, images: Tensor, weight: Tensor) -> AffineMap:
    """Affine map that minimises `sum_i e_i.Q_i e_i`, `e_i = A p_i + b - p'_i` (eq. 46, with a weight matrix of each match).

    Arguments: `points [..., n, p]`, `images [..., n, q]`, `weight [..., n, q, q]` symmetric positive definite, the inverse
    covariances of the matches. One matrix for all changes nothing: eq. 52 does not know Q; then `affine_fit` is enough.
    Wrong when the points are collinear (in space, coplanar).
    """
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    normal = torch.einsum("...ia,...ipq,...ib->...paqb", homogeneous, weight, homogeneous)
    load = torch.einsum("...ia,...ipq,...iq->...pa", homogeneous, weight, images)
    q, p = images.shape[-1], points.shape[-1]
    fit = torch.linalg.solve(normal.flatten(-2).flatten(-3, -2), load.flatten(-2)).unflatten(-1, (q, p + 1))
    return AffineMap(fit[..., :-1], fit[..., -1])


class LocalAffineMaps(nn.Module):
    """One affine map for each quadrilateral of a grid of points, with `G^-1` precomputed (section 3.2).

    Argument: `points [V, p]`, the grid's rest positions (p = 2: in the image, or in the plane). Calling it with the moved
    points `[..., V, q]` returns `A [..., m-1, n-1, q, p]`, `b [..., m-1, n-1, q]`.
    """

    points: Tensor
    inverse_moment: Tensor

    def __init__(self, points: Tensor, grid: tuple[int, int]):
        super().__init__()
        self.grid = grid
        p = corners(points, grid)
        centred = p - p.mean(-2, keepdim=True)
        self.register_buffer("points", p)
        self.register_buffer("inverse_moment", torch.linalg.inv(centred.mT @ centred))

    def forward(self, moved: Tensor) -> AffineMap:
        return affine_fit(self.points, corners(moved, self.grid), self.inverse_moment)
