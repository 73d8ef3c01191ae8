"""Checked access to the tables of a TOML file, and a writer for such tables.

Every message names the file, the table, the key, the value found and what was expected.
"""

import glob
import json
import math
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from ..files.safe_read import lies_within, printable, read_text, shortened
from ..files.system_files import is_of_system
from .suggestions import did_you_mean

MOST_BYTES, LONGEST_LINE = 2**15, 2000
"""Largest file (bytes) and longest line (characters): parsing time grows as the square of a line's length."""
MOST_FILES = 1000
"""Largest number of files that one key may name."""
LARGEST = 1e300
"""Largest whole number."""
DEEPEST = 8
"""Deepest nesting of tables and lists."""
EXPECTED = "a sensor file in TOML"


class Table:
    """One table of a TOML file, whose methods return checked values by key or raise a `MembraneError`.

    Args:
        path: path of the file.
        name: dotted name of the table; empty for the top level of the file.
        values: the table's values by key.

    Example:
        >>> table = Table(Path("sensor.toml"), "material", {"prestretch": "1.2"})
        >>> table.number("prestretch")
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: sensor.toml: [material] prestretch = "1.2"; expected a finite number
    """

    def __init__(self, path: Path, name: str, values: Mapping[str, Any]) -> None:
        self.path, self.name, self.values = path, name, values

    @classmethod
    def from_file(cls, path: Path) -> "Table":
        """Read a file and return its top-level table."""
        text = read_text(path, MOST_BYTES, EXPECTED)
        if (longest := max(map(len, text.split("\n")))) > LONGEST_LINE:
            raise MembraneError(f"{path}: a line of {longest} characters; expected {EXPECTED}, lines of at most {LONGEST_LINE}")
        try:
            values = tomllib.loads(text)
        except ValueError as error:
            cause = str(error).replace("at end of document", f"at line {len(text.splitlines())}, the last")
            raise MembraneError(f"{path}: not valid TOML: {cause}; correct that line") from error
        except RecursionError as error:
            raise MembraneError(_too_deep(path)) from error
        return cls(path, "", _plain(path, values))

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def where(self, key: str = "") -> str:
        """Return file, table and key as the beginning of a message."""
        key = key if key.isidentifier() else _said(key) if key else ""
        return " ".join(part for part in (f"{self.path}:", f"[{self.name}]" if self.name else "", key) if part)

    def refuse(self, key: str, expected: str) -> MembraneError:
        """Return the error for a value that differs from what was expected."""
        return MembraneError(f"{self.where(key)} = {_said(self.values[key])}; expected {expected}")

    @contextmanager
    def naming(self, key: str = "") -> Iterator[None]:
        """Prefix the messages of errors raised in this context with file, table and key, unless they begin with the file."""
        try:
            yield
        except MembraneError as error:
            if str(error).startswith(f"{self.path}:"):
                raise
            shown = f" = {_said(self.values[key])}" if key in self else ""
            raise MembraneError(f"{self.where(key)}{shown}: {error}") from error

    def allow(self, keys: Iterable[str], owner: str = "here") -> None:
        """Raise an error for a key that is not among `keys`, and suggest the closest one."""
        keys = list(keys)
        for key in self.values:
            if key not in keys:
                remedy = did_you_mean(key, keys, "remove it")
                raise MembraneError(f"{self.where(key)} is unknown {owner}; expected {', '.join(keys)}; {remedy}")

    def table(self, key: str) -> "Table":
        """Return the subtable of this name."""
        name = f"{self.name}.{key}" if self.name else key
        return Table(self.path, name, self._get(key, _is_table, f"a table [{name}]"))

    def tables(self, key: str) -> list["Table"]:
        """Return the tables of an array of tables, `[[key]]`; an empty list if the key is missing."""
        if key not in self:
            return []
        name = f"{self.name}.{key}" if self.name else key
        values = self._get(key, _are_tables, f"tables [[{name}]]")
        return [Table(self.path, f"{name}[{i}]", value) for i, value in enumerate(values)]

    def text(self, key: str, choices: Iterable[str] = ()) -> str:
        """Return a non-empty text, which must be one of `choices` if any are given."""
        choices = tuple(choices)
        meant = did_you_mean(self.values.get(key), choices)
        expected = (" or ".join(map(_shown, choices)) or "text in quotes") + (meant and f": {meant}")

        def right(value: object) -> bool:
            return isinstance(value, str) and value != "" and (not choices or value in choices)

        value: str = self._get(key, right, expected)
        return value

    def number(self, key: str) -> float:
        """Return a finite number."""
        return float(self._get(key, _finite, "a finite number"))

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """Return a list of finite numbers, whose length must be `count` if that is given."""
        return [float(value) for value in self._list(key, count, _finite, "finite")]

    def date(self, key: str) -> date:
        """Return a date, written as a TOML date or as text in quotes."""
        value = self._get(key, lambda value: _day(value) is not None, "a day as 2026-09-27")
        return _day(value) or value

    def whole_number(self, key: str) -> int:
        """Return a whole number."""
        value: int = self._get(key, _whole, "a whole number")
        return value

    def whole_numbers(self, key: str, count: int) -> list[int]:
        """Return a list of `count` whole numbers."""
        return self._list(key, count, _whole, "whole")

    def whole_pair(self, key: str) -> list[int]:
        """Return two whole numbers; a single number is used for both."""

        def right(value: object) -> bool:
            return _whole(value) or _is_list(value, 2, _whole)

        value = self._get(key, right, "a whole number, or a list of 2")
        return value if isinstance(value, list) else [value, value]

    def rotation(self, key: str) -> list[Any]:
        """Return a rotation: a matrix as three rows of three numbers, or a rotation vector of three numbers."""

        def right(value: object) -> bool:
            return _is_list(value, 3, _finite) or _is_list(value, 3, lambda row: _is_list(row, 3, _finite))

        value: list[Any] = self._get(key, right, "three rows of three finite numbers, or a rotation vector of three, degrees")
        return value

    def matrix(self, key: str, count: int) -> list[list[float]]:
        """Return a square matrix of finite numbers as a list of `count` rows."""

        def right(value: object) -> bool:
            return _is_list(value, count, lambda row: _is_list(row, count, _finite))

        value: list[list[float]] = self._get(key, right, f"{count} rows of {count} finite numbers")
        return value

    def file(self, key: str) -> Path:
        """Return the path of the file that `key` names; it must lie in this file's folder or below."""
        return self._named(key, [self.text(key)])[0]

    def files(self, key: str) -> list[Path]:
        """Return the paths of the files that `key` names (a name, a list or patterns), in this file's folder or below."""
        names = self._get(key, _is_names, "a file, or a list of files, in quotes")
        return self._named(key, [names] if isinstance(names, str) else names)

    def named_files(self) -> list[Path]:
        """Return the existing files that any text in this table or its subtables names."""
        names = [name for name in _texts(self.values) if lies_within(name)]
        patterns = [f"{glob.escape(str(self.path.parent))}/{name if '*' in name else glob.escape(name)}" for name in names]
        return [Path(match) for pattern in patterns for match in sorted(glob.glob(pattern)) if os.path.isfile(match)]

    def _named(self, key: str, names: Iterable[str]) -> list[Path]:
        folder, paths = self.path.parent, []
        for name in names:
            if not lies_within(name):
                raise self.refuse(key, "a path relative to the sensor file, of a file in its folder or below: copy it there")
            matches = map(Path, glob.glob(f"{glob.escape(str(folder))}/{name}"))
            found = sorted(path for path in matches if not is_of_system(path)) if "*" in name else [folder / name]
            if not found or not all(map(_is_file, found)):
                raise self.refuse(
                    key, f"a file; there is none at {printable(folder / name)}: paths are relative to the sensor file"
                )
            paths += found
        if len(paths) > MOST_FILES:
            raise self.refuse(key, f"at most {MOST_FILES} files; these are {len(paths)}")
        return paths

    def _list(self, key: str, count: int | None, right: Callable[[object], bool], kind: str) -> list[Any]:
        expected = f"a list of {'' if count is None else f'{count} '}{kind} numbers"
        values: list[Any] = self._get(key, lambda values: _is_list(values, count, right), expected)
        return values

    def _get(self, key: str, right: Callable[[object], bool], expected: str) -> Any:
        if key not in self:
            raise MembraneError(f"{self.where(key)} is missing; expected {expected}: add it")
        if not right(self.values[key]):
            raise self.refuse(key, expected)
        return self.values[key]


