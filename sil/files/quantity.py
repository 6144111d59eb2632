"""Values as an engineer reads them: the unit from the name, few digits, words for limits.

Checked by: tests/unit/sil/files/test_quantity.py
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

SUFFIX_UNITS = {
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_kg_m2": "kg m²",
    "_n_per_m": "N/m",
    "_s_per_m": "s/m",
    "_m3": "m³",
    "_per_k": "1/K",
    "_per_s": "1/s",
    "_m_s2": "m/s²",
    "_m2": "m²",
    "_m_s": "m/s",
    "_n_s": "N s",
    "_pa_s": "Pa/s",
    "drag_n_m": "N m",
    "_ppm": "ppm",
    "_ns": "ns",
    "_hz": "Hz",
    "_kg": "kg",
    "_pa": "Pa",
    "_ohm": "Ω",
    "_a": "A",
    "_v": "V",
    "_j": "J",
    "_k": "K",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
"""Unit of a name by its ending; longer endings before those that they end in."""

_SCALED = {
    "s": (1e3, "ms", 1.0),
    "m": (1e3, "mm", 1.0),
    "kg": (1e3, "g", 1.0),
    "Pa": (1e-5, "bar", 0.0),
}
"""Factor and unit in which a value is shown that is smaller than the last number (0: always)."""


def unit_of(name: str) -> str:
    """Return the unit that a name ends in, e.g. "m/s" of impact_speed_m_s; empty without one."""
    return next((unit for ending, unit in SUFFIX_UNITS.items() if name.endswith(ending)), "")


def quantity(value: Any, unit: str = "", digits: int = 4) -> str:
    """Return a value with its unit, e.g. "12.76 ms"; lists as their items, None as "none"."""
    if value is None or (isinstance(value, Sequence) and len(value) == 0):
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence):
        return ", ".join(quantity(item, unit, digits) for item in value)
    if unit in _SCALED:
        factor, small_unit, below = _SCALED[unit]
        if below == 0.0 or abs(value) < below:
            value, unit = value * factor, small_unit
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < 1e7:  # 26310, not 2.631e+04
        text = f"{value:.0f}"
    return f"{text} {unit}".rstrip()


def limits(limit: Any, unit: str = "", digits: int = 4) -> str:
    """Return what was expected in words: "38 ms to 46 ms", "at least 4", or the value itself."""
    if not isinstance(limit, Mapping):
        return quantity(limit, unit, digits)
    low, high = limit.get("min"), limit.get("max")
    if low is None and high is None:
        return "any value"
    if low is None or high is None:
        return f"at {'most' if low is None else 'least'} {quantity(high if low is None else low, unit, digits)}"
    if low == high:
        return quantity(low, unit, digits)
    return f"{quantity(low, unit, digits)} to {quantity(high, unit, digits)}"


def comparison(name: str, value: Any, limit: Any, unit: str = "") -> str:
    """Return "NAME: VALUE, expected LIMIT", with as many digits as show that they differ."""
    bounds = [b for b in limit.values() if b != value] if isinstance(limit, Mapping) else []
    digits = 4
    if isinstance(value, float) and math.isfinite(value):
        while digits < 17 and quantity(value, unit, digits) in [
            quantity(b, unit, digits) for b in bounds
        ]:
            digits += 1
    return f"{name}: {quantity(value, unit, digits)}, expected {limits(limit, unit, digits)}"


def noun(count: int, what: str) -> str:
    """Return a noun as it follows a number: "shift" after 1, else "shifts"."""
    return what if count == 1 else f"{what}s"


def counted(count: int, what: str) -> str:
    """Return a number with its noun: "1 shift", "3 shifts"."""
    return f"{count} {noun(count, what)}"
