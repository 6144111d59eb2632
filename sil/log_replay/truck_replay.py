"""Every shift of a truck's log by our firmware and plant, next to the recorded one.

Checked by: tests/scenarios/test_truck_log.py
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

import numpy as np

from can_dbc.codec import can_id_of
from can_dbc.errors import InputError
from can_dbc.messages import ValveCommand
from sil.files.overrides import NO_SETTINGS, Settings, setting_texts
from sil.files.progress import Progress
from sil.j1939.mapping import ANY_SOURCE, SignalMapping
from sil.log_replay.options import firmware_of
from sil.log_replay.tick_grid import HEAD_FRAMES
from sil.log_replay.truck_log import TruckLog, is_data_of
from sil.log_replay.truck_loop import Input, OurShift, inputs_of, simulate, why_not
from sil.log_replay.truck_shift import NAMES, RecordedShift, recorded_shift
from sil.logs import Logs
from sil.shifts.cutter import TRANSMISSION, gear_name


@dataclass(frozen=True)
class Variant:
    """A column of the comparison: our defaults, or what the user changed."""

    name: str
    changes: str = ""
    table: dict[str, Any] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class ComparedShift:
    """A recorded shift and ours by each variant; without ours, `skipped` says why."""

    number: int
    recorded: RecordedShift
    inputs: list[Input]
    ours: list[OurShift]
    skipped: str | None = None

    @property
    def title(self) -> str:
        """Number and gears, and the sender's address if it is not the usual one."""
        shift = self.recorded.shift
        sender = f" ({shift.source:#04x})" if shift.source not in (TRANSMISSION, ANY_SOURCE) else ""
        gears = f"{gear_name(shift.from_gear)} to {gear_name(shift.to_gear)}"
        return f"{self.number}. {gears}{sender}"

    @property
    def counts(self) -> bool:
        """Whether the shift is in the statistics."""
        return self.skipped is None and self.recorded.is_whole


@dataclass(frozen=True)
class TruckReplay:
    """The comparison of a whole log."""

    log: TruckLog
    variants: list[Variant]
    shifts: list[ComparedShift]
    notes: list[str]

    @property
    def columns(self) -> list[str]:
        """The names of the columns."""
        return ["recorded", *(variant.name for variant in self.variants)]

    @property
    def failed(self) -> list[ComparedShift]:
        """The shifts in which our firmware, by any variant, did not reach the gear."""
        return [s for s in self.shifts if not all(ours.reached for ours in s.ours)]


def replay_truck(
    reader: Logs,
    *,
    map: str | None = None,
    dbc: str | None = None,
    settings: Settings = NO_SETTINGS,
    firmware: str | None = None,
) -> TruckReplay | None:
    """Compare every shift of a log with ours; None if the log is of our own control unit.

    `map`: mapping file; with one the log is a truck's, whatever is in it. `dbc`: the layout that its
    names are of. `settings` and `firmware` make a second column.
    Raises InputError for a log without shaft speeds, gears or shifts, and for wrong settings.
    """
    path = reader.path
    unit_id = None if map is not None else can_id_of(ValveCommand)
    if any(is_data_of(frame, unit_id) for frame in islice(reader, HEAD_FRAMES)):
        return None
    log = TruckLog(path, SignalMapping(map, dbc))
    if not log.read(reader, unit_id):
        return None
    log.require_shifts()
    if reader.report.time_base == "none":
        raise InputError(
            f"{path}: has no times, so that no shift can be timed; expected a log with times"
        )
    variants = [Variant("ours")]
    if settings or firmware:
        changes = ", ".join([*([firmware] if firmware else []), *setting_texts(settings)])
        table = firmware_of(firmware) if firmware else {}
        variants.append(Variant("what-if", changes, table, settings))
    shifts = []
    with Progress("shifts") as progress:
        for number, shift in enumerate(log.shifts, start=1):
            recorded = recorded_shift(log, shift)
            skipped = why_not(recorded)
            inputs = [] if skipped else inputs_of(recorded)
            ours = [
                simulate(recorded, inputs, path, variant.table, variant.settings)
                for variant in variants
                if not skipped
            ]
            shifts.append(ComparedShift(number, recorded, inputs, ours, skipped))
            progress(number, len(log.shifts))
    notes = list(log.notes)
    if not reader.report.clean:
        notes += [f"log: {line}" for line in reader.report.lines()[1:]]
    return TruckReplay(log, variants, shifts, notes)


def truck_verdict(shift: ComparedShift, column: int = 0) -> list[str]:
    """Return in sentences where ours would be quicker or softer, and why."""
    if shift.skipped:
        return [f"not simulated: {shift.skipped}"]
    recorded, ours = shift.recorded, shift.ours[column]
    if not ours.reached:
        faults = f" ({ours.faults})" if ours.faults else ""
        return [f"ours does not reach the gear{faults}"]
    lines = []
    theirs, mine = recorded.times_s["engaged"], ours.times_s["engaged"]
    assert mine is not None
    if not recorded.is_whole:
        return ["not comparable: the log has a gap inside"]
    if theirs is None:
        lines.append("how long the truck took to the new gear is not known")
    else:
        early = theirs - mine
        both = f"{mine:.3f} s against {theirs:.3f} s from the request to the new gear"
        known_s = recorded.known_s["engaged"]
        if abs(early) <= known_s:
            lines.append(f"as quick: {both}, the log resolves {known_s:.2f} s")
        else:
            lines.append(f"{abs(early):.3f} s {'quicker' if early > 0 else 'slower'}: {both}")
            lines += _reasons(recorded, ours)
    return [*lines, *_softness(recorded, ours)]


