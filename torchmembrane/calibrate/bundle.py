"""Bundle adjustment: dots and camera poses from dots measured in several views, the scale from one length of travel."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from .fit import Fit, fit, outliers, outline_centres, rotations

LOCATION_NOISE = 0.05  # px, of a located dot, before it is known


class Bundle(NamedTuple):
    """D dots in P views.

    Attributes:
        projections: of each view, from points `[..., 3]` in the frame of its pose to pixels `[..., 2]`.
        motions: `[P - 1, 6]` first guess of all poses but the first: rotation vectors (rad) and positions in its frame.
        dots: `[D, 3]` first guess of the dots' centres, first camera's frame.
        around: `[D, K, 3]` points of each dot's outline, from its centre.
        pixels: `[P, D, 2]` measured centres of the outlines, px, NaN where not visible.
    """

    projections: Sequence[Callable[[Tensor], Tensor]]
    motions: np.ndarray
    dots: np.ndarray
    around: np.ndarray
    pixels: np.ndarray

    def in_two_views(self) -> tuple["Bundle", np.ndarray]:
        """The dots that are visible in two views or more, and which they are, `[D]` bool."""
        visible = np.isfinite(self.pixels).all(-1)
        kept = visible.sum(0) >= 2
        return self._replace(dots=self.dots[kept], around=self.around[kept], pixels=self.pixels[:, kept]), kept


def bundle_adjusted(bundle: Bundle, travel_error: float) -> tuple["BundleProblem", Fit]:
    """Poses and dots that explain the pixels, mistaken ones left out.

    Args:
        bundle: what was measured, each dot in two views or more.
        travel_error: standard deviation of the second view's travel, whose first guess is the scale.

    Returns:
        The problem, which says what was used, and the fit of `theta = (motions [P - 1, 6], dots [D, 3])`.
    """
    problem = BundleProblem(bundle, LOCATION_NOISE / travel_error)
    theta = np.concatenate([bundle.motions.ravel(), bundle.dots.ravel()])
    found = fit(problem.residuals, problem.jacobian, theta, "calibrate views")
    mistaken = outliers(found.residuals[:-1].reshape(-1, 2))
    problem.used[np.nonzero(problem.used)] = ~mistaken
    problem.travel_weight = found.noise / travel_error
    return problem, fit(problem.residuals, problem.jacobian, found.values, "calibrate views")


class BundleProblem:
    """Least squares for `theta = (motions [P - 1, 6], dots [D, 3])`: pixels used, modelled less measured, then the travel.

    Args:
        bundle: what was measured, and the first guess.
        travel_weight: what an error of the travel counts, px per length unit.

    Attributes:
        used: `[P, D]` bool, the pixels that count.
        own: how many numbers the motions have.
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
        """Measured less modelled, `[P, D, 2]`, NaN where not used."""
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
        """Where each view has the dots' outlines, `[P, D, 2]`."""
        motions, dots, around = self._parts(theta)
        return np.stack([of_view(motion, dots, around) for of_view, motion in zip(self._views, motions, strict=True)])

    def _parts(self, theta: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """All motions `[P, 6]`, the first zero, dots `[D, 3]`, and the points around them."""
        moved = torch.from_numpy(theta[: self.own]).view(-1, 6)
        return torch.cat([moved.new_zeros(1, 6), moved]), torch.from_numpy(theta[self.own :]).view(-1, 3), self.around


def _modelled(project: Callable[[Tensor], Tensor]) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Where a view has the centre of a dot's outline, `[2]`, from its motion `[6]`, the dot `[3]` and points around it."""

    def centre(motion: Tensor, dot: Tensor, around: Tensor) -> Tensor:
        return outline_centres(project((dot + around - motion[3:]) @ rotations(motion[:3])))

    return centre
