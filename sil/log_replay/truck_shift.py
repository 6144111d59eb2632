"""A recorded shift of a truck: its phases, and the speeds and torque that caused them.

Assumptions: equal speeds at the synchronizer are the speed ratio of the gear after the shift; the
reported gear is late by up to the period of its message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, get_args

import numpy as np

from sil.j1939.mapping import Gearbox, Meaning
from sil.log_replay.truck_log import Samples, TruckLog
from sil.report.figure import Floats
from sil.shifts.cutter import Shift

PHASES: Final = {
    "torque_cut": "torque cut",
    "disengaged": "gear left",
    "synchronised": "speeds agree",
    "engaged": "new gear reported",
    "torque_back": "torque back",
}
"""Instants of a shift after its request, in order, with their names in words."""

AROUND_S: Final = 1.5
"""Recorded time before and after a shift that is looked at."""


SYNCHRONISED_RAD_S: Final = 2.0
LONGEST_GAP_S: Final = 0.35
"""A longer time without the transmission's frames is a gap: ETC2 comes every 0.1 s."""


@dataclass(frozen=True)
class Synchronisation:
    """The recorded speeds at the synchronizer, on the main shaft, of the gear after the shift.

    difference_rad_s: [n] main_by_output (input/new_ratio - output) at time_s [n], after the request.
    main_rad_s: speed of the main shaft. step_rad_s: the difference in the gear before. delay_s,
    ramp_rad_s2: the straight fall from step to zero, from 90 to 10 % of the step; the delay counts
    from the disengagement. apart_rad_s: the largest distance of the recorded difference from it.
    """

    time_s: Floats
    difference_rad_s: Floats
    main_rad_s: float
    step_rad_s: float
    main_by_output: float
    old_ratio: float
    new_ratio: float
    delay_s: float | None = None
    ramp_rad_s2: float | None = None
    apart_rad_s: float | None = None


@dataclass
class RecordedShift:
    """A shift as the log shows it; times in s after the request, None where not known.

    known_s: uncertainty of an instant, the period of its message. is_whole: no gap of the recording
    or of a sender inside.
    """

    shift: Shift
    request_ns: int
    end_s: float
    signals: Mapping[Meaning, Samples | None]
    times_s: dict[str, float | None]
    known_s: dict[str, float]
    synchronisation: Synchronisation | None
    is_whole: bool
    notes: list[str] = field(default_factory=list)

    @property
    def peak_rad_s2(self) -> float | None:
        """Greatest change of the difference per time while the speeds are synchronised."""
        sync, begin = self.synchronisation, self.times_s["disengaged"]
        if sync is None or begin is None or self.times_s["synchronised"] is None:
            return None
        end = self.times_s["synchronised"] + 0.1
        return peak_rate(sync.time_s, sync.difference_rad_s, begin, end)


def peak_rate(time_s: Floats, values: Floats, begin_s: float, end_s: float) -> float | None:
    """Return the greatest rate of values [n] at time_s [n], over 40 ms or one sample, per second."""
    inside = Samples(time_s, values, "").within(begin_s, end_s)
    t, y = inside.time_s, inside.values
    step = max(1, round(0.04 / inside.period_s)) if len(t) > 1 else 1
    if len(t) <= step:
        return None
    return float(np.max(np.abs(y[step:] - y[:-step]) / (t[step:] - t[:-step])))


def recorded_shift(log: TruckLog, shift: Shift) -> RecordedShift:
    """Return the phases of a shift of the log."""
    around_ns = round(AROUND_S * 1e9)

    def samples(meaning: Meaning, origin_ns: int) -> Samples | None:
        begin_ns, end_ns = shift.start_ns - around_ns, shift.end_ns + around_ns
        return log.samples(meaning, shift, begin_ns, end_ns, origin_ns)

    selected = samples("selected_gear", shift.start_ns)
    early_s = 0.0
    if selected is not None and shift.to_gear is not None:
        early_s = _selected_before(selected, shift.to_gear)
    notes = ["request: the start of the shift in process, no earlier sign of it recorded"]
    if early_s:
        notes = ["request: when the selected gear changed, before the shift in process"]
    request_ns = shift.start_ns + round(1e9 * early_s)
    signals = {meaning: samples(meaning, request_ns) for meaning in get_args(Meaning)}
    gap_s = log.gap_s(shift, shift.start_ns - 100_000_000, shift.end_ns + 100_000_000)
    if gap_s > LONGEST_GAP_S:
        notes.append(f"{gap_s:.2f} s without frames of the transmission inside: not in the figures")
    end_s = (shift.end_ns - request_ns) / 1e9
    times: dict[str, float | None] = dict.fromkeys(PHASES)
    is_whole = gap_s <= LONGEST_GAP_S
    recorded = RecordedShift(shift, request_ns, end_s, signals, times, {}, None, is_whole, notes)
    _speeds(recorded, (shift.start_ns - request_ns) / 1e9, log.mapping.gearbox)
    _reported_gears(recorded)
    _fit_ramp(recorded)
    _torque(recorded)
    return recorded


