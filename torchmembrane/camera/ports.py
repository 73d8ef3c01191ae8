"""Flat refractive layers normal to the optical axis: rays behind them, and points seen through them.

All formulas use only the square of the distance from the axis, so that values and gradients are finite and smooth on it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import expect

MOST_INDEX, FARTHEST = 5.0, 1e6  # refractive index; length unit
PORT_STEPS = 10  # Newton steps to the refracted ray of a point
DERIVATIVES = 2  # how many derivatives of that ray are exact, and how many of these steps are differentiated


class Port(NamedTuple):
    """A flat layer normal to the optical axis.

    Attributes:
        distance: distance from the centre of projection to the near face, length unit.
        thickness: length unit.
        index: refractive index.

    Example:
        >>> Port(distance=4.0, thickness=3.0, index=1.49)._asdict()
        {'distance': 4.0, 'thickness': 3.0, 'index': 1.49}
    """

    distance: float
    thickness: float
    index: float  # type: ignore[assignment]  # hides tuple.index


class Layers(NamedTuple):
    """The layers that light passes from the lens to the far face of the last port: gaps of air, then the ports.

    Attributes:
        heights: thicknesses along the axis, `[2 P]`.
        indices: refractive indices, `[2 P]`.
        far: depth of the last far face, `[]`.
    """

    heights: Tensor
    indices: Tensor
    far: Tensor


def layers_of(distance: Tensor, thickness: Tensor, index: Tensor) -> Layers:
    """Combine ports and the gaps before them to one stack.

    Args:
        distance: distances of the near faces, `[P]`.
        thickness: thicknesses of the ports, `[P]`.
        index: refractive indices, `[P]`.

    Returns:
        `Layers`.

    Example:
        >>> layers_of(torch.tensor([2.0, 6.0]), torch.tensor([3.0, 1.0]), torch.tensor([1.5, 1.4])).heights.tolist()
        [2.0, 1.0, 3.0, 1.0]
    """
    far = distance + thickness
    gaps = distance - torch.cat([torch.zeros_like(far[:1]), far[:-1]])
    heights = torch.cat([gaps, thickness])
    return Layers(heights, torch.cat([torch.ones_like(gaps), index]), far[-1])


def refract(direction: Tensor, layers: Layers, medium_index: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ray in the medium that belongs to a direction in air.

    Snell's law preserves the transverse part `s = (s_x, s_y)` of refractive index times direction. The refracted ray extended
    backwards meets the axis at `z = sum_i h_i (1 - sqrt((n^2 - s^2) / (n_i^2 - s^2)))`; its direction is
    `(s_x, s_y, sqrt(n^2 - s^2)) / n`.

    Args:
        direction: unit vectors `[..., 3]`, in air.
        layers: heights `h_i` and indices `n_i`.
        medium_index: refractive index n of the medium behind the last layer, `[]`.

    Returns:
        Origins on the axis and unit directions, `[..., 3]`; NaN for directions that do not point forwards.
    """
    ahead = direction[..., 2:] > 0
    cosine_squared = torch.where(ahead, direction[..., 2:], 1.0) ** 2
    inside = (medium_index**2 - 1 + cosine_squared).sqrt()  # n cos of the angle in the medium
    slant = inside / (layers.indices**2 - 1 + cosine_squared).sqrt()
    axis_depth = (layers.heights * (1 - slant)).sum(-1, keepdim=True)
    origin = torch.cat([torch.zeros_like(direction[..., :2]), axis_depth], -1)
    refracted = torch.cat([direction[..., :2], inside], -1) / medium_index
    return torch.where(ahead, origin, math.nan), torch.where(ahead, refracted, math.nan)


def apparent_points(points: Tensor, layers: Layers, medium_index: Tensor) -> Tensor:
    """Return where points in the medium appear to be, for a lens in air.

    With rho the distance from the axis and w = tan(angle in air) / rho, Snell's law is `g(w) = 0`,
    `g(w) = sum_i h_i w / sqrt(n_i^2 + (n_i^2 - 1) rho^2 w^2) - 1`, concave and increasing for n_i >= 1, and
    g(1 / z) <= 0: Newton from 1 / z is monotone. At the root, the derivative of a Newton step with respect to w is 0, so that k
    steps from there have the first k derivatives of w with respect to all else; the steps before are not differentiated.

    Args:
        points: `[..., 3]`, length unit, camera frame.
        layers: heights `h_i` and indices `n_i`.
        medium_index: refractive index of the medium behind the last layer, `[]`.

    Returns:
        `[..., 3]`, the point at z = 1 in the direction from which the light enters the lens; NaN before the last layer's far
        face.
    """
    xy, z = points[..., :2], points[..., 2:]
    behind = z > layers.far
    depth = torch.where(behind, z - layers.far, 1.0)
    heights = torch.cat([layers.heights.expand(*depth.shape[:-1], -1), depth], -1)
    squared = torch.cat([layers.indices, medium_index[None]]) ** 2
    rho_squared = (xy * xy).sum(-1, keepdim=True)
    terms = heights, squared, rho_squared
    start = 1 / torch.where(behind, z, 1.0)
    w = _newton(start.detach(), PORT_STEPS - DERIVATIVES, *(term.detach() for term in terms))
    w = _newton(w, DERIVATIVES, *terms)
    return torch.where(behind, torch.cat([xy * w, torch.ones_like(w)], -1), math.nan)


def _newton(w: Tensor, steps: int, heights: Tensor, squared: Tensor, rho_squared: Tensor) -> Tensor:
    """Return `w` after steps towards the root of g, with the squares of the indices and of rho."""
    for _ in range(steps):
        optical = (squared + (squared - 1) * rho_squared * w * w).rsqrt()
        value = (heights * optical).sum(-1, keepdim=True) * w - 1
        slope = (heights * squared * optical**3).sum(-1, keepdim=True)
        w = w - value / slope
    return w


def check_ports(owner: str, ports: Sequence[Sequence[float]]) -> None:
    """Refuse ports that are not finite, not in order from the camera, or overlap.

    Args:
        owner: name at the beginning of the message.
        ports: distance, thickness and index of each port.

    Raises:
        MembraneError: a port is invalid; the message contains the port and its value.

    Example:
        >>> check_ports("Camera", [(2.0, 3.0, 0.9)])
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: Camera: ports[0].index is 0.9; expected 1 (air) or more; Plexiglas has 1.49
    """
    face = 0.0
    for i, port in enumerate(ports):
        name = f"{owner}: ports[{i}]"
        finite = len(port) == 3 and all(map(math.isfinite, port))
        expect(finite, name, list(port), "distance, thickness, index, all finite")
        distance, thickness, index = port
        expect(0 < thickness <= FARTHEST, f"{name}.thickness", thickness, f"a positive length, at most {FARTHEST:g}")
        expect(1 <= index <= MOST_INDEX, f"{name}.index", index, "1 (air) or more; Plexiglas has 1.49")
        order = f"more than 0 and at least {face}, where the layer before it ends: list ports in order from the camera"
        expect(0 < distance <= FARTHEST and distance >= face * (1 - 1e-12), f"{name}.distance", distance, order)
        face = distance + thickness
