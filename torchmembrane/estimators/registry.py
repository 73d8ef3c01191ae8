"""Registry of the estimators by name: those of this package, registered ones, and those of installed packages."""

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from ..errors import MembraneError, expect
from ..sensor.sensor import Sensor
from ..sensor.suggestions import did_you_mean
from .base import Estimator, Problem
from .force_balance.estimator import ForceBalance
from .minimum_energy.estimator import MinimumEnergy
from .paper.estimator import PaperEstimator

GROUP = "torchmembrane.estimators"
"""Group of the entry points by which installed packages register estimators."""
ESTIMATORS: dict[str, type[Estimator]] = {
    "force-balance": ForceBalance,
    "minimum-energy": MinimumEnergy,
    "paper": PaperEstimator,
}
PROTOCOL = ("Settings", "from_problem", "prepare", "forward", "is_converged")
"""Members that a subclass of `Estimator` must define."""


def register_estimator(name: str, kind: type[Estimator]) -> None:
    """Register an estimator under a name for `Reconstructor` and the command line's `--estimator`, in this process.

    An installed package registers its estimators for all processes by entry points of the group `torchmembrane.estimators`.

    Args:
        name: name of the estimator, of letters, digits, hyphens and underscores; it must not begin with a digit.
        kind: a subclass of `Estimator`.

    Raises:
        MembraneError: the name belongs to another class or has other characters, or the class lacks a part of the protocol.

    Example:
        >>> import torchmembrane as tm
        >>> register_estimator("force-balance", tm.ForceBalance)  # again: nothing changes
        >>> register_estimator("paper", tm.ForceBalance)
        Traceback (most recent call last):
        torchmembrane.errors.MembraneError: register_estimator: 'paper' is PaperEstimator's; expected another name
    """
    if not name.replace("-", "_").isidentifier():
        raise MembraneError(
            f"register_estimator: name = {name!r}; expected letters, digits, hyphens and underscores, without a digit at the "
            "beginning"
        )
    check_protocol(kind, f"register_estimator: {name!r}")
    if ESTIMATORS.setdefault(name, kind) is not kind:
        raise MembraneError(f"register_estimator: {name!r} is {ESTIMATORS[name].__qualname__}'s; expected another name")


def estimator_kind(given: str | type[Estimator]) -> tuple[str, type[Estimator]]:
    """Return the name and the class of an estimator.

    Args:
        given: a name, `MODULE:CLASS`, or the class. The name of a class that is not registered is `MODULE:CLASS`.

    Raises:
        MembraneError: the name is unknown, the module or class does not exist, or the class lacks a part of the protocol.

    Example:
        >>> estimator_kind("torchmembrane.estimators.paper.estimator:PaperEstimator")[0]
        'paper'
    """
    if isinstance(given, str) and ":" not in given:
        return given, _named(given)
    kind = _imported(given) if isinstance(given, str) else given
    check_protocol(kind, f"Reconstructor: estimator = {given!r}")
    registered = (name for name, other in ESTIMATORS.items() if other is kind)
    return next(registered, f"{kind.__module__}:{kind.__qualname__}"), kind


def check_protocol(kind: Any, given: str) -> None:
    """Refuse an object that is not a class with the protocol of an estimator.

    Args:
        kind: the object to check.
        given: its name in error messages.

    Raises:
        MembraneError: it is not a class, or lacks parts of the protocol, which the message names.
    """
    if not isinstance(kind, type):
        raise MembraneError(f"{given} is not a class; expected a subclass of torchmembrane.Estimator")
    lacking = [] if issubclass(kind, Estimator) else ["the base class torchmembrane.Estimator"]
    lacking += [part for part in PROTOCOL if not _defines(kind, part)]
    settings = getattr(kind, "Settings", None)
    if settings is not None and not getattr(getattr(settings, "__dataclass_params__", None), "frozen", False):
        lacking.append("@dataclass(frozen=True) at Settings")
    if lacking:
        raise MembraneError(f"{given} lacks {', '.join(lacking)}; see torchmembrane.Estimator for what a subclass must define")


def refuse_unfit(sensor: Sensor, name: str, kind: type[Estimator]) -> None:
    """Refuse a sensor that an estimator does not support.

    Args:
        sensor: the sensor.
        name: name of the estimator, for messages.
        kind: class of the estimator.

    Raises:
        MembraneError: the estimator does not support several views, or markers at a distance from the surface.
    """
    views, markers = max(1, len(sensor.views)), sensor.markers
    expected = "1, as of sensor.in_view(0), or force-balance"
    expect(views == 1 or kind.takes_views, f"Reconstructor: views for {name}", views, expected)
    expected = "0, markers on the surface, or force-balance"
    right = kind.takes_heights or not markers.stand_off
    expect(right, f"Reconstructor: height of the markers for {name}", markers.height, expected)


def built_estimator(problem: Problem, name: str, kind: type[Estimator], settings: Any = None) -> Estimator:
    """Build the estimator for a sensor.

    Args:
        problem: description of the sensor.
        name: name of the estimator.
        kind: class of the estimator.
        settings: settings of that class; None for its defaults.

    Raises:
        MembraneError: the settings are those of another estimator.
    """
    if settings is not None and not isinstance(settings, kind.Settings):
        raise MembraneError(
            f"Reconstructor: settings are {type(settings).__name__}; expected {kind.Settings.__name__} for {name}"
        )
    built = kind.from_problem(problem, settings)
    built.name = name
    return built


def _named(name: str) -> type[Estimator]:
    """Return the estimator with this name, registering it if it comes from an installed package."""
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    points = entry_points(group=GROUP)
    values = {f"{point.module}:{point.attr}" for point in points if point.name == name}
    if len(values) > 1:
        raise MembraneError(f"estimator {name!r}: installed packages have {', '.join(sorted(values))}; expected MODULE:CLASS")
    if not values:
        names = list(dict.fromkeys([*ESTIMATORS, *sorted(point.name for point in points)]))
        meant = did_you_mean(name, names, "`register_estimator` adds a class under a name")
        raise MembraneError(f"Reconstructor: estimator = {name!r}; expected one of {', '.join(names)} or MODULE:CLASS; {meant}")
    register_estimator(name, _imported(values.pop()))
    return ESTIMATORS[name]


def _imported(path: str) -> Any:
    """Import `MODULE:CLASS`."""
    name, _, member = path.partition(":")
    try:
        module = import_module(name)
    except (ImportError, ValueError) as error:
        raise MembraneError(
            f"estimator {path!r}: the module {name!r} cannot be imported ({error}); expected MODULE:CLASS, of a module in the "
            "current directory or of an installed package"
        ) from error
    if not hasattr(module, member):
        where = getattr(module, "__file__", None) or name
        raise MembraneError(f"estimator {path!r}: no {member!r} in {where}; expected MODULE:CLASS, a class of that module")
    return getattr(module, member)


def _defines(kind: type, part: str) -> bool:
    """Return whether a class or one of its bases, other than `Estimator` and its bases, defines this part of the protocol."""
    return any(part in vars(base) for base in kind.__mro__ if base not in Estimator.__mro__)
