"""What a prestretch costs where presses were measured: how badly they are explained with it, their pushes apart.

The force balance minimises the misfit of the markers and the loss of the tractions, over `p0`. A press with the wrong
prestretch needs shear and pulls where only pushes can be, and leaves the markers off. Its push is no sign of anything: it is
what a press is. But its loss, too, changes with the prestretch, up or down with the force, its area and `p0`: it is not
counted. A solve from rest may also end beside the least loss at one prestretch and not at the next; so the least at each is
looked for from those at its neighbours, too.
"""

import torch

from ..estimators.base import Equilibrium, Observation
from ..estimators.force_balance.estimator import ForceBalance
from ..estimators.force_balance.gauss_newton import State
from ..progress import Progress, silent

STEPS = 4  # from a neighbour's solution

Explained = tuple[ForceBalance, Equilibrium]


def continued(solutions: list[Explained], observation: Observation, progress: Progress = silent) -> list[Explained]:
    """The solutions at increasing prestretches, each the better one of itself and what its neighbours' lead to, upwards and
    then downwards."""
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
    """Of each press `own`, or what some steps from the `neighbour`'s solution end at, if that has converged to less."""
    (estimator, found), (other, near) = own, neighbour
    measured = estimator.equations.bearings.measured(observation)
    start = State(
        near.vertices - estimator.membrane.rest, near.pressure * (estimator.rest_pressure / other.rest_pressure), near.moved
    )
    state: State
    with torch.no_grad():
        state, before = estimator.gauss_newton(start, measured, estimator.schedule()[-1:] * STEPS)
        tried = estimator.equilibrium(*state, before, measured)
    lower = estimator.is_converged(tried) & (tried.objective < found.objective)
    rows = (torch.where(lower.reshape(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in zip(tried, found, strict=True))
    return estimator, Equilibrium(*rows)
