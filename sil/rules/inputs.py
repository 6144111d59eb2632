"""What the firmware may conclude from the frames that it received.

An independent receiver takes the same frames; a report is judged by what had arrived at its step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import numpy as np

from can_dbc.codec import can_id_of
from can_dbc.e2e import ACCEPTED, Receiver
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    E2eState,
    Fault,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from controller.settings import SensorConfig, WindowConfig
from sil.recording.run_record import RunRecord
from sil.rules.reports import sent
from sil.rules.rule import Broken, Circumstances

CHANNELS: dict[type, tuple[Fault, str]] = {
    PositionPulse: (Fault.POSITION_LOST, "position_timeout_s"),
    ShiftRequest: (Fault.REQUEST_LOST, "request_timeout_s"),
    DrivelineSpeeds: (Fault.SPEEDS_LOST, "speeds_timeout_s"),
}
"""What the firmware receives: the fault that tells the loss, and the setting of its timeout."""

UNSEEN = Fault.POSITION_LOST | Fault.POSITION_IMPLAUSIBLE | Fault.SENSOR_STUCK


@dataclass(frozen=True)
class _Step:
    """A report of the controller, and what it could know when it made it."""

    at_s: float
    status: ControllerStatus
    arrived: list[Any]  # the messages that have been accepted since the report before
    valid_s: float  # when the channel was valid last


def _steps(record: RunRecord, circumstances: Circumstances, kind: Any) -> list[_Step]:
    timeout_ns = round(_timeout_s(circumstances, kind) * NS_PER_S)
    computation_ns = circumstances.control.computation_ns * circumstances.slow_clock
    key = kind, timeout_ns, computation_ns, circumstances.deaf_s
    if key not in record.derived:
        record.derived[key] = list(_each_step(record, *key))
    return cast("list[_Step]", record.derived[key])


def _each_step(
    record: RunRecord,
    kind: Any,
    timeout_ns: int,
    computation_ns: float,
    deaf_s: tuple[tuple[float, float], ...],
) -> Iterator[_Step]:
    frames = [
        frame
        for frame in record.frames_of(can_id_of(kind))
        if not any(begin <= frame.arrival_ns / NS_PER_S <= end for begin, end in deaf_s)
    ]
    reports = record.frames_of(can_id_of(ControllerStatus))
    begins = [round(report.released_ns - computation_ns) for report in reports]
    start_ns = min(begins[:1] + [frame.arrival_ns for frame in frames[:1]], default=0)
    # counts from the firmware's first step
    channel = Receiver(kind, timeout_ns, max(start_ns, 0))
    # the record may be a piece of a run: until frames have followed each other
    valid_s = _begin_s(record) + 0.05
    taken = 0
    for sent_s, status in sorted(sent(record, ControllerStatus), key=lambda report: report[0]):
        at_ns, arrived = round(sent_s * NS_PER_S - computation_ns), []
        while taken < len(frames) and frames[taken].arrival_ns <= at_ns:
            if channel.receive(frames[taken].arrival_ns, frames[taken].frame) in ACCEPTED:
                arrived.append(channel.message)
            taken += 1
        if channel.state(max(at_ns, start_ns, 0)) is E2eState.VALID:
            valid_s = max(valid_s, at_ns / NS_PER_S)
        yield _Step(at_ns / NS_PER_S, status, arrived, valid_s)


def _begin_s(record: RunRecord) -> float:
    return float(record.truth["time_s"][0]) if len(record.truth["time_s"]) else 0.0


def _timeout_s(circumstances: Circumstances, kind: type) -> float:
    return float(getattr(circumstances.control.e2e, CHANNELS[kind][1]) * circumstances.slow_clock)


def _grace_s(circumstances: Circumstances) -> float:
    """Return how much later in s than the channel's end the firmware may notice it."""
    return 2.0 * circumstances.control.period_s * circumstances.slow_clock + 0.005