def _selected_before(selected: Samples, gear: int) -> float:
    """Return how long before the start, as a time <= 0, the gear was selected; 0 if it was not."""
    before = selected.time_s <= 0.0
    others = np.flatnonzero(before & (np.round(selected.values) != gear))
    early_s = selected.time_s[others[-1] + 1 :] if len(others) else selected.time_s[:0]
    return min(float(early_s[0]), 0.0) if len(early_s) else 0.0


def _set(recorded: RecordedShift, phase: str, times: Floats, index: int) -> None:
    """Set an instant to that of a sample, unless its sender was silent before it."""
    before = max(index, 1)
    spacing_s = float(times[before] - times[before - 1]) if len(times) > 1 else np.inf
    if spacing_s > LONGEST_GAP_S:
        silent = f"its sender was silent for {spacing_s:.2f} s"
        recorded.notes.append(f"{PHASES[phase]}: not known, {silent}")
        recorded.times_s[phase] = None
    else:
        recorded.times_s[phase], recorded.known_s[phase] = float(times[index]), spacing_s


def _speeds(recorded: RecordedShift, start_s: float, gearbox: Gearbox) -> None:
    """Fill in disengagement and synchronisation from the shaft speeds."""
    entry, output = recorded.signals["input_shaft_rad_s"], recorded.signals["output_shaft_rad_s"]
    note, end_s = recorded.notes.append, recorded.end_s
    if entry is None or output is None:
        note("shaft speeds not available: synchronisation not known")
        return
    time = entry.time_s
    w_in, w_out = entry.values, np.interp(time, output.time_s, output.values)
    steady_before, settled_after = (start_s - 0.6, start_s - 0.05), (end_s + 0.1, end_s + 0.7)
    moving = w_out > 2.1  # 20 rpm: below, a ratio means nothing
    ratios = w_in[moving] / w_out[moving]
    possible = (ratios > 0.2) & (ratios < 40.0)  # others: neutral, the clutch or a sensor
    ratio = Samples(time[moving][possible], ratios[possible], "")
    old, new = ratio.median(*steady_before), ratio.median(*settled_after)
    during = Samples(time, w_out, "").median(start_s, end_s)
    from_gear = bool(recorded.shift.from_gear)
    if not recorded.shift.to_gear:
        return
    slow = during is None or during < 2.1
    if new is None or during is None or slow or (old is None and from_gear):
        note("speed ratios not known: the vehicle too slow, or no speeds")
        return
    old = old or new
    if abs(old / new - 1.0) < 0.03 and from_gear:
        note(f"speed ratio {old:.2f} before, {new:.2f} after: nothing to synchronise")
        return
    factor = gearbox.main_shaft_by_output(new)
    difference = factor * (w_in / new - w_out)
    step = factor * during * (old / new - 1.0)
    sync = Synchronisation(time, difference, factor * during, step, factor, old, new)
    recorded.synchronisation = sync
    inside = (time >= start_s) & (time <= settled_after[0])
    t, d = time[inside], difference[inside]
    if len(t) > 1 and np.max(np.diff(t)) > LONGEST_GAP_S:
        note("shaft speeds missing for a while during the shift: not in the figures")
        recorded.is_whole = False
    settled = Samples(time, difference, "").within(*settled_after)
    away = np.flatnonzero(np.abs(d) > max(SYNCHRONISED_RAD_S, _scatter(settled)))
    agreed = int(away[-1]) + 1 if len(away) else 0
    if agreed >= len(t):
        note("the speeds never agree within the shift")
        return
    _set(recorded, "synchronised", t, agreed)
    if from_gear:
        before = Samples(time, factor * (w_in - old * w_out) / new, "")
        band = max(0.01 * abs(factor * during), _scatter(before.within(*steady_before)))
        left = np.flatnonzero(np.abs(before.values[inside]) > band)
        if len(left):
            _set(recorded, "disengaged", t, int(left[0]))


