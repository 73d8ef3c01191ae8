"""When steps of force balance are taken by machine code, and what that is given."""

from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....machine_code import Kept, fingerprint, is_used, kept
from ....mechanics import cavity, native_membrane
from ....mechanics.cavity import CavityLaw
from ....mechanics.native_membrane import Surface, surface_of
from ....solve import native_band, symmetric_2x2
from ....solve.stencil import inner
from .. import camera_motion, robust
from ..marker_residuals import MeasuredRays
from ..normal_equations import DAMPING, BalanceEquations
from . import equations, gauss_newton, spread
from .equations import Constants, Numbers, Workspace, workspace
from .gauss_newton import step
from .spread import spread_of


class NativeSteps:
    """The steps of one grid. What is constant is looked up again where precision, settings or material have changed. Frames of
    a batch are shared out among as many threads as torch has."""

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
        weights: Tensor,
        measured: MeasuredRays,
        rows: Sequence[Sequence[float]],
    ) -> list[Tensor]:
        """Displacement, pressure and camera after the steps, the displacement before the last, and the weights; arguments as of
        `GaussNewton.step`, `rows`: the numbers of every step."""
        constants, fixed = self._prepared(equations, cavity, measured)
        changing = [value.clone(memory_format=torch.contiguous_format) for value in (*state, weights)]
        changing.append(changing[0].clone())
        u, pressure, moved, weighing, before = (value.numpy() for value in changing)
        surface = -1, *equations.forces.membrane.grid, 3
        surfaces = u.reshape(surface), pressure, moved, weighing, before.reshape(surface)
        self._shared_out(
            equations, constants, [*surfaces, *fixed, np.empty((0, 4), u.dtype)], np.array(rows, float).reshape(-1, 5)
        )
        after, pressure_after, camera, weights, before_last = changing
        return [after, pressure_after, camera, before_last, weights]

    def spread(
        self,
        equations: BalanceEquations,
        cavity: CavityLaw,
        state: tuple[Tensor, Tensor, Tensor],
        measured: MeasuredRays,
        outlier: float,
    ) -> Tensor:
        """Standard deviations of force and depth, `[B, 4]`; arguments as of `deviations.spreads`."""
        constants, fixed = self._prepared(equations, cavity, measured)
        u, pressure, moved = (value.contiguous().numpy() for value in state)
        weights, found = np.ones((len(u), len(constants.area)), u.dtype), np.empty((len(u), 4), u.dtype)
        scales = np.array([[equations.loss.settings.tau[1], outlier, equations.loss.cone, 1.0, DAMPING]])
        u = u.reshape(-1, *equations.forces.membrane.grid, 3)
        self._shared_out(equations, constants, [u, pressure, moved, weights, u, *fixed, found], scales)
        return torch.from_numpy(found)

    def _prepared(
        self, equations: BalanceEquations, cavity: CavityLaw, measured: MeasuredRays
    ) -> tuple[Constants, list[np.ndarray]]:
        """What is constant, and what is measured, as arrays."""
        gauge = torch.zeros_like(measured.motion[:, 0, :2, 0]) if measured.gauge is None else measured.gauge
        fixed = [value.contiguous().numpy() for value in (*measured[:5], gauge)]
        return self._found(equations, cavity, fixed[0].dtype), fixed

    def _shared_out(self, equations: BalanceEquations, constants: Constants, each: list[np.ndarray], rows: np.ndarray) -> None:
        """Call `frames` with parts of what `each` frame has, of which the last is `found`, each part in a thread of its own."""
        grid, dtype, threads = equations.forces.membrane.grid, each[0].dtype, min(torch.get_num_threads(), len(each[0]))

        def take(part: Sequence[np.ndarray]) -> None:
            try:
                work = self._idle[dtype].pop()
            except IndexError:
                work = workspace(grid, len(constants.positions), dtype)
            with compiled.compiling(np.dtype(dtype)):
                frames(constants, work, *part[:-1], rows, part[-1])
            self._idle[dtype].append(work)

        if threads <= 1:
            take(each)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(take, zip(*(np.array_split(values, threads) for values in each), strict=True)))

    def _found(self, equations: BalanceEquations, cavity: CavityLaw, dtype: Any) -> Constants:
        forces, loss, bearings = equations.forces, equations.loss, equations.bearings
        elasticity, membrane = forces.elasticity, forces.membrane
        material = elasticity.prestretch, elasticity.c1, elasticity.c2, cavity.rest_pressure
        places = forces.rest_load, membrane.rest, loss.surroundings, bearings.positions
        key = dtype, loss.settings, *(float(value) for value in material), *(value.data_ptr() for value in places)
        if self._constants is None or self._constants[0] != key:
            self._constants = key, _constants(equations, cavity, dtype)
        return self._constants[1]


