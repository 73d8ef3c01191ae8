"""The loss of measured presses as a function of the prestretch, without the normal-compression term.

Force balance minimises the misfit of the markers and a loss of the tractions over `p0`. With a wrong prestretch, a press needs
shear and tension where only compression is possible, and the markers' misfit grows. Compression is what every press has, so it
is no evidence; but its loss also changes with the prestretch, up or down depending on the force, its area and `p0`, so it is
not counted. A solve from rest may miss the minimum at one prestretch and not at the next; therefore the solutions at
neighbouring prestretches are tried as starts, too.
"""

import torch

from ..estimators.base import Equilibrium, Observation
from ..estimators.force_balance.estimator import ForceBalance
from ..estimators.force_balance.gauss_newton import State
from ..progress import Progress, silent

STEPS = 8  # largest number of Gauss-Newton steps from a neighbour's solution

Explained = tuple[ForceBalance, Equilibrium]


def continued(solutions: list[Explained], observation: Observation, progress: Progress = silent) -> list[Explained]:
    """Improve solutions at increasing prestretches by continuation from neighbours, first upwards, then downwards."""
    upwards: list[Explained] = []
    for k, own in enumerate(solutions):
        progress(k / (2 * len(solutions)), "prestretches from their lower neighbours")
        upwards.append(_better(own, upwards[-1], observation) if upwards else own)
    downwards: list[Explained] = []
    for k, own in enumerate(reversed(upwards)):
        progress(0.5 + k / (2 * len(solutions)), "prestretches from their upper neighbours")
        downwards.append(_better(own, downwards[-1], observation) if downwards else own)
    return downwards[::-1]


def _better(own: Explained, neighbour: Explained, observation: Observation) -> Explained:
    """Return for each press its `own` solution, or one found from the `neighbour`'s if that converged to a lower objective."""
    (estimator, found), (other, near) = own, neighbour
    measured = estimator.equations.bearings.measured(observation)
    start = State(
        near.vertices - estimator.membrane.rest, near.pressure * (estimator.rest_pressure / other.rest_pressure), near.moved
    )
    state: State
    with torch.no_grad():
        state, before = estimator.gauss_newton(start, measured, estimator.settings.tau[-1], STEPS)
        tried = estimator.equilibrium(*state, before, measured)
    lower = estimator.is_converged(tried) & (tried.objective < found.objective)
    rows = (torch.where(lower.reshape(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in zip(tried, found, strict=True))
    return estimator, Equilibrium(*rows)
