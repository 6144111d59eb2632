"""Metrics of a run from the plant's true motion; the lag also from the bus alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

from can_dbc.messages import (
    Chamber,
    ControllerStatus,
    Gear,
    PlantMotion,
    SafetyBlow,
    ShiftRequest,
    ValveCommand,
)
from sil.coupling.clock import NS_PER_S
from sil.recording.interpolation import hermite, monotone_slopes
from sil.recording.run_record import CHAMBERS, Floats, M, PlantEvent, RunRecord

ARRIVED_WITHIN_M = 5e-5
"""The stay counts as arrived this close to its stop: one step of the external potentiometer."""

OPEN_ABOVE = 0.34
"""A commanded duty above this is meant to open (closed at or below 0.33, open at or above 0.35)."""

LONGEST_SHIFT_S = 120.0
"""A shift's figures are taken from its request to the next one, at most this long."""

GEAR_CHAMBER = {Gear.BACKWARD: "B", Gear.NEUTRAL: "N", Gear.FORWARD: "F"}


class Shift(msgspec.Struct, frozen=True, kw_only=True):
    """One shift: instants in s of simulated time from request to confirmation; None = never."""

    from_gear: str
    to_gear: str
    requested_s: float
    commanded_s: float | None
    valve_open_s: float | None
    first_motion_s: float | None
    arrived_s: float | None
    confirmed_s: float | None
    blow_end_s: float | None
    shift_time_s: float | None
    impact_speed_m_s: float | None
    impact_energy_j: float | None
    position_lag_10_s: float | None
    position_lag_90_s: float | None
    position_lag_10_held_s: float | None
    position_lag_90_held_s: float | None
    bus_lag_10_s: float | None
    bus_lag_90_s: float | None


def crossing(times: Floats, values: Floats, level: float, rising: bool) -> float | None:
    """Return when sampled values [n] over times [n] in s first reach a level; None if never.

    The unit of values is that of the level; between samples the line is straight.
    """
    beyond = values >= level if rising else values <= level
    if not beyond.any():
        return None
    i = int(np.argmax(beyond))
    if i == 0:
        return float(times[0])
    share = (level - values[i - 1]) / (values[i] - values[i - 1])
    return float(times[i - 1] + share * (times[i] - times[i - 1]))


def held_crossing(times: Floats, values: Floats, level: float, rising: bool) -> float | None:
    """Return the time of the first sample, of values [n] at times [n] in s, at or past a level."""
    beyond = values >= level if rising else values <= level
    return float(times[int(np.argmax(beyond))]) if beyond.any() else None


def phase_averaged_crossing(
    times: Floats, values: Floats, level: float, rising: bool
) -> float | None:
    """Return when held values [n], sampled at times [n] in s, reach a level, averaged over the phase.

    The line through the samples (monotone cubic) crosses at t. The held value follows between zero
    and one sampling period later, half a period on average: t + (t[i] - t[i-1]) / 2.
    Assumes that the line is monotone near the crossing.
    """
    beyond = values >= level if rising else values <= level
    if not beyond.any():
        return None
    i = int(np.argmax(beyond))
    if i == 0:
        return float(times[0])
    near = slice(max(i - 4, 0), i + 4)
    t, y = times[near], values[near]
    fine = np.linspace(times[i - 1], times[i], 201)
    line = hermite(t, y, monotone_slopes(t, y), fine) if len(t) > 2 else np.interp(fine, t, y)
    between = crossing(fine, line, level, rising)
    assert between is not None  # the last sample is beyond the level
    return between + 0.5 * float(times[i] - times[i - 1])


def gear_position_m(gear: Gear, stroke_m: float) -> float:
    """Return the position of a gear in m: 0 neutral, +stroke backward, -stroke forward."""
    return {Gear.NEUTRAL: 0.0, Gear.BACKWARD: stroke_m, Gear.FORWARD: -stroke_m}[gear]


def gear_at(position_m: float, stroke_m: float, within_m: float = ARRIVED_WITHIN_M) -> Gear:
    """Return the gear whose stop the position is at, UNKNOWN between them."""
    for gear in (Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD):
        if abs(position_m - gear_position_m(gear, stroke_m)) <= within_m:
            return gear
    return Gear.UNKNOWN


