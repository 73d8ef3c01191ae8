"""Bundle adjustment: dots and camera poses from dots measured in several views, the scale from one length of travel."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from ..camera.model import Camera
from .fit import Fit, fit, outliers, outline_centres, rotations

NOISE = 0.05  # px, of a located dot, before it is known


class Bundle(NamedTuple):
    """D dots in P views.

    Attributes:
        motions: `[P - 1, 6]` first guess of all poses but the first: rotation vectors (rad) and positions in its frame.
        dots: `[D, 3]` first guess of the dots' centres, first camera's frame.
        around: `[D, K, 3]` points of each dot's outline, from its centre.
        pixels: `[P, D, 2]` measured centres of the outlines, px, NaN where not visible.
    """

    motions: np.ndarray
    dots: np.ndarray
    around: np.ndarray
    pixels: np.ndarray

    def in_two_views(self) -> tuple["Bundle", np.ndarray]:
        """The dots that are visible in two views or more, and which they are, `[D]` bool."""
        visible = np.isfinite(self.pixels).all(-1)
        kept = visible.sum(0) >= 2
        return Bundle(self.motions, self.dots[kept], self.around[kept], self.pixels[:, kept]), kept


def bundle_adjusted(camera: Camera, bundle: Bundle, travel_error: float) -> tuple["BundleProblem", Fit]:
    """Poses and dots that explain the pixels, mistaken ones left out.

    Args:
        camera: the camera, the same in all views.
        bundle: what was measured, each dot in two views or more.
        travel_error: standard deviation of the second view's travel, whose first guess is the scale.

    Returns:
        The problem, which says what was used, and the fit of `theta = (motions [P - 1, 6], dots [D, 3])`.
    """
    problem = BundleProblem(camera, bundle, NOISE / travel_error)
    theta = np.concatenate([bundle.motions.ravel(), bundle.dots.ravel()])
    found = fit(problem.residuals, problem.jacobian, theta, "calibrate views")
    mistaken = outliers(found.residuals[:-1].reshape(-1, 2))
    problem.used[np.nonzero(problem.used)] = ~mistaken
    problem.travel_weight = found.noise / travel_error
    return problem, fit(problem.residuals, problem.jacobian, found.values, "calibrate views")


class BundleProblem:
    """Least squares for `theta = (motions [P - 1, 6], dots [D, 3])`: pixels used, modelled less measured, then the travel.

    Args:
        camera: the camera.
        bundle: what was measured, and the first guess.
        travel_weight: what an error of the travel counts, px per length unit.

    Attributes:
        used: `[P, D]` bool, the pixels that count.
        own: how many numbers the motions have.
    """

    def __init__(self, camera: Camera, bundle: Bundle, travel_weight: float):
        self.camera, self.pixels, self.travel_weight = camera, bundle.pixels, travel_weight
        self.around = torch.from_numpy(bundle.around)
        self.own, self.travel = bundle.motions.size, np.linalg.norm(bundle.motions[0, 3:])
        self.used = np.isfinite(bundle.pixels).all(-1)
        self._all_views = vmap(vmap(self._modelled, (None, 0, 0)), (0, None, None))
        self._derivatives = vmap(vmap(jacfwd(self._modelled, (0, 1)), (None, 0, 0)), (0, None, None))

    def pixel_residuals(self, theta: np.ndarray) -> np.ndarray:
        """Measured less modelled, `[P, D, 2]`, NaN where not used."""
        left = self.pixels - self._all_views(*self._parts(theta)).numpy()
        return np.where(self.used[..., None], left, np.nan)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        left = self._all_views(*self._parts(theta)).numpy() - self.pixels
        return np.append(left[self.used].ravel(), self.travel_weight * (np.linalg.norm(theta[3:6]) - self.travel))

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        by_motion, by_dot = (a.numpy() for a in self._derivatives(*self._parts(theta)))
        own, (P, D) = self.own, self.used.shape
        J = np.zeros((P, D, 2, own + 3 * D))
        for p in range(1, P):
            J[p, ..., 6 * (p - 1) : 6 * p] = by_motion[p]
        for d in range(D):
            J[:, d, :, own + 3 * d : own + 3 * d + 3] = by_dot[:, d]
        row = np.zeros((1, own + 3 * D))
        row[0, 3:6] = self.travel_weight * theta[3:6] / np.linalg.norm(theta[3:6])
        return np.concatenate([J[self.used].reshape(-1, own + 3 * D), row])

    def _parts(self, theta: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """All motions `[P, 6]`, the first zero, dots `[D, 3]`, and the points around them."""
        moved = torch.from_numpy(theta[: self.own]).view(-1, 6)
        return torch.cat([moved.new_zeros(1, 6), moved]), torch.from_numpy(theta[self.own :]).view(-1, 3), self.around

    def _modelled(self, motion: Tensor, dot: Tensor, around: Tensor) -> Tensor:
        """Where a view has the centre of a dot's outline, `[2]`."""
        return outline_centres(self.camera.point_to_pixel((dot + around - motion[3:]) @ rotations(motion[:3])))
