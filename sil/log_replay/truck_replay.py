"""Every shift of a truck's log by our firmware and plant, next to the recorded one.

Checked by: tests/scenarios/test_truck_log.py
"""

from __future__ import annotations

from collections import Counter
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
from sil.log_replay.truck_shift import PHASES, RecordedShift, recorded_shift
from sil.logs import Logs
from sil.shifts.cutter import TRANSMISSION


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
        return f"{self.number}. {shift.gears}{sender}"

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
    damage = [] if reader.report.clean else reader.report.lines()[1:]
    return TruckReplay(log, variants, shifts, [*log.notes, *(f"log: {line}" for line in damage)])


def truck_verdict(shift: ComparedShift, column: int = 0) -> list[str]:
    """Return in sentences where ours would be quicker or softer, and why."""
    if shift.skipped:
        return [f"not simulated: {shift.skipped}"]
    recorded, ours = shift.recorded, shift.ours[column]
    if not ours.reached:
        faults = f" ({ours.faults})" if ours.faults else ""
        return [f"ours does not reach the gear{faults}"]
    if not recorded.is_whole:
        return ["not comparable: the log has a gap inside"]
    early = _early_s(shift, column)
    if early is None:
        lines = ["how long the truck took to the new gear is not known"]
    else:
        theirs, mine = recorded.times_s["engaged"], ours.times_s["engaged"]
        both = f"{mine:.3f} s against {theirs:.3f} s from the request to the new gear"
        known_s = recorded.known_s["engaged"]
        if abs(early) <= known_s:
            lines = [f"as quick: {both}, the log resolves {known_s:.2f} s"]
        else:
            lines = [f"{abs(early):.3f} s {'quicker' if early > 0 else 'slower'}: {both}"]
            lines += _reasons(recorded, ours)
    return [*lines, *_softness(recorded, ours)]


def _early_s(shift: ComparedShift, column: int) -> float | None:
    """Return by how much ours reaches the new gear before the truck, None where not known."""
    theirs, mine = (side.times_s["engaged"] for side in (shift.recorded, shift.ours[column]))
    return None if theirs is None or mine is None else theirs - mine


def _reasons(recorded: RecordedShift, ours: OurShift) -> Iterator[str]:
    """Yield the parts that make the difference, the largest first."""
    parts = []
    before, theirs_before, mine_before = "", 0.0, 0.0
    for name in ("torque_cut", "disengaged", "synchronised", "engaged"):
        theirs, mine = recorded.times_s[name], ours.times_s[name]
        if theirs is None or mine is None:
            continue
        spans = theirs - theirs_before, mine - mine_before
        if abs(spans[0] - spans[1]) >= 0.005:
            parts.append((abs(spans[0] - spans[1]), before, name, *spans))
        before, theirs_before, mine_before = name, theirs, mine
    for _, before, after, theirs, mine in sorted(parts, reverse=True):
        start = PHASES.get(before, "request")
        why = _why(after, recorded, ours, mine < theirs)
        yield f"{start} to {PHASES[after]}: {mine:.3f} s against {theirs:.3f} s{why}"


def _why(after: str, recorded: RecordedShift, ours: OurShift, quicker: bool) -> str:
    if after == "disengaged" and quicker:
        return "; the log shows the gear left only when speeds or reported gear do"
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
    sides = [
        [side_figures(shift, column) for shift in replay.shifts if shift.counts]
        for column in range(len(replay.columns))
    ]
    return [
        {
            "figure": name,
            "unit": unit,
            "columns": [_spread(s[name] for s in side) for side in sides],
        }
        for name, unit in FIGURES.items()
    ]


def _spread(values: Iterable[float | None]) -> dict[str, float | int | None]:
    figures = np.array([value for value in values if value is not None])
    if not len(figures):
        return {"shifts": 0, "median": None, "p95": None}
    median, p95 = np.percentile(figures, (50, 95))
    return {"shifts": len(figures), "median": float(median), "p95": float(p95)}


def quicker(replay: TruckReplay, column: int) -> tuple[int, int, int]:
    """Return in how many counted shifts a variant is quicker, as quick, and slower."""
    counts: Counter[float] = Counter()
    for shift in replay.shifts:
        if shift.counts and (early := _early_s(shift, column)) is not None:
            same = abs(early) <= shift.recorded.known_s["engaged"]
            counts[0.0 if same else np.sign(early)] += 1
    return counts[1.0], counts[0.0], counts[-1.0]
