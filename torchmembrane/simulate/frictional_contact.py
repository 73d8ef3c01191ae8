"""Unilateral contact of the free vertices with a rigid indenter, with Coulomb friction, by a primal-dual active set method.

    phi >= 0,  N >= 0,  N phi = 0;        |T| <= mu N,  slip = 0 where |T| < mu N,  T opposite to the slip elsewhere

The nodal forces `N` (along the indenter's normal n) and `T` (tangential) are unknowns besides the positions. A semismooth
Newton method finds them from their projections (Alart, Curnier 1991; Hueber, Stadler, Wohlmuth 2008): `N = max(0, N - c phi)`,
and T is `T - c_t slip` projected onto the friction cone. The weights c, c_t > 0 do not affect the solution.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import MembraneError
from .indenters import Indenter, norm

RIGID = 1e3  # the linearised contact's stiffness over c: what still yields in one step is gone in the next
GENTLE = 0.1  # c_t over c: large enough to show the slip's direction, too small to let what sticks slip at once
SAME_SIDE = 0.5  # smallest cosine between an indenter's normals at one vertex before and after an increment


class ActiveSet(NamedTuple):
    """The vertices in contact in a Newton step and their state, which makes the contact law linear in the step.

    Attributes:
        vertices: indices of the free vertices in contact, `[A]`.
        phi: their distances from the indenter, `[A]`.
        n: normals of the indenter there, `[A, 3]`.
        slip: their slip so far, `[A, 3]`.
        sticks: `[A]` bool, whether they stick.
        e: directions of T where they slip, `[A, 3]`.
        turning: stiffness against rotation of these directions, `[A]`.
    """

    vertices: Tensor
    phi: Tensor
    n: Tensor
    slip: Tensor
    sticks: Tensor
    e: Tensor
    turning: Tensor


class FrictionalContact(NamedTuple):
    """One indenter during one increment of its motion, in contact with F free vertices `x [F, 3]`.

    Attributes:
        indenter: the indenter at the end of the increment.
        normal: normal forces N, `[F]`, positive in compression.
        tangential: tangential forces T, `[F, 3]`.
        anchor: positions of the vertices if they had stuck, `[F, 3]`, from which slip is measured.
        weight: weight c, force / length.
        friction: Coulomb's coefficient mu.

    Reference:
        P. Alart, A. Curnier: A mixed formulation for frictional contact problems prone to Newton like solution methods, 1991.
        S. Hueber, G. Stadler, B. Wohlmuth: A primal-dual active set algorithm for three-dimensional contact problems with
        Coulomb friction, 2008.
    """

    indenter: Indenter
    normal: Tensor
    tangential: Tensor
    anchor: Tensor
    weight: float
    friction: float

    @classmethod
    def at_first_pose(cls, indenter: Indenter, x: Tensor, weight: float, friction: float) -> "FrictionalContact":
        """Return the contact without force, with the indenter at its first pose."""
        return cls(indenter, torch.zeros_like(x[:, 0]), torch.zeros_like(x), x, weight, friction)

    def carried_to(self, pose: Indenter, x: Tensor) -> "FrictionalContact":
        """Return the contact of the next increment: the indenter moves to `pose` from an equilibrium `x` with this contact.

        A vertex that the indenter meets on the way is carried along only from the point of contact on.

        Raises:
            MembraneError: the indenter may overtake a vertex, which would then be inside it or on another side of it.
        """
        (before, n_before), (after, n_after) = (self._distance_and_normal(body, x) for body in (self.indenter, pose))
        turn = pose.rotation @ self.indenter.rotation.T
        along = (x - self.indenter.translation) @ turn.T + pose.translation
        travel = along - x
        reached = (before < travel.norm(dim=-1)) & ((n_before * travel).sum(-1) > 0)
        if (reached & ((n_before * n_after).sum(-1) < SAME_SIDE)).any():
            raise MembraneError("press: the indenter moves through the membrane in one step; expected smaller steps")
        met = (-after / (before - after).clamp_min(1e-300)).clamp(0, 1)
        share = torch.where(self.normal > 0, 1.0, met)[:, None]
        return self._replace(indenter=pose, tangential=self.tangential @ turn.T, anchor=x + share * travel)

    def projected(self, x: Tensor) -> "FrictionalContact":
        """Return the contact with the projections of N and T at `x`; in equilibrium they equal N and T."""
        index, phi, n = self._touching(x)
        normal = self.normal[index] - self.weight * phi
        trial = self._trial(x, index, n)
        cone = self.friction * normal / norm(trial).clamp_min(1e-300)
        return self._with(index, normal, cone.clamp_max(1)[:, None] * trial)

    def force(self, x: Tensor) -> Tensor:
        """Return the forces `N n + T` on the vertices at `x`, `[F, 3]`."""
        index = torch.nonzero(self.normal).squeeze(-1)
        n = self.indenter.normal(x[index]).detach()
        return torch.zeros_like(x).index_copy(0, index, self.normal[index, None] * n + self.tangential[index])

    def distance_from(self, other: "FrictionalContact") -> float:
        """Return the largest difference between the nodal force components of two contacts."""
        normal, tangential = self.normal - other.normal, self.tangential - other.tangential
        return float(torch.cat([normal, tangential.ravel()]).abs().max())

    def active_set(self, x: Tensor) -> ActiveSet:
        """Return the vertices in contact at `x` and their state."""
        index, phi, n = self._touching(x)
        trial = self._trial(x, index, n)
        size, bound = norm(trial), self.friction * self.normal[index].clamp_min(0)
        ratio = bound / size.clamp_min(1e-300)
        turning = (GENTLE * self.weight * ratio / (1 - ratio).clamp_min(1e-300)).clamp(0, RIGID * self.weight)
        e = trial / size.clamp_min(1e-300)[:, None]
        return ActiveSet(index, phi, n, (x - self.anchor)[index], size <= bound, e, turning)

    def linearised(self, active: ActiveSet, move: Tensor | float = 0.0) -> "FrictionalContact":
        """Return the contact with the forces of the linearised law on the active vertices after a `move [F, 3]`."""
        rigid, index, n, e = RIGID * self.weight, active.vertices, active.n, active.e
        move = torch.broadcast_to(torch.as_tensor(move, dtype=n.dtype, device=n.device), self.tangential.shape)[index]
        normal = self.normal[index] - rigid * (active.phi + (n * move).sum(-1))
        if self.friction == 0:
            return self._with(index, normal, torch.zeros_like(n))
        slip = _tangential(active.slip + move, n)
        sticking = _tangential(self.tangential[index], n) - rigid * slip
        slipping = self.friction * normal[:, None] * e - active.turning[:, None] * _tangential(slip, e)
        return self._with(index, normal, torch.where(active.sticks[:, None], sticking, slipping))

    def stiffness_blocks(self, x: Tensor, active: ActiveSet) -> Tensor:
        """Return minus the derivative of each vertex's linearised force in its own move, `[F, 3, 3]`; asymmetric with
        friction."""
        rigid, index, n, e = RIGID * self.weight, active.vertices, active.n, active.e
        blocks = rigid * _outer(n, n) - self.normal[index, None, None] * self._curvature(x[index])
        if self.friction:
            plane = torch.eye(3, dtype=x.dtype, device=x.device) - _outer(n, n)
            slips = self.friction * rigid * _outer(e, n) + active.turning[:, None, None] * (plane - _outer(e, e))
            blocks = blocks + torch.where(active.sticks[:, None, None], rigid * plane, slips)
        return x.new_zeros(len(x), 3, 3).index_copy(0, index, blocks)

    def held(self, x: Tensor, active: ActiveSet) -> Tensor:
        """Return forces `[F, 3]` at `x` if no other vertex is in contact: N and T, less c times the penetration and the slip of
        sticking vertices."""
        phi, n = self._distance_and_normal(self.indenter, x[active.vertices])
        force = (self.normal[active.vertices] - self.weight * phi)[:, None] * n + self.tangential[active.vertices]
        if self.friction:
            slip = _tangential((x - self.anchor)[active.vertices], n)
            force = force - self.weight * torch.where(active.sticks[:, None], slip, 0.0)
        return torch.zeros_like(x).index_copy(0, active.vertices, force)

    @staticmethod
    def _distance_and_normal(body: Indenter, x: Tensor) -> tuple[Tensor, Tensor]:
        distance, normal = body.distance_and_normal(x)
        return distance.detach(), normal.detach()

    def _touching(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        index = torch.nonzero(self.normal - self.weight * self.indenter.distance(x) > 0).squeeze(-1)
        return index, *self._distance_and_normal(self.indenter, x[index])

    def _trial(self, x: Tensor, index: Tensor, n: Tensor) -> Tensor:
        return _tangential(self.tangential[index] - GENTLE * self.weight * (x - self.anchor)[index], n)

    def _with(self, index: Tensor, normal: Tensor, tangential: Tensor) -> "FrictionalContact":
        zeros = torch.zeros_like
        return self._replace(
            normal=zeros(self.normal).index_copy(0, index, normal),
            tangential=zeros(self.tangential).index_copy(0, index, tangential),
        )

    def _curvature(self, points: Tensor) -> Tensor:
        """Return the second derivatives of the distance, `[A, 3, 3]`; zero if the indenter has none."""
        points = points.detach().requires_grad_()
        _, n = self.indenter.distance_and_normal(points)
        if not n.requires_grad:
            return points.new_zeros(*points.shape, 3)
        rows = [torch.autograd.grad(n[:, i].sum(), points, retain_graph=True, materialize_grads=True)[0] for i in range(3)]
        return torch.stack(rows, 1)


def _outer(p: Tensor, q: Tensor) -> Tensor:
    """Return `p q^T` of `[A, 3]` and `[A, 3]`, `[A, 3, 3]`."""
    return p[:, :, None] * q[:, None, :]


def _tangential(vectors: Tensor, n: Tensor) -> Tensor:
    """Return the part of `vectors [A, 3]` orthogonal to unit vectors `n [A, 3]`."""
    return vectors - (vectors * n).sum(-1, keepdim=True) * n
