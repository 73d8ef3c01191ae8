"""Static equilibrium of the membrane under a pressure that obeys the cavity's law, a dead load, and contacts: Newton's method.

`grad U(x) - h - p grad V(x) = sum of contact forces` on the free vertices, and the cavity's law between V and p.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from torch import Tensor

from ..errors import MembraneError
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane, corners, triangles_of
from .frictional_contact import FrictionalContact

FORCE_TOLERANCE = 1e-9  # over modulus x edge length
VOLUME_TOLERANCE = 1e-11  # over the volume at rest
LONGEST_STEP = 0.05  # of a vertex, over the surface's size
NEWTON_STEPS = 40
HALVINGS = 6


class Liquid(NamedTuple):
    """The volume is kept."""

    volume: float

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        """How much volume is missing at this pressure, and the compliance C: `v . dx + C dp = gap` in each Newton step."""
        return self.volume - volume, 0.0


class Gas(NamedTuple):
    """Absolute pressure x volume is kept: `p = p0 + P (V_gas / (V_gas + V - V0) - 1)`."""

    rest_pressure: float
    rest_volume: float
    absolute: float
    gas_volume: float

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        ratio = self.gas_volume / (self.gas_volume + volume - self.rest_volume)
        compliance = self.gas_volume / (self.absolute * ratio**2)
        return compliance * (self.rest_pressure + self.absolute * (ratio - 1) - pressure), compliance


class Open(NamedTuple):
    """The pressure stays."""

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        return 0.0, math.inf


class Solution(NamedTuple):
    """`vertices [V, 3]`, pressure difference, the contacts with their forces, Newton steps taken."""

    vertices: Tensor
    pressure: float
    contacts: Sequence[FrictionalContact]
    iterations: int


class Equilibrium:
    """Newton's method on one membrane.

    Arguments: the membrane, its `elasticity`, the `cavity` (`Liquid`, `Gas`, `Open`), a dead `load [V, 3]` (default: none).
    Element Hessians are exact; where the step they give does not descend, their convex part. The line search is on the slope
    of the potential along the step, its volume term augmented; the bordered matrix is never factored.
    """

    def __init__(self, membrane: Membrane, elasticity: ElasticEnergy, cavity, load: Tensor | None = None):
        self.membrane, self.elasticity, self.cavity, self.free = membrane, elasticity, cavity, membrane.free
        self.load = torch.zeros_like(membrane.rest) if load is None else load
        self.matrix = _Pattern(membrane)
        modulus = float(2 * (elasticity.c1 + elasticity.c2) + elasticity.tension.abs())
        self.force_scale = modulus * membrane.size / len(membrane.rest) ** 0.5
        self.vertex_stiffness = float(self.matrix(elasticity.hessian_blocks(membrane.rest)).diagonal().mean())

    def solve(self, x: Tensor, pressure: float, contacts: Sequence[FrictionalContact] = ()) -> Solution:
        """Equilibrium from a start `x [V, 3]`, whose rim stays where it is. Raises `MembraneError` if none is found."""
        for iteration in range(NEWTON_STEPS):
            projected = [contact.projected(x[self.free]) for contact in contacts]
            residual = np.abs(self._out_of_balance(x, pressure, [contact.force(x[self.free]) for contact in projected])).max()
            change = max((p.distance_from(c) for p, c in zip(projected, contacts, strict=True)), default=0.0)
            settled = max(residual, change) <= FORCE_TOLERANCE * self.force_scale
            if settled and abs(self._gap(x, pressure)[0]) <= VOLUME_TOLERANCE * float(self.membrane.rest_volume):
                return Solution(x, float(pressure), projected, iteration)
            found = self._step(x, pressure, contacts, False) or self._step(x, pressure, contacts, True)
            if found is None:
                break
            x, pressure, contacts = found
        raise MembraneError(
            f"Equilibrium: not found after {iteration + 1} Newton steps, largest residual force {residual:.3g} where "
            f"{self.force_scale:.3g} is one element's tension; expected a start near it: take smaller steps"
        )

    def _out_of_balance(self, x, pressure, pushes):
        """`grad U - h - p grad V - contact forces` on the free degrees of freedom; `pushes [F, 3]` of each indenter."""
        field = self.elasticity.gradient(x) - self.load - pressure * self.membrane.volume_gradient(x)
        return (field[self.free] - sum(pushes)).numpy().ravel()

    def _gap(self, x, pressure):
        return self.cavity.gap(float(self.membrane.volume(x)), pressure)

    def _step(self, x, pressure, contacts, positive):
        """One Newton step: vertices, pressure and contacts, or None where it does not descend."""
        active = [contact.active_set(x[self.free]) for contact in contacts]
        each = list(zip(contacts, active, strict=True))
        blocks = self.elasticity.hessian_blocks(x, positive) - pressure * self.membrane.volume_hessian_blocks(x)
        K = self.matrix(blocks, sum(contact.stiffness_blocks(x[self.free], a) for contact, a in each))
        linear = [contact.linearised(a).force(x[self.free]) for contact, a in each]
        push, (gap, compliance) = self.membrane.volume_gradient(x)[self.free].numpy().ravel(), self._gap(x, pressure)
        try:
            y, g = _solved(K, np.stack([-self._out_of_balance(x, pressure, linear), push], 1)).T
        except RuntimeError:  # exactly singular
            return None
        softness = push @ g
        rise = (gap - push @ y) / (softness + compliance)
        direction, pressure = y + rise * g, pressure + rise
        move = torch.zeros_like(x)
        move[self.free] = torch.from_numpy(direction.reshape(-1, 3))
        contacts = [contact.linearised(a, move[self.free]) for contact, a in each]

        def slope(x):
            """Of the potential along the step, with the multipliers it gave: volume and active contacts are augmented."""
            gap, compliance = self._gap(x, pressure)
            held = [contact.held(x[self.free], a) for contact, a in zip(contacts, active, strict=True)]
            return direction @ self._out_of_balance(x, pressure + gap / (compliance + abs(softness)), held)

        start, share = slope(x), min(1.0, LONGEST_STEP * self.membrane.size / float(move.norm(dim=-1).max()))
        for _ in range(HALVINGS if start < 0 else 0):
            if slope(x + share * move) <= 0.5 * abs(start) + (FORCE_TOLERANCE * self.force_scale) ** 2:
                return x + share * move, pressure, contacts
            share /= 2
        return None


def _solved(K: csc_matrix, loads: np.ndarray) -> np.ndarray:
    return splu(K, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}).solve(loads)


class _Pattern:
    """Sum of triangle blocks and free vertices' blocks on the free degrees of freedom, with a sparsity pattern found once."""

    def __init__(self, membrane: Membrane):
        V, free = len(membrane.rest), membrane.free.numpy()
        number = np.full(V, -1)
        number[free] = np.arange(len(free))
        triangles = triangles_of(corners(torch.arange(V)[:, None], membrane.grid)).reshape(-1, 3).numpy()
        groups = [number[triangles], np.arange(len(free))[:, None]]
        pairs = [_pairs(group, len(free)) for group in groups]
        entries, slots = np.unique(np.concatenate(pairs), return_inverse=True)
        self.size, self.empty = 3 * len(free), int(entries[0] < 0)
        self.slots, self.count = slots, len(entries)
        rows, columns = entries[self.empty :] % self.size, entries[self.empty :] // self.size
        self.indices = rows.astype(np.int32)
        self.starts = np.searchsorted(columns, np.arange(self.size + 1)).astype(np.int32)
        self.vertex_entries = len(pairs[1])

    def __call__(self, triangle_blocks: Tensor, vertex_blocks: Tensor | int = 0) -> csc_matrix:
        vertex = np.zeros(self.vertex_entries) if isinstance(vertex_blocks, int) else vertex_blocks.numpy().ravel()
        values = np.concatenate([triangle_blocks.numpy().ravel(), vertex])
        data = np.bincount(self.slots, values, self.count)[self.empty :]
        return csc_matrix((data, self.indices, self.starts), (self.size, self.size))


def _pairs(vertices: np.ndarray, free: int) -> np.ndarray:
    """`column * size + row` of every entry of every block, -1 where a vertex is fixed."""
    dofs = (3 * vertices[..., None] + np.arange(3)).reshape(len(vertices), -1)
    fixed = np.repeat(vertices < 0, 3, axis=1)
    pairs = dofs[:, None, :] * (3 * free) + dofs[:, :, None]
    return np.where(fixed[:, None, :] | fixed[:, :, None], -1, pairs).ravel()
