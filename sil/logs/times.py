"""Times in logs as integers of nanoseconds, never through a float; dates in their headers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime
from decimal import ROUND_HALF_UP, Context, Decimal, InvalidOperation
from typing import Final

from can_dbc.instants import NS_PER_S

NS_PER_MS: Final = 1_000_000
_MONTHS: Final = "jan feb mar apr may jun jul aug sep oct nov dec".split()  # noqa: SIM905
RELATIVE_BELOW_NS: Final = 315_532_800 * NS_PER_S
"""Times before 1980 are taken as counted from the start of a log, not from 1970."""

_NUMBER = re.compile(r"[+-]?\d{0,19}(?:\.\d{0,40})?(?:[eE][+-]?\d{1,2})?\Z", re.ASCII)
_EXACTLY: Final = Context(prec=200, rounding=ROUND_HALF_UP)


def parse_decimal_ns(text: str, unit_ns: int = NS_PER_S) -> int:
    """Return a decimal number of `unit_ns` in ns, rounded half up. Raises ValueError for another text."""
    try:
        if not _NUMBER.match(text):
            raise InvalidOperation
        time_ns = int(_EXACTLY.to_integral_value(_EXACTLY.multiply(Decimal(text), unit_ns)))
    except InvalidOperation:
        raise ValueError(f"{text[:40]!r} is no decimal time") from None
    if abs(time_ns) >= 2**63:
        raise ValueError(f"time {text[:40]} is out of range")
    return time_ns


def format_ns(time_ns: int, decimals: int | None = None) -> str:
    """Write nanoseconds as seconds: 6 decimals when that is exact, else 9 (or `decimals`, rounded)."""
    if decimals is None:
        decimals = 9 if time_ns % 1000 else 6
    sign = "-" if time_ns < 0 else ""
    unit = 10 ** (9 - decimals)
    counts = (abs(time_ns) + unit // 2) // unit
    whole, fraction = divmod(counts, 10**decimals)
    return f"{sign}{whole}.{fraction:0{decimals}d}"


def enough_decimals(frames: Iterable[tuple[int, *tuple[object, ...]]]) -> int:
    """Return 6 if all the frames' times are whole microseconds, else 9."""
    return 9 if any(frame[0] % 1000 for frame in frames) else 6


def utc_ns(
    year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: int = 0, ns: int = 0
) -> int:
    """Return the nanoseconds since 1970 of a calendar time; logs name no zone, so it is UTC.

    Raises ValueError for a date that does not exist.
    """
    moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    return int(moment.timestamp()) * NS_PER_S + ns


def utc_calendar(time_ns: int) -> datetime:
    """Return the UTC calendar time of nanoseconds since 1970, the fraction of a second dropped."""
    return datetime.fromtimestamp(time_ns // NS_PER_S, UTC)


def parse_date(text: str) -> int | None:
    """Return the nanoseconds since 1970 of `Sat Sep 30 10:06:13.191 PM 2017` and the like, or None.

    Weekday in any language, month in English, German or Swedish, 12 or 24 hours; the zone is not written
    and taken as UTC.
    """
    match = re.match(
        r"(?:\w+\.?\s+)?(\w{3})\w*\.?\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:\.(\d{1,6}))?"
        r"(?:\s+([ap]m))?\s+(\d{4})\s*\Z",
        text.strip(),
        re.IGNORECASE,
    )
    if match is None:
        return None
    name, day, hour_text, minute, second, fraction, half, year = match.groups()
    months = dict(zip(_MONTHS, range(1, 13), strict=True))
    months |= {"mär": 3, "mrz": 3, "mai": 5, "maj": 5, "okt": 10, "dez": 12}
    hour = int(hour_text)
    if half and not 1 <= hour <= 12:
        return None
    if half:
        hour = hour % 12 + (12 if half.lower() == "pm" else 0)
    date = int(year), months.get(name.lower(), 0), int(day)
    try:
        return utc_ns(*date, hour, int(minute), int(second), int((fraction or "0").ljust(9, "0")))
    except (ValueError, OverflowError):
        return None


def write_date(time_ns: int) -> str:
    """Return a date for a header, English, UTC, with milliseconds; the same on every locale."""
    moment = utc_calendar(time_ns)
    milliseconds = time_ns // NS_PER_MS % 1000
    month = _MONTHS[moment.month - 1].capitalize()
    day = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")[moment.weekday()]
    return f"{day} {month} {moment.day:02d} {moment:%H:%M:%S}.{milliseconds:03d} {moment.year:04d}"
