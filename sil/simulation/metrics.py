"""Metrics of a run from the plant's true motion; the lag also from the bus alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.e2e import M
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    ControllerStatus,
    Gear,
    PlantMotion,
    SafetyBlow,
    ShiftRequest,
    ValveCommand,
)
from sil.firmware import cost
from sil.recording.interpolation import hermite, monotone_slopes
from sil.recording.run_record import CHAMBERS, OPEN_ABOVE, Floats, PlantEvent, RunRecord
from sil.recording.runs import true_runs
from sil.simulation.impacts import HOLD_S, PICK_UP, counted, worst_speed_m_s

ARRIVED_WITHIN_M = 5e-5
"""The stay counts as arrived this close to its stop: one step of the external potentiometer."""

LAGS = (
    *("position_lag_10_s", "position_lag_90_s", "position_lag_10_held_s"),
    *("position_lag_90_held_s", "bus_lag_10_s", "bus_lag_90_s"),
)
WORST = ("impact_worst_m_s", "impact_worst_energy_j", "impact_worst_force_n", "confirmed_early_s")
"""Figures of a shift of which the summary gives the largest."""

METRICS = {
    "shift_time_s": "time from request to stop",
    "impact_speed_m_s": "impact speed",
    "impact_energy_j": "impact energy",
    "impact_worst_m_s": "hardest impact, as a speed",
    "impact_worst_energy_j": "hardest impact, energy",
    "impact_worst_force_n": "hardest impact, peak force",
    "confirmed_early_s": "confirmed before arrival",
    "position_lag_10_s": "estimate late at 10 %",
    "position_lag_90_s": "estimate late at 90 %",
    "bus_lag_10_s": "the same on the bus, 10 %",
    "bus_lag_90_s": "the same on the bus, 90 %",
    "air_used_kg": "air used",
    "valve_switchings": "valve switchings",
    "frames": "frames on the bus",
    **cost.METRICS,
}
"""Numbers of the summary: of all shifts, of the last one (the lags), of the run as a whole."""


class Impact(msgspec.Struct, frozen=True, kw_only=True):
    """One impact of a shift that counts, see `sil.simulation.impacts`."""

    time_s: float
    name: str
    position_m: float
    energy_j: float
    peak_force_n: float


class Shift(msgspec.Struct, frozen=True, kw_only=True):
    """One shift: instants in s of simulated time from request to confirmation; None = never.

    arrived_s: at its stop for `HOLD_S` at least, or to the end. confirmed_early_s: by how much sooner it was
    confirmed, None without confirmation. impact_...: first impact of the stay on its stop; impact_worst_...:
    the hardest of `impacts`, as a speed of the stay, energy, peak force.
    """

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
    impact_worst_m_s: float | None
    impact_worst_energy_j: float | None
    impact_worst_force_n: float | None
    confirmed_early_s: float | None
    impacts: list[Impact]
    position_lag_10_s: float | None
    position_lag_90_s: float | None
    position_lag_10_held_s: float | None
    position_lag_90_held_s: float | None
    bus_lag_10_s: float | None
    bus_lag_90_s: float | None


def _first_past(values: Floats, level: float, rising: bool) -> int | None:
    """Return the index of the first value at or past a level, None without one."""
    beyond = values >= level if rising else values <= level
    return int(np.argmax(beyond)) if beyond.any() else None


def crossing(times: Floats, values: Floats, level: float, rising: bool) -> float | None:
    """Return when values [n] over times [n] in s, joined by lines, reach a level; None if never."""
    i = _first_past(values, level, rising)
    if not i:
        return None if i is None else float(times[0])
    share = (level - values[i - 1]) / (values[i] - values[i - 1])
    return float(times[i - 1] + share * (times[i] - times[i - 1]))


def held_crossing(times: Floats, values: Floats, level: float, rising: bool) -> float | None:
    """Return the time of the first sample, of values [n] at times [n] in s, at or past a level."""
    i = _first_past(values, level, rising)
    return None if i is None else float(times[i])


def phase_averaged_crossing(
    times: Floats, values: Floats, level: float, rising: bool
) -> float | None:
    """Return when held values [n], sampled at times [n] in s, reach a level, averaged over the phase.

    The line through the samples (monotone cubic) crosses at t. The held value follows between zero
    and one sampling period later, half a period on average: t + (t[i] - t[i-1]) / 2.
    Assumes that the line is monotone near the crossing.
    """
    i = _first_past(values, level, rising)
    if not i:
        return None if i is None else float(times[0])
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


def gear_at(
    position_m: float,
    stroke_m: float,
    within_m: float = ARRIVED_WITHIN_M,
    neutral_within_m: float = ARRIVED_WITHIN_M,
) -> Gear:
    """Return the gear whose stop the position is at, within a tolerance; UNKNOWN between them."""
    for gear in (Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD):
        width_m = neutral_within_m if gear == Gear.NEUTRAL else within_m
        if abs(position_m - gear_position_m(gear, stroke_m)) <= width_m:
            return gear
    return Gear.UNKNOWN


def requests(record: RunRecord, initial: Gear) -> list[tuple[float, Gear, Gear]]:
    """Return (release time in s, from, to) of each change of the requested gear on the bus."""
    changes: list[tuple[float, Gear, Gear]] = []
    current = initial
    for entry, message in record.each(ShiftRequest):
        if message.target != current:
            changes.append((entry.released_ns / NS_PER_S, current, message.target))
            current = message.target
    return changes


def spans(
    changes: Sequence[tuple[float, Gear, Gear]], end_s: float
) -> list[tuple[float, Gear, Gear, float]]:
    """Return (from when, from, to, until when) of each shift of a run that ends at `end_s`."""
    bounds = [*(t for t, _, _ in changes), max(end_s, changes[-1][0])][1:] if changes else []
    return [
        (*change, min(until, change[0] + 120.0))
        for change, until in zip(changes, bounds, strict=True)
    ]


def shifts(record: RunRecord, initial: Gear) -> list[Shift]:
    """Return one Shift for each change of the requested gear, in order."""
    end = float(record.truth["time_s"][-1]) if len(record.truth["time_s"]) else 0.0
    return [shift_figures(record, *span) for span in spans(requests(record, initial), end)]


def _first(
    record: RunRecord, kind: type[M], start: float, until: float, wanted: Callable[[M], bool]
) -> float | None:
    times = ((entry.arrival_ns / NS_PER_S, message) for entry, message in record.of(kind))
    return next((at for at, message in times if start <= at <= until and wanted(message)), None)


def shift_figures(
    record: RunRecord, start: float, source: Gear, target: Gear, until: float
) -> Shift:
    """Return the figures of one shift; `record` holds at least the time from start to until, s."""
    truth = record.truth
    window = _within(truth["time_s"], start, until)
    t, x = truth["time_s"][window], truth["position_m"][window]
    moves = target is not Gear.UNKNOWN and len(t) > 0
    letter = "N" if target is Gear.UNKNOWN else target.name[0]  # of its chamber
    goal = gear_position_m(target, record.stroke_m) if moves else 0.0
    origin = float(x[0]) if len(x) else 0.0
    arrived = first_motion = stop = None
    if moves:
        arrived = _arrival(t, np.abs(x - goal) <= ARRIVED_WITHIN_M, record.events, goal)
        first_motion = next(map(float, t[np.abs(x - origin) > ARRIVED_WITHIN_M]), None)
        stop = _stop_event(record.events, start, until, goal)
    impacts = _impacts(record, start, until, (source, target))
    speed = 0.0 if stop is None else abs(float(stop.values["speed_m_s"]))
    confirmed = _first(record, ControllerStatus, start, until, lambda m: m.confirmed == target)
    early = None
    if confirmed is not None:
        early = max((until if arrived is None else arrived) - confirmed, 0.0)
    is_open = attrgetter(f"duty_{letter.lower()}")
    commanded = _first(record, ValveCommand, start, until, lambda m: is_open(m) > OPEN_ABOVE)
    name = f"valve_{letter}_open"
    opened = (e.time_s for e in record.events if e.name == name and start <= e.time_s <= until)
    frames = record.of(SafetyBlow)
    blows = [e.arrival_ns / NS_PER_S for e, m in frames if m.active and m.chamber.name == letter]
    blow_end = max((at for at in blows if start <= at <= until), default=None)
    lags: dict[str, Any] = dict.fromkeys(LAGS)
    if moves and arrived is not None:
        lags = dict(zip(LAGS, _lags(record, origin, goal, start, until), strict=True))
    return Shift(
        from_gear=source.name.lower(),
        to_gear=target.name.lower(),
        requested_s=start,
        commanded_s=commanded,
        valve_open_s=next(opened, None),
        first_motion_s=first_motion,
        arrived_s=arrived,
        confirmed_s=confirmed,
        blow_end_s=blow_end,
        shift_time_s=None if arrived is None else arrived - start,
        impact_speed_m_s=None if stop is None else speed,
        impact_energy_j=None if stop is None else float(stop.values["energy_j"]),
        **_worst(impacts, speed, record.moving_mass_kg),
        confirmed_early_s=early,
        impacts=impacts,
        **lags,
    )


def _arrival(
    t: Floats, at_stop: NDArray[np.bool_], events: Sequence[PlantEvent], goal_m: float
) -> float | None:
    """Return when the stay arrives to remain at its stop, from samples [n] at times t in s."""
    for begin, end in true_runs(at_stop):
        if end == len(t) or t[end - 1] - t[begin] >= HOLD_S:
            stop = _stop_event(events, t[max(begin - 1, 0)], t[end - 1], goal_m)
            return float(t[begin]) if stop is None else stop.time_s
    return None


def _impacts(record: RunRecord, start: float, until: float, way: tuple[Gear, Gear]) -> list[Impact]:
    """Return the impacts of a shift that count, in order of time."""
    events = [e for e in record.events if start <= e.time_s <= until and "energy_j" in e.values]
    names = np.array([e.name for e in events])
    counts = counted(
        names,
        np.array([e.time_s for e in events]),
        np.array([float(e.values["energy_j"]) for e in events]),
        np.asarray(names == "sync_block", dtype=np.bool_),
        PICK_UP.get((way[0].name.lower(), way[1].name.lower()), ()),
    )
    figures = ("position_m", "energy_j", "peak_force_n")
    return [
        Impact(time_s=e.time_s, name=e.name, **{n: float(e.values[n]) for n in figures})
        for e, is_counted in zip(events, counts, strict=True)
        if is_counted
    ]


def _worst(impacts: Sequence[Impact], stay_m_s: float, mass_kg: float) -> dict[str, float | None]:
    """Return the hardest impact as a speed, its energy and its peak force; None without one."""
    if not impacts:
        return dict.fromkeys(WORST[:3])
    worst = max(impacts, key=lambda impact: impact.energy_j)
    speed_m_s = worst_speed_m_s(np.array(worst.energy_j), np.array(stay_m_s), mass_kg)
    return dict(zip(WORST, (float(speed_m_s), worst.energy_j, worst.peak_force_n), strict=False))


def _within(times: Floats, start: float, until: float) -> NDArray[np.bool_]:
    return (times >= start - 1e-9) & (times <= until + 1e-9)


def _stop_event(
    events: Sequence[PlantEvent], start: float, until: float, goal_m: float
) -> PlantEvent | None:
    """Return the stay's first impact on the stop of the requested gear."""
    stops = (e for e in events if e.name == "stay_stop" and start <= e.time_s <= until)
    at_goal = (e for e in stops if abs(float(e.values["position_m"]) - goal_m) <= ARRIVED_WITHIN_M)
    return next(at_goal, None)


