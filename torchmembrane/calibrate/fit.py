"""Nonlinear least squares with covariance."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from ..errors import MembraneError

TOLERANCE, MOST_STEPS = 1e-7, 200
LEAST = 1e-13  # smallest singular value that counts as nonzero, over the largest
LARGEST_NOISE = 1e-3  # largest rms residual, over the image's diagonal; noise of located dots is at most a tenth of it
OUTLIER = 6.0  # robust standard deviations beyond which a residual is an outlier


class Fit(NamedTuple):
    """The minimum of `|r(theta)|^2` over n unknowns, with m residuals.

    With `J = dr / dtheta` at the minimum and `s^2 = |r|^2 / (m - n)`, the covariance is `s^2 (J^T J)^-1`. Parameters that the
    data cannot identify separately have huge standard deviations and correlations near one.

    Attributes:
        values: the unknowns at the minimum, `[n]`.
        covariance: covariance of the values, `[n, n]`.
        residuals: residuals at the minimum, `[m]`.
        noise: standard deviation of one residual, `s`.
    """

    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    noise: float

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the values, `[n]`."""
        return np.sqrt(np.diag(self.covariance))

    def in_degrees(self, count: int) -> "Fit":
        """Return the fit with the first `count` motions, each a rotation vector (rad) and a shift, converted to degrees."""
        scale = np.ones(len(self.values))
        scale[: 6 * count].reshape(count, 6)[:, :3] = 180 / np.pi
        return self._replace(values=scale * self.values, covariance=scale[:, None] * self.covariance * scale)


def fit(
    residuals: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    what: str,
) -> Fit:
    """Minimise the sum of squared residuals by scipy's trust-region method.

    Args:
        residuals: function from `theta [n]` (float64) to the residuals `[m]`; m must be larger than n.
        jacobian: function from `theta [n]` to the derivatives of the residuals, `[m, n]`.
        start: initial values, `[n]`.
        what: name of the calibration, for error messages.

    Returns:
        The minimum with its covariance.

    Raises:
        MembraneError: there are too few data, residuals at the start are not finite, or the method does not converge.

    Limitations:
        The covariance assumes independent residuals of equal variance, and that all parameters held fixed are exact.

    Example:
        >>> x = np.arange(5.0)
        >>> line = np.stack([np.ones(5), x], -1)
        >>> fit(lambda theta: line @ theta - (2 + 3 * x), lambda theta: line, np.zeros(2), "line").values.round(6)
        array([2., 3.])
    """
    start = np.asarray(start, float)
    first = residuals(start)
    if first.size <= start.size:
        raise MembraneError(f"{what}: {first.size} data for {start.size} unknowns; expected more: give more images or dots")
    if not np.isfinite(first).all():
        raise MembraneError(
            f"{what}: some points cannot be projected from the first guess; check the sensor file's design values"
        )
    solution = least_squares(
        residuals, start, jacobian, x_scale="jac", xtol=TOLERANCE, ftol=TOLERANCE, gtol=None, max_nfev=MOST_STEPS
    )
    if solution.status <= 0:
        raise MembraneError(f"{what}: not converged after {solution.nfev} steps; check the images and the design values")
    noise = float(np.sqrt((solution.fun**2).sum() / (first.size - start.size)))
    return Fit(solution.x, noise**2 * _inverse_gram(np.asarray(solution.jac)), solution.fun, noise)


def with_common_errors(found: Fit, jacobian: np.ndarray, errors: np.ndarray) -> Fit:
    """Add the effect of K errors that residuals share, `errors [m, K]` (one standard deviation each), to the covariance.

    The covariance is `C + (J^+ E) (J^+ E)^T`. Unlike noise, shared errors do not average out over many residuals.
    """
    shifts = np.linalg.lstsq(jacobian, errors)[0]
    return found._replace(covariance=found.covariance + shifts @ shifts.T)


def outliers(residuals: np.ndarray) -> np.ndarray:
    """Return which of the residual vectors `[N, 2]` are outliers, `[N]` bool.

    Example:
        >>> outliers(np.array([[0.1, 0.0], [0.0, -0.1], [5.0, 0.0], [np.nan, 0.0]]))
        array([False, False,  True,  True])
    """
    length = np.linalg.norm(residuals, axis=-1)
    return ~(length <= OUTLIER * max(np.nanmedian(length) / 1.18, 1e-9))  # 1.18: median length of planar unit-normal vectors


def rotations(vectors: Tensor) -> Tensor:
    """Convert rotation vectors (rad) `[..., 3]` to rotation matrices `[..., 3, 3]`; differentiable at 0.

    Example:
        >>> (rotations(torch.tensor([0.0, 0.0, torch.pi / 2])) @ torch.tensor([1.0, 0.0, 0.0])).round().tolist()
        [0.0, 1.0, 0.0]
    """
    x, y, z = vectors.unbind(-1)
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def outline_centres(pixels: Tensor) -> Tensor:
    """Return the area centroids `[..., 2]` of outlines in the image, `[..., K, 2]`.

    K is even, and the K points of an outline are at equal angles of the dot; for K = 1 the points themselves are returned. The
    centroid is `c = 2/3 int p (p x p') / int p x p'` about the mean, with p' by trigonometric interpolation. It is accurate to
    high order for dots that are small compared with their distance, whose outlines are nearly ellipses.

    Example:
        >>> square = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]], dtype=torch.float64)
        >>> outline_centres(square).tolist()
        [1.0, 1.0]
    """
    mean = pixels.mean(-2)
    count = pixels.shape[-2]
    if count == 1:
        return mean
    p = pixels - mean[..., None, :]
    gap = torch.arange(count, dtype=torch.float64, device=pixels.device)
    angle = torch.pi * (gap[:, None] - gap) / count
    derivative = torch.where(angle == 0, 0.0, torch.cos((gap[:, None] - gap) * torch.pi) / (2 * torch.tan(angle)))
    q = derivative @ p
    cross = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return mean + 2 / 3 * (p * cross[..., None]).sum(-2) / cross.sum(-1, keepdim=True)


def _inverse_gram(jacobian: np.ndarray) -> np.ndarray:
    """Return `(J^T J)^-1` by an SVD with scaled columns; undetermined directions give huge entries, not errors."""
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1e-150
    _, singular, V = np.linalg.svd(jacobian / scale, full_matrices=False)
    half = V.T / np.maximum(singular, LEAST * singular[0]) / scale[:, None]
    return half @ half.T
