"""The camera's motion against the rim as four more unknowns: du, dv, rotation and growth of the image, px.

A camera that was bumped sees every marker moved, the rim's as well, which no press does: the motion is found together with the
surface. With the angles' derivatives `K` in it, a step solves

    [M  B'] [d ]     [g]         B = K^T w J,  T = K^T w K + stiffness,  k = K^T w r + stiffness x motion
    [B  T ] [dm] = - [k],

by the factor of `M`: with `d = -M^-1 (g + B' dm)` the second row is `(T - B M^-1 B') dm = B M^-1 g - k`. Of W views each moves
by itself: `4 W` unknowns, one view's after the other's.
"""

from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ...solve.elimination import solve_dense

Scalar = TypeVar("Scalar", float, Tensor)

PRIOR_WEIGHT = 100.0
"""How unlikely it is that a camera moves: a motion that is ten times larger is `10^PRIOR_WEIGHT` times less likely."""


def camera_stiffness(play: Any, moved2: Scalar) -> Scalar:
    """The weight of the parabola that touches the loss `w / 2 log(play^2 + |m|^2)` of a motion `m` with `|m|^2 = moved2`, where
    `w` is `PRIOR_WEIGHT`.

    Args:
        play: px, below which a motion hardly counts.
        moved2: px^2, `[...]`.

    Returns:
        1 / px^2, `[...]`.

    Example:
        >>> camera_stiffness(3.0, 16.0)
        4.0
    """
    stiffness: Scalar = PRIOR_WEIGHT / (play**2 + moved2)
    return stiffness


class CameraMotion(NamedTuple):
    """Of a step: `coupling` `B [B, 4 W, 3 N]` to the vertices, `own` `T [B, 4 W, 4 W]` and `slope` `k [B, 4 W]`."""

    coupling: Tensor
    own: Tensor
    slope: Tensor

    def with_prior(self, moved: Tensor, play: float | Tensor) -> "CameraMotion":
        """With the loss of `camera_stiffness` of each view's motion in `moved [B, 4 W]`: a camera rarely moves, and then by any
        amount."""
        each = moved.unflatten(-1, (-1, 4))
        stiffness = camera_stiffness(play, each.square().sum(-1))[..., None].expand_as(each).flatten(-2)
        one = torch.eye(moved.shape[-1], dtype=moved.dtype, device=moved.device)
        own, slope = self.own + stiffness[..., None] * one, self.slope + stiffness * moved
        return CameraMotion(self.coupling, own, slope)

    def eliminate_camera(self, solved: Tensor, of_motion: Tensor) -> Tensor:
        """`(M - B' T^-1 B)^-1` of loads whose `M^-1` is `solved [B, L, 3 N]`; `of_motion [B, 4, 3 N]`: that of the coupling."""
        share = solve_dense(self.own - self.coupling @ of_motion.mT, self.coupling @ solved.mT)
        eased: Tensor = solved + share.mT @ of_motion
        return eased

    def eliminated(self, products: Tensor) -> tuple[Tensor, Tensor]:
        """What three loads' solutions of the surface alone have to do with the loads, `[B, 3, 3]` (row x, column y: `x . M^-1
        y`), and how the camera follows each, `[B, 4 W, 3]`; the camera's slope comes with the second load.

        Args:
            products: the same with `M` alone, of these loads and the coupling, `[B, 3 + 4 W, 3 + 4 W]`.
        """
        loads, coupling = products[:, :, :3], products[:, :, 3:]
        pulled = loads[:, 3:] - F.pad(self.slope[..., None], (1, 1))
        following = solve_dense(self.own - coupling[:, 3:], pulled)
        return loads[:, :3] + coupling[:, :3] @ following, following

    def project_out(self, loads: Tensor, slopes: Tensor) -> Tensor:
        """Loads `[B, L, 3 N]` on the surface alone, of those that pull the camera by `slopes [B, L, 4 W]` as well."""
        kept: Tensor = loads - solve_dense(self.own, slopes.mT).mT @ self.coupling
        return kept

    def response(self, y: Tensor) -> Tensor:
        """`T^-1 B y`, `[B, L, 4 W]`, of fields `y [B, L, 3 N]`."""
        turned: Tensor = solve_dense(self.own, self.coupling @ y.mT).mT
        return turned
