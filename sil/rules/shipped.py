"""The rules that every run is held to.

Two limits. A single position sensor whose error looks like a motion (it or its thermometer stuck,
or wrong by a constant) cannot be distinguished from one. End-to-end protection carries no time and no secret:
frames repeated a whole round of the counter later (15 to 16 periods), or repeated of a sender that
is silent, pass as new. A report is then as old as the repetition; a coil is not held on by one
repeated message, because the driver needs both commands and blows to be good. ETC2 carries the gear
without protection, as in J1939, so reports are judged by the status frames.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from can_dbc.codec import can_id_of, decode
from can_dbc.e2e import ACCEPTED, E2eStatus, Receiver
from can_dbc.errors import CodecError
from can_dbc.instants import NS_PER_S
from can_dbc.messages import (
    Chamber,
    ControllerStatus,
    Fault,
    Gear,
    SafetyBlow,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from controller.strategies import parameters
from sil.recording.run_record import CHAMBERS, OPEN_ABOVE, RunRecord
from sil.recording.runs import true_runs
from sil.rules import inputs
from sil.rules.reports import accepted, falsely_reported, sent
from sil.rules.rule import Broken, Circumstances, Rule

PUSHING = (ShiftState.PUSH, ShiftState.CONFIRM)


def orphaned(record: RunRecord, circumstances: Circumstances) -> NDArray[np.bool_]:
    """Return at which rows [n] of the trace a coil is energised without a living controller.

    Counted from the valve driver's timeout, plus the longest time that a frame can still take to
    arrive; and while no command of the controller has arrived for longer than that timeout.
    """
    time_s = record.truth["time_s"]
    if not len(time_s):
        return np.zeros(0, dtype=np.bool_)
    on = np.any([record.truth[f"cmd_{c}"] > OPEN_ABOVE for c in CHAMBERS], axis=0)
    commanded_s = [float(time_s[0])] + [
        entry.arrival_ns / NS_PER_S
        for entry in record.frames_of(can_id_of(ValveCommand))
        if entry.sender == "controller"
    ]
    timeout_s = circumstances.driver_timeout_s
    last_s = np.array(commanded_s)[np.searchsorted(commanded_s, time_s, side="right") - 1]
    alone = time_s - last_s > timeout_s + 0.001
    for start_s, end_s in circumstances.down_s:
        begin_s = start_s + timeout_s + 0.005 + circumstances.late_s
        alone |= (time_s > begin_s) & (time_s < end_s)
    return np.asarray(on & alone)


def _orphan_coil(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No coil is energised without a living controller, longer than the valve driver's timeout."""
    rows = np.flatnonzero(orphaned(record, circumstances))
    if not len(rows):
        return None
    return float(record.truth["time_s"][rows[0]]), "a coil is energised without a living controller"


