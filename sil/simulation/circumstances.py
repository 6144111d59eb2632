"""What the rules may know of a run of a scenario.

Checked by: tests/unit/sil/simulation/test_safety.py
"""

from __future__ import annotations

import math

from sil.coupling.faults import (
    Babbling,
    BusFault,
    BusOff,
    Dead,
    Delay,
    OtherBitRate,
    Replayed,
    Stalled,
)
from sil.rules.rule import Circumstances
from sil.simulation.scenario import Scenario


def circumstances(scenario: Scenario) -> Circumstances:
    """Return what the rules may know of a run of this scenario."""
    faults = scenario.fault
    of_controller = [f for f in faults if getattr(f, "node", "") == "controller"]
    kinds = [fault.kind for fault in scenario.sensor_fault]
    kinds += [fault.kind for fault in scenario.temperature_fault]
    replayed = [f for f in faults if isinstance(f, Replayed)]
    repeats = any(f.message == "PositionPulse" for f in replayed)
    lies = "wrong" in kinds or "stuck" in kinds
    return Circumstances(
        control=scenario.controller,
        driver_timeout_s=scenario.valve_driver.timeout_s,
        late_s=math.inf if _overloaded(scenario) else _stated_delays_s(scenario),
        sight_s=math.inf if lies or _overloaded(scenario) else sight_s(scenario),
        true_samples=not (scenario.temperature_fault or repeats)
        and {"off", "slow", "intermittent"}.issuperset(kinds),
        repeated_s=max(
            (f.delay_s for f in replayed if f.message == "ControllerStatus"), default=0.0
        ),
        down_s=tuple(
            _interval_s(f)
            for f in faults
            if (isinstance(f, Dead | Stalled) and f.node == "controller")
            or (isinstance(f, BusOff | OtherBitRate) and f.node in ("controller", "plant"))
        ),
        disturbed=bool(faults) or scenario.bus.extra_load > 0.0,
        deaf_s=tuple(_interval_s(f) for f in of_controller if isinstance(f, OtherBitRate)),
        forced=bool(scenario.valve_fault),
        slow_clock=1.0 / (1.0 + 1e-6 * scenario.clock.controller_ppm),
    )


def sight_s(scenario: Scenario) -> float:
    """Return the longest time in s until a motion shows in the status frames, with the stated delays."""
    sensor, controller = scenario.sensor, scenario.controller
    total_s = sensor.period_s + sensor.capture_s + sensor.delay_s
    late = max((f.late for f in scenario.sensor_fault if f.kind == "delayed"), default=0)
    total_s += late * sensor.period_s
    return total_s + 2.0 * controller.period_s + 0.005 + _stated_delays_s(scenario)


def _stated_delays_s(scenario: Scenario) -> float:
    """Return the longest delay in s that faults of the bus add to a frame."""
    return sum(f.delay_s + f.jitter_s for f in scenario.fault if isinstance(f, Delay))


def _overloaded(scenario: Scenario) -> bool:
    """Return whether foreign frames leave the bus less than half, so that others may wait for any time."""
    loads = [scenario.bus.extra_load, *(f.load for f in scenario.fault if isinstance(f, Babbling))]
    return sum(loads) > 0.5


def _interval_s(fault: BusFault) -> tuple[float, float]:
    return fault.start_s, math.inf if fault.end_s is None else fault.end_s
