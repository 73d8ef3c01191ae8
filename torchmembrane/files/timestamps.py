"""Read times from file names, given as seconds since 1970 or as a date with a time of day.

torchmembrane and torchmembrane-edge contain identical copies of this file.
"""

import math
import re
from datetime import datetime

SECONDS = re.compile(r"(?<!\d)(1\d{9})(?:[.,](\d{1,9})|_?(\d{9})|(\d{3}|\d{6}))?(?!\d)")
"""Seconds since 1970 with decimals after a point, or milliseconds, microseconds or nanoseconds: 2001 to 2033."""
DATE = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[T _-]?([0-2]\d)[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d)"
    r"(?:[.,](\d{1,9})|(\d{3}|\d{6}|\d{9}))?(?!\d)"
)
"""Year, month, day, hour, minute and second, with decimals after a point or directly appended."""


def time_in(text: str) -> float:
    """Return the time in a text, seconds since 1970; NaN if there is none.

    A date with a time of day is read as UTC: differences between frames are correct in any time zone.

    Args:
        text: text such as the name of an image file without its extension.

    Example:
        >>> time_in("press_20260927T113829.250"), time_in("1790509109_250000000"), time_in("press_000012")
        (1790509109.25, 1790509109.25, nan)
    """
    for found in DATE.finditer(text):
        *parts, decimals, directly = found.groups()
        try:
            whole = datetime.fromisoformat("{}-{}-{}T{}:{}:{}+00:00".format(*parts)).timestamp()
        except ValueError:
            continue
        return whole + float(f"0.{decimals or directly or 0}")
    if since := SECONDS.search(text):
        seconds, *decimals = since.groups()
        return float(f"{seconds}.{next(filter(None, decimals), 0)}")
    return math.nan
