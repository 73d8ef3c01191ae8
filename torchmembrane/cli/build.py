"""The reconstructor that a command's options ask for."""

from argparse import Namespace

from ..errors import MembraneError
from ..estimators.settings import MinimumEnergySettings
from ..reconstruct import Reconstructor
from ..sensor.sensor import Sensor


def build_reconstructor(sensor: Sensor, arguments: Namespace) -> Reconstructor:
    """The reconstructor of `--estimator`, `--energy` and `--element`.

    Raises:
        MembraneError: an element that the estimator does not have.
    """
    settings = None
    if arguments.estimator == "minimum-energy":
        settings = MinimumEnergySettings(element=arguments.element)
    elif arguments.element != "triangle":
        raise MembraneError(
            f"--element {arguments.element}: {arguments.estimator} has linear triangles; "
            "leave it out, or pass --estimator minimum-energy"
        )
    return Reconstructor(sensor, arguments.estimator, settings=settings, model=arguments.energy)
