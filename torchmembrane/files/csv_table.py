"""Reader for the CSV tables that users write; it finds columns by their names.

It tolerates what spreadsheets, editors and numpy leave in a file: a byte order mark, Windows line endings, blank lines, lines
of commas only, commas and blanks at the ends of lines, quotes, capitals in names, and comments after `#` and a blank. It
refuses what is ambiguous: semicolons, decimal commas, thousands separators, and repeated or unknown columns.
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import MembraneError
from .safe_read import in_one_line, printable, read_text, shortened

NUMBER = re.compile(r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|nan|inf(inity)?)", re.ASCII | re.IGNORECASE)
"""What is read as a number; `float` also takes 1_000, and digits of other scripts."""
COMMENT = re.compile(r"\s*#+(\s|$)")
QUOTED = re.compile(r"[\w.,;+ ()\[\]-]{0,60}")
"""A first line that an error message may quote; of any other line it states only the length, as the content may be
arbitrary."""
MINUS = str.maketrans({"\N{MINUS SIGN}": "-"})
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven")


class Columns(NamedTuple):
    """The columns that a table may have.

    Attributes:
        forms: alternative sets of column names; a table has the columns of exactly one set, in any order.
        of: what a line describes, in one word.
        optional: name of one further column that may be left out; empty: none.
        unit: unit of the numbers, for messages.
        least: smallest number of lines.
        most: largest number of lines; None: no limit.
    """

    forms: Sequence[tuple[str, ...]]
    of: str
    optional: str = ""
    unit: str = ""
    least: int = 1
    most: int | None = None

    @property
    def expected(self) -> str:
        """Return a description of the expected columns for messages."""
        heads = " or ".join(map(",".join, self.forms)) + (f", each with ,{self.optional} or without" if self.optional else "")
        return f"{heads}, a line for each {self.of}" + (f", {self.unit}" if self.unit else "")

    def form_of(self, names: Sequence[str]) -> tuple[str, ...] | None:
        """Return the form whose columns have these names, in any order, or None."""
        given = sorted(name for name in names if name != self.optional or names.count(name) > 1)
        return next((form for form in self.forms if sorted(form) == given), None)


class Limit(NamedTuple):
    """The largest allowed magnitude of a number, and the name of the number in messages."""

    most: float = math.inf
    what: str = "a number"
    unit: str = ""


ANY, ANGLE = Limit(), Limit(360.0, "an angle", "degrees")


class Row(NamedTuple):
    """A line of a table.

    Attributes:
        path: the file.
        line: line number, from 1.
        places: index of each column among the cells, by column name.
        cells: cells of the line.
    """

    path: Path
    line: int
    places: Mapping[str, int]
    cells: list[str]

    @property
    def where(self) -> str:
        """Return the file and line with which a message begins."""
        return f"{self.path}, line {self.line}"

    def text(self, column: str) -> str:
        """Return the text of a cell, without surrounding blanks."""
        return self.cells[self.places[column]]

    def number(self, column: str, limit: Limit = ANY) -> float:
        """Return a finite number within its limit; otherwise raise a `MembraneError` that names file, line and column."""
        cell = self.text(column).translate(MINUS)
        if not NUMBER.fullmatch(cell):
            raise self.refusal(column, "a number such as 12 or 1.5, with a point and not a comma")
        value = float(cell)
        if not math.isfinite(value):
            raise self.refusal(column, "a finite number: leave the line out where it is unknown")
        if abs(value) > limit.most:
            raise self.refusal(column, f"{limit.what} up to {limit.most:g}, in {limit.unit}")
        return value

    def numbers(self, columns: Iterable[str], limit: Limit = ANY) -> list[float]:
        """Return the finite numbers in several columns."""
        return [self.number(column, limit) for column in columns]

    def choice(self, column: str, choices: Sequence[str]) -> str:
        """Return one of several allowed words, matched without regard to case."""
        word = self.text(column).lower()
        if word not in choices:
            raise self.refusal(column, " or ".join(choices))
        return word

    def refusal(self, column: str, expected: str) -> MembraneError:
        """Return the error for a cell that does not hold what was expected."""
        cell = shortened(printable(self.text(column)))
        return MembraneError(f"{self.where}: {column} = {cell if _is_number(cell) else repr(cell)}; expected {expected}")


class Table(NamedTuple):
    """A table as read from its file.

    Attributes:
        form: the form in `Columns.forms` whose columns the table has.
        rows: the lines below the header.
    """

    form: tuple[str, ...]
    rows: list[Row]


def read_table(path: Path, columns: Columns, most_bytes: int) -> Table:
    """Read the lines of a table; each cell is checked when it is accessed.

    Args:
        path: path of the CSV file.
        columns: columns that the table may have.
        most_bytes: largest allowed file size in bytes.

    Raises:
        MembraneError: the file is missing, is not text or not CSV, has other columns, a line with too many or too few cells, or
            too few or too many lines; the message names file and line, what was found, what was expected, and the remedy.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "dots.csv"
        ...     _ = path.write_text("# measured by hand\\n Y , X ,\\n2.5,+1,\\n\\n")
        ...     form, rows = read_table(path, Columns([("x", "y")], "dot"), 1000)
        >>> form, rows[0].numbers(form)
        (('x', 'y'), [1.0, 2.5])
    """
    text = read_text(path, most_bytes, f"CSV with {columns.expected}")
    lines = io.StringIO(text, newline="").readlines()
    rows, damage = _rows(lines)
    names, body = _header(path, columns, rows, lines) if rows or not damage else ([], [])
    if damage:
        raise MembraneError(f"{path}, {damage}; expected {columns.expected}")
    form = columns.form_of(names)
    assert form is not None  # or the header has been refused
    _refuse_count(path, columns, len(body))
    places = {name: k for k, name in enumerate(names)}
    return Table(form, [Row(path, line, places, _cells(path, line, cells, names)) for line, cells in body])


def _rows(lines: list[str]) -> tuple[list[tuple[int, list[str]]], str]:
    """Return the non-empty lines, each with its number and cells, and a description of the damage that ended them early, or
    ""."""
    reader = csv.reader(("\n" if COMMENT.match(line) else line for line in lines), strict=True, skipinitialspace=True)
    rows = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        return rows, f"line {reader.line_num}: not readable as CSV ({in_one_line(error)})"
    return rows, ""


def _header(
    path: Path, columns: Columns, rows: list[tuple[int, list[str]]], lines: list[str]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the column names and the lines below them; the names may stand in a comment, as numpy writes them."""
    line, first = rows[0] if rows else (1, ["nothing"])
    if columns.form_of(names := _names(first)):
        return names, rows[1:]
    comments = [_names(text.lstrip("# \t").split(",")) for text in lines[: line - 1] if COMMENT.match(text)]
    for commented in reversed(comments):
        if columns.form_of(commented):
            return commented, rows
    known = {columns.optional, *(name for form in columns.forms for name in form)}
    if twice := [name for name in names if name and name in known and names.count(name) > 1]:
        raise MembraneError(f"{path}, line {line}: the header names {twice[0]} twice; expected {columns.expected}: remove one")
    came = ",".join(first)
    came = repr(came) if QUOTED.fullmatch(came) else f"{len(came)} characters that name no columns"
    remedy = "put these names in the first line, commas between them, and numbers with a decimal point"
    raise MembraneError(f"{path}, line {line}: the header is {came}; expected {columns.expected}: {remedy}")


def _names(cells: Sequence[str]) -> list[str]:
    """Return the names in a header, normalised for comparison, without empty names at the end."""
    names = [re.sub(r"[\s-]+", "_", cell.strip().lower()) for cell in cells]
    while names and not names[-1]:
        names.pop()
    return names


def _cells(path: Path, line: int, cells: list[str], names: list[str]) -> list[str]:
    if len(cells) < len(names) or any(cells[len(names) :]):
        wanted = f"{COUNTS[len(names)]}, {','.join(names)}: commas only between columns, numbers with a decimal point"
        raise MembraneError(f"{path}, line {line}: {len(cells)} values, {in_one_line(','.join(cells))}; expected {wanted}")
    return cells[: len(names)]


def _refuse_count(path: Path, columns: Columns, count: int) -> None:
    of, least, most = f"{columns.of}s", columns.least, columns.most
    if count == 0 and least == 1:
        raise MembraneError(f"{path}: no {of} after the header; expected {columns.expected}")
    if count < least or (most is not None and count > most):
        bounds = f"{least} to {most}" if least > 1 else f"at most {most}"
        raise MembraneError(f"{path}: {count} {of}; expected {bounds}, a line for each")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
