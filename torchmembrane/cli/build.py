"""Construction of the reconstructor from a command's options."""

import os
import sys
from argparse import Namespace
from dataclasses import fields
from typing import Any

from ..errors import MembraneError
from ..estimators.registry import ESTIMATORS, estimator_kind
from ..reconstruct import Reconstructor
from ..sensor.sensor import Sensor

OPTIONS = ("flow", "smoothing", "pressure_noise")


def build_reconstructor(sensor: Sensor, arguments: Namespace) -> Reconstructor:
    """Return the reconstructor for `--estimator`, `--energy`, `--flow`, `--smoothing`, `--pressure-noise` and `--locator`.

    An estimator MODULE:CLASS is first searched in the current directory.

    Raises:
        MembraneError: the estimator does not exist, or does not have one of the options.
    """
    if ":" in arguments.estimator and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # and stays there: worker processes import the module as well
    _, kind = estimator_kind(arguments.estimator)
    known = {field.name for field in fields(kind.Settings)}
    given = {name: getattr(arguments, name) for name in OPTIONS if getattr(arguments, name, None) is not None}
    foreign = [name for name in given if name not in known]
    if foreign:
        fitting = next(name for name, other in ESTIMATORS.items() if foreign[0] in other.Settings.__dataclass_fields__)
        raise MembraneError(
            f"--{foreign[0].replace('_', '-')} {given[foreign[0]]}: {arguments.estimator} has no such choice; leave it out, or "
            f"pass --estimator {fitting}"
        )
    options: Any = {"settings": kind.Settings(**given), "model": arguments.energy, "locator": arguments.locator}
    try:
        return Reconstructor(sensor, arguments.estimator, **options)
    except MembraneError as error:
        raise MembraneError(f"{arguments.sensor}: {error}") from error
