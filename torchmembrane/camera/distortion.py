"""Lens models as functions from the image plane (pixel minus centre, over focal length) to unit directions and back.

Both directions invert their distortion by a fixed number of Newton steps; the result is NaN at and beyond the radius where the
distortion folds back. Even functions of the radius are evaluated from its square, with a safe argument on the axis, so that
values and gradients are finite there.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..solve.symmetric_2x2 import symmetric_adjugate_product, symmetric_determinant

LENS_STEPS = 12  # Newton steps that undo a distortion
FOLD_SAMPLES = 512  # angles from the axis at which a distortion is tested for folding back


def pinhole_direction(image: Tensor, distortion: Tensor) -> Tensor:
    """Convert image positions to directions through a pinhole.

    Args:
        image: `[..., 2]`, pixel minus centre, over the focal length.
        distortion: k1 k2 p1 p2 k3, optionally followed by k4 k5 k6, or empty.

    Returns:
        Unit directions `[..., 3]`; NaN at and beyond the radius where the distortion folds back.

    Example:
        >>> k = torch.tensor([-0.2, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> pinhole_image(pinhole_direction(torch.tensor([0.3, 0.0], dtype=torch.float64), k), k).round(decimals=9).tolist()
        [0.3, 0.0]
    """
    xy = image
    if len(distortion):
        radial, p1, p2, fold = _pinhole_terms(distortion)
        within = (image * image).sum(-1, keepdim=True) <= (fold * _ratio(fold**2, radial)[0]) ** 2
        target = xy = torch.where(within, image, 0.0)
        for _ in range(LENS_STEPS):
            xy = xy * (fold**2 / (xy * xy).sum(-1, keepdim=True).clamp(min=fold**2)).sqrt()
            distorted, a, b, c = distort(xy, radial, p1, p2)
            du, dv = (target - distorted).unbind(-1)
            determinant = symmetric_determinant(a, b, c).clamp(min=1e-6)
            xy = xy + torch.stack(symmetric_adjugate_product(a, b, c, du, dv), -1) / determinant[..., None]
        distorted, a, b, c = distort(xy, radial, p1, p2)
        solved = ((distorted - target).abs() < _tolerance(xy)).all(-1) & (a + c > 0) & (a * c > b * b)
        xy = torch.where(within & solved[..., None], xy, math.nan)
    direction = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
    return direction / (direction * direction).sum(-1, keepdim=True).sqrt()


def pinhole_image(points: Tensor, distortion: Tensor) -> Tensor:
    """Project points to image positions through a pinhole.

    Args:
        points: `[..., 3]`, length unit.
        distortion: k1 k2 p1 p2 k3, optionally followed by k4 k5 k6, or empty.

    Returns:
        `[..., 2]`, in focal lengths; NaN behind the camera and where the distortion folds back.

    Example:
        >>> pinhole_image(torch.tensor([1.0, -2.0, 10.0]), torch.zeros(0)).round(decimals=6).tolist()
        [0.10000000149011612, -0.20000000298023224]
    """
    ahead = points[..., 2:] > 0
    xy = points[..., :2] / torch.where(ahead, points[..., 2:], 1.0)
    if len(distortion):
        radial, p1, p2, fold = _pinhole_terms(distortion)
        ahead = ahead & ((xy * xy).sum(-1, keepdim=True) <= fold**2)
        xy, a, b, c = distort(torch.where(ahead, xy, 0.0), radial, p1, p2)
        ahead = ahead & ((a + c > 0) & (a * c > b * b))[..., None]
    return torch.where(ahead, xy, math.nan)


def _pinhole_terms(distortion: Tensor) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Return the radial coefficients k1 k2 k3 (and k4 k5 k6 if there are eight), the tangential ones p1 and p2, and the radius
    (tangent of the angle) at which the radial distortion folds back."""
    k1, k2, p1, p2, *others = distortion.unbind()
    radial = [k1, k2, *others]
    angles = torch.linspace(0, math.radians(89.9), FOLD_SAMPLES, dtype=distortion.dtype, device=distortion.device)
    return radial, p1, p2, _fold(angles.tan(), radial[:3], radial[3:])


def distort(xy: Tensor, radial: list[Tensor], p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Apply OpenCV's radial and tangential distortion.

    Args:
        xy: `[..., 2]`, undistorted, in focal lengths.
        radial: up to three coefficients k1 k2 k3, or k1 to k6 of the rational model.
        p1: first tangential coefficient.
        p2: second tangential coefficient.

    Returns:
        The distorted positions `[..., 2]`, and their derivative's entries `a`, `b`, `c` of `[[a, b], [b, c]]`, each `[...]`.

    Example:
        >>> distort(torch.tensor([0.5, 0.0]), [torch.tensor(-0.2)], torch.tensor(0.0), torch.tensor(0.0))[0].tolist()
        [0.4749999940395355, 0.0]
    """
    x, y = xy.unbind(-1)
    r_squared = x * x + y * y
    factor, rate = _ratio(r_squared, radial)
    u = x * factor + 2 * p1 * x * y + p2 * (r_squared + 2 * x * x)
    v = y * factor + 2 * p2 * x * y + p1 * (r_squared + 2 * y * y)
    a = factor + 2 * rate * x * x + 2 * p1 * y + 6 * p2 * x
    b = 2 * rate * x * y + 2 * p1 * x + 2 * p2 * y
    c = factor + 2 * rate * y * y + 6 * p1 * y + 2 * p2 * x
    return torch.stack([u, v], -1), a, b, c


def fisheye_direction(image: Tensor, distortion: Tensor) -> Tensor:
    """Convert image positions to directions through a fisheye lens.

    Args:
        image: `[..., 2]`, pixel minus centre, over the focal length (distorted angle, rad).
        distortion: k1 k2 k3 k4, or empty.

    Returns:
        Unit directions `[..., 3]`; NaN at and beyond the radius where the distortion folds back.

    Example:
        >>> fisheye_direction(torch.tensor([torch.pi / 2, 0.0]), torch.zeros(0)).round(decimals=6).tolist()
        [1.0, 0.0, -0.0]
    """
    r_squared = (image * image).sum(-1, keepdim=True)
    off_axis = r_squared > torch.finfo(image.dtype).eps ** 2
    radius = torch.where(off_axis, r_squared, 1.0).sqrt()
    theta = target = torch.where(off_axis, radius, 0.0)
    within = target < math.pi
    if len(distortion):
        fold = fisheye_fold(distortion)
        within = target <= fold * _radial(fold**2, distortion.unbind())[0]
        theta = target = torch.where(within, target, 0.0)
        for _ in range(LENS_STEPS):
            theta = torch.minimum(theta.clamp(min=0.0), fold)
            factor, rate = _radial(theta * theta, distortion.unbind())
            theta = theta - (theta * factor - target) / (factor + 2 * theta * theta * rate)
        residual = theta * _radial(theta * theta, distortion.unbind())[0] - target
        within = within & (residual.abs() < _tolerance(theta))
    sideways = torch.where(off_axis, theta.sin() / radius, 1.0)
    return torch.where(within, torch.cat([image * sideways, theta.cos()], -1), math.nan)


def fisheye_image(points: Tensor, distortion: Tensor) -> Tensor:
    """Project points to image positions through a fisheye lens, up to 180 degrees from the axis.

    Args:
        points: `[..., 3]`, length unit.
        distortion: k1 k2 k3 k4, or empty.

    Returns:
        `[..., 2]`, distorted angle, rad; NaN where the distortion folds back, and on the axis behind the camera.

    Example:
        >>> fisheye_image(torch.tensor([2.0, 0.0, 0.0]), torch.zeros(0)).round(decimals=4).tolist()
        [1.5707999467849731, 0.0]
    """
    xy, z = points[..., :2], points[..., 2:]
    rho_squared = (xy * xy).sum(-1, keepdim=True)
    off_axis = rho_squared > torch.finfo(points.dtype).eps ** 2 * z * z
    rho = torch.where(off_axis, rho_squared, 1.0).sqrt()
    theta = torch.atan2(torch.where(off_axis, rho, 0.0), torch.where(off_axis, z, 1.0))
    scale = torch.where(off_axis, theta / rho, 1 / torch.where(z > 0, z, 1.0))
    visible = off_axis | (z > 0)
    if len(distortion):
        visible = visible & (theta <= fisheye_fold(distortion))
        scale = scale * _radial(theta * theta, distortion.unbind())[0]
    return torch.where(visible, xy * scale, math.nan)


def fisheye_fold(distortion: Tensor) -> Tensor:
    """Return the angle from the axis, rad, up to which the image radius of a fisheye increases; pi if it never folds back.

    Args:
        distortion: k1 k2 k3 k4.

    Returns:
        `[]`.

    Example:
        >>> [round(float(fisheye_fold(torch.tensor([k1, 0.0, 0.0, 0.0]))), 2) for k1 in (-0.3, 0.0)]
        [1.05, 3.14]
    """
    angles = torch.linspace(0, math.pi, FOLD_SAMPLES + 1, dtype=distortion.dtype, device=distortion.device)
    return _fold(angles, distortion.unbind())


def _radial(r_squared: Tensor, coefficients: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return `1 + sum_i k_i r^(2 i)` and its derivative with respect to r^2."""
    factor, rate = torch.zeros_like(r_squared), torch.zeros_like(r_squared)
    descending: list[Tensor | float] = [*reversed(coefficients), 1.0]
    for k in descending:
        factor, rate = factor * r_squared + k, rate * r_squared + factor
    return factor, rate


def _ratio(r_squared: Tensor, radial: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return `(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)` and its derivative with respect to r^2; with
    three coefficients, k4 to k6 are 0."""
    factor, rate = _radial(r_squared, radial[:3])
    if len(radial) > 3:
        divisor, slope = _radial(r_squared, radial[3:])
        factor = factor / divisor
        rate = (rate - factor * slope) / divisor
    return factor, rate


def _fold(radii: Tensor, coefficients: Sequence[Tensor], below: Sequence[Tensor] = ()) -> Tensor:
    """Return the last of the increasing `radii [S]` up to which the distorted radius increases and its divisor is positive."""
    squared = radii * radii
    factor, rate = _ratio(squared, [*coefficients, *below]) if below else _radial(squared, coefficients)
    increases = (factor + 2 * squared * rate > 0) & (_radial(squared, below)[0] > 0)
    first = torch.where(increases, math.inf, radii).amin(-1)
    return torch.where(radii < first, radii, 0.0).amax(-1)


def _tolerance(value: Tensor) -> float:
    """Return the distance from the target, in focal lengths, within which Newton's method counts as converged."""
    epsilon: float = torch.finfo(value.dtype).eps
    tolerance: float = epsilon ** (2 / 3)
    return tolerance
