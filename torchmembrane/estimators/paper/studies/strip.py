"""The one-dimensional membrane of Appendix A: a polygon of material points in the plane, with its energy and area.

The strip is the cross-section of a long half cylinder, with the stretch `s` along the arc and a constant stretch along the
axis. All quantities are per unit length of the axis: energies are forces, tensions are force / length, and the enclosed area
replaces the volume.
"""

from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from ....errors import MembraneError

Scalar = TypeVar("Scalar", float, Tensor)

MODELS = ("harmonic", "neo_hookean")


@dataclass(frozen=True)
class Strip:
    """Material of a strip.

    The energy per rest length as a function of the stretch s is, up to a constant:

        harmonic      w = mu/2 l^2 s^2
        neo_hookean   w = mu/2 (l^2 s^2 + 1 / (l^4 s^2))

    Args:
        model: "harmonic" | "neo_hookean".
        prestretch: l, prestretch of the rest state in both directions.
        modulus: mu, shear modulus x thickness at rest, force / length.

    Raises:
        MembraneError: the model is unknown, the prestretch is below 1, or the modulus is not positive.

    Example:
        >>> round(Strip("harmonic", 1.2).tension(1.0), 6)
        1.44
    """

    model: str = "harmonic"
    prestretch: float = 1.2
    modulus: float = 1.0

    def __post_init__(self) -> None:
        if self.model not in MODELS or not self.prestretch >= 1 or not self.modulus > 0:
            raise MembraneError(f"{self}; expected model {' or '.join(MODELS)}, prestretch >= 1 and modulus > 0")

    def density(self, s2: Tensor) -> Tensor:
        """Return the energy per rest length, a force, for the squared stretch `s2 [...]`."""
        l2, mu = self.prestretch**2, self.modulus
        return mu / 2 * l2 * s2 if self.model == "harmonic" else mu / 2 * (l2 * s2 + 1 / (l2**2 * s2))

    def tension(self, s: Scalar) -> Scalar:
        """Return the tension along the strip, `dw/ds`, force / length, for the stretch `s [...]`."""
        l2, mu = self.prestretch**2, self.modulus
        return mu * l2 * s if self.model == "harmonic" else mu * (l2 * s - 1 / (l2**2 * s**3))

    def energy(self, x: Tensor, rest: Tensor) -> Tensor:
        """Return the energy of a polygon: exactly eq. 12 in one dimension, `1/2 sum |x_{k+1} - x_k|^2 / h_k`, if harmonic.

        Args:
            x: vertices of the polygon, `[N, 2]`.
            rest: vertices of the polygon at rest, `[N, 2]`.

        Returns:
            The energy U, a force, `[]`.
        """
        length2 = (rest[1:] - rest[:-1]).square().sum(-1)
        return (length2.sqrt() * self.density((x[1:] - x[:-1]).square().sum(-1) / length2)).sum()


def area(x: Tensor) -> Tensor:
    """Return the area between the counterclockwise polygon `x [N, 2]` and the origin (`1/2 int u^2 g' dtheta`, eq. 37).

    Example:
        >>> area(torch.tensor([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])).item()
        1.0
    """
    return (x[:-1, 0] * x[1:, 1] - x[:-1, 1] * x[1:, 0]).sum() / 2


def outward(x: Tensor) -> Tensor:
    """Return the outward unit normals `[N, 2]` of the polygon `x [N, 2]`, from the chords between neighbours.

    Example:
        >>> outward(around(1.0, torch.linspace(0, torch.pi, 3)))[1].abs().round(decimals=6).tolist()
        [0.0, 1.0]
    """
    padded = torch.cat([2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]])
    chord = padded[2:] - padded[:-2]
    return torch.nn.functional.normalize(torch.stack([chord[:, 1], -chord[:, 0]], -1), dim=-1)


def around(radius: Tensor | float, angle: Tensor) -> Tensor:
    """Return the points `[..., 2]` with given polar coordinates, radius and `angle [...]` in radians.

    Example:
        >>> around(2.0, torch.tensor([0.0])).tolist()
        [[2.0, 0.0]]
    """
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
