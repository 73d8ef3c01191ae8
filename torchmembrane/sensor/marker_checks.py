"""Checks of markers against the rest surface that they are on."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..errors import MembraneError, expect
from ..surface.membrane import Membrane
from .parts import Markers

OFF_SURFACE = 0.05  # largest distance of a dot from the rest surface, in the surface's size
LEAST_APART = 1e-3  # of two dots, in the surface's size
TALLEST = 0.5  # largest height of a marker, in the surface's size


def refuse_off_surface(membrane: Membrane, positions: np.ndarray, names: Sequence[str]) -> None:
    """Refuse the first dot that is not near the rest surface.

    Args:
        membrane: the rest surface.
        positions: `[D, 3]`.
        names: names of the D dots, as the message begins.

    Raises:
        MembraneError: with its name, position, distance and what was expected.
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
    """Refuse markers that stand off the surface by more than a part of its size.

    Args:
        membrane: the rest surface.
        markers: on it.

    Raises:
        MembraneError: with the largest height, the limit, and the remedy.
    """
    limit, largest = TALLEST * membrane.size, float(np.max(np.abs(markers.height), initial=0.0))
    expected = f"at most {limit:.4g}, {TALLEST:g} of the surface's size: give it in the length unit"
    expect(largest <= limit, "height of a marker", largest, expected)


def refuse_coincident(membrane: Membrane, positions: np.ndarray, names: Sequence[str]) -> None:
    """Refuse the first dot that lies on another one.

    Args:
        membrane: the rest surface.
        positions: `[D, 3]`.
        names: names of the D dots, as the message begins.

    Raises:
        MembraneError: with the names and positions of both, and what was expected.
    """
    limit = LEAST_APART * membrane.size
    pairs = cKDTree(positions).query_pairs(limit, output_type="ndarray")
    if len(pairs):
        i, j = pairs[np.lexsort(pairs.T)[0]]
        raise MembraneError(
            f"{names[j]} at {positions[j].tolist()} lies on that at {positions[i].tolist()} ({names[i]}); expected dots more "
            f"than {limit:.3g} apart: remove one"
        )
