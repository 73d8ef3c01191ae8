"""The equilibrium of a sheet inflated by a pressure, or to a height, by Newton's method on successively finer grids.

grad U(x) = p grad V(x)  on the free vertices;   p given, or the height of the highest vertex given and p unknown
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from torch import Tensor

from ..errors import MembraneError
from ..surface.membrane import Membrane
from ..surface.resampling import at_equal_steps
from ..surface.topology import grid_triangles
from .sheet_energy import SheetEnergy

TOLERANCE = 1e-10  # of the residual forces, over modulus x edge length
STEPS, HALVINGS = 60, 10
LONGEST_STEP = 0.1  # of a vertex, over the sheet's size
RISE = 0.08  # largest increase of height between successive equilibria, over the sheet's size
HIGHEST = 1.5  # largest height tried for a pressure, over the sheet's size
FLAT = 1e-6  # smallest height of an inflated sheet, over its size
AWAY = 3.0  # distance of the sheet from the origin, from which volumes are measured, over the sheet's size


class Sheet(NamedTuple):
    """A sheet before inflation, in the frame of its rim's plane.

    Attributes:
        vertices: vertices of the sheet stretched in its rim, `[m, n, 3]`; the third coordinate is the height above the plane.
        model: elastic energy, "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: equibiaxial prestretch.
        c2_ratio: C2 / C1, for "mooney_rivlin" only.
    """

    vertices: np.ndarray
    model: str
    prestretch: float
    c2_ratio: float = 0.0


class Inflated(NamedTuple):
    """An inflated sheet.

    Attributes:
        vertices: vertices in equilibrium, `[m, n, 3]`, in the frame of the rim's plane.
        pressure: equilibrium pressure, over shear modulus x thickness of the sheet in its rim, 1 / length.
        height: height of the highest vertex above the rim's plane, length unit.
    """

    vertices: np.ndarray
    pressure: float
    height: float


def inflated_to(sheet: Sheet, height: float) -> Inflated:
    """Inflate a sheet to a height.

    Args:
        sheet: the sheet, with an odd number of lines per side.
        height: height of the highest point above the rim's plane, length unit.

    Returns:
        The `Inflated` sheet.

    Raises:
        MembraneError: the rim or the uninflated sheet is already as high, or no equilibrium is found.
    """
    return _Inflation(sheet).to_height(height)


def inflated_by(sheet: Sheet, pressure: float) -> Inflated:
    """Inflate a sheet by a pressure.

    Args:
        sheet: the sheet, with an odd number of lines per side.
        pressure: positive pressure, over shear modulus x thickness of the sheet, 1 / length.

    Returns:
        The `Inflated` sheet: the lowest equilibrium at this pressure.

    Raises:
        MembraneError: the sheet has no equilibrium at this pressure.
    """
    return _Inflation(sheet).by_pressure(pressure)


class _Inflation:
    """Solver for the equilibria of one sheet, on grids of every 4th line, every 2nd line, and all lines."""

    def __init__(self, sheet: Sheet) -> None:
        self.sheet, self.top = sheet, float(sheet.vertices[..., 2].max())
        lines = min(sheet.vertices.shape[:2])
        strides = [step for step in (4, 2, 1) if (lines - 1) % step == 0 and (lines - 1) // step >= 8] or [1]
        self.levels = []
        for step in strides:
            with suppress(*([MembraneError] if step > 1 else [])):  # a coarse grid may fold within a strongly curved rim
                self.levels.append(_Level(sheet._replace(vertices=sheet.vertices[::step, ::step])))
        self.size = self.levels[0].size

    def to_height(self, height: float) -> Inflated:
        if not height > self.top + FLAT * self.size:
            raise MembraneError(
                f"inflated: height = {height:g}; expected more than {self.top:.4g}, how high the rim and the sheet in it are "
                "without pressure"
            )
        first = self.levels[0]
        count = max(2, int(np.ceil((height - self.top) / (RISE * self.size))))
        x = first.bulged((height - self.top) / count)
        p = first.pressure_of(x)
        for goal in np.linspace(self.top, height, count + 1)[1:].tolist():
            x, p = first.solved(x, p, goal)
        return self._refined(x, p, height)

    def by_pressure(self, pressure: float) -> Inflated:
        first = self.levels[0]
        rise = first.rise_by(pressure)
        x = first.bulged(rise)
        x, found = first.solved(x, first.pressure_of(x), self.top + rise)
        while found < pressure:
            rise *= 1.25
            before = found
            x, found = first.solved(x, found, self.top + rise)
            if found < before or rise > HIGHEST * self.size:
                raise MembraneError(
                    f"inflated: a pressure of {pressure:.4g} x modulus x thickness; the sheet holds at most about "
                    f"{max(found, before):.4g} of these: expected a lower pressure or a larger modulus, thickness or prestretch"
                )
        return self._refined(first.solved(x, pressure)[0], pressure)

    def _refined(self, x: Tensor, p: float, height: float | None = None) -> Inflated:
        level = self.levels[0]
        for finer in self.levels[1:]:
            x = finer.interpolated(level, x)
            x, p = finer.solved(x, p, height)
            level = finer
        vertices = x.numpy().reshape(*level.membrane.grid, 3) - level.shift
        return Inflated(vertices, p, float(vertices[..., 2].max()))


class _Level:
    """The equilibrium equations on one grid."""

    def __init__(self, sheet: Sheet) -> None:
        size = float(np.linalg.norm(np.ptp(sheet.vertices, axis=(0, 1))))
        self.shift = np.array([0.0, 0.0, AWAY * size])
        self.membrane = Membrane(sheet.vertices + self.shift)
        self.size, self.top = self.membrane.size, float(sheet.vertices[..., 2].max())
        self.sheet = self.membrane.rest
        self.energy = SheetEnergy(self.membrane, self.sheet, sheet.model, sheet.prestretch, 1.0, sheet.c2_ratio)
        self.free = self.membrane.free_vertices
        split = grid_triangles(self.membrane.grid)
        number = np.full(len(self.sheet), -1)
        number[self.free.numpy()] = np.arange(len(self.free))
        dofs = (3 * number[split][..., None] + np.arange(3)).reshape(len(split), 9)
        of_free = np.repeat(number[split] >= 0, 3, axis=1)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        self.kept = (of_free[:, :, None] & of_free[:, None, :]).ravel()
        self.rows, self.columns = rows.ravel()[self.kept], columns.ravel()[self.kept]
        self.scale = self.size / len(self.sheet) ** 0.5

    def bulged(self, rise: float) -> Tensor:
        """Return the sheet raised in the shape of a soap film under small pressure: a start for the first equilibrium."""
        z = self._film()
        x = self.sheet.clone()
        x[self.free, 2] += rise * z / z.max()
        return x

    def rise_by(self, pressure: float) -> float:
        """Return a first height at a pressure, by linear membrane theory, at most `RISE` over the size."""
        tension = max(float(self.energy.tension), 1e-3)
        return float(np.clip(0.7 * pressure / tension * float(self._film().max()), 1e-3 * self.size, RISE * self.size))

    def _film(self) -> Tensor:
        """Return the heights of a film of tension 1 under pressure 1, at the free vertices."""
        harmonic = SheetEnergy(self.membrane, self.sheet, "harmonic")
        K = self._matrix(harmonic.hessian_blocks(self.sheet))[2::3][:, 2::3]
        return torch.from_numpy(splu(csc_array(K)).solve(self.membrane.volume_gradient(self.sheet)[self.free, 2].numpy()))

    def interpolated(self, coarse: "_Level", x: Tensor) -> Tensor:
        """Interpolate the displacement from a coarser grid bicubically; the rim stays on the sheet."""
        u = at_equal_steps((x - coarse.sheet).numpy().reshape(*coarse.membrane.grid, 3), self.membrane.grid)
        return self.sheet + torch.from_numpy(u.reshape(-1, 3)) * ~self.membrane.fixed[:, None]

    def solved(self, x: Tensor, p: float, height: float | None = None) -> tuple[Tensor, float]:
        """Solve for the equilibrium near `x` at the pressure `p`, or at a given height with an unknown pressure near `p`."""
        for _ in range(STEPS):
            force = self._force(x, p)
            gap = 0.0 if height is None else height - float(x[:, 2].max() - self.shift[2])
            if np.abs(force).max() < TOLERANCE * self.scale and abs(gap) < 1e-9 * self.size:
                return x, p
            move, rise = self._newton(x, p, force, gap, height is not None)
            share = min(1.0, LONGEST_STEP * self.size / max(float(move.norm(dim=1).max()), 1e-300))
            size = np.linalg.norm(force)
            for _ in range(HALVINGS):
                y = x.clone()
                y[self.free] += share * move
                left = np.linalg.norm(self._force(y, p + share * rise))
                if left < size * (1 - 0.1 * share) or left < TOLERANCE * self.scale or abs(gap) > 1e-6 * self.size:
                    break
                share /= 2
            x, p = y, p + share * rise
        raise MembraneError(
            "inflated: no equilibrium was found; expected a sheet in tension: a smaller height or pressure, or a larger "
            "prestretch"
        )

    def _newton(self, x: Tensor, p: float, force: np.ndarray, gap: float, by_height: bool) -> tuple[Tensor, float]:
        blocks = self.energy.hessian_blocks(x) - p * self.membrane.volume_hessian_blocks(x)
        v = self.membrane.volume_gradient(x)[self.free].numpy().ravel()
        y, g = splu(self._matrix(blocks), "MMD_AT_PLUS_A").solve(np.stack([-force, v], 1)).T
        rise = 0.0
        if by_height:
            top = 3 * int(x[self.free, 2].argmax()) + 2
            rise = (gap - y[top]) / g[top]
        return torch.from_numpy((y + rise * g).reshape(-1, 3)), float(rise)

    def pressure_of(self, x: Tensor) -> float:
        """Return the pressure that minimises the sum of squared residual forces of a surface."""
        u, v = (a[self.free] for a in (self.energy.gradient(x), self.membrane.volume_gradient(x)))
        return float((u * v).sum() / (v * v).sum())

    def _force(self, x: Tensor, p: float) -> np.ndarray:
        left = self.energy.gradient(x) - p * self.membrane.volume_gradient(x)
        return left[self.free].numpy().ravel()

    def _matrix(self, blocks: Tensor) -> csc_array:
        size = 3 * len(self.free)
        return csc_array((blocks.numpy().ravel()[self.kept], (self.rows, self.columns)), (size, size))
