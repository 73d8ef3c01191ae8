"""Check markers against the rest surface on which they lie."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..errors import MembraneError, expect
from ..surface.membrane import Membrane
from .parts import Markers

OFF_SURFACE = 0.05  # largest distance of a dot from the rest surface, over the surface's size
LEAST_APART = 1e-3  # smallest distance between two dots, over the surface's size
TALLEST = 0.5  # largest height of a marker, over the surface's size


def refuse_off_surface(membrane: Membrane, positions: np.ndarray, names: Sequence[str]) -> None:
    """Raise an error for the first dot that is not near the rest surface.

    Args:
        membrane: the rest surface.
        positions: positions of the dots, `[D, 3]`, length unit.
        names: names of the D dots, for the message.

    Raises:
        MembraneError: a dot is off the surface; the message has its name, position, distance and the limit.
    """
    distance = membrane.closest_points(positions).distance
    limit = OFF_SURFACE * membrane.size
    if not (distance <= limit).all():
        i = int(np.flatnonzero(~(distance <= limit))[0])
        raise MembraneError(
            f"{names[i]} at {positions[i].tolist()} is {distance[i]:.4g} off the rest surface; expected at most {limit:.4g}: "
            "give positions at rest, in the camera's frame and the sensor's length unit"
        )


def refuse_tall(membrane: Membrane, markers: Markers) -> None:
    """Raise an error if markers stand off the surface by more than `TALLEST` of its size.

    Args:
        membrane: the rest surface.
        markers: its markers.

    Raises:
        MembraneError: a marker is too high; the message has the largest height, the limit and the remedy.
    """
    limit, largest = TALLEST * membrane.size, float(np.max(np.abs(markers.height), initial=0.0))
    expected = f"at most {limit:.4g}, {TALLEST:g} of the surface's size: give it in the length unit"
    expect(largest <= limit, "height of a marker", largest, expected)


def refuse_coincident(membrane: Membrane, positions: np.ndarray, names: Sequence[str]) -> None:
    """Raise an error for the first dot that coincides with another one.

    Args:
        membrane: the rest surface.
        positions: positions of the dots, `[D, 3]`, length unit.
        names: names of the D dots, for the message.

    Raises:
        MembraneError: two dots coincide; the message has their names and positions and the limit.
    """
    limit = LEAST_APART * membrane.size
    pairs = cKDTree(positions).query_pairs(limit, output_type="ndarray")
    if len(pairs):
        i, j = pairs[np.lexsort(pairs.T)[0]]
        raise MembraneError(
            f"{names[j]} at {positions[j].tolist()} coincides with that at {positions[i].tolist()} ({names[i]}); expected dots "
            f"more than {limit:.3g} apart: remove one"
        )
