"""Decimal times as integers of nanoseconds: no float ever comes between."""

from __future__ import annotations

import calendar
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Final

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
RELATIVE_BELOW_NS: Final = 315_532_800 * NS_PER_S
"""Times before 1980 are taken as counted from the start of a log, not from 1970."""

_DECIMAL = re.compile(r"([+-]?)(\d{0,15})(?:\.(\d{0,40}))?\Z", re.ASCII)
_EXPONENT = re.compile(r"([+-]?\d{0,15}(?:\.\d{0,40})?)[eE]([+-]?\d{1,2})\Z", re.ASCII)


def parse_decimal_ns(text: str, unit_ns: int = NS_PER_S) -> int:
    """Turn a decimal number of seconds (or of `unit_ns`) into nanoseconds, rounded half up.

    Raises: ValueError when it is no decimal number or out of the 64-bit range.
    Checked by: tests/unit/sil/logs/test_times.py.
    """
    match = _DECIMAL.match(text)
    shift = 0
    if match is None:
        power = _EXPONENT.match(text)
        match = _DECIMAL.match(power[1]) if power is not None else None
        if power is None or match is None:
            raise ValueError(f"{text[:40]!r} is no decimal time")
        shift = int(power[2])
    sign, whole, fraction = match[1], match[2], match[3] or ""
    if not whole and not fraction:
        raise ValueError(f"{text[:40]!r} is no decimal time")
    scaled = int(whole + fraction or "0") * unit_ns
    places = len(fraction) - shift
    if places > 0:
        divisor = 10**places
        scaled = (2 * scaled + divisor) // (2 * divisor)
    else:
        scaled *= 10**-places
    if scaled >= 2**63:
        raise ValueError(f"time {text[:40]} is out of range")
    return -scaled if sign == "-" else scaled


def format_ns(time_ns: int, decimals: int | None = None) -> str:
    """Write nanoseconds as seconds: 6 decimals when that is exact, else 9 (or as told).

    With fewer decimals than needed the time is rounded half up.
    Checked by: tests/unit/sil/logs/test_times.py.
    """
    if decimals is None:
        decimals = 9 if time_ns % 1000 else 6
    sign = "-" if time_ns < 0 else ""
    unit = 10 ** (9 - decimals)
    counts = (abs(time_ns) + unit // 2) // unit
    whole, fraction = divmod(counts, 10**decimals)
    return f"{sign}{whole}.{fraction:0{decimals}d}"


def enough_decimals(frames: Iterable[tuple[int, *tuple[object, ...]]]) -> int:
    """6 when all the frames' times are whole microseconds, else 9."""
    return 9 if any(frame[0] % 1000 for frame in frames) else 6


def utc_ns(
    year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: int = 0, ns: int = 0
) -> int:
    """Nanoseconds since 1970 of a calendar time; logs name no zone, so it is taken as UTC.

    Raises: ValueError for a date that does not exist.
    """
    moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    return calendar.timegm(moment.timetuple()) * NS_PER_S + ns


def utc_calendar(time_ns: int) -> datetime:
    """The UTC calendar time of whole seconds since 1970 (fraction dropped).

    Raises: ValueError or OverflowError outside years 1 to 9999.
    """
    return datetime.fromtimestamp(time_ns // NS_PER_S, UTC)
