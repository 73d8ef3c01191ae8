"""The camera's motion relative to the rim as four more unknowns: du, dv, rotation and scaling of the image, px.

After a bump the camera sees all markers move, including those at the rim, which no press causes. The motion is therefore found
together with the surface. With the derivatives `K` of the angles in the motion, a step solves

    [M  B'] [d ]     [g]         B = K^T w J,  T = K^T w K + stiffness,  k = K^T w r + stiffness x motion
    [B  T ] [dm] = - [k],

by the factor of `M`: with `d = -M^-1 (g + B' dm)` the second row is `(T - B M^-1 B') dm = B M^-1 g - k`. The cameras of W views
move independently: there are `4 W` unknowns, view by view.
"""

from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ...solve.elimination import solve_dense

Scalar = TypeVar("Scalar", float, Tensor)

PRIOR_WEIGHT = 100.0
"""Weight of the prior of a camera's motion: a motion that is ten times larger is `10^PRIOR_WEIGHT` times less likely."""


def camera_stiffness(play: Any, moved2: Scalar) -> Scalar:
    """Return the weight of the parabola that touches the loss `w / 2 log(play^2 + |m|^2)` of a motion `m`.

    Here `w` is `PRIOR_WEIGHT`.

    Args:
        play: scale of the prior, px; smaller motions hardly count.
        moved2: squared motion `|m|^2`, px^2, `[...]`.

    Returns:
        The weight, 1 / px^2, `[...]`.

    Example:
        >>> camera_stiffness(3.0, 16.0)
        4.0
    """
    stiffness: Scalar = PRIOR_WEIGHT / (play**2 + moved2)
    return stiffness


class CameraMotion(NamedTuple):
    """The camera's part of a step's equations.

    Attributes:
        coupling: coupling `B` to the vertices, `[B, 4 W, 3 N]`.
        own: matrix `T` of the motion itself, `[B, 4 W, 4 W]`.
        slope: gradient `k` in the motion, `[B, 4 W]`.
    """

    coupling: Tensor
    own: Tensor
    slope: Tensor

    def with_prior(self, moved: Tensor, play: float | Tensor) -> "CameraMotion":
        """Add the prior of each view's motion in `moved [B, 4 W]`, with the loss of `camera_stiffness` and the scale `play`.

        It states that a camera rarely moves, but if it does, then by any amount.
        """
        each = moved.unflatten(-1, (-1, 4))
        stiffness = camera_stiffness(play, each.square().sum(-1))[..., None].expand_as(each).flatten(-2)
        one = torch.eye(moved.shape[-1], dtype=moved.dtype, device=moved.device)
        own, slope = self.own + stiffness[..., None] * one, self.slope + stiffness * moved
        return CameraMotion(self.coupling, own, slope)

    def eliminate_camera(self, solved: Tensor, of_motion: Tensor) -> Tensor:
        """Return the solutions of `M - B' T^-1 B` for given loads, `[B, L, 3 N]`.

        Args:
            solved: solutions of `M` for the loads, `[B, L, 3 N]`.
            of_motion: solutions of `M` for the coupling, `[B, 4 W, 3 N]`.
        """
        share = solve_dense(self.own - self.coupling @ of_motion.mT, self.coupling @ solved.mT)
        eased: Tensor = solved + share.mT @ of_motion
        return eased

    def eliminated(self, products: Tensor) -> tuple[Tensor, Tensor]:
        """Eliminate the camera from the products of the loads of volume, forces and pressure with their solutions.

        Args:
            products: products `x . M^-1 y` of the loads and the coupling (rows `x`, columns `y`), `[B, 3 + 4 W, 3 + 4 W]`.

        Returns:
            The products of the loads with the camera eliminated, `[B, 3, 3]`, and the camera's response to each load,
            `[B, 4 W, 3]`; the second load, of the forces and markers, includes the gradient in the motion.
        """
        loads, coupling = products[:, :, :3], products[:, :, 3:]
        pulled = loads[:, 3:] - F.pad(self.slope[..., None], (1, 1))
        following = solve_dense(self.own - coupling[:, 3:], pulled)
        return loads[:, :3] + coupling[:, :3] @ following, following

    def project_out(self, loads: Tensor, slopes: Tensor) -> Tensor:
        """Eliminate the camera from loads `[B, L, 3 N]` on the surface whose parts on the camera are `slopes [B, L, 4 W]`."""
        kept: Tensor = loads - solve_dense(self.own, slopes.mT).mT @ self.coupling
        return kept

    def response(self, y: Tensor) -> Tensor:
        """Return `T^-1 B y`, `[B, L, 4 W]`, for fields `y [B, L, 3 N]`."""
        turned: Tensor = solve_dense(self.own, self.coupling @ y.mT).mT
        return turned
