"""Static equilibrium of the membrane under the cavity's pressure, a dead load and contacts, by Newton's method.

`grad U(x) - h - p grad V(x) = sum of contact forces` on the free vertices, with the cavity's law between V and p.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from torch import Tensor

from ..errors import MembraneError
from ..mechanics.cavity import gas_law_step
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..surface.topology import corners, triangles_of
from .frictional_contact import FrictionalContact

FORCE_TOLERANCE = 1e-9  # over modulus x edge length
VOLUME_TOLERANCE = 1e-11  # over the volume at rest
LONGEST_STEP = 0.05  # of a vertex, over the surface's size
NEWTON_STEPS = 40
HALVINGS = 6


class Filling(Protocol):
    """The content of the cavity: the law between its volume and the pressure difference across the membrane."""

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        """Return the missing volume at this pressure, and the compliance C: `v . dx + C dp = gap` in each Newton step."""


class Liquid(NamedTuple):
    """A cavity of constant volume.

    Attributes:
        volume: the volume, length^3.
    """

    volume: float

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        return self.volume - volume, 0.0


class Gas(NamedTuple):
    """A gas with constant product of absolute pressure and volume: `p = p0 + P (V_gas / (V_gas + V - V0) - 1)`.

    Attributes:
        rest_pressure: p0, pressure difference at rest, force / length^2.
        rest_volume: V0, volume between the rest surface and the camera, length^3.
        absolute: P, absolute pressure at rest.
        gas_volume: V_gas, volume of the gas at rest.
    """

    rest_pressure: float
    rest_volume: float
    absolute: float
    gas_volume: float

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        return gas_law_step(volume - self.rest_volume, pressure, self.rest_pressure, self.absolute, self.gas_volume)


class Open(NamedTuple):
    """A cavity of constant pressure."""

    def gap(self, volume: float, pressure: float) -> tuple[float, float]:
        return 0.0, math.inf


class Solution(NamedTuple):
    """The result of `EquilibriumProblem.solve`.

    Attributes:
        vertices: vertices in equilibrium, `[V, 3]`.
        pressure: pressure difference across the membrane, force / length^2.
        contacts: the contacts with their forces.
        iterations: number of Newton steps.
    """

    vertices: Tensor
    pressure: float
    contacts: Sequence[FrictionalContact]
    iterations: int


class EquilibriumProblem:
    """The equilibrium of one membrane, solved by Newton's method.

    Element Hessians are exact; if the resulting step does not descend, their convex part is used. The line search uses the
    slope of the potential along the step, with an augmented volume term; the bordered matrix is never factored.

    Args:
        membrane: the membrane at rest.
        elasticity: its elastic energy.
        cavity: `Liquid`, `Gas` or `Open`.
        load: dead load on the vertices, `[V, 3]`, force; default: none.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> cap = spherical_cap(12, 9, 15, (9, 9))
        >>> elasticity = ElasticEnergy(cap, "neo_hookean", 1.3)
        >>> found = EquilibriumProblem(cap, elasticity, Liquid(float(cap.rest_volume))).solve(cap.rest, 0.1)
        >>> round(found.pressure / float(2 * elasticity.tension / 12.5), 1)  # Laplace's law
        1.0
    """

    def __init__(self, membrane: Membrane, elasticity: ElasticEnergy, cavity: Filling, load: Tensor | None = None) -> None:
        self.membrane, self.elasticity, self.cavity, self.free = membrane, elasticity, cavity, membrane.free_vertices
        self.load = torch.zeros_like(membrane.rest) if load is None else load
        self.matrix = _SparsityPattern(membrane)
        modulus = float(2 * (elasticity.c1 + elasticity.c2) + elasticity.tension.abs())
        self.force_scale = modulus * membrane.size / len(membrane.rest) ** 0.5
        self.vertex_stiffness = float(self.matrix(elasticity.hessian_blocks(membrane.rest)).diagonal().mean())

    def solve(self, x: Tensor, pressure: float, contacts: Sequence[FrictionalContact] = ()) -> Solution:
        """Find the equilibrium near a start.

        Args:
            x: initial vertices, `[V, 3]`; the rim is fixed there.
            pressure: initial pressure difference across the membrane.
            contacts: contacts with indenters, at the poses for which the equilibrium is sought.

        Returns:
            The converged equilibrium.

        Raises:
            MembraneError: no equilibrium is found.
        """
        for iteration in range(NEWTON_STEPS):
            projected = [contact.projected(x[self.free]) for contact in contacts]
            forces = [contact.force(x[self.free]) for contact in projected]
            residual = np.abs(self._imbalance(x, pressure, forces)).max()
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

    def _imbalance(self, x: Tensor, pressure: float, contact_forces: Sequence[Tensor]) -> np.ndarray:
        """Return `grad U - h - p grad V - contact forces` on the free degrees of freedom, `[3 F]`; `contact_forces [F, 3]`
        each."""
        field = self.elasticity.gradient(x) - self.load - pressure * self.membrane.volume_gradient(x)
        return (field[self.free] - sum(contact_forces)).numpy().ravel()

    def _gap(self, x: Tensor, pressure: float) -> tuple[float, float]:
        return self.cavity.gap(float(self.membrane.volume(x)), pressure)

    def _step(
        self, x: Tensor, pressure: float, contacts: Sequence[FrictionalContact], positive: bool
    ) -> tuple[Tensor, float, list[FrictionalContact]] | None:
        """Take one Newton step; return vertices, pressure and contacts, or None if it does not descend."""
        active = [contact.active_set(x[self.free]) for contact in contacts]
        each = list(zip(contacts, active, strict=True))
        blocks = self.elasticity.hessian_blocks(x, positive) - pressure * self.membrane.volume_hessian_blocks(x)
        touching = [contact.stiffness_blocks(x[self.free], a) for contact, a in each]
        K = self.matrix(blocks, torch.stack(touching).sum(0) if touching else 0)
        linear = [contact.linearised(a).force(x[self.free]) for contact, a in each]
        v, (gap, compliance) = self.membrane.volume_gradient(x)[self.free].numpy().ravel(), self._gap(x, pressure)
        try:
            y, g = _solved(K, np.stack([-self._imbalance(x, pressure, linear), v], 1)).T
        except RuntimeError:  # exactly singular
            return None
        softness = v @ g
        rise = (gap - v @ y) / (softness + compliance)
        direction, pressure = y + rise * g, pressure + rise
        move = torch.zeros_like(x)
        move[self.free] = torch.from_numpy(direction.reshape(-1, 3))
        contacts = [contact.linearised(a, move[self.free]) for contact, a in each]

        def slope(x: Tensor) -> float:
            """Return the slope of the potential along the step, with the step's multipliers; volume and active contacts are
            augmented."""
            gap, compliance = self._gap(x, pressure)
            held = [contact.held(x[self.free], a) for contact, a in zip(contacts, active, strict=True)]
            return float(direction @ self._imbalance(x, pressure + gap / (compliance + abs(softness)), held))

        start, share = slope(x), min(1.0, LONGEST_STEP * self.membrane.size / float(move.norm(dim=-1).max()))
        for _ in range(HALVINGS if start < 0 else 0):
            if slope(x + share * move) <= 0.5 * abs(start) + (FORCE_TOLERANCE * self.force_scale) ** 2:
                return x + share * move, pressure, contacts
            share /= 2
        return None


def _solved(K: csc_matrix, loads: np.ndarray) -> np.ndarray:
    """Return `K^-1 loads` by a sparse LU factorisation; raises `RuntimeError` if K is exactly singular."""
    return splu(K, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}).solve(loads)


class _SparsityPattern:
    """Assembles triangle blocks and free vertices' blocks on the free degrees of freedom; the sparsity pattern is found
    once."""

    def __init__(self, membrane: Membrane) -> None:
        V, free = len(membrane.rest), membrane.free_vertices.numpy()
        number = np.full(V, -1)
        number[free] = np.arange(len(free))
        triangles = triangles_of(corners(torch.arange(V, device="cpu")[:, None], membrane.grid)).reshape(-1, 3).numpy()
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
    """Return `column * size + row` of every entry of every block, -1 where a vertex is fixed."""
    dofs = (3 * vertices[..., None] + np.arange(3)).reshape(len(vertices), -1)
    fixed = np.repeat(vertices < 0, 3, axis=1)
    pairs = dofs[:, None, :] * (3 * free) + dofs[:, :, None]
    return np.where(fixed[:, None, :] | fixed[:, :, None], -1, pairs).ravel()