def _scatter(steady: Samples) -> float:
    """Return six times the median deviation from the median: what noise hardly exceeds."""
    if not len(steady.values):
        return 0.0
    return 6.0 * float(np.median(np.abs(steady.values - np.median(steady.values))))


def _fit_ramp(recorded: RecordedShift) -> None:
    """Fit the straight fall of the difference between disengagement and synchronisation."""
    sync, begin = recorded.synchronisation, recorded.times_s["disengaged"]
    if sync is None or begin is None or recorded.times_s["synchronised"] is None:
        return
    difference = Samples(sync.time_s, sync.difference_rad_s, "").within(begin, recorded.end_s + 0.1)
    t, share, step = difference.time_s, difference.values / sync.step_rad_s, abs(sync.step_rad_s)
    if not (share <= 0.1).any():
        return
    high, low = np.argmax(share <= 0.9), np.argmax(share <= 0.1)
    taken_s = max(float(t[low] - t[high]), 0.01)  # at least a period of ETC1
    ramp = 0.8 * step / taken_s
    delay_s = max(0.0, float(t[high]) - begin - 0.1 * step / ramp)
    fallen = np.clip(1.0 - (t - begin - delay_s) * ramp / step, 0.0, 1.0)
    apart = float(np.max(np.abs(share - fallen)) * step)
    recorded.synchronisation = replace(sync, delay_s=delay_s, ramp_rad_s2=ramp, apart_rad_s=apart)


def _reported_gears(recorded: RecordedShift) -> None:
    """Fill in what the reported gear shows: neutral before the speeds do, the new one after them."""
    gears, target = recorded.signals["current_gear"], recorded.shift.to_gear
    times, synchronised = recorded.times_s, recorded.times_s["synchronised"]
    if gears is not None and len(gears.values) > 1:
        later = gears.time_s >= 0.0
        neutral = np.flatnonzero((np.round(gears.values) == 0) & later)
        left_s = recorded.end_s if times["disengaged"] is None else times["disengaged"]
        if recorded.shift.from_gear and len(neutral) and gears.time_s[neutral[0]] <= left_s:
            _set(recorded, "disengaged", gears.time_s, int(neutral[0]))
        reported = np.flatnonzero((np.round(gears.values) == target) & later)
        if len(reported):
            _set(recorded, "engaged", gears.time_s, int(reported[0]))
    engaged = times["engaged"]
    if synchronised is not None and (engaged is None or engaged < synchronised):
        times["engaged"] = synchronised
        recorded.known_s["engaged"] = recorded.known_s["synchronised"]
        note = "engaged: when the speeds agreed for good, the gear was not reported later"
        recorded.notes.append(note)


def _torque(recorded: RecordedShift) -> None:
    """Fill in the cut of the engine's torque, and when it is back; a change by less than 10 % is none."""
    torque, times = recorded.signals["engine_torque_share"], recorded.times_s
    if torque is None:
        recorded.notes.append("engine torque not available: torque cut and return not known")
        return
    before = torque.median(-0.5, 0.0)
    until = times["disengaged"] if times["disengaged"] is not None else recorded.end_s
    during = torque.within(0.0, until + torque.period_s)
    if before is not None and len(during.values) > 1:
        least = float(np.min(during.values))
        if before - least >= 0.1:
            cut = during.values <= least + 0.1 * (before - least)
            _set(recorded, "torque_cut", during.time_s, int(np.argmax(cut)))
        else:
            note = f"engine torque hardly changes ({before:.0%} before): no cut to see"
            recorded.notes.append(note)
    engaged = times["engaged"]
    after = torque.median(recorded.end_s + 0.5, recorded.end_s + 1.0)
    if engaged is None or after is None:
        return
    later = torque.within(engaged, recorded.end_s + AROUND_S)
    if len(later.values) > 1 and after - later.values[0] >= 0.1:
        back = later.values >= later.values[0] + 0.9 * (after - later.values[0])
        if back.any():
            _set(recorded, "torque_back", later.time_s, int(np.argmax(back)))
