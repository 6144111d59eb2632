"""Units as files state them: those that one factor brings to SI, and those that need a calibration."""

from __future__ import annotations

import re

import numpy as np

COLUMN_UNITS = {
    "time_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "sec": 1.0},
    "position_m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "µm": 1e-6, "um": 1e-6, "in": 0.0254},
    "force_n": {"N": 1.0, "kN": 1e3, "lbf": 4.4482216, "kgf": 9.80665},
    "pressure_pa": {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "bar": 1e5, "MPa": 1e6}
    | {"psi": 6894.757},
    "angle_rad": {"rad": 1.0, "deg": np.pi / 180.0, "°": np.pi / 180.0},
    "torque_n_m": {"Nm": 1.0, "N m": 1.0, "N·m": 1.0, "mNm": 1e-3},
}
SCALES = {
    unit: (ours, scale) for ours, table in COLUMN_UNITS.items() for unit, scale in table.items()
}
"""Our column and the factor to its unit, by unit."""

PRESSURE_LEVELS = {
    f"{unit}{gap}{mark}": (level, unit)
    for level, marks in {"gauge": ("g", "ü", "rel"), "absolute": ("a", "abs")}.items()
    for mark in marks
    for unit in COLUMN_UNITS["pressure_pa"]
    for gap in ("", " ")
}
"""What a pressure counts from, and its unit, by units that say both: barg, bar ü, psia, kPa abs."""
SCALES |= {text: SCALES[unit] for text, (_, unit) in PRESSURE_LEVELS.items()}

RAW = re.compile(r"m?[VA]|%|counts?|digits?|inc|LSB|-|1")
"""Units of channels that only a calibration makes one of our columns."""
OTHER = re.compile(r"°?C|degC|K|k?Hz|rpm|1/min|k?g|l/min|m/s²?")
"""Units of channels that are none of our columns."""


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that is known."""
    text = text.strip("[]() ")
    return text in SCALES or any(form.fullmatch(text) for form in (RAW, OTHER))


def unit_of(name: str) -> str:
    """Return the unit in a column's name as written: x [mm], x (mm), x_mm, x/mm; empty without one."""
    if match := re.search(r"[\[(]\s*([^\])]+?)\s*[\])]$", name):
        return match[1]
    match = re.search(r"(?:/\s*|_)([^\s/_]+)$", name)
    return match[1] if match and match[1] in SCALES else ""