def requests(record: RunRecord, initial: Gear) -> list[tuple[float, Gear, Gear]]:
    """Return (release time in s, from, to) of each change of the requested gear on the bus."""
    found: list[tuple[float, Gear, Gear]] = []
    current = initial
    for entry, message in record.each(ShiftRequest):
        if message.target != current:
            found.append((entry.released_ns / NS_PER_S, current, message.target))
            current = message.target
    return found


def spans(
    changes: Sequence[tuple[float, Gear, Gear]], end_s: float
) -> list[tuple[float, Gear, Gear, float]]:
    """Return (from when, from, to, until when) of each shift of a run that ends at `end_s`."""
    bounds = [*(t for t, _, _ in changes), max(end_s, changes[-1][0])][1:] if changes else []
    return [
        (*change, min(until, change[0] + LONGEST_SHIFT_S))
        for change, until in zip(changes, bounds, strict=True)
    ]


def shifts(record: RunRecord, initial: Gear) -> list[Shift]:
    """Return one Shift for each change of the requested gear, in order."""
    end = float(record.truth["time_s"][-1]) if len(record.truth["time_s"]) else 0.0
    return [shift_figures(record, *span) for span in spans(requests(record, initial), end)]


def _first(
    record: RunRecord, kind: type[M], start: float, until: float, wanted: Callable[[M], bool]
) -> float | None:
    for entry, message in record.of(kind):
        at = entry.arrival_ns / NS_PER_S
        if start <= at <= until and wanted(message):
            return at
    return None


def shift_figures(
    record: RunRecord, start: float, source: Gear, target: Gear, until: float
) -> Shift:
    """Return the figures of one shift; `record` holds at least the time from start to until, s."""
    chamber = GEAR_CHAMBER.get(target)
    truth = record.truth
    time = truth["time_s"]
    window = (time >= start - 1e-9) & (time <= until + 1e-9)
    t, x = time[window], truth["position_m"][window]
    known = chamber is not None and len(t) > 0
    goal = gear_position_m(target, record.stroke_m) if known else 0.0
    origin = float(x[0]) if len(x) else 0.0
    arrived = first_motion = None
    if known:
        there = np.abs(x - goal) <= ARRIVED_WITHIN_M
        arrived = float(t[int(np.argmax(there))]) if there.any() else None
        moved = np.abs(x - origin) > ARRIVED_WITHIN_M
        first_motion = float(t[int(np.argmax(moved))]) if moved.any() else None
    stop = _stop_event(record.events, start, until, goal) if known else None
    if stop is not None:
        arrived = stop.time_s
    letter = chamber or "N"
    duty = f"duty_{letter.lower()}"
    commanded = _first(record, ValveCommand, start, until, lambda m: getattr(m, duty) > OPEN_ABOVE)
    opened = next(
        (
            e.time_s
            for e in record.events
            if e.name == f"valve_{letter}_open" and e.time_s >= start and e.time_s <= until
        ),
        None,
    )
    blow = [
        e.arrival_ns / NS_PER_S
        for e, m in record.of(SafetyBlow)
        if m.active and m.chamber == Chamber[letter] and start <= e.arrival_ns / NS_PER_S <= until
    ]
    lags = (
        _lags(record, origin, goal, start, until) if known and arrived is not None else [None] * 6
    )
    return Shift(
        from_gear=source.name.lower(),
        to_gear=target.name.lower(),
        requested_s=start,
        commanded_s=commanded,
        valve_open_s=opened,
        first_motion_s=first_motion,
        arrived_s=arrived,
        confirmed_s=_first(record, ControllerStatus, start, until, lambda m: m.confirmed == target),
        blow_end_s=blow[-1] if blow else None,
        shift_time_s=None if arrived is None else arrived - start,
        impact_speed_m_s=None if stop is None else abs(float(stop.values["speed_m_s"])),
        impact_energy_j=None if stop is None else float(stop.values["energy_j"]),
        position_lag_10_s=lags[0],
        position_lag_90_s=lags[1],
        position_lag_10_held_s=lags[2],
        position_lag_90_held_s=lags[3],
        bus_lag_10_s=lags[4],
        bus_lag_90_s=lags[5],
    )


