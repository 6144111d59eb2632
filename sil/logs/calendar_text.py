"""Start dates as loggers write them into their headers."""

from __future__ import annotations

import re
from typing import Final

from sil.logs.times import NS_PER_MS, utc_calendar, utc_ns

_MONTH_NAMES: Final = "jan feb mar apr may jun jul aug sep oct nov dec"
_MONTHS: Final = tuple(_MONTH_NAMES.split())
_FOREIGN_MONTHS: Final = {"mär": 3, "mrz": 3, "mai": 5, "okt": 10, "dez": 12}
_DAYS: Final = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_TEXT: Final = re.compile(
    r"(?:\w+\.?\s+)?(\w{3})\w*\.?\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:\.(\d{1,6}))?"
    r"(?:\s+([ap]m))?\s+(\d{4})\s*\Z",
    re.IGNORECASE,
)


def parse_date(text: str) -> int | None:
    """Nanoseconds since 1970 of `Sat Sep 30 10:06:13.191 PM 2017` and its likes, or None.

    Weekday in any language, month in English or German, 12 or 24 hours; the zone is not written
    and taken as UTC.
    Checked by: tests/unit/sil/logs/test_times.py.
    """
    found = _TEXT.match(text.strip())
    if found is None:
        return None
    name = found[1].lower()
    month = _MONTHS.index(name) + 1 if name in _MONTHS else _FOREIGN_MONTHS.get(name, 0)
    hour = int(found[3])
    half = (found[7] or "").lower()
    if half:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if half == "pm" else 0)
    nanoseconds = int((found[6] or "0").ljust(9, "0"))
    try:
        return utc_ns(
            int(found[8]), month, int(found[2]), hour, int(found[4]), int(found[5]), nanoseconds
        )
    except (ValueError, OverflowError):
        return None


def write_date(time_ns: int) -> str:
    """A date header, English, UTC, with milliseconds; the same on every locale."""
    moment = utc_calendar(time_ns)
    milliseconds = time_ns // NS_PER_MS % 1000
    month = _MONTHS[moment.month - 1].capitalize()
    return (
        f"{_DAYS[moment.weekday()]} {month} {moment.day:02d} {moment:%H:%M:%S}.{milliseconds:03d} "
        f"{moment.year:04d}"
    )
