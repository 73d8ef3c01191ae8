"""Interface between the estimator and the machine code of its steps: when it is used, and its arguments."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .... import vectors
from ....machine_code import Kept, fingerprint, in_threads, kept
from ....mechanics import cavity, native_membrane
from ....mechanics.cavity import CavityLaw
from ....mechanics.native_membrane import Surface, surface_of
from ....solve import native_envelope, native_rows, symmetric_2x2
from ....solve.native_rows import within
from ....solve.stencil import inner
from .. import camera_motion, robust, schedule
from ..marker_residuals import MeasuredRays
from ..normal_equations import DAMPING, BalanceEquations
from ..schedule import settling_of
from . import equations, gauss_newton, layout, markers, solution, spread
from .equations import Constants, Numbers, Workspace, workspace
from .gauss_newton import settle
from .solution import TOLD, solution_of
from .spread import spread_of


class NativeSteps:
    """The steps on one grid. Constants are looked up again after a change of precision, settings or material. The frames of a
    batch are distributed over as many threads as torch uses."""

    def __init__(self) -> None:
        self._constants: tuple[Any, Constants] | None = None
        self._idle: defaultdict[Any, list[Workspace]] = defaultdict(list)

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return type(self), ()

    def take(
        self,
        equations: BalanceEquations,
        cavity: CavityLaw,
        state: tuple[Tensor, Tensor, Tensor],
        measured: MeasuredRays,
        tau: float,
        steps: int,
    ) -> list[Tensor]:
        """Return displacement, pressure and camera motion after the steps, and the displacement before the last step.

        Arguments are those of `GaussNewton.forward`.
        """
        constants, fixed = self._prepared(equations, cavity, measured)
        changing = [value.clone(memory_format=torch.contiguous_format) for value in (*state, state[0])]
        u, pressure, moved, before = (value.numpy() for value in changing)
        surface = -1, *equations.forces.membrane.grid, 3
        each = [
            u.reshape(surface),
            pressure,
            moved,
            before.reshape(surface),
            *fixed,
            *_nothing(u),
            np.empty((len(u), 0), u.dtype),
        ]
        self._shared_out(equations, constants, each, (tau, steps, settling_of(steps)))
        return changing

    def spread(
        self,
        equations: BalanceEquations,
        cavity: CavityLaw,
        state: tuple[Tensor, Tensor, Tensor],
        measured: MeasuredRays,
        outlier: float,
    ) -> Tensor:
        """Return the standard deviations of force and depth, `[B, 4]`; arguments as for `deviations.spreads`."""
        constants, fixed = self._prepared(equations, cavity, measured)
        u, pressure, moved = (value.contiguous().numpy() for value in state)
        found = np.empty((len(u), 4), u.dtype)
        u = u.reshape(-1, *equations.forces.membrane.grid, 3)
        self._shared_out(equations, constants, [u, pressure, moved, u, *fixed, *_nothing(u), found], (outlier, DAMPING, 0))
        return torch.from_numpy(found)

    def solution(
        self,
        equations: BalanceEquations,
        cavity: CavityLaw,
        state: tuple[Tensor, Tensor, Tensor],
        before: Tensor,
        measured: MeasuredRays,
        far: float,
    ) -> tuple[Sequence[Tensor], Tensor, Tensor]:
        """Return the results of a state: the numbers `[B]` listed in `TOLD`, the tractions `[B, V, 3]` and their references
        `[B, V]`.

        Arguments are those of `ForceBalance.equilibrium`; `far` as for `MarkerResiduals.misfits`.
        """
        constants, fixed = self._prepared(equations, cavity, measured)
        u, pressure, moved, earlier = (value.contiguous().numpy() for value in (*state, before))
        shapes = (len(u), TOLD), state[0].shape, state[0].shape[:-1]
        found = [state[0].new_empty(shape) for shape in shapes]
        told, traction, reference = (value.numpy() for value in found)
        grid = equations.forces.membrane.grid
        u, earlier, traction = (value.reshape(-1, *grid, 3) for value in (u, earlier, traction))
        each = [u, pressure, moved, earlier, *fixed, traction, reference.reshape(-1, *grid), told]
        self._shared_out(equations, constants, each, (far, 0, 0))
        return found[0].unbind(1), found[1], found[2]

    def _prepared(
        self, equations: BalanceEquations, cavity: CavityLaw, measured: MeasuredRays
    ) -> tuple[Constants, list[np.ndarray]]:
        """Return the constants and the measurements as arrays."""
        gauge = torch.zeros_like(measured.motion[:, 0, :2, 0]) if measured.gauge is None else measured.gauge
        fixed = [value.contiguous().numpy() for value in (*measured[:5], gauge)]
        return self._found(equations, cavity, fixed[0].dtype), fixed

    def _shared_out(
        self, equations: BalanceEquations, constants: Constants, each: list[np.ndarray], given: tuple[float, float, float]
    ) -> None:
        """Call `frames` on parts of the arrays `each`, the last of which is `found`, with one thread per part."""
        numbers = np.array(given, float)
        grid, dtype = equations.forces.membrane.grid, each[0].dtype

        def take(*part: np.ndarray) -> None:
            try:
                work = self._idle[dtype].pop()
            except IndexError:
                work = workspace(grid, len(constants.positions), dtype)
            with compiled.compiling(np.dtype(dtype)):
                frames(constants, work, *part[:-1], numbers, part[-1])
            self._idle[dtype].append(work)

        in_threads(take, *each)

    def _found(self, equations: BalanceEquations, cavity: CavityLaw, dtype: Any) -> Constants:
        forces, loss, bearings = equations.forces, equations.loss, equations.bearings
        elasticity, membrane = forces.elasticity, forces.membrane
        material = elasticity.prestretch, elasticity.c1, elasticity.c2, cavity.rest_pressure, loss.friction
        places = forces.rest_load, membrane.rest, loss.surroundings, bearings.positions
        key = dtype, loss.settings, *(float(value) for value in material), *(value.data_ptr() for value in places)
        if self._constants is None or self._constants[0] != key:
            self._constants = key, _constants(equations, cavity, dtype)
        return self._constants[1]


def _constants(equations: BalanceEquations, cavity: CavityLaw, dtype: Any) -> Constants:
    forces, loss, bearings, settings = equations.forces, equations.loss, equations.bearings, equations.loss.settings
    absolute, gas = cavity.gas.tolist()
    surface = surface_of(forces.membrane, forces.elasticity, forces.rest_load, dtype)
    numbers = Numbers(
        reference=loss.reference,
        size=loss.size,
        last_tau=settings.tau[1],
        first_tau=settings.tau[0],
        cone=loss.cone,
        rest_pressure=float(cavity.rest_pressure),
        rest_volume=_volume(surface),
        is_open=cavity.filling == "open",
        is_gas=cavity.filling == "gas",
        absolute=absolute,
        gas_volume=gas,
        largest_stretch=schedule.LARGEST_STRETCH,
        **{name: float(getattr(settings, name)) for name in Numbers._fields if hasattr(settings, name)},
    )

    def array(values: Tensor) -> np.ndarray:
        return np.ascontiguousarray(values.detach().numpy(), dtype)

    surroundings, wider = array(loss.surroundings), array(loss.wider)
    return Constants(
        surface,
        array(loss.area),
        surroundings,
        within(surroundings),
        wider,
        within(wider),
        array(loss.push_noise),
        -array(inner(forces.membrane.rest_normals, forces.membrane.grid)),
        array(bearings.positions),
        _sparse(array(bearings.smooth_shares)),
        _sparse(array(bearings.vertex_shares), 3),
        bearings.nearest.numpy(),
        numbers,
    )


def _nothing(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return placeholders for tractions and their references that are not requested."""
    return np.empty((len(u), 0, 0, 3), u.dtype), np.empty((len(u), 0, 0), u.dtype)


