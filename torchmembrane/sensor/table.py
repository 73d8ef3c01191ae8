"""Checked access to the tables of a TOML file, and the few kinds of lines needed to write one.

Every message names the file, the table and key, the value that came and what was expected.
"""

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path

from ..errors import MembraneError


class Table:
    """One table of a TOML file: typed, finite values by key, or a `MembraneError` that says where and what."""

    def __init__(self, path: Path, name: str, values: Mapping):
        self.path, self.name, self.values = path, name, values

    @classmethod
    def from_file(cls, path: Path) -> "Table":
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

    def where(self, key: str = "") -> str:
        return " ".join(part for part in (f"{self.path}:", f"[{self.name}]" if self.name else "", key) if part)

    def refuse(self, key: str, expected: str) -> MembraneError:
        return MembraneError(f"{self.where(key)} = {_shown(self.values[key])}; expected {expected}")

    @contextmanager
    def naming(self, key: str = ""):
        """Put file, table and key before the message of whatever is refused inside."""
        try:
            yield
        except MembraneError as error:
            shown = f" = {_shown(self.values[key])}" if key in self.values else ""
            raise MembraneError(f"{self.where(key)}{shown}: {error}") from error

    def allow(self, keys: Iterable[str], owner: str = "here") -> None:
        """Refuse keys other than these, suggesting the closest."""
        keys = list(keys)
        for key in self.values:
            if key not in keys:
                closest = difflib.get_close_matches(key, keys, 1)
                remedy = f"did you mean {closest[0]!r}?" if closest else "remove it"
                raise MembraneError(f"{self.where(key)} is unknown {owner}; expected {', '.join(keys)}; {remedy}")

    def _get(self, key: str, right, expected: str, required: bool):
        if key not in self.values:
            if required:
                raise MembraneError(f"{self.where(key)} is missing; expected {expected}: add it")
            return None
        if not right(self.values[key]):
            raise self.refuse(key, expected)
        return self.values[key]

    def table(self, key: str, required: bool = True) -> "Table | None":
        name = f"{self.name}.{key}" if self.name else key
        values = self._get(key, lambda v: isinstance(v, dict), f"a table [{name}]", required)
        return None if values is None else Table(self.path, name, values)

    def tables(self, key: str) -> list["Table"]:
        def right(values):
            return isinstance(values, list) and all(isinstance(v, dict) for v in values)

        values = self._get(key, right, f"tables [[{self.name}.{key}]]", False) or []
        return [Table(self.path, f"{self.name}.{key}[{i}]", v) for i, v in enumerate(values)]

    def text(self, key: str, choices: Iterable[str] = (), required: bool = True) -> str | None:
        choices = tuple(choices)
        expected = " or ".join(map(_shown, choices)) or "text in quotes"
        return self._get(key, lambda v: isinstance(v, str) and v and (not choices or v in choices), expected, required)

    def number(self, key: str, required: bool = True) -> float | None:
        value = self._get(key, _finite, "a finite number", required)
        return None if value is None else float(value)

    def numbers(self, key: str, count: int | None, required: bool = True, whole: bool = False) -> list | None:
        right, kind = (_whole, "whole") if whole else (_finite, "finite")
        expected = f"a list of {'' if count is None else f'{count} '}{kind} numbers"

        def right_list(values):
            return isinstance(values, list) and len(values) == (count or len(values)) and all(map(right, values))

        values = self._get(key, right_list, expected, required)
        return None if values is None else [value if whole else float(value) for value in values]

    def file(self, key: str, required: bool = True) -> Path | None:
        """The path of the file that `key` names, relative to this file's folder."""
        name = self.text(key, required=required)
        if name is None:
            return None
        path = self.path.parent / name
        if not path.is_file():
            raise self.refuse(key, f"a file; there is none at {path}: paths are relative to the sensor file")
        return path


def toml_lines(name: str, values: Mapping, repeated: bool = False) -> list[str]:
    """A table as lines of TOML: text, numbers and lists of numbers; keys that are None are left out."""
    head = [f"[[{name}]]" if repeated else f"[{name}]"] if name else []
    return head + [f"{key} = {_shown(value)}" for key, value in values.items() if value is not None]


def _shown(value) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    return repr(list(value) if isinstance(value, tuple) else value)


def _finite(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
