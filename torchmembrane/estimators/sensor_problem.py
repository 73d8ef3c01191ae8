"""The `Problem` of a sensor whose markers have been located on its surface."""

import torch

from ..markers.sightings import Sightings
from ..mechanics.hyperelastic import ElasticEnergy
from ..sensor.factories import CavityFilling
from ..surface.membrane import Membrane
from .base import Problem

LEAST_ERROR = 0.02  # smallest standard deviation of a marker's position, px


def problem_of(
    seen: Sightings, membrane: Membrane, elasticity: ElasticEnergy, cavity: CavityFilling, friction: float
) -> Problem:
    """Return the problem of a sensor, in double precision.

    Args:
        seen: the markers as the camera sees them.
        membrane: the rest surface on the solver's grid.
        elasticity: elastic energy of the membrane.
        cavity: filling of the cavity.
        friction: coefficient of friction between the membrane and what touches it.
    """
    views = len(seen.positions) // len(seen.markers.positions)
    return Problem(
        camera=seen.camera,
        membrane=membrane,
        elasticity=elasticity,
        filling=cavity.filling,
        gas=cavity.gas,
        markers=seen.points,
        positions=seen.positions,
        rest_pixels=seen.rest_pixels,
        vertex_pixels=seen.vertex_pixels,
        rest_covariance=2 * seen.observer.rest_covariance.double() + LEAST_ERROR**2 * torch.eye(2).double(),
        rest_confidence=None if views == 1 else seen.observer.seen_at_rest.double(),
        views=views,
        levers=seen.levers,
        friction=friction,
    )
