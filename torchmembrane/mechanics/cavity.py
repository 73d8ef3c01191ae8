"""The law of the enclosed fluid: constant volume (liquid), constant pressure x volume (gas), or constant pressure (open
cavity)."""

from typing import Protocol, TypeVar

import torch
from torch import Tensor, nn

from ..errors import MembraneError
from ..surface.membrane import Membrane

FILLINGS = ("liquid", "gas", "open")


Scalar = TypeVar("Scalar", float, Tensor)


def gas_law_step(
    rise: Scalar, pressure: Scalar, rest_pressure: Scalar, absolute: Scalar, volume: Scalar
) -> tuple[Scalar, Scalar]:
    """Linearise the law of a gas, `absolute pressure x volume = constant`, for one step of a solver.

    The law is `p = p0 + P (V_gas / (V_gas + rise) - 1)`. A step leads to a state that satisfies the linearised law if
    `volume step + C (pressure step) = c`.

    Args:
        rise: increase of the cavity's volume from rest, `[...]`, length^3.
        pressure: pressure difference across the membrane, `[...]`, force / length^2.
        rest_pressure: p0, pressure difference at rest, force / length^2.
        absolute: P, absolute pressure of the gas at rest, force / length^2.
        volume: V_gas, volume of the gas at rest, length^3.

    Returns:
        Target `c` and compliance `C`, `[...]` each.

    Example:
        >>> gas_law_step(0.0, 0.0, 1.0, 4.0, 100.0)
        (25.0, 25.0)
    """
    ratio = volume / (volume + rise)
    compliance = volume / (absolute * ratio**2)
    return compliance * (rest_pressure + absolute * (ratio - 1) - pressure), compliance


class CavityLaw(nn.Module):
    """The law of the cavity's filling, linearised for one step of a solver.

    Args:
        membrane: the rest surface.
        rest_pressure: pressure difference at rest, `[]`.
        filling: "liquid" (constant volume), "gas" (constant pressure x volume) or "open" (pressure stays as at rest).
        gas: absolute pressure (force / length^2) and volume (length^3) of a gas at rest.

    Raises:
        MembraneError: the filling is unknown, or pressure and volume of a gas are missing.
    """

    rest_pressure: Tensor
    rest_volume: Tensor
    gas: Tensor

    def __init__(
        self,
        membrane: Membrane,
        rest_pressure: Tensor,
        filling: str = "liquid",
        gas: tuple[float, float] | None = None,
    ):
        super().__init__()
        if filling not in FILLINGS:
            raise MembraneError(f"CavityLaw: filling = {filling!r}; expected one of {', '.join(FILLINGS)}")
        if filling == "gas" and gas is None:
            raise MembraneError("CavityLaw: filling = 'gas' without gas = (pressure, volume); pass both")
        self.filling = filling
        self.register_buffer("rest_pressure", rest_pressure)
        self.register_buffer("rest_volume", membrane.rest_volume.clone())
        self.register_buffer("gas", torch.tensor(gas if gas else (1.0, 1.0), dtype=torch.float64))

    def condition(self, rise: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Return the target `c [...]` and the compliance `C` (`[]` for a liquid) of a step, `v.y + C (pressure step) = c`.

        Args:
            rise: increase of the volume from rest, `[...]`.
            pressure: pressure difference across the membrane, `[...]`.
        """
        if self.filling == "liquid":
            return -rise, rise.new_zeros(())
        absolute, volume = self.gas.unbind()
        return gas_law_step(rise, pressure, self.rest_pressure, absolute, volume)

    def target_volume(self, volume: Tensor, pressure: Tensor) -> Tensor:
        """Return the volume that the law requires at this pressure, `[...]`; for an open cavity the given volume."""
        if self.filling == "liquid":
            return self.rest_volume.expand(volume.shape)
        if self.filling == "open":
            return volume
        absolute, gas = self.gas.unbind()
        return self.rest_volume + gas * (absolute / (absolute + pressure - self.rest_pressure) - 1)

    def volume_error(self, volume: Tensor, pressure: Tensor) -> Tensor:
        """Return the deviation of the volume from the one that the law requires, relative to the rest volume, `[...]`."""
        return (volume - self.target_volume(volume, pressure)) / self.rest_volume


class HasGradient(Protocol):
    """An energy with a gradient: `ElasticEnergy` or the paper's element."""

    def gradient(self, x: Tensor) -> Tensor:
        """Return the gradient with respect to the vertices, `[..., V, 3]`."""
        ...


def rest_balance(membrane: Membrane, energy: HasGradient) -> tuple[Tensor, Tensor]:
    """Return the rest pressure `p0 []` and the rest load `h = grad U(X) - p0 grad V(X)`, `[V, 3]`, zero at fixed vertices.

    `p0` balances the normal components of both gradients; spurious tangential components do not affect it.

    Args:
        membrane: the rest surface.
        energy: an `ElasticEnergy` or the paper's element.
    """
    force, of_fluid = energy.gradient(membrane.rest), membrane.volume_gradient(membrane.rest)
    normal, free = membrane.rest_normals, membrane.free_vertices
    p0 = (force * normal)[free].sum() / (of_fluid * normal)[free].sum()
    return p0, torch.where(membrane.fixed[:, None], 0.0, force - p0 * of_fluid)
