"""Principal stretches and tensions of the membrane at its vertices."""

import torch
from torch import Tensor

from ..errors import expect
from ..surface.membrane import Membrane
from .hyperelastic import ElasticEnergy

FIELDS = ("stretch", "tension")


def principal_fields(elasticity: ElasticEnergy, membrane: Membrane, x: Tensor, name: str) -> Tensor:
    """Return the principal stretches or tensions of the deformed membrane at its vertices.

    "stretch" is the ratio of the lengths of a material line in the deformed and in the unstretched membrane, `l s_1` and
    `l s_2`, with the stretches `s` relative to the rest state and the prestretch `l`. "tension" is the force in the membrane
    per deformed length,

        T_1 = dW/ds_1 / s_2 = 2 (s_1 / s_2) (dW/dI + s_2^2 dW/dD),

    and likewise `T_2`; in a sphere of radius R under the pressure p it is `p R / 2`. Both are constant in each triangle. The
    value at a vertex is the mean of the triangles around it, weighted by their areas at rest.

    Args:
        elasticity: elastic energy of the membrane.
        membrane: the rest surface on the same grid.
        x: vertices `[..., V, 3]`.
        name: "stretch" | "tension".

    Returns:
        `[..., V, 2]`, the direction of the larger stretch first; stretches are dimensionless, tensions in force / length.

    Raises:
        MembraneError: the name is unknown.

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
    """Append an axis for the two directions; a scalar stays a scalar."""
    return derivative[..., None] if derivative.ndim else derivative
