"""The one-dimensional membrane of Appendix A: a polygon of a strip's material points in the plane, its energy and area.

The strip is a long half cylinder's cross-section: stretched along the arc by `s`, its stretch along the axis kept. Per unit
length of the axis: energies are forces, tensions force / length, and the enclosed area stands for the volume.
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
    """The strip's material.

    Energy per rest length, up to a constant, of the stretch s:

        harmonic      w = mu/2 l^2 s^2
        neo_hookean   w = mu/2 (l^2 s^2 + 1 / (l^4 s^2))

    Args:
        model: harmonic | neo_hookean.
        prestretch: l, at rest, both ways.
        modulus: mu, shear modulus x thickness at rest, force / length.

    Raises:
        MembraneError: an unknown model, a prestretch below 1, a modulus that is not positive.

    Example:
        >>> round(Strip("harmonic", 1.2).tension(1.0), 6)
        1.44
    """

    model: str = "harmonic"
    prestretch: float = 1.2
    modulus: float = 1.0

    def __post_init__(self) -> None:
        if self.model not in MODELS or not self.prestretch >= 1 or not self.modulus > 0:
            raise MembraneError(f"Strip: {self}; expected model {' or '.join(MODELS)}, prestretch >= 1 and modulus > 0")

    def density(self, s2: Tensor) -> Tensor:
        """Energy per rest length, force, of the squared stretch `s2 [...]`."""
        l2, mu = self.prestretch**2, self.modulus
        return mu / 2 * l2 * s2 if self.model == "harmonic" else mu / 2 * (l2 * s2 + 1 / (l2**2 * s2))

    def tension(self, s: Scalar) -> Scalar:
        """`dw/ds`, the tension along the strip, force / length, of the stretch `s [...]`."""
        l2, mu = self.prestretch**2, self.modulus
        return mu * l2 * s if self.model == "harmonic" else mu * (l2 * s - 1 / (l2**2 * s**3))

    def energy(self, x: Tensor, rest: Tensor) -> Tensor:
        """Energy of a polygon; in one dimension eq. 12, exactly: `1/2 sum |x_{k+1} - x_k|^2 / h_k` for the harmonic model.

        Args:
            x: the polygon, `[N, 2]`.
            rest: the same at rest, `[N, 2]`.

        Returns:
            U, force, `[]`.
        """
        length2 = (rest[1:] - rest[:-1]).square().sum(-1)
        return (length2.sqrt() * self.density((x[1:] - x[:-1]).square().sum(-1) / length2)).sum()


def area(x: Tensor) -> Tensor:
    """Area between the polygon `x [N, 2]`, counterclockwise, and the origin (`1/2 int u^2 g' dtheta`, eq. 37).

    Example:
        >>> area(torch.tensor([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])).item()
        1.0
    """
    return (x[:-1, 0] * x[1:, 1] - x[:-1, 1] * x[1:, 0]).sum() / 2


def outward(x: Tensor) -> Tensor:
    """Unit normals `[N, 2]` of the polygon `x [N, 2]` away from the cavity, by the chords between neighbours.

    Example:
        >>> outward(around(1.0, torch.linspace(0, torch.pi, 3)))[1].abs().round(decimals=6).tolist()
        [0.0, 1.0]
    """
    padded = torch.cat([2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]])
    chord = padded[2:] - padded[:-2]
    return torch.nn.functional.normalize(torch.stack([chord[:, 1], -chord[:, 0]], -1), dim=-1)


def around(radius: Tensor | float, angle: Tensor) -> Tensor:
    """Points `[..., 2]` at polar coordinates, radius and `angle [...]` in radians.

    Example:
        >>> around(2.0, torch.tensor([0.0])).tolist()
        [[2.0, 0.0]]
    """
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
