"""Which column of a measured file is which of ours: by unit, name and level; what stays open is asked.

Checked by: tests/unit/sil/inference/campaign/test_new_campaign.py
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sil.campaign.campaign import OWN_COLUMN, Floats
from sil.campaign.units import COLUMN_UNITS, OTHER, PRESSURE_LEVELS, RAW, SCALES, unit_of

NAME_PATTERNS = {
    "time_s": r"t|time|zeit|timestamp|.*_t(ime)?",
    "position_m": r"x|y|qm?|pos(ition)?|weg|hub|stroke|displacement|travel|s",
    "angle_rad": r"angle|theta|phi|winkel",
    "force_n": r"f|force|kraft|load(cell)?|u?force",
    "torque_n_m": r"torque|tau|moment|drehmoment",
    "pressure_pa": r"p(?=\d?$|[\W_])|(.*\W)?(pressure|druck|kammer)|.*press(ure)?",
    "cmd": r"(y|u|i|mv|ev)(?=\d$|[\W_])|.*(coil|cmd|command|valve|ventil|spule|magnet|solenoid|pwm|duty)",
}
"""Names by which a channel is recognised if no unit identifies it; of a chamber's, how they begin."""


@dataclass(frozen=True)
class RecordedColumn:
    """A column of a file, its unit as written, and what it was taken for.

    ours: our column, empty for one that is not used; scale: factor to its unit, None where the file
    does not tell it; open: what is asked about it.
    """

    name: str
    unit: str = ""
    ours: str = ""
    scale: float | None = 1.0
    open: str = ""

    def __str__(self) -> str:
        unit = self.unit or "no unit"
        if not self.ours:
            return f"{self.name}: {unit}: {self.open or 'not used'}"
        scaled = f"{self.ours} = {self.scale:g} * column" if self.scale else f"{self.ours}?"
        if self.ours.startswith("cmd_"):
            scaled = f"commands of valve {self.ours[4:]}"
        return f"{self.name}: {unit}: {scaled}" + (f"; {self.open}" if self.open else "")


def chamber_of(name: str, chambers: str) -> str:
    """Return the chamber or valve that a name ends in: pB, p_1, Druck N; empty for none."""
    match = re.search(rf"(?:^|[\W_]|[a-z])([{chambers}])$", name, re.IGNORECASE)
    return match[1].upper() if match else ""


def recognise(
    columns: Mapping[str, Floats], units: Mapping[str, str], chambers: str
) -> list[RecordedColumn]:
    """Return what each column [n], in the file's unit, is taken for; units: those stored apart from the names.

    chambers: letters of the rig's chambers, empty for a rig of which force and position are known.
    """
    channels: list[RecordedColumn] = []
    for name, values in columns.items():
        channel = _recognised(name, values, units.get(name, ""), chambers)
        if channel.ours in {one.ours for one in channels} - {""}:
            if channel.ours == "pressure_pa" and not chambers:
                channel = replace(channel, ours="pressure_2_pa")
            else:
                text = f"a second {channel.ours}, not used"
                channel = RecordedColumn(name, channel.unit, open=text)
        channels.append(channel)
    return channels


def _recognised(name: str, values: Floats, stored: str, chambers: str) -> RecordedColumn:
    bare = re.split(r"[\[(/.]", name)[0 if re.search(r"[\[(/]", name) else -1].strip().lower()
    unit = stored or unit_of(name)
    if name.endswith(f"_{unit}") and unit in chambers:  # coil_N is of valve N, force_N in newtons
        stem = bare.removesuffix(f"_{unit.lower()}")
        unit = unit if re.fullmatch(NAME_PATTERNS["force_n"], stem) else ""
    if OWN_COLUMN.fullmatch(name):
        scale = SCALES[unit][1] if unit in SCALES else 1.0
        return RecordedColumn(name, unit or "SI", name, scale)
    ours = SCALES[unit][0] if unit in SCALES else ""
    if not ours:
        word = bare.removesuffix(f"_{unit}")
        ours = next((o for o, form in NAME_PATTERNS.items() if re.fullmatch(form, word)), "")
        if not ours and (chamber := chamber_of(word, chambers or "0")):
            stem = word[: -len(chamber)]
            ours = next(
                (o for o in ("pressure_pa", "cmd") if re.match(NAME_PATTERNS[o], stem + "_")), ""
            )
    if ours == "cmd":
        return _command(name, unit, values, chamber_of(bare, chambers) if chambers else "")
    if OTHER.fullmatch(unit) or (ours == "time_s" and RAW.fullmatch(unit)):
        return RecordedColumn(name, unit)
    if ours == "time_s" and np.any(np.diff(values) < 0.0):
        return RecordedColumn(name, unit, open="falls, so that it is no time")
    if ours == "pressure_pa" and chambers:
        chamber = "oil2" if re.search("oil|öl", bare) else chamber_of(bare, chambers)
        if not chamber:
            return RecordedColumn(name, unit, open="a pressure; of which chamber?")
        ours = f"pressure_{chamber}_pa"
    if ours == "position_m" and chambers and re.search("intern|sensor|ecu|opc", bare):
        ours = "position_internal_m"
    if not ours or unit in SCALES:
        return RecordedColumn(name, unit, ours, SCALES[unit][1] if ours else 1.0)
    return _without_scale(name, unit, ours, values)