def toml_lines(name: str, values: Mapping[str, object], repeated: bool = False) -> list[str]:
    """Format a table as lines of TOML.

    Args:
        name: dotted name of the table; empty for the top level of the file.
        values: texts, numbers and lists of numbers by key; keys whose value is None are left out.
        repeated: whether the table is an element of an array of tables, `[[name]]`.

    Returns:
        The lines, the table's header first.

    Example:
        >>> toml_lines("cavity", {"filling": "gas", "pressure": np.float64(1013.0), "volume": None})
        ['[cavity]', 'filling = "gas"', 'pressure = 1013.0']
    """
    head = [f"[[{name}]]" if repeated else f"[{name}]"] if name else []
    return head + [f"{key} = {_shown(value)}" for key, value in values.items() if value is not None]


def _shown(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, date):
        return value.isoformat()
    return repr(value.item() if isinstance(value, np.generic) else value)


def _plain(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a file; raise an error if it is nested too deeply or has an integer of more than 300 digits."""
    level: list[Any] = [values]
    for _ in range(DEEPEST + 1):
        if any(isinstance(value, int) and abs(value) > LARGEST for value in level):
            raise MembraneError(f"{path}: a whole number of more than 300 digits; expected {EXPECTED}, of a real sensor")
        nested = [value.values() if isinstance(value, dict) else value for value in level if isinstance(value, dict | list)]
        level = [value for values in nested for value in values]
    if level:
        raise MembraneError(_too_deep(path))
    return values


def _too_deep(path: Path) -> str:
    return f"{path}: tables or lists within one another on more than {DEEPEST} levels; expected {EXPECTED}, which needs four"


def _said(value: object) -> str:
    """Format a value for a message: on one line, shortened if it is long."""
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in shortened(_shown(value)))


def _is_file(path: Path) -> bool:
    """Return whether something of that name exists; if it is not a file, reading it raises the error."""
    try:
        return path.exists()
    except OSError:
        return False


def _texts(value: object) -> Iterator[str]:
    """Yield all texts in nested tables and lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts(each)


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _day(value: object) -> date | None:
    """Convert a value to a date; return None if it is not one."""
    try:
        return date.fromisoformat(str(value)) if isinstance(value, str | date) else None
    except ValueError:
        return None


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_list(values: object, count: int | None, right: Callable[[object], bool]) -> bool:
    return isinstance(values, list) and len(values) == (count or len(values)) and all(map(right, values))


def _is_names(value: object) -> bool:
    names = [value] if isinstance(value, str) else value
    return isinstance(names, list) and len(names) > 0 and all(isinstance(name, str) and name for name in names)


def _is_table(value: object) -> bool:
    return isinstance(value, dict)


def _are_tables(values: object) -> bool:
    return isinstance(values, list) and all(map(_is_table, values))
