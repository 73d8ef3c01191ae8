"""Bundle adjustment: positions of dots and camera poses from several views; a known camera travel sets the scale."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from .fit import Fit, fit, outliers, outline_centres, rotations

LOCATION_NOISE = 0.05  # px, initial guess of the noise of located dots


class Bundle(NamedTuple):
    """Observations of D dots in P views, and a first guess of dots and poses.

    Attributes:
        projections: for each view, the function from points `[..., 3]` in the frame of its pose to pixels `[..., 2]`.
        motions: first guess of all poses but the first, `[P - 1, 6]`: rotation vectors (rad) and positions in the first frame.
        dots: first guess of the dots' centres, `[D, 3]`, first camera's frame.
        around: points on each dot's outline relative to its centre, `[D, K, 3]`.
        pixels: measured centres of the outlines, `[P, D, 2]`, px; NaN where a dot is not visible.
    """

    projections: Sequence[Callable[[Tensor], Tensor]]
    motions: np.ndarray
    dots: np.ndarray
    around: np.ndarray
    pixels: np.ndarray

    def in_two_views(self) -> tuple["Bundle", np.ndarray]:
        """Return the bundle of the dots that are visible in at least two views, and the mask of these dots, `[D]` bool."""
        visible = np.isfinite(self.pixels).all(-1)
        kept = visible.sum(0) >= 2
        return self._replace(dots=self.dots[kept], around=self.around[kept], pixels=self.pixels[:, kept]), kept


def bundle_adjusted(bundle: Bundle, travel_error: float) -> tuple["BundleProblem", Fit]:
    """Fit poses and dots to the measured pixels, without outliers.

    Args:
        bundle: the observations; each dot is visible in at least two views.
        travel_error: standard deviation of the distance from the first to the second view, length unit; the first guess of this
            distance sets the scale.

    Returns:
        The problem, with the mask of the pixels used, and the fit of `theta = (motions [P - 1, 6], dots [D, 3])`.
    """
    problem = BundleProblem(bundle, LOCATION_NOISE / travel_error)
    theta = np.concatenate([bundle.motions.ravel(), bundle.dots.ravel()])
    found = fit(problem.residuals, problem.jacobian, theta, "calibrate views")
    mistaken = outliers(found.residuals[:-1].reshape(-1, 2))
    problem.used[np.nonzero(problem.used)] = ~mistaken
    problem.travel_weight = found.noise / travel_error
    return problem, fit(problem.residuals, problem.jacobian, found.values, "calibrate views")


class BundleProblem:
    """Least-squares problem for `theta = (motions [P - 1, 6], dots [D, 3])`.

    Its residuals are the modelled minus the measured pixels, for the pixels used, and then the weighted error of the travel.

    Args:
        bundle: the observations and the first guess.
        travel_weight: weight of an error of the travel, px per length unit.

    Attributes:
        used: mask of the pixels used, `[P, D]` bool.
        own: number of unknowns of the motions.
    """

    def __init__(self, bundle: Bundle, travel_weight: float):
        self.pixels, self.travel_weight = bundle.pixels, travel_weight
        self.around = torch.from_numpy(bundle.around)
        self.own, self.travel = bundle.motions.size, np.linalg.norm(bundle.motions[0, 3:])
        self.used = np.isfinite(bundle.pixels).all(-1)
        modelled = [_modelled(project) for project in bundle.projections]
        self._views = [vmap(of_view, (None, 0, 0)) for of_view in modelled]
        self._derivatives = [vmap(jacfwd(of_view, (0, 1)), (None, 0, 0)) for of_view in modelled]

    def pixel_residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled pixels, `[P, D, 2]`; NaN where not used."""
        return np.where(self.used[..., None], self.pixels - self._all_views(theta), np.nan)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        left = self._all_views(theta) - self.pixels
        return np.append(left[self.used].ravel(), self.travel_weight * (np.linalg.norm(theta[3:6]) - self.travel))

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        motions, dots, around = self._parts(theta)
        each = [of_view(motion, dots, around) for of_view, motion in zip(self._derivatives, motions, strict=True)]
        by_motion, by_dot = (torch.stack(parts).numpy() for parts in zip(*each, strict=True))
        own, (P, D) = self.own, self.used.shape
        J = np.zeros((P, D, 2, own + 3 * D))
        for p in range(1, P):
            J[p, ..., 6 * (p - 1) : 6 * p] = by_motion[p]
        for d in range(D):
            J[:, d, :, own + 3 * d : own + 3 * d + 3] = by_dot[:, d]
        row = np.zeros((1, own + 3 * D))
        row[0, 3:6] = self.travel_weight * theta[3:6] / np.linalg.norm(theta[3:6])
        return np.concatenate([J[self.used].reshape(-1, own + 3 * D), row])

    def _all_views(self, theta: np.ndarray) -> np.ndarray:
        """Return the modelled centres of the dots' outlines in each view, `[P, D, 2]`, px."""
        motions, dots, around = self._parts(theta)
        return np.stack([of_view(motion, dots, around) for of_view, motion in zip(self._views, motions, strict=True)])

    def _parts(self, theta: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Return all motions in `theta` `[P, 6]`, the first one zero, its dots `[D, 3]`, and the outline points."""
        moved = torch.from_numpy(theta[: self.own]).view(-1, 6)
        return torch.cat([moved.new_zeros(1, 6), moved]), torch.from_numpy(theta[self.own :]).view(-1, 3), self.around


def _modelled(project: Callable[[Tensor], Tensor]) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Return the function from motion `[6]`, dot `[3]` and outline points to the centre of the dot's outline, `[2]` px."""

    def centre(motion: Tensor, dot: Tensor, around: Tensor) -> Tensor:
        return outline_centres(project((dot + around - motion[3:]) @ rotations(motion[:3])))

    return centre
