"""The reconstructor that a command's options ask for."""

from argparse import Namespace
from typing import Any

from ..errors import MembraneError
from ..estimators.registry import ESTIMATORS
from ..reconstruct import Reconstructor
from ..sensor.sensor import Sensor

OPTIONS = ("flow", "smoothing", "pressure_noise")


def build_reconstructor(sensor: Sensor, arguments: Namespace) -> Reconstructor:
    """The reconstructor of `--estimator`, `--energy`, `--flow`, `--smoothing`, `--pressure-noise` and `--locator`.

    Raises:
        MembraneError: an option that the estimator does not have.
    """
    kind: Any = ESTIMATORS[arguments.estimator].Settings
    given = {name: getattr(arguments, name) for name in OPTIONS if getattr(arguments, name, None) is not None}
    foreign = [name for name in given if name not in kind.__dataclass_fields__]
    if foreign:
        fitting = next(name for name, other in ESTIMATORS.items() if foreign[0] in other.Settings.__dataclass_fields__)
        raise MembraneError(
            f"--{foreign[0].replace('_', '-')} {given[foreign[0]]}: {arguments.estimator} has no such choice; leave it out, or "
            f"pass --estimator {fitting}"
        )
    options: Any = {"settings": kind(**given), "model": arguments.energy, "locator": arguments.locator}
    try:
        return Reconstructor(sensor, arguments.estimator, **options)
    except MembraneError as error:
        raise MembraneError(f"{arguments.sensor}: {error}") from error