def _stop_event(
    events: Sequence[PlantEvent], start: float, until: float, goal_m: float
) -> PlantEvent | None:
    """Return the stay's first impact on the stop of the wanted gear."""
    for event in events:
        if event.name != "stay_stop" or not start <= event.time_s <= until:
            continue
        if abs(float(event.values["position_m"]) - goal_m) <= ARRIVED_WITHIN_M:
            return event
    return None


def _lags(
    record: RunRecord, origin: float, goal: float, start: float, until: float
) -> list[float | None]:
    """Return three pairs of lags in s at 10 % and 90 % of travel; None where there is none.

    Averaged over the phase of the sampling, as held in this run, and from the bus log alone (the
    plant's truth frames against the controller's status frames).
    """
    rising = goal > origin
    levels = [origin + share * (goal - origin) for share in (0.1, 0.9)]
    time, position = record.truth["time_s"], record.truth["position_m"]
    inside = (time >= start - 1e-9) & (time <= until + 1e-9)
    true = [crossing(time[inside], position[inside], level, rising) for level in levels]
    when, estimate = record.estimate
    inside = (when >= start) & (when <= until)
    when, estimate = when[inside], estimate[inside]
    mean = [phase_averaged_crossing(when, estimate, level, rising) for level in levels]
    held = [held_crossing(when, estimate, level, rising) for level in levels]
    bus = _truth_on_bus(record, start, until, levels, rising)
    return [
        *(_minus(a, b) for a, b in zip(mean, true, strict=True)),
        *(_minus(a, b) for a, b in zip(held, true, strict=True)),
        *(_minus(a, b) for a, b in zip(mean, bus, strict=True)),
    ]


def _truth_on_bus(
    record: RunRecord, start: float, until: float, levels: list[float], rising: bool
) -> list[float | None]:
    entries = [
        (e.released_ns / NS_PER_S, m.position_m, m.velocity_m_s)
        for e, m in record.of(PlantMotion)
        if start <= e.released_ns / NS_PER_S <= until
    ]
    if len(entries) < 2:
        return [None for _ in levels]
    times, values, slopes = np.array(entries, dtype=np.float64).T
    fine = np.arange(times[0], times[-1], 1e-4)
    line = hermite(times, values, slopes, fine)
    return [crossing(fine, line, level, rising) for level in levels]


def _minus(later: float | None, earlier: float | None) -> float | None:
    return None if later is None or earlier is None else later - earlier


def valve_switchings(record: RunRecord) -> int:
    """Return how often any valve actually moved (either way)."""
    return sum(1 for e in record.events if e.name.startswith("valve_") and e.name[6:7] in CHAMBERS)


def summary(record: RunRecord, found: Sequence[Shift], air_used_kg: float | None) -> dict[str, Any]:
    """Return the metrics of result.json.

    `shift_time_s` is the time spent shifting: the sum over the shifts of request to arrival at the
    stop, None when one of them never arrived. Impact speed and energy are the worst of all shifts;
    lags are those of the last shift that completed.
    """
    return whole_run(found, air_used_kg, valve_switchings(record), len(record.frames))


def whole_run(
    found: Sequence[Shift], air_used_kg: float | None, switchings: int, frames: int
) -> dict[str, Any]:
    """Return what `summary` does, of a run whose valve switchings and frames are counted already."""
    times = [s.shift_time_s for s in found]
    speeds = [s.impact_speed_m_s for s in found if s.impact_speed_m_s is not None]
    energies = [s.impact_energy_j for s in found if s.impact_energy_j is not None]
    complete = [s for s in found if s.position_lag_10_s is not None]
    last = complete[-1] if complete else None
    total = None if not times or None in times else sum(t for t in times if t is not None)
    return {
        "shift_time_s": total,
        "impact_speed_m_s": max(speeds, default=None),
        "impact_energy_j": max(energies, default=None),
        "position_lag_10_s": last.position_lag_10_s if last else None,
        "position_lag_90_s": last.position_lag_90_s if last else None,
        "bus_lag_10_s": last.bus_lag_10_s if last else None,
        "bus_lag_90_s": last.bus_lag_90_s if last else None,
        "air_used_kg": air_used_kg,
        "valve_switchings": switchings,
        "frames": frames,
        "shifts": [msgspec.to_builtins(s) for s in found],
    }