def takes(*values: Any) -> bool:
    """Whether steps of these tensors are taken by machine code: on a processor, alone, without gradients."""
    tensors = [value for value in values if value is not None]
    return (
        not torch.compiler.is_compiling()
        and is_used()
        and all(type(value) is Tensor and value.device.type == "cpu" for value in tensors)
        and not (torch.is_grad_enabled() and any(value.requires_grad for value in tensors))
        and all(torch.func.debug_unwrap(value, recurse=False) is value for value in tensors)
    )


def _constants(equations: BalanceEquations, cavity: CavityLaw, dtype: Any) -> Constants:
    forces, loss, bearings, settings = equations.forces, equations.loss, equations.bearings, equations.loss.settings
    absolute, gas = cavity.gas.tolist()
    surface = surface_of(forces.membrane, forces.elasticity, forces.rest_load, dtype)
    numbers = Numbers(
        reference=loss.reference,
        size=loss.size,
        last_tau=settings.tau[1],
        first_tau=settings.tau[0],
        rest_pressure=float(cavity.rest_pressure),
        rest_volume=_volume(surface),
        is_open=cavity.filling == "open",
        is_gas=cavity.filling == "gas",
        absolute=absolute,
        gas_volume=gas,
        **{name: getattr(settings, name) for name in Numbers._fields if hasattr(settings, name)},
    )

    def array(values: Tensor) -> np.ndarray:
        return np.ascontiguousarray(values.numpy(), dtype)

    surroundings, wider = array(loss.surroundings), array(loss.wider)
    return Constants(
        surface,
        array(loss.area),
        surroundings,
        _within(surroundings),
        wider,
        _within(wider),
        array(loss.push_noise),
        -array(inner(forces.membrane.rest_normals, forces.membrane.grid)),
        array(bearings.positions),
        _sparse(array(bearings.smooth_shares)),
        _sparse(array(bearings.vertex_shares), 3),
        numbers,
    )


def _volume(surface: Surface) -> float:
    """At rest, eq. 19, by triangles as steps sum it up."""
    edges = surface.edges.astype(float)
    spins = np.cross(edges[:, 0], edges[:, 1], axis=0).sum(1)
    inner: np.ndarray = surface.rest[:-1, :-1].astype(float)
    return float(surface.law[4] * (inner * np.moveaxis(spins, 0, -1)).sum())


def _within(rows: np.ndarray) -> np.ndarray:
    """Where the rows begin and end to be more than zero, `[N, 2]`."""
    there = rows != 0
    return np.stack([there.argmax(1), rows.shape[1] - there[:, ::-1].argmax(1)], 1)


def _sparse(rows: np.ndarray, count: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and values of what is not zero in each row, `[D, K]` each, then some that are."""
    count = count or int((rows != 0).sum(1).max())
    numbers = np.argsort(rows == 0, axis=1, kind="stable")[:, :count]
    return numbers, np.take_along_axis(rows, numbers, 1)


def _entry(sources: str) -> Any:
    @kept
    def frames(  # type: ignore[no-untyped-def]
        c, work, u, pressure, moved, weights, before, origins, across, weight, noise_level, motion, gauge, rows, found
    ):
        """Steps of every frame, and then its deviations.

        `u [B, m, n, 3]`, `pressure [B]`, `moved [B, 4]` and `weights [B, N]`, of the normal tractions, become those after the
        steps; `before [B, m, n, 3]` the displacement before the last; `found [B, 4]` the standard deviations of force and depth
        by the last of the rows, with which no step is taken; `[0, 4]` where they are not asked for.

        c: `Constants`, work: a `Workspace`, origins to gauge: `MeasuredRays`, rows: of every step tau, outlier, cone, renewal
        and damping, `[S, 5]`.
        """
        count = len(rows) - (len(found) > 0)
        for b in range(len(u) if sources else 0):
            state, measured = (u[b], pressure[b : b + 1], moved[b], weights[b]), (noise_level[b], gauge[b])
            seen, now, earlier = (origins[b], across[b], weight[b], motion[b]), u[b].ravel(), before[b].ravel()
            for k in range(count):
                for i in range(len(earlier) if k == count - 1 else 0):
                    earlier[i] = now[i]
                step(c, work, *state, seen, *measured, rows[k])
            if len(found) > 0:
                spread_of(c, work, *state, seen, *measured, rows[count], found[b])

    return frames


SOURCES = fingerprint(
    __file__,
    *(each.__file__ for each in (camera_motion, cavity, equations, gauss_newton, native_band, native_membrane)),
    *(each.__file__ for each in (robust, spread, symmetric_2x2)),
)
frames = _entry(SOURCES)
compiled = Kept(frames, SOURCES)
"""For which precisions `frames` has been compiled."""
