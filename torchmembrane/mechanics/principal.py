"""Principal stretches and tensions of the membrane at its vertices."""

import torch
from torch import Tensor

from ..errors import expect
from ..surface.membrane import Membrane
from .hyperelastic import ElasticEnergy

FIELDS = ("stretch", "tension")


def principal_fields(elasticity: ElasticEnergy, membrane: Membrane, x: Tensor, name: str) -> Tensor:
    """A field of the deformed membrane along its two principal directions, at the vertices.

    "stretch": the length of a material line over that in the unstretched membrane, `l s_1` and `l s_2`, with the stretches
    `s` from the rest state and its prestretch `l`. "tension": the force in the membrane per deformed length,

        T_1 = dW/ds_1 / s_2 = 2 (s_1 / s_2) (dW/dI + s_2^2 dW/dD),

    and `T_2` alike; of a sphere under the pressure p it is `p R / 2`. Both are constant on a triangle; a vertex has the mean of
    the triangles around it, weighted by their areas at rest.

    Args:
        elasticity: elasticity of the membrane.
        membrane: the rest surface on the same grid.
        x: vertices `[..., V, 3]`.
        name: "stretch" | "tension".

    Returns:
        `[..., V, 2]`, the direction of the larger stretch first; stretch without unit, tension in force / length.

    Raises:
        MembraneError: another name.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> cap = spherical_cap(12.0, 9.0, 15.0)
        >>> principal_fields(ElasticEnergy(cap, prestretch=1.25), cap, cap.rest, "stretch")[0].round(decimals=4).tolist()
        [1.25, 1.25]
    """
    expect(name in FIELDS, "principal_fields: name", name, " or ".join(FIELDS))
    stretches = elasticity.principal_stretches(x)
    values = elasticity.prestretch * stretches
    if name == "tension":
        squared = stretches.square()
        first, second = elasticity.first_derivatives(squared.sum(-1), squared.prod(-1))
        across = stretches.flip(-1)
        values = 2 * stretches / across * (_with_axis(first) + across.square() * _with_axis(second))
    m, n = membrane.grid
    weight = torch.linalg.vector_norm(membrane.area_vectors(membrane.rest), dim=-1)
    summed = membrane.thirds_to_vertices(values.unflatten(-2, (m - 1, n - 1, 2)) * weight[..., None])
    mean: Tensor = summed / membrane.rest_area[:, None]
    return mean


def _with_axis(derivative: Tensor) -> Tensor:
    """For both directions; a constant stays a scalar."""
    return derivative[..., None] if derivative.ndim else derivative
