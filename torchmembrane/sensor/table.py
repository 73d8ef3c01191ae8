"""Checked access to the tables of a TOML file, and the few kinds of lines needed to write one.

Every message names the file, the table and key, the value that came and what was expected.
"""

import glob
import json
import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from .synonyms import did_you_mean


class Table:
    """One table of a TOML file: typed, finite values by key, or a `MembraneError` that says where and what.

    Args:
        path: the file.
        name: of the table, dotted; empty for the file itself.
        values: by key.

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
        """The table of a whole file."""
        try:
            text = path.read_text(encoding="utf-8")
            return cls(path, "", tomllib.loads(text))
        except FileNotFoundError:
            raise MembraneError(f"{path}: no such file; expected a sensor file, check the path") from None
        except UnicodeDecodeError as error:
            raise MembraneError(f"{path}: not UTF-8 text ({error}); expected a TOML file saved as UTF-8") from error
        except OSError as error:
            raise MembraneError(f"{path}: not readable ({error.strerror}); expected a sensor file") from error
        except tomllib.TOMLDecodeError as error:
            cause = str(error).replace("at end of document", f"at line {len(text.splitlines())}, the last")
            raise MembraneError(f"{path}: not valid TOML: {cause}; correct that line") from error

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def where(self, key: str = "") -> str:
        """File, table and key, as messages begin."""
        return " ".join(part for part in (f"{self.path}:", f"[{self.name}]" if self.name else "", key) if part)

    def refuse(self, key: str, expected: str) -> MembraneError:
        """The error for a value that is not what was expected."""
        return MembraneError(f"{self.where(key)} = {_shown(self.values[key])}; expected {expected}")

    @contextmanager
    def naming(self, key: str = "") -> Iterator[None]:
        """Put file, table and key before the message of whatever is refused inside."""
        try:
            yield
        except MembraneError as error:
            shown = f" = {_shown(self.values[key])}" if key in self else ""
            raise MembraneError(f"{self.where(key)}{shown}: {error}") from error

    def allow(self, keys: Iterable[str], owner: str = "here") -> None:
        """Refuse keys other than these, suggesting the closest."""
        keys = list(keys)
        for key in self.values:
            if key not in keys:
                remedy = did_you_mean(key, keys, "remove it")
                raise MembraneError(f"{self.where(key)} is unknown {owner}; expected {', '.join(keys)}; {remedy}")

    def table(self, key: str) -> "Table":
        """The table within this one."""
        name = f"{self.name}.{key}" if self.name else key
        return Table(self.path, name, self._get(key, _is_table, f"a table [{name}]"))

    def tables(self, key: str) -> list["Table"]:
        """The tables of a list of them, `[[key]]`; none if there are none."""
        if key not in self:
            return []
        values = self._get(key, _are_tables, f"tables [[{self.name}.{key}]]")
        return [Table(self.path, f"{self.name}.{key}[{i}]", value) for i, value in enumerate(values)]

    def text(self, key: str, choices: Iterable[str] = ()) -> str:
        """Text that is not empty; one of `choices` where they are given."""
        choices = tuple(choices)
        meant = did_you_mean(self.values.get(key), choices)
        expected = (" or ".join(map(_shown, choices)) or "text in quotes") + (meant and f": {meant}")

        def right(value: object) -> bool:
            return isinstance(value, str) and value != "" and (not choices or value in choices)

        value: str = self._get(key, right, expected)
        return value

    def number(self, key: str) -> float:
        """A finite number."""
        return float(self._get(key, _finite, "a finite number"))

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """A list of finite numbers, `count` of them where that is given."""
        return [float(value) for value in self._list(key, count, _finite, "finite")]

    def whole_numbers(self, key: str, count: int) -> list[int]:
        """A list of `count` whole numbers."""
        return self._list(key, count, _whole, "whole")

    def whole_pair(self, key: str) -> list[int]:
        """Two whole numbers; one stands for both."""

        def right(value: object) -> bool:
            return _whole(value) or _is_list(value, 2, _whole)

        value = self._get(key, right, "a whole number, or a list of 2")
        return value if isinstance(value, list) else [value, value]

    def rotation(self, key: str) -> list[Any]:
        """The numbers of a rotation: three rows of three, or three of a rotation vector."""

        def right(value: object) -> bool:
            return _is_list(value, 3, _finite) or _is_list(value, 3, lambda row: _is_list(row, 3, _finite))

        value: list[Any] = self._get(key, right, "three rows of three finite numbers, or a rotation vector of three, degrees")
        return value

    def file(self, key: str) -> Path:
        """The path of the file that `key` names, relative to this file's folder."""
        path = self.path.parent / self.text(key)
        if not path.is_file():
            raise self.refuse(key, f"a file; there is none at {path}: paths are relative to the sensor file")
        return path

    def files(self, key: str) -> list[Path]:
        """The paths of the files that `key` names: one, a list, or patterns with `*`, relative to this file's folder."""
        names = self._get(key, _is_names, "a file, or a list of files, in quotes")
        paths: list[Path] = []
        for name in [names] if isinstance(names, str) else names:
            pattern = name if Path(name).is_absolute() else f"{glob.escape(str(self.path.parent))}/{name}"
            found = sorted(map(Path, glob.glob(pattern))) if "*" in name else [self.path.parent / name]
            if not found or not all(path.is_file() for path in found):
                where = self.path.parent / name
                raise self.refuse(key, f"a file; there is none at {where}: paths are relative to the sensor file")
            paths += found
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
    """A table as lines of TOML.

    Args:
        name: of the table, dotted; empty for the file itself.
        values: text, numbers and lists of numbers by key; keys that are None are left out.
        repeated: one of a list of tables.

    Returns:
        The lines, the table's head first.

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
    return repr(value.item() if isinstance(value, np.generic) else value)


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


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
