"""What a fault did: when it was seen, how the run ended, what was at risk.

Safe states that the firmware and the plant's valve driver are to keep, whatever up to two things
fail: no coil stays energised by a controller that no longer lives (longer than the driver's
timeout), and no gear is reported that the stay is not in (longer than a motion takes to be seen).

Two limits. A single position sensor that lies like a motion (it or its thermometer stuck, or wrong by
a constant) cannot be told from one. And end-to-end protection knows no time and no secret: frames repeated a whole
round of the counter later (15 to 16 periods), or repeated of a sender that has gone silent, pass
for new. A report is then as old as the repetition; a coil is not held so by one repeated message,
because the driver wants both commands and blows to be good. ETC2 tells the gear of the status frame
without any protection, as J1939 has it: reports are judged by the status frames.

Checked by: tests/unit/sil/simulation/test_safety.py, tests/faults/
"""

from __future__ import annotations

import math
from itertools import zip_longest

import numpy as np

from can_dbc.codec import can_id_of
from can_dbc.e2e import E2eConfig, E2eStatus, Receiver
from can_dbc.messages import ControllerStatus, E2eState, Fault, Gear, ValveCommand
from sil.coupling.clock import NS_PER_S
from sil.coupling.faults import BusOff, Dead, Delay, Stalled
from sil.recording.run_record import BusFrame, RunRecord
from sil.simulation.metrics import gear_position_m
from sil.simulation.scenario import Scenario

FILLED_PA = 3e5
"""A chamber at this absolute pressure can move the stay against its friction."""

ENERGISED = 0.34
"""Duty above which a coil is meant to be energised."""

REPORT_HOLDS_S = 0.05
"""After this long without a new one, nobody believes a status frame any more."""

COLUMNS = (
    "detected_after_s",
    "fault_bits",
    "coils_off_after_s",
    "end_position_m",
    "end_gear",
    "reported_gear",
    "energised_at_end",
    "worst_impact_m_s",
    "both_filled_s",
    "half_engaged",
    "orphan_energised_s",
    "false_gear_s",
)
"""Gears as the contract numbers them: 0 neutral, 1 backward, 2 forward, 3 unknown."""


def fault_start_s(scenario: Scenario) -> float:
    """Instant [s] at which the first stated fault begins; inf without one.

    Other nodes' load and clocks that drift are there from the start.
    """
    clock = scenario.clock
    if scenario.bus.extra_load or clock.controller_ppm or clock.driver_ppm:
        return 0.0
    lists = (
        scenario.fault,
        scenario.sensor_fault,
        scenario.temperature_fault,
        scenario.speed_fault,
        scenario.valve_fault,
    )
    return min((fault.start_s for faults in lists for fault in faults), default=math.inf)


def figures(record: RunRecord, scenario: Scenario) -> dict[str, float]:
    """The safety figures of a finished run, by `COLUMNS`; nan where there is none.

    detected_after_s: from the first fault's start to the first status frame that reports one not
    reported before. coils_off_after_s: until the last coil was switched off. reported_gear: what a
    receiver believes at the end, nan when it believes no report. both_filled_s: for how long the
    chambers B and F were both filled. half_engaged: the stay ended between its gears.
    """
    start = fault_start_s(scenario)
    truth = record.truth
    time_s, position = truth["time_s"], truth["position_m"]
    windows = scenario.controller.windows
    status = believed_status(record)
    before = Fault.NONE
    bits, detected = 0, math.nan
    for entry, message in status:
        if message is None:
            continue
        at = entry.arrival_ns / NS_PER_S
        if at < start:
            before |= message.faults
            continue
        bits |= int(message.faults)
        if math.isnan(detected) and message.faults & ~before:
            detected = at - start
    duties = np.stack([truth[f"cmd_{c}"] for c in "BNF"])
    energised: np.ndarray = np.any(duties > ENERGISED, axis=0)
    late = np.flatnonzero(energised & (time_s >= start))
    off = math.nan
    if len(late) and late[-1] + 1 < len(time_s):
        off = float(time_s[late[-1] + 1]) - start
    end = float(position[-1])
    end_gear = true_gear(
        end, record.stroke_m, windows.neutral_tolerance_m, windows.gear_tolerance_m
    )
    impacts = [abs(float(e.values["speed_m_s"])) for e in record.events if e.name == "stay_stop"]
    both = (truth["pressure_B_pa"] > FILLED_PA) & (truth["pressure_F_pa"] > FILLED_PA)
    step = float(np.median(np.diff(time_s)))
    return {
        "detected_after_s": detected,
        "fault_bits": float(bits),
        "coils_off_after_s": off,
        "end_position_m": end,
        "end_gear": float(end_gear),
        "reported_gear": _reported_at(status, float(time_s[-1])),
        "energised_at_end": float(energised[-1]),
        "worst_impact_m_s": max(impacts, default=math.nan),
        "both_filled_s": float(np.count_nonzero(both)) * step,
        "half_engaged": float(end_gear == Gear.UNKNOWN),
        "orphan_energised_s": orphan_energised_s(record, scenario),
        "false_gear_s": false_gear_s(record, scenario),
    }


Reports = list[tuple[BusFrame, ControllerStatus | None]]


