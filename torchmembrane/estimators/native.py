"""When steps of force balance are taken by machine code, and what that is given."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..mechanics.cavity import CavityLaw
from ..mechanics.native_membrane import Surface, surface_of
from .bearings import Bearings
from .native_equations import Constants, Numbers, Workspace, workspace
from .native_step import steps
from .normal_equations import BalanceEquations
from .settings import ForceBalanceSettings


class NativeSteps:
    """The steps of one grid. What is constant is looked up again where precision or material have changed.

    Args:
        equations: of the force balance.
        cavity: its law.
        settings: of the estimator.
    """

    def __init__(self) -> None:
        self._constants: tuple[Any, Constants] | None = None
        self._own = threading.local()

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return type(self), ()

    def take(
        self,
        equations: BalanceEquations,
        cavity: CavityLaw,
        settings: ForceBalanceSettings,
        state: tuple[Tensor, Tensor, Tensor],
        weights: Tensor,
        measured: Bearings,
        scales: Sequence[float],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Displacement, pressure, camera and weights after a step; arguments as of `Descent.step`."""
        grid = equations.forces.membrane.grid
        u, pressure, moved, weights = (value.clone(memory_format=torch.contiguous_format) for value in (*state, weights))
        gauge = torch.zeros_like(moved[:, :2]) if measured.gauge is None else measured.gauge
        given = (*measured[:5], gauge)
        arrays = [value.contiguous().numpy() for value in given]
        constants = self._found(equations, cavity, settings, u.dtype)
        work = self._work(grid, len(constants.positions), u.numpy().dtype)
        numbers = tuple(float(scale) for scale in scales)
        steps(constants, work, u.view(-1, *grid, 3).numpy(), pressure.numpy(), moved.numpy(), weights.numpy(), *arrays, numbers)
        return u, pressure, moved, weights

    def _work(self, grid: tuple[int, int], markers: int, dtype: Any) -> Workspace:
        kept: dict[Any, Workspace] = self._own.__dict__
        if dtype not in kept:
            kept[dtype] = workspace(grid, markers, dtype)
        return kept[dtype]

    def _found(
        self, equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings, dtype: torch.dtype
    ) -> Constants:
        forces, loss, bearings = equations.forces, equations.loss, equations.bearings
        elasticity, membrane = forces.elasticity, forces.membrane
        material = elasticity.prestretch, elasticity.c1, elasticity.c2, cavity.rest_pressure
        places = forces.rest_load, membrane.rest, loss.surroundings, bearings.positions
        key = dtype, *(float(value) for value in material), *(value.data_ptr() for value in places)
        if self._constants is None or self._constants[0] != key:
            self._constants = key, _constants(equations, cavity, settings)
        return self._constants[1]


def takes(*values: Any) -> bool:
    """Whether steps of these tensors can be taken: on a processor, alone, without gradients."""
    tensors = [value for value in values if value is not None]
    return (
        not torch.compiler.is_compiling()
        and all(type(value) is Tensor and value.device.type == "cpu" for value in tensors)
        and not (torch.is_grad_enabled() and any(value.requires_grad for value in tensors))
        and not any(torch._C._functorch.is_functorch_wrapped_tensor(value) for value in tensors)
    )


def _constants(equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings) -> Constants:
    forces, loss, bearings = equations.forces, equations.loss, equations.bearings
    absolute, gas = cavity.gas.tolist()
    surface = surface_of(forces.membrane, forces.elasticity, forces.rest_load)
    numbers = Numbers(
        reference=loss.reference,
        size=loss.size,
        friction=settings.friction,
        slip=settings.slip,
        sparsity=settings.sparsity,
        floor=settings.floor,
        last_tau=settings.tau[1],
        first_tau=settings.tau[0],
        scale_share=settings.scale_share,
        far_share=settings.far_share,
        noise_share=settings.noise_share,
        decrease=settings.decrease,
        least_scale=settings.least_scale,
        camera_motion=settings.camera_motion,
        longest_step=settings.longest_step,
        largest_stretch=settings.largest_stretch,
        rest_pressure=float(cavity.rest_pressure),
        rest_volume=_volume(surface),
        is_open=cavity.filling == "open",
        is_gas=cavity.filling == "gas",
        absolute=absolute,
        gas_volume=gas,
    )
    surroundings, wider = loss.surroundings.contiguous().numpy(), loss.wider.contiguous().numpy()
    return Constants(
        surface,
        loss.area.numpy(),
        surroundings,
        _within(surroundings),
        wider,
        _within(wider),
        loss.push_noise.numpy(),
        bearings.positions.numpy(),
        _sparse(bearings.smooth_shares.numpy()),
        _sparse(bearings.vertex_shares.numpy(), 3),
        numbers,
    )


def _volume(surface: Surface) -> float:
    """At rest, eq. 19, by triangles as steps sum it up."""
    spins = np.cross(*surface.edges.astype(float).swapaxes(0, 1), axis=0).sum(1)
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
