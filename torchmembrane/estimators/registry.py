"""The estimators by their names."""

from typing import Any

from ..errors import MembraneError
from .base import Problem
from .force_balance.estimator import ForceBalance
from .force_balance.settings import ForceBalanceSettings
from .minimum_energy.estimator import MinimumEnergy, MinimumEnergySettings
from .paper.estimator import PaperEstimator, PaperSettings

AnyEstimator = ForceBalance | MinimumEnergy | PaperEstimator
Settings = ForceBalanceSettings | MinimumEnergySettings | PaperSettings
ESTIMATORS: dict[str, type[ForceBalance] | type[MinimumEnergy] | type[PaperEstimator]] = {
    "force-balance": ForceBalance,
    "minimum-energy": MinimumEnergy,
    "paper": PaperEstimator,
}


def estimator_of(problem: Problem, name: str, settings: Settings | None) -> AnyEstimator:
    """The estimator of that name; refuses settings of another one."""
    kind: Any = ESTIMATORS[name]
    if settings is not None and not isinstance(settings, kind.Settings):
        raise MembraneError(
            f"Reconstructor: settings are {type(settings).__name__}; expected {kind.Settings.__name__} for {name}"
        )
    built: AnyEstimator = kind.of(problem, settings)
    return built