def _false_gear(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No gear is reported that the stay is not in, longer than a motion takes to be observed."""
    control, time_s = circumstances.control, record.truth["time_s"]
    longest_s = circumstances.sight_s + circumstances.repeated_s
    # the firmware answers for its reports, not for how long the last one is believed
    stands_s = 1.5 * control.period_s * circumstances.slow_clock
    arrivals_s = (
        np.array([entry.arrival_ns for entry, _ in accepted(record, ControllerStatus)]) / NS_PER_S
    )
    for begin, end in true_runs(falsely_reported(record, control.windows)):
        last_s = arrivals_s[np.searchsorted(arrivals_s, time_s[end - 1], side="right") - 1]
        lasted_s = float(min(time_s[end - 1], last_s + stands_s) - time_s[begin])
        if lasted_s > longest_s:
            what = f"a gear that the stay is not in is reported for {1e3 * lasted_s:.0f} ms; a motion shows within {1e3 * longest_s:.0f} ms"
            return float(time_s[begin]), what
    return None


def _energised(record: RunRecord, closed: float) -> dict[Chamber, list[float]]:
    """Return when, s, the controller sent a command or a blow that energises each chamber's coil."""
    on: dict[Chamber, set[float]] = {Chamber.B: set(), Chamber.N: set(), Chamber.F: set()}
    for at_s, command in sent(record, ValveCommand):
        for chamber, times in on.items():
            if getattr(command, f"duty_{chamber.name.lower()}") > closed:
                times.add(at_s)
    for at_s, blow in sent(record, SafetyBlow):
        if blow.active and blow.chamber in on:
            on[blow.chamber].add(at_s)
    return {chamber: sorted(times) for chamber, times in on.items()}


def _opposed_chambers(record: RunRecord, circumstances: Circumstances) -> Broken:
    """Backward and forward are not filled sooner after each other than the interlock."""
    control = circumstances.control
    on = _energised(record, control.duty_closed)
    least_s = (control.shift.interlock_s - 1e-6) * circumstances.slow_clock
    for chamber, opposite in ((Chamber.B, Chamber.F), (Chamber.F, Chamber.B)):
        for at_s in on[chamber]:
            before = bisect_right(on[opposite], at_s)
            gap_s = at_s - on[opposite][before - 1] if before else math.inf
            if gap_s < least_s:
                return at_s, f"{chamber.name} is filled {1e3 * gap_s:.0f} ms after {opposite.name}"
    return None


def _coil_on_time(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No coil is energised longer than a push may last with its blow."""
    if circumstances.disturbed:
        return None  # what was lost may have been the commands that switch it off
    control, shift = circumstances.control, circumstances.control.shift
    attempts = 1 if shift.retry_pause_s > 3.0 * control.period_s else shift.retries + 1
    most_s = attempts * shift.push_timeout_s + 2.0 * control.blow.duration_s + 0.1
    most_s *= circumstances.slow_clock
    for chamber, times in _energised(record, control.duty_closed).items():
        begin_s = last_s = -math.inf
        for at_s in times:
            if at_s - last_s > 1.9 * control.period_s * circumstances.slow_clock:
                begin_s = at_s  # off in between for a step at least
            last_s = at_s
            if at_s - begin_s > most_s:
                return at_s, f"the coil of {chamber.name} is on for more than {most_s:.2f} s"
    return None


def _request_changes(record: RunRecord) -> Iterator[tuple[float, ShiftRequest, float]]:
    """Yield arrival in s of each changed request, the request, and until when it is the present one."""
    groups = (next(same) for _, same in groupby(record.each(ShiftRequest), itemgetter(1)))
    changes = [(entry.arrival_ns / NS_PER_S, message) for entry, message in groups]
    ends_s = [at_s for at_s, _ in changes[1:]] + [math.inf]
    for (at_s, message), end_s in zip(changes, ends_s, strict=False):
        yield at_s, message, end_s


def _answer_s(circumstances: Circumstances, before: ControllerStatus | None, target: Gear) -> float:
    """Return the longest time in s in which a request is answered by a gear or by a refusal.

    Its leg with all attempts; a leg to neutral before it, and whatever is under way, with its blow; the
    start of the firmware until it has found its gear. before: the status when the request came.
    """
    control = circumstances.control
    shift = control.shift
    leg_s = (shift.retries + 1) * shift.push_timeout_s + shift.retries * shift.retry_pause_s
    at_rest = before is not None and before.state is ShiftState.IDLE
    straight = before is not None and Gear.NEUTRAL in (target, before.confirmed)
    total_s = leg_s + shift.interlock_s + 6.0 * control.period_s
    total_s += shift.sync_wait_s if shift.wait_for_sync else 0.0
    if not (at_rest and straight):
        total_s += leg_s + 2.0 * control.blow.duration_s + shift.retry_pause_s
    if not at_rest:
        total_s += shift.init_timeout_s + shift.init_settle_s + control.e2e.startup_s
    return total_s * circumstances.slow_clock


def _unanswered_request(record: RunRecord, circumstances: Circumstances) -> Broken:
    """Every request is answered in time, by the gear or by a fault."""
    if circumstances.disturbed or circumstances.down_s:
        return None  # what neither side received is nobody's to answer
    if circumstances.forced or not circumstances.true_samples:
        return None  # a leg may begin anew at any time
    time_s = record.truth["time_s"]
    end_s = float(time_s[-1]) if len(time_s) else 0.0
    status = [(e.arrival_ns / NS_PER_S, m) for e, m in record.of(ControllerStatus)]
    times = [t for t, _ in status]
    earlier: Gear | None = None
    for at_s, request, until_s in _request_changes(record):
        first = bisect_right(times, at_s)
        before = status[first - 1][1] if first else None
        if earlier is not None and before is not None and not _is_answer(before, earlier):
            before = None  # the step that takes this request may begin the push of the earlier one
        earlier = request.target
        latest_s = at_s + _answer_s(circumstances, before, request.target)
        if latest_s > min(until_s, end_s):
            continue
        answers = (m for _, m in status[first : bisect_right(times, latest_s)])
        if not any(_is_answer(m, request.target) for m in answers):
            what = f"{request.target.name.lower()}, requested at {at_s:.2f} s, is neither confirmed nor refused"
            return latest_s, what
    return None


def _is_answer(status: ControllerStatus, target: Gear) -> bool:
    refused = status.faults is not Fault.NONE or status.state is ShiftState.FAULT
    return refused or status.confirmed == target


def _early_refusal(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No push is given up before all its attempts have timed out."""
    shift, period_s = circumstances.control.shift, circumstances.control.period_s
    least_s = (shift.retries + 1) * shift.push_timeout_s + shift.retries * shift.retry_pause_s
    least_s = (least_s - 3.0 * period_s) * circumstances.slow_clock
    pushed_s = -math.inf
    timed_out = False
    for at_s, status in sent(record, ControllerStatus):
        expired = Fault.SHIFT_TIMEOUT in status.faults
        if expired and not timed_out and at_s - pushed_s < least_s:
            what = f"a push is given up after {at_s - pushed_s:.2f} s; its attempts last {least_s:.2f} s"
            return None if circumstances.disturbed else (at_s, what)
        timed_out = expired
        # a push goes on after a blow in which the stay slipped
        if status.state not in (*PUSHING, ShiftState.BLOW, ShiftState.VENT):
            pushed_s = at_s
    return None


def _too_many_attempts(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No push is tried more often than its retries allow."""
    if circumstances.disturbed:
        return None
    most = circumstances.control.shift.retries + 1
    legs = {
        e.released_ns: c.target for e, c in record.each(ValveCommand) if e.sender == "controller"
    }
    attempts, leg, before, pausing = 0, None, ShiftState.INIT, False
    for entry, status in record.each(ControllerStatus):
        if status.state in PUSHING:
            target = legs.get(entry.released_ns)
            if target is not leg or not (before in PUSHING or pausing):
                attempts = 1
            elif before is ShiftState.VENT:
                attempts += 1
            leg = target
            if attempts > most:
                at_s = entry.released_ns / NS_PER_S
                return at_s, f"attempt {attempts} of a push begins; there are {most}"
        pausing = status.state is ShiftState.VENT and (pausing or before in PUSHING)
        before = status.state
    return None


def _early_rest(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No rest begins without a gear before the search for it has timed out."""
    control = circumstances.control
    if circumstances.disturbed or control.ns_per_instruction:
        return None
    least_s = (control.shift.init_timeout_s - 3.0 * control.period_s) * circumstances.slow_clock
    searches_s, before = -math.inf, ShiftState.INIT  # the record may begin within a search
    for at_s, status in sent(record, ControllerStatus):
        if status.state is ShiftState.INIT and before is not ShiftState.INIT:
            searches_s = at_s
        ends = before is ShiftState.INIT and status.state is ShiftState.IDLE
        if ends and status.confirmed == Gear.UNKNOWN and at_s - searches_s < least_s:
            what = f"ready without a gear after a search of {at_s - searches_s:.2f} s; it lasts {least_s:.2f} s"
            return at_s, what
        before = status.state
    return None


def _cut_short(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No blow, hold or vent of a requested gear ends before it has lasted as long as it is set."""
    control = circumstances.control
    if control.blow.cut == "confirmation" or circumstances.disturbed or control.ns_per_instruction:
        return None
    blow_s = control.blow.duration_s
    if control.strategy == "blow_cut":
        limits = parameters("blow_cut", control.strategy_parameters)
        blow_s = min(blow_s, limits.otherwise_s)  # type: ignore[attr-defined]
    stages = (ShiftState.BLOW, ShiftState.HOLD, ShiftState.VENT, ShiftState.IDLE)
    set_s = (blow_s, control.shift.hold_s, control.shift.vent_s)
    requests, tolerance_s = list(_request_changes(record)), 2.0 * control.period_s
    begun_s, before = math.inf, ShiftState.INIT
    for at_s, status in sent(record, ControllerStatus):
        stage = ShiftState.BLOW if before in PUSHING else before  # one of no length
        ends = stage in stages[:-1] and status.state is stages[stages.index(stage) + 1]
        lasted_s = at_s - begun_s if stage is before else 0.0
        least_s = set_s[stages.index(stage)] - tolerance_s if ends else -math.inf
        if lasted_s < least_s * circumstances.slow_clock:
            since_s, gear = at_s - lasted_s - tolerance_s, status.confirmed
            if any(r.target == gear and t < since_s and at_s < u for t, r, u in requests):
                name = stage.name.lower()
                return at_s, f"the {name} of {gear.name.lower()} ends after {1e3 * lasted_s:.0f} ms"
        if status.state is not before:
            begun_s = at_s
        before = status.state
    return None


def _unnamed_fault(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No fault state is reported without the fault that led to it."""
    unnamed = ~(Fault.REQUEST_LOST | Fault.SPEEDS_LOST | Fault.REQUEST_INVALID)
    what = "the fault state is reported without a fault"
    for at_s, status in sent(record, ControllerStatus):
        if status.state is ShiftState.FAULT and not status.faults & unnamed:
            return at_s, what
    return None


def _internal_fault(record: RunRecord, circumstances: Circumstances) -> Broken:
    """No error of the firmware itself is reported (INTERNAL)."""
    what = "the firmware caught an error of its own"
    reports = sent(record, ControllerStatus)
    return next(((at_s, what) for at_s, m in reports if Fault.INTERNAL in m.faults), None)


def _sender_rules(record: RunRecord, circumstances: Circumstances) -> Broken:
    """Every frame of the controller has the right counter and checksum."""
    if circumstances.disturbed or circumstances.down_s:
        return None  # the record holds what the bus made of the frames
    for kind in (ValveCommand, SafetyBlow, ControllerStatus):
        receiver = Receiver(kind)
        for entry in record.frames_of(can_id_of(kind)):
            status = receiver.receive(entry.arrival_ns, entry.frame)
            if status not in (*ACCEPTED, E2eStatus.INITIAL) or status is E2eStatus.OK_SOME_LOST:
                what = f"{kind.__name__}: counter or checksum: {status.value} {receiver.reason}"
                return entry.released_ns / NS_PER_S, what.strip()
    return None


def _outputs_in_range(record: RunRecord, circumstances: Circumstances) -> Broken:
    """Every value that the controller sends is within the range of the DBC."""
    if circumstances.disturbed:
        return None
    for kind in (ValveCommand, SafetyBlow, ControllerStatus):
        for entry in record.frames_of(can_id_of(kind)):
            try:
                decode(entry.frame)
            except CodecError as error:
                return entry.released_ns / NS_PER_S, str(error)
    return None


RULES = tuple(
    Rule(first.__name__.lstrip("_"), first.__doc__ or "", source, first)
    for first, source in (
        (_orphan_coil, "valve driver of the plant; ISO 26262-6, safe state"),
        (_false_gear, "thesis 2.2.4: confirmation by position"),
        (inputs.blind_gear, "controller.e2e.position_timeout_s; AUTOSAR PRS E2E Protocol"),
        (inputs.unsampled_gear, "controller.windows.samples"),
        (inputs.unconfirmed_gear, "shift state machine: a gear is confirmed again at rest"),
        (inputs.false_position, "thesis 2.2.4: position sensor and filter"),
        (inputs.unrequested_push, "controller.e2e.request_timeout_s; AUTOSAR PRS E2E Protocol"),
        (inputs.false_loss, "controller.e2e.startup_s; AUTOSAR PRS E2E Protocol"),
        (inputs.missed_loss, "controller.e2e; AUTOSAR PRS E2E Protocol"),
        (_opposed_chambers, "controller.shift.interlock_s"),
        (_coil_on_time, "controller.shift.push_timeout_s, controller.blow.duration_s"),
        (_unanswered_request, "shift state machine: push, retries, fault"),
        (_early_refusal, "controller.shift.push_timeout_s, controller.shift.retries"),
        (_too_many_attempts, "controller.shift.retries"),
        (_early_rest, "controller.shift.init_timeout_s"),
        (_cut_short, "thesis 6.1; controller.blow, shift.hold_s, shift.vent_s"),
        (_unnamed_fault, "shift state machine: a fault is latched with its state"),
        (_internal_fault, "controller.firmware"),
        (_sender_rules, "AUTOSAR PRS E2E Protocol, profile 2"),
        (_outputs_in_range, "can_dbc/opc4.dbc"),
    )
)
