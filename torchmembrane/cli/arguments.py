"""Arguments shared by several commands, and argument types that convert a text to a value or state what was expected."""

import math
import re
from argparse import Action, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from ..errors import MembraneError
from .choices import ENERGIES, ESTIMATORS, FLOWS, LOCATORS

Add: TypeAlias = Callable[..., Action]
"""The type of a parser's `add_argument`."""


def add_command(commands: Any, name: str, run: Callable[..., int], purpose: str, examples: str, *aliases: str) -> Add:
    """Add the parser of a command.

    Args:
        commands: object returned by `add_subparsers`.
        name: name of the command.
        run: function called with the parsed arguments; it returns the exit code.
        purpose: one line, without a capital letter or a full stop.
        examples: text shown below the options.
        *aliases: other names of the command.

    Returns:
        The parser's `add_argument`.
    """
    parser = commands.add_parser(
        name,
        aliases=aliases,
        help=purpose,
        description=purpose[0].upper() + purpose[1:] + ".",
        epilog=examples,
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    add: Add = parser.add_argument
    return add


def add_sensor(add: Add) -> None:
    """Add the argument of the sensor file."""
    add("sensor", metavar="SENSOR.toml", help="the sensor file, or preset:NAME")


def add_estimator(add: Add) -> None:
    """Add the options that choose how the markers and the surface are found."""
    named = f"{', '.join(ESTIMATORS)}, the name of an installed estimator, or MODULE:CLASS for your own"
    add("--estimator", metavar="NAME", default=ESTIMATORS[0], help=f"how the surface is found: {named} (default: %(default)s)")
    add("--energy", choices=ENERGIES, help="the membrane's elastic energy (default: the sensor file's)")
    add(
        "--flow",
        choices=FLOWS,
        help="interpolation of the markers' displacements in the image, of the estimator paper only (default: bilinear)",
    )
    add(
        "--smoothing",
        metavar="S",
        type=positive,
        help="weight of the smoother (eq. 28 of the paper), of the estimator paper only (default: 0.1)",
    )
    how = "how markers are found: by least-squares fit or by soft-argmax (default: soft for paper, else fit)"
    add("--locator", choices=LOCATORS, help=how)


def add_force(add: Add) -> None:
    """Add the option that allows existing files to be overwritten."""
    add("--force", action="store_true", help="overwrite existing files, but never those that the command reads")


def add_device(add: Add) -> None:
    """Add the option that chooses where torch computes."""
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute (default: %(default)s)")


def check_device(device: str) -> None:
    """Refuse a device that torch cannot use on this machine.

    Raises:
        MembraneError: CUDA is requested and not available.
    """
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise MembraneError("--device cuda: torch sees no CUDA device; pass --device cpu, or install torch with CUDA")


def add_rerun(add: Add) -> None:
    """Add the options that show frames in the Rerun viewer."""
    add("--rerun", action="store_true", help='show image, surface, contacts, wrench and pressure in Rerun (extra "rerun")')
    add("--save", metavar="FILE.rrd", type=Path, help="with --rerun: write this file instead of opening the viewer")


def wants_rerun(arguments: Namespace) -> bool:
    """Return whether `--rerun` was given.

    Raises:
        MembraneError: `--save` was given without `--rerun`.
    """
    if arguments.save is not None and not arguments.rerun:
        raise MembraneError(f"--save {arguments.save}: this option writes a file for Rerun; expected --rerun with it")
    given: bool = arguments.rerun
    return given


def positive(text: str) -> float:
    """Return a positive number.

    >>> positive("0.5")
    0.5
    """
    value: float = _values(text, float, 1, "a positive number")[0]
    if not value > 0:
        raise ArgumentTypeError(f"{text!r}; expected a positive number")
    return value


NEWTONS = {"N": 1.0, "mN": 1e-3, "kg": 9.80665, "g": 9.80665e-3}


def weight(text: str) -> float:
    """Return a force, N, from a weight with its unit.

    >>> weight("2N"), round(weight("200 g"), 4)
    (2.0, 1.9613)
    """
    unit = next((unit for unit in ("mN", "N", "kg", "g") if text.strip().endswith(unit)), None)
    if unit is None:
        raise ArgumentTypeError(f"{text!r}; expected a weight with its unit, {', '.join(NEWTONS)}, as 200g")
    return positive(text.strip().removesuffix(unit).strip()) * NEWTONS[unit]


def number_from(least: float, most: float, expected: str = "a number") -> Callable[[str], float]:
    """Return the argument type of a number within bounds.

    >>> number_from(0, 1)("0.5")
    0.5
    """
    said = f"{expected} from {least:g} to {most:g}"

    def within(text: str) -> float:
        value: float = _values(text, float, 1, said)[0]
        if not least <= value <= most:
            raise ArgumentTypeError(f"{text!r}; expected {said}")
        return value

    return within


def camera(text: str) -> int | str:
    """Return the number of a camera, or the path or address of its stream.

    >>> camera("0"), camera("/dev/video0")
    (0, '/dev/video0')
    """
    return int(text) if text.isdecimal() else text


def of_each_view(option: str, kind: str, given: Sequence[str], views: Sequence[str]) -> list[str]:
    """Return the value of a repeatable option VIEW=... for each view, in the order of the views; for a single view, its value.

    Args:
        option: name of the option, such as `--camera`.
        kind: kind of its value, such as `NUMBER`.
        given: texts given for the option.
        views: names of the views with images of their own; empty for a single view, or for regions of one image.

    Raises:
        MembraneError: a view has no value or more than one, or the name of a view is unknown.

    Example:
        >>> of_each_view("--camera", "NUMBER", ["right=2", "left=0"], ["left", "right"])
        ['0', '2']
    """
    if not views:
        if len(given) > 1:
            raise MembraneError(f"{option} {' '.join(given)}: {len(given)} of one camera; expected one {kind}")
        return list(given)
    named = dict(text.partition("=")[::2] for text in given)
    if given and (len(given) != len(views) or set(named) != set(views)):
        expected = " ".join(f"{option} {view}={kind}" for view in views)
        raise MembraneError(f"{option} {' '.join(given)}: a sensor of several views; expected {expected}")
    return [named[view] for view in views if given]


def file_name(text: str) -> str:
    """Return a name for files in an output folder, which must not lead out of the folder or be hidden.

    >>> file_name("press 1")
    'press 1'
    """
    if not re.fullmatch(r"(?!\.)[^/\\:*?\"<>|]{1,100}", text) or not text.isprintable():
        raise ArgumentTypeError(f"{text!r}; expected a file's name of at most 100 characters, without folder")
    return text


def count(text: str) -> int:
    """Return a whole number of at least 1."""
    if not re.fullmatch(r"[0-9]{1,12}", text) or int(text) < 1:
        raise ArgumentTypeError(f"{text[:40]!r}; expected a whole number, 1 or more, of at most 12 digits")
    return int(text)


def count_or_auto(text: str) -> int | None:
    """Return a whole number of at least 1, or None for auto."""
    return None if text == "auto" else count(text)


def share(text: str) -> tuple[int, int]:
    """Return I and N of the I-th of N parts, written I/N.

    >>> share("2/8")
    (2, 8)
    """
    number, _, total = text.partition("/")
    if not (number.isdigit() and total.isdigit() and 1 <= int(number) <= int(total)):
        raise ArgumentTypeError(f"{text!r}; expected I/N, I from 1 to N, as 2/8")
    return int(number), int(total)


def seed(text: str) -> int:
    """Return a whole number of at least 0."""
    return 0 if text == "0" else count(text)


def vector(text: str) -> list[float]:
    """Return three numbers, written X,Y,Z.

    >>> vector("0.5,0,-1")
    [0.5, 0.0, -1.0]
    """
    return _values(text, float, 3, "three numbers X,Y,Z")


def positive_pair(expected: str) -> Callable[[str], list[float]]:
    """Return the argument type of two positive numbers; `expected` describes them in an error."""
    return lambda text: _values(text, positive, 2, expected)


def count_pair(expected: str, most: int = 1000) -> Callable[[str], list[int]]:
    """Return the argument type of two whole numbers of at least 1; `expected` describes them in an error.

    >>> count_pair("two counts, COLUMNS,ROWS")("11,8")
    [11, 8]
    """

    def pair(text: str) -> list[int]:
        values = _values(text, count, 2, expected)
        if max(values) > most:
            raise ArgumentTypeError(f"{text!r}; expected {expected}, each at most {most}")
        return values

    return pair


def numbers(expected: str) -> Callable[[str], list[int]]:
    """Return the argument type of one or more whole numbers; `expected` describes them in an error."""
    return lambda text: _values(text, int, None, expected)


def some_of(choices: tuple[str, ...], expected: str) -> Callable[[str], list[str]]:
    """Return the argument type of some of the choices, in any order, with repetitions; `expected` describes them in an
    error."""

    def chosen(text: str) -> list[str]:
        parts = text.split(",")
        if not set(parts) <= set(choices):
            raise ArgumentTypeError(f"{text!r}; expected {expected}")
        return parts

    return chosen


def _values(text: str, kind: Callable[[str], Any], number: int | None, expected: str) -> list[Any]:
    try:
        values = [kind(part) for part in text.split(",")]
    except (ValueError, ArgumentTypeError):
        values = []
    if not values or not all(map(math.isfinite, values)) or (number and len(values) != number):
        raise ArgumentTypeError(f"{text!r}; expected {expected}")
    return values


def pressure(text: str) -> float:
    """Return a pressure, hPa, from a number with its unit."""
    from ..presets.draft import PRESSURE_UNITS, pressure_in_hectopascal

    try:
        return pressure_in_hectopascal(text)
    except ValueError:
        raise ArgumentTypeError(f"{text!r}; expected a number and its unit, of {', '.join(PRESSURE_UNITS)}, as 20hPa") from None