def _volume(surface: Surface) -> float:
    """Return the volume at rest (eq. 19), summed over the cells as in the steps."""
    edges, rest = surface.edges.astype(float), surface.rest.reshape(-1, 3).T.astype(float)
    spins = np.cross(edges[:, 0], edges[:, 1], axis=0).sum(1)[:, : rest.shape[1]]
    return float((surface.sixth[: rest.shape[1]] * rest * spins).sum())


def _sparse(rows: np.ndarray, count: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices and values of the non-zero entries of each row, `[D, K]` each, padded with other entries."""
    count = count or int((rows != 0).sum(1).max())
    numbers = np.ascontiguousarray(np.argsort(rows == 0, axis=1, kind="stable")[:, :count])
    return numbers, np.take_along_axis(rows, numbers, 1)


def _entry(sources: str) -> Any:
    @kept
    def frames(  # type: ignore[no-untyped-def]
        c,
        work,
        u,
        pressure,
        moved,
        before,
        origins,
        across,
        weight,
        noise_level,
        motion,
        gauge,
        traction,
        scale,
        given,
        found,
    ):
        """Steps of every frame, and then its deviations, or what its state amounts to.

        If nothing is `found`, `[B, 0]`, then `u [B, m, n, 3]`, `pressure [B]` and `moved [B, 4]` become those after the steps,
        and `before [B, m, n, 3]` the displacement before the last. Otherwise no step is taken, and `found` is filled: `[B, 4]`
        with the standard deviations of force and depth; `[B, 7]` with what is `TOLD`, and then also `traction [B, m, n, 3]` and
        `scale [B, m, n]`, what they are measured against.

        c: `Constants`, work: a `Workspace`, origins to gauge: `MeasuredRays`, given: for steps the first tau, their number and
        how many of them settle; for deviations the scale of the markers' loss and the damping; else the limit of a marker's
        angle; `[3]`.
        """
        wanted = found.shape[1]
        for b in range(len(u) if sources else 0):
            state, measured = (u[b], pressure[b : b + 1], moved[b]), (noise_level[b], gauge[b])
            seen = origins[b], across[b], weight[b], motion[b]
            if wanted == TOLD:
                told = found[b], traction[b], scale[b]
                solution_of(c, work, *state, before[b], seen, *measured, given[0], *told)
            elif wanted > 0:
                spread_of(c, work, *state, seen, *measured, given[0], given[1], found[b])
            else:
                settle(c, work, *state, before[b], seen, *measured, given[0], int(given[1]), int(given[2]))

    return frames


SOURCES = fingerprint(
    __file__,
    *(each.__file__ for each in (camera_motion, cavity, equations, gauss_newton, layout, markers, native_envelope)),
    *(each.__file__ for each in (native_membrane, native_rows, robust, schedule, solution, spread, symmetric_2x2, vectors)),
)
frames = _entry(SOURCES)
compiled = Kept(frames, SOURCES)
"""For which precisions `frames` has been compiled."""