def believed_status(record: RunRecord) -> Reports:
    """Status frames as a receiver takes them that checks their end-to-end protection.

    None stands where the channel is no longer valid: from that frame on nothing is believed.
    """
    receiver = Receiver(ControllerStatus, E2eConfig(timeout_ns=round(REPORT_HOLDS_S * NS_PER_S)))
    wanted = can_id_of(ControllerStatus)
    found: Reports = []
    for entry in record.frames_of(wanted):
        status = receiver.receive(entry.arrival_ns, entry.frame)
        if receiver.state(entry.arrival_ns) is not E2eState.VALID:
            found.append((entry, None))
        elif status in (E2eStatus.OK, E2eStatus.OK_SOME_LOST):
            found.append((entry, receiver.message))
    return found


def _reported_at(status: Reports, at_s: float) -> float:
    """The gear that a receiver believes at an instant [s]; nan when it believes none."""
    if (
        not status
        or status[-1][1] is None
        or at_s - status[-1][0].arrival_ns / NS_PER_S > REPORT_HOLDS_S
    ):
        return math.nan
    return float(status[-1][1].confirmed)


def true_gear(position_m: float, stroke_m: float, neutral_m: float, gear_m: float) -> Gear:
    """The gear in whose window [m] the stay truly is, UNKNOWN between the windows."""
    for gear, width in ((Gear.NEUTRAL, neutral_m), (Gear.BACKWARD, gear_m), (Gear.FORWARD, gear_m)):
        if abs(position_m - gear_position_m(gear, stroke_m)) <= width:
            return gear
    return Gear.UNKNOWN


def controller_down_ns(scenario: Scenario) -> list[tuple[int, float]]:
    """Intervals [ns] in which the controller does not live or the plant cannot hear it."""
    return [
        (
            round(fault.start_s * NS_PER_S),
            math.inf if fault.end_s is None else fault.end_s * NS_PER_S,
        )
        for fault in scenario.fault
        if (isinstance(fault, Dead | Stalled) and fault.node == "controller")
        or (isinstance(fault, BusOff) and fault.node in ("controller", "plant"))
    ]


def orphan_energised_s(record: RunRecord, scenario: Scenario) -> float:
    """For how long [s] the driver energised a coil without a living controller.

    Counted from its timeout, and the longest time a frame can still have been under way, on; and
    wherever no command of the controller itself has arrived for longer than that timeout.
    """
    time_s = record.truth["time_s"]
    under_way = 0.005 + _stated_delays_s(scenario)
    duties = np.stack([record.truth[f"cmd_{c}"] for c in "BNF"])
    wanted = can_id_of(ValveCommand)
    heard_s = [-math.inf] + [
        entry.arrival_ns / NS_PER_S
        for entry in record.frames_of(wanted)
        if entry.sender == "controller"
    ]
    last_s = np.array(heard_s)[np.searchsorted(heard_s, time_s, side="right") - 1]
    silent = time_s - last_s > scenario.valve_driver.timeout_s + 0.001
    orphaned = silent & (duties > ENERGISED).any(axis=0)
    for start_ns, end_ns in controller_down_ns(scenario):
        begin = start_ns / NS_PER_S + scenario.valve_driver.timeout_s + under_way
        down = (time_s > begin) & (time_s < end_ns / NS_PER_S)
        orphaned |= down & (duties > ENERGISED).any(axis=0)
    return float(np.count_nonzero(orphaned)) * float(np.median(np.diff(time_s)))


def false_gear_s(record: RunRecord, scenario: Scenario) -> float:
    """The longest spell [s] in which a gear was reported that the stay was not in.

    A report counts from its arrival to the next one's, at most REPORT_HOLDS_S. The border lies at
    twice the window's width: the sensor's tick, noise and temperature move the firmware's own.
    """
    status = believed_status(record)
    time_s, position = record.truth["time_s"], record.truth["position_m"]
    windows = scenario.controller.windows
    wrong = np.zeros(len(time_s), dtype=bool)
    for (entry, message), follower in zip_longest(status, status[1:]):
        if message is None or message.confirmed == Gear.UNKNOWN:
            continue
        begin = entry.arrival_ns / NS_PER_S
        end = math.inf if follower is None else follower[0].arrival_ns / NS_PER_S
        low, high = np.searchsorted(time_s, [begin, min(end, begin + REPORT_HOLDS_S)])
        neutral = message.confirmed == Gear.NEUTRAL
        width = windows.neutral_tolerance_m if neutral else windows.gear_tolerance_m
        goal = gear_position_m(message.confirmed, record.stroke_m)
        wrong[low:high] = np.abs(position[low:high] - goal) > 2.0 * width
    return longest_run(wrong) * float(np.median(np.diff(time_s)))


def longest_run(flags: np.ndarray) -> int:
    """Length of the longest unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def sight_s(scenario: Scenario) -> float:
    """The longest time [s] before a motion can have reached the status frames.

    A pulse period, the report's way, a step of the firmware, and the frames' way on the bus, with
    what stated faults delay of them.
    """
    sensor, controller = scenario.sensor, scenario.controller
    seen = sensor.period_s + sensor.capture_s + sensor.delay_s
    late = max((f.late for f in scenario.sensor_fault if f.kind == "delayed"), default=0)
    seen += late * sensor.period_s
    return seen + 2.0 * controller.period_s + 0.005 + _stated_delays_s(scenario)


def _stated_delays_s(scenario: Scenario) -> float:
    """How much later [s] than usual faults of the bus may let a frame arrive."""
    return sum(f.delay_s + f.jitter_s for f in scenario.fault if isinstance(f, Delay))