def _lags(
    record: RunRecord, origin: float, goal: float, start: float, until: float
) -> list[float | None]:
    """Return pairs of lags in s at 10 % and 90 % of travel: phase-averaged, as held, and from the bus alone."""
    rising = goal > origin
    levels = [origin + share * (goal - origin) for share in (0.1, 0.9)]
    inside = _within(record.truth["time_s"], start, until)
    time, position = record.truth["time_s"][inside], record.truth["position_m"][inside]
    true = [crossing(time, position, level, rising) for level in levels]
    when, estimate = record.estimate
    inside = (when >= start) & (when <= until)
    when, estimate = when[inside], estimate[inside]
    mean = [phase_averaged_crossing(when, estimate, level, rising) for level in levels]
    in_this_run = [held_crossing(when, estimate, level, rising) for level in levels]
    bus = _truth_on_bus(record, start, until, levels, rising)
    pairs = zip([*mean, *in_this_run, *mean], [*true, *true, *bus], strict=True)
    return [None if later is None or early is None else later - early for later, early in pairs]


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


def valve_switchings(record: RunRecord) -> int:
    """Return how often any valve actually moved (either way)."""
    return sum(1 for e in record.events if e.name.startswith("valve_") and e.name[6:7] in CHAMBERS)


def summary(
    shifts: Sequence[Shift], air_used_kg: float | None, switchings: int, frames: int
) -> dict[str, Any]:
    """Return the metrics of result.json.

    `shift_time_s`: the sum over shifts of request to arrival, None when one never arrived. Impacts and early
    confirmation: the worst of all shifts. Lags: of the last shift that completed.
    """
    times = [s.shift_time_s for s in shifts]
    last = next((s for s in reversed(shifts) if s.position_lag_10_s is not None), None)
    return {
        "shift_time_s": None if not times or None in times else sum(t for t in times if t),
        **{
            name: max((v for s in shifts if (v := getattr(s, name)) is not None), default=None)
            for name in ("impact_speed_m_s", "impact_energy_j", *WORST)
        },
        **{name: last and getattr(last, name) for name in LAGS if "held" not in name},
        "air_used_kg": air_used_kg,
        "valve_switchings": switchings,
        "frames": frames,
        "shifts": [msgspec.to_builtins(s) for s in shifts],
    }