def _reasons(recorded: RecordedShift, ours: OurShift) -> Iterator[str]:
    """Yield the parts that make the difference, the largest first."""
    parts = []
    instants = [
        name
        for name in ("torque_cut", "disengaged", "synchronised", "engaged")
        if recorded.times_s[name] is not None and ours.times_s[name] is not None
    ]
    for before, after in zip(["", *instants], instants, strict=False):
        theirs = recorded.times_s[after] - (recorded.times_s[before] if before else 0.0)  # type: ignore[operator]
        mine = ours.times_s[after] - (ours.times_s[before] if before else 0.0)  # type: ignore[operator]
        if abs(theirs - mine) >= 0.005:
            parts.append((abs(theirs - mine), before, after, theirs, mine))
    for _, before, after, theirs, mine in sorted(parts, reverse=True):
        start = NAMES.get(before, "request")
        why = _why(after, recorded, ours, mine < theirs)
        yield f"{start} to {NAMES[after]}: {mine:.3f} s against {theirs:.3f} s{why}"


def _why(after: str, recorded: RecordedShift, ours: OurShift, quicker: bool) -> str:
    if after == "disengaged":
        return (
            "; the log shows the gear left only when speeds or reported gear do" if quicker else ""
        )
    if after == "synchronised":
        if ours.left_rad_s is not None and ours.left_rad_s > 2.0:
            return (
                f"; our cone takes the last {ours.left_rad_s:.1f} rad/s with {ours.impulse_n_s:.0f} N s "
                "while the engine still synchronises"
            )
        return "; the engine has synchronised as recorded before our cone has anything to take"
    if after == "engaged":
        known_s = recorded.known_s["engaged"]
        if recorded.times_s["synchronised"] is None and recorded.shift.to_gear:
            return "; what the truck waited for is not recorded"
        return f"; ours confirms by its position sensor, the truck reports every {known_s:.2f} s"
    return ""


def _softness(recorded: RecordedShift, ours: OurShift) -> Iterator[str]:
    if recorded.peak_rad_s2 and ours.peak_rad_s2 is not None:
        share = ours.peak_rad_s2 / recorded.peak_rad_s2
        word = "softer" if share < 0.9 else "harder" if share > 1.1 else "as soft"
        yield (
            f"{word}: the speeds meet at up to {ours.peak_rad_s2:.0f} rad/s² against "
            f"{recorded.peak_rad_s2:.0f} rad/s²"
        )
    if ours.impact_speed_m_s is not None:
        yield f"our stay meets its stop at {ours.impact_speed_m_s:.2f} m/s; the truck's is not recorded"


FIGURES: Final = {
    "request to new gear": "s",
    "torque cut to new gear": "s",
    "gear left to speeds agree": "s",
    "peak of synchronising": "rad/s²",
    "impact speed": "m/s",
}


def side_figures(shift: ComparedShift, column: int) -> dict[str, float | None]:
    """Return the figures of a column, by their names in `FIGURES`: 0 recorded, 1 ours, 2 ours as changed."""
    side = shift.ours[column - 1] if column else shift.recorded

    def between(before: str, after: str) -> float | None:
        a, b = side.times_s[before], side.times_s[after]
        return None if a is None or b is None else b - a

    values = (
        side.times_s["engaged"],
        between("torque_cut", "engaged"),
        between("disengaged", "synchronised"),
        side.peak_rad_s2,
        side.impact_speed_m_s if isinstance(side, OurShift) else None,
    )
    return dict(zip(FIGURES, values, strict=True))


def statistics(replay: TruckReplay) -> list[dict[str, Any]]:
    """Return median and 95 % of each figure and column, over the shifts without gaps."""
    shifts = [shift for shift in replay.shifts if shift.counts]
    rows = []
    for name, unit in FIGURES.items():
        columns = [
            _spread(side_figures(shift, column)[name] for shift in shifts)
            for column in range(len(replay.columns))
        ]
        rows.append({"figure": name, "unit": unit, "columns": columns})
    return rows


def _spread(values: Iterable[float | None]) -> dict[str, float | int | None]:
    figures = np.array([value for value in values if value is not None])
    if not len(figures):
        return {"shifts": 0, "median": None, "p95": None}
    median, p95 = np.percentile(figures, (50, 95))
    return {"shifts": len(figures), "median": float(median), "p95": float(p95)}


def quicker(replay: TruckReplay, column: int) -> tuple[int, int, int]:
    """Return in how many counted shifts a variant is quicker, as quick, and slower."""
    counts = [0, 0, 0]
    for shift in replay.shifts:
        if not shift.counts or not shift.ours[column].reached:
            continue
        theirs, mine = shift.recorded.times_s["engaged"], shift.ours[column].times_s["engaged"]
        if theirs is None or mine is None:
            continue
        within = abs(theirs - mine) <= shift.recorded.known_s["engaged"]
        counts[1 if within else 0 if mine < theirs else 2] += 1
    return counts[0], counts[1], counts[2]