def _command(name: str, unit: str, values: Floats, chamber: str) -> RecordedColumn:
    if not chamber:
        return RecordedColumn(name, unit, open="a valve's command? of which valve?")
    ours = f"cmd_{chamber}"
    if unit == "%":
        return RecordedColumn(name, unit, ours, 0.01)
    if float(values.max()) <= 1.0 and unit in ("", "-", "1"):
        return RecordedColumn(name, unit, ours)
    return RecordedColumn(name, unit, ours, None, "on above half of its largest value")


def _without_scale(name: str, unit: str, ours: str, values: Floats) -> RecordedColumn:
    quantity = "pressure_pa" if ours.startswith("pressure") else ours.replace("_internal", "")
    si = next(iter(COLUMN_UNITS[quantity]))
    if unit:
        question = f"if it is one: scale in {si} per {unit}, and offset?"
        return RecordedColumn(name, unit, ours, None, question)
    largest = float(np.abs(values).max())
    # not SI: steps above 50 ms, positions above 1 m, pressures all below 0.2 bar
    likely = {
        "time_s": float(np.median(np.diff(values))) <= 0.05,
        "position_m": largest <= 1.0,
        "pressure_pa": largest >= 2e4,
    }
    if likely.get(quantity, True):
        return RecordedColumn(name, unit, ours, 1.0, f"no unit is stated: {si} is assumed")
    question = f"no unit is stated, and {si} is unlikely: scale?"
    return RecordedColumn(name, unit, ours, None, question)


def pressures(channels: list[RecordedColumn], tables: Sequence[Mapping[str, Floats]]) -> str:
    """Return whether pressures, columns [n] of each file, are absolute, by unit or level, or "?" where only the user can tell."""
    stated = {
        PRESSURE_LEVELS.get(c.unit, ("", ""))[0] for c in channels if c.ours.startswith("pressure_")
    }
    if stated - {""}:
        return stated.pop() if len(stated) == 1 else "?"
    lowest = [
        float(table[channel.name].min()) * (channel.scale or np.nan)
        for channel in channels
        for table in tables
        if channel.ours.startswith("pressure_") and "oil" not in channel.ours
    ]
    return "?" if lowest and not 5e4 < min(lowest) < 1.5e5 else "absolute"


def commands(
    channels: list[RecordedColumn], table: Mapping[str, Floats]
) -> tuple[list[str], list[list[object]]]:
    """Return which valves are on at the beginning of a file [n], and each later change as time in s, valve, duty."""
    clocks = [(c.name, c.scale) for c in channels if c.ours == "time_s" and c.scale]
    charged: list[str] = []
    changes: list[list[object]] = []
    for channel in channels if clocks else ():
        if not channel.ours.startswith("cmd_"):
            continue
        clock, scale = clocks[0]
        valve, values, time_s = (
            channel.ours[4:],
            table[channel.name],
            table[clock] - table[clock][0],
        )
        on = values > 0.5 * max(float(values.max()), 1e-12)
        charged += [valve] if on[0] else []
        # each run of equal values after the first one
        edges = [*(np.flatnonzero(np.diff(on.astype(int))) + 1).tolist(), len(on)]
        for begin, end in itertools.pairwise(edges):
            duty = float(np.median(values[begin:end])) * (channel.scale or 0.0)
            if on[begin] and (channel.scale is None or duty == 1.0):
                duty = 0.98
            when_s = round(float(time_s[begin] * scale), 6)
            changes.append([when_s, valve, round(duty, 3) if on[begin] else 0.0])
    return charged, sorted(changes, key=str)
