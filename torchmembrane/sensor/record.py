"""What is known of a sensor as one piece: its serial, and when and how it was calibrated."""

import json
from collections.abc import Callable
from datetime import date
from typing import Any, NamedTuple

from .table import Table


class Record(NamedTuple):
    """`[record]` of a sensor file. It says nothing of how images become surfaces, so it is no part of the fingerprint.

    Attributes:
        serial: serial of the piece, any text.
        calibrated: the day of the latest calibration.
        images: that it was made from.
        by: what made it.
        uncertainty: standard deviation of forces by the calibration of the material, over the force; `force_deviation` has it.

    Example:
        >>> Record("A17", date(2026, 9, 27), 12, uncertainty=0.04).text
        '{"serial": "A17", "calibrated": "2026-09-27", "images": 12, "uncertainty": 0.04}'
        >>> Record().text
        ''
    """

    serial: str | None = None
    calibrated: date | None = None
    images: int | None = None
    by: str | None = None
    uncertainty: float | None = None

    @property
    def known(self) -> dict[str, Any]:
        """What is known, by key."""
        return {key: value for key, value in self._asdict().items() if value is not None}

    @property
    def text(self) -> str:
        """What is known as JSON, as results and exported models carry it; empty where nothing is."""
        return json.dumps(self.known, default=str, ensure_ascii=False) if self.known else ""

    def said(self, today: date) -> list[str]:
        """Lines that say what is known, with the age of the calibration.

        Example:
            >>> Record("A17", date(2026, 9, 27), 12, "calibrate rest").said(date(2026, 11, 27))
            ['serial A17', 'calibrated 2026-09-27, 61 days ago, from 12 images, by calibrate rest']
        """
        lines = [] if self.serial is None else [f"serial {self.serial}"]
        words = []
        if self.calibrated is not None:
            days = (today - self.calibrated).days
            age = "today" if days == 0 else f"{days} days ago" if days > 1 else "1 day ago" if days == 1 else "in the future"
            words.append(f"calibrated {self.calibrated.isoformat()}, {age}")
        words += [] if self.images is None else [f"from {self.images} image{'' if self.images == 1 else 's'}"]
        words += [] if self.by is None else [f"by {self.by}"]
        words += [] if self.uncertainty is None else [f"forces known to {100 * self.uncertainty:.2g} %"]
        return lines + ([", ".join(words)] if words else [])


def read_record(table: Table) -> Record:
    """The record that a table `[record]` holds; every key may be left out.

    Raises:
        MembraneError: another key, or a value that is none of its kind.
    """
    table.allow(Record._fields)
    kinds: dict[str, Callable[[str], Any]] = {"serial": table.text, "by": table.text, "calibrated": table.date}
    kinds |= {"images": table.whole_number, "uncertainty": table.number}
    record = Record(**{key: kinds[key](key) for key in Record._fields if key in table})
    for key, least in (("images", 1), ("uncertainty", 0)):
        if (value := getattr(record, key)) is not None and value < least:
            raise table.refuse(key, f"{least} or more")
    return record
