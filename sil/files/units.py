"""Values with a unit, e.g. "7bar" or "2 ms", in the unit of their key.

Checked by: tests/unit/sil/files/test_units.py
"""

from __future__ import annotations

import re
from collections.abc import Callable
from decimal import Decimal
from typing import Any

from can_dbc.errors import InputError
from can_dbc.typed_toml import Steps, dotted, one_line
from sil.files.quantity import unit_of

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