def blind_gear(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No gear is confirmed without valid position samples."""
    for step in _steps(record, circumstances, PositionPulse):
        blind_s = step.at_s - step.valid_s
        if step.status.confirmed != Gear.UNKNOWN and blind_s > _grace_s(circumstances):
            what = f"is confirmed {1e3 * blind_s:.0f} ms after the last valid sample"
            return step.at_s, f"{step.status.confirmed.name.lower()} {what}"
    return None


def unrequested_push(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No push begins out of rest without a valid request."""
    for before, step in pairwise(_steps(record, circumstances, ShiftRequest)):
        states, deaf_s = (before.status.state, step.status.state), step.at_s - step.valid_s
        if states == (ShiftState.IDLE, ShiftState.PUSH) and deaf_s > _grace_s(circumstances):
            return step.at_s, f"a push begins {1e3 * deaf_s:.0f} ms after the last valid request"
    return None


def false_loss(record: RunRecord, circumstances: Circumstances) -> Broken:
    """Position, request and speeds are not reported lost while their frames arrive."""
    if circumstances.disturbed or not circumstances.true_samples:
        return None
    grace_s = _grace_s(circumstances)
    for kind, (fault, _) in CHANNELS.items():
        startup_s = circumstances.control.e2e.startup_s * circumstances.slow_clock
        startup_s = min(startup_s, _timeout_s(circumstances, kind)) - grace_s
        since_s, before = math.inf, Fault.NONE
        waits = _begin_s(record) == 0.0
        for step in _steps(record, circumstances, kind):
            valid = step.valid_s == step.at_s
            waits = waits and not valid and step.at_s < startup_s
            since_s = min(since_s, step.at_s) if valid else math.inf
            begins = fault in step.status.faults & ~before  # afterwards it may be latched
            if begins and (waits or step.at_s - since_s > grace_s):
                return step.at_s, f"{fault.name} is reported while the frames of the channel arrive"
            before = step.status.faults
    return None


def missed_loss(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No loss of position, request or speeds goes unreported."""
    grace_s, startup_s = _grace_s(circumstances), circumstances.control.e2e.startup_s
    startup_s *= circumstances.slow_clock
    for kind, (fault, _) in CHANNELS.items():
        begin_s = math.inf  # of the firmware, which waits for a channel that has never been valid
        for step in _steps(record, circumstances, kind):
            begin_s = min(begin_s, step.at_s)
            deaf_s = step.at_s - max(step.valid_s, begin_s + startup_s)
            if deaf_s > grace_s and fault not in step.status.faults:
                what = f"is not reported {1e3 * deaf_s:.0f} ms after the last valid frame"
                return step.at_s, f"{fault.name} {what}"
    return None


def unsampled_gear(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No gear is confirmed before its number of samples in a row within its window."""
    control = circumstances.control
    if circumstances.disturbed or not circumstances.true_samples or control.ns_per_instruction:
        return None
    wanted = control.windows.samples
    confirmed = None
    for step, run, window in _windows(record, circumstances):
        gear = step.status.confirmed
        in_row = run if gear is window else 0
        if confirmed is not None and gear not in (confirmed, Gear.UNKNOWN) and in_row < wanted:
            what = f"{gear.name.lower()} is confirmed after {in_row} samples in a row within its window; it takes {wanted}"
            return step.at_s, what
        confirmed = gear
    return None


def _windows(record: RunRecord, circumstances: Circumstances) -> Iterator[tuple[_Step, int, Gear]]:
    """Yield each step with the window of the latest sample, and how many in a row lay within it."""
    control, run, window = circumstances.control, 0, Gear.UNKNOWN
    for step in _steps(record, circumstances, PositionPulse):
        for pulse in step.arrived:
            gear = _window_of(_measured_m(pulse, control.sensor), control.windows)
            run, window = (run + 1 if gear is window else 1), gear
        yield step, run, window


def unconfirmed_gear(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No gear stays unconfirmed at rest while the samples lie within its window."""
    control = circumstances.control
    if circumstances.disturbed:
        return None
    settled_s = 0.2 + (3.0 / control.filter.fc_hz if control.filter.enabled else 0.0)
    wanted = control.windows.samples + math.ceil(settled_s / control.sensor.period_s)
    before = 0  # samples until the firmware came to rest
    steady, position_m = 0, math.nan
    for step, run, window in _windows(record, circumstances):
        status = step.status
        rests = status.state is ShiftState.IDLE and not status.faults & UNSEEN
        before = min(before, run) if rests else run
        for pulse in step.arrived:
            last_m, position_m = position_m, _measured_m(pulse, control.sensor)
            # after a larger step the low-pass filter may overshoot a window's edge
            steady = steady + 1 if abs(position_m - last_m) < 0.0005 else 0
        in_row = min(run - before, steady)
        if in_row >= wanted and window is not Gear.UNKNOWN and status.confirmed == Gear.UNKNOWN:
            what = f"{window.name.lower()} is not confirmed after {in_row} samples in a row"
            return step.at_s, what
    return None


def _measured_m(pulse: PositionPulse, sensor: SensorConfig) -> float:
    warmth = 1.0 + sensor.temp_coeff_per_k * (pulse.coil_temperature_k - sensor.t_ref_k)
    return (pulse.pulse_s / warmth - sensor.t_mid_s) / sensor.slope_s_per_m


def _window_of(position_m: float, windows: WindowConfig) -> Gear:
    """Return in which gear's window a position is; a nanometre is left to rounding."""
    if abs(position_m) >= windows.stroke_m - windows.gear_tolerance_m - 1e-9:
        return Gear.BACKWARD if position_m > 0.0 else Gear.FORWARD
    inside = abs(position_m) <= windows.neutral_tolerance_m + 1e-9
    return Gear.NEUTRAL if inside else Gear.UNKNOWN


def false_position(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No position is reported that the stay was not near within the time of sight."""
    if not (circumstances.true_samples and math.isfinite(circumstances.sight_s)):
        return None
    time_s, position_m = record.truth["time_s"], record.truth["position_m"]
    low_pass = circumstances.control.filter
    back_s = circumstances.sight_s + 2.0 * circumstances.control.e2e.position_timeout_s
    back_s += 2.5 / low_pass.fc_hz if low_pass.enabled else 0.0
    # when the estimate began that is reported: unknown after reports that others have hidden
    afresh_s = math.inf
    gap_s, before_s = 1.5 * circumstances.control.period_s * circumstances.slow_clock, -math.inf
    for step in _steps(record, circumstances, PositionPulse):
        at_s, status = step.at_s, step.status
        follows, before_s = at_s - before_s <= gap_s, at_s
        if step.valid_s >= at_s and not follows:
            afresh_s = -math.inf
        elif step.valid_s < at_s or afresh_s == math.inf:
            afresh_s = at_s if step.valid_s >= at_s and step.arrived else math.inf
        unseen = status.faults & UNSEEN or status.state is ShiftState.INIT
        latched = status.state in (ShiftState.FAULT, ShiftState.INIT)
        latched = latched and not circumstances.disturbed
        if unseen and not (latched and status.faults & UNSEEN in (0, Fault.POSITION_LOST)):
            continue
        since_s = max(at_s - back_s, afresh_s - circumstances.sight_s)
        low, high = np.searchsorted(time_s, [since_s, at_s])
        if since_s < time_s[0] or high <= low:
            continue
        past_m = position_m[low:high]
        away_m = float(max(past_m.min() - status.estimate_m, status.estimate_m - past_m.max()))
        overshoot_m = 0.2 * float(np.ptp(past_m))
        if away_m > 0.0015 + overshoot_m:
            what = f"the position is reported {1e3 * away_m:.1f} mm from anywhere that the stay was within {1e3 * (at_s - since_s):.0f} ms"
            return at_s, what
    return None
