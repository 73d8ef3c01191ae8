"""The record of an individual sensor: its serial number, and when and how it was calibrated."""

import json
from collections.abc import Callable
from datetime import date
from typing import Any, NamedTuple

from .table import Table


class Record(NamedTuple):
    """`[record]` of a sensor file. It does not affect reconstructions, so it is not part of the fingerprint.

    Attributes:
        serial: serial number of this unit, any text.
        calibrated: date of the latest calibration.
        images: number of images used for it.
        by: the command that made it.
        uncertainty: relative standard deviation of forces due to the material's calibration; `force_deviation` includes it.

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
        """The known values by key."""
        return {key: value for key, value in self._asdict().items() if value is not None}

    @property
    def text(self) -> str:
        """The known values as JSON, as stored in results and exported models; empty if nothing is known."""
        return json.dumps(self.known, default=str, ensure_ascii=False) if self.known else ""

    def said(self, today: date) -> list[str]:
        """Format the record as lines of text, with the age of the calibration on the day `today`.

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
    """Read the record from a table `[record]`; every key is optional.

    Raises:
        MembraneError: a key is unknown, or a value has the wrong type.
    """
    table.allow(Record._fields)
    kinds: dict[str, Callable[[str], Any]] = {"serial": table.text, "by": table.text, "calibrated": table.date}
    kinds |= {"images": table.whole_number, "uncertainty": table.number}
    record = Record(**{key: kinds[key](key) for key in Record._fields if key in table})
    for key, least in (("images", 1), ("uncertainty", 0)):
        if (value := getattr(record, key)) is not None and value < least:
            raise table.refuse(key, f"{least} or more")
    return record
