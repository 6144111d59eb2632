"""Values as an engineer reads and writes them: units from names, few digits, "7bar" in the unit of its key."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from html import escape
from typing import Any

from can_dbc.errors import InputError
from can_dbc.typed_toml import Steps, dotted, one_line

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


_SIZES = {
    "time": {"s": "1", "ms": "1e-3", "us": "1e-6", "µs": "1e-6", "ns": "1e-9", "min": "60", "h": "3600"},
    "pressure": {"Pa": "1", "kPa": "1e3", "MPa": "1e6", "mbar": "100", "bar": "1e5", "psi": "6894.757293168"},
    "length": {"m": "1", "cm": "1e-2", "mm": "1e-3", "um": "1e-6", "µm": "1e-6"},
    "area": {"m^2": "1", "m2": "1", "cm2": "1e-4", "mm2": "1e-6"},
    "volume": {"m^3": "1", "m³": "1", "m3": "1", "l": "1e-3", "cm3": "1e-6", "mm3": "1e-9"},
    "mass": {"kg": "1", "g": "1e-3"},
    "force": {"N": "1", "kN": "1e3"},
    "speed": {"m/s": "1", "mm/s": "1e-3", "km/h": "0.2777777777777778"},
    "angular speed": {"rad/s": "1", "rpm": "0.10471975511965977"},
    "frequency": {"Hz": "1", "kHz": "1e3"},
    "energy": {"J": "1", "mJ": "1e-3", "kJ": "1e3"},
    "impulse": {"N s": "1", "Ns": "1"},
    "torque": {"N m": "1", "Nm": "1"},
    "voltage": {"V": "1", "mV": "1e-3"},
    "current": {"A": "1", "mA": "1e-3"},
    "resistance": {"Ω": "1", "ohm": "1"},
    "temperature": {"K": "1"},
}  # fmt: skip
"""Size of each unit in that of its dimension which comes first."""
_DIMENSIONS = {unit: dimension for dimension, sizes in _SIZES.items() for unit in sizes}


def in_unit(text: str, unit: str, where: str) -> float | str:
    """Return the number of a text "7bar" in `unit`; a text that is not a number with a unit as it is.

    Raises InputError that begins with `where` for an unknown unit, or one of another dimension.
    """
    match = re.fullmatch(
        r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?+)\s*([^\W\d_].*?)\s*", text
    )
    unit = unit.removesuffix(" (absolute)")
    if match is None or not unit.strip("-"):
        return text
    number, given = match.groups()
    sizes = _SIZES.get(_DIMENSIONS.get(unit, ""), {unit: "1"})
    if given not in sizes:
        kind = f"a unit of {_DIMENSIONS[given]}" if given in _DIMENSIONS else "an unknown unit"
        expected = (
            f"one of {_DIMENSIONS[unit]}: {', '.join(sizes)}" if unit in _DIMENSIONS else unit
        )
        raise InputError(f"{where}: {one_line(text)} has {kind}; expected {expected}")
    return float(Decimal(number) * Decimal(sizes[given]) / Decimal(sizes[unit]))


def without_units(
    value: Any,
    source: str,
    unit_of_key: Callable[[str], str] = unit_of,
    unit: str = "",
    steps: Steps = (),
) -> Any:
    """Return a parsed table with the texts "7bar" below keys that have a unit as numbers.

    The values of a sweep have the unit of its `path`. Raises InputError naming source and key.
    """
    if isinstance(value, str):
        return in_unit(value, unit, f"{source}: {dotted(steps)}") if unit else value
    if isinstance(value, list):
        return [
            without_units(item, source, unit_of_key, unit, (*steps, k))
            for k, item in enumerate(value)
        ]
    if not isinstance(value, dict):
        return value
    if isinstance(path := value.get("path"), str):
        unit = unit_of_key(path)
    inherited = dict.fromkeys(("min", "max", "low", "high", "values"), unit)
    return {
        key: without_units(
            item, source, unit_of_key, unit_of_key(key) or inherited.get(key, ""), (*steps, key)
        )
        for key, item in value.items()
    }


def html_table(title: str, heads: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a title and a table as HTML, all texts escaped."""
    lines = [("th", heads), *(("td", row) for row in rows)]
    cells = ("".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in row) for tag, row in lines)
    return f"<p>{escape(title)}</p><table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"
