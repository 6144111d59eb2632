"""What must hold in every step of every run of the firmware."""

from __future__ import annotations

from collections.abc import Sequence

from can_dbc.messages import Chamber, Fault, Gear, ShiftState
from controller.config import FirmwareConfig
from controller.firmware import Outputs
from tests.support.toy_actuator import Row


def duties(out: Outputs) -> tuple[float, float, float]:
    return out.valves.duty_b, out.valves.duty_n, out.valves.duty_f


def energised(out: Outputs) -> set[Chamber]:
    """Chambers that the valve driver keeps energised on these outputs."""
    chambers = (Chamber.B, Chamber.N, Chamber.F)
    on = {chamber for chamber, duty in zip(chambers, duties(out), strict=True) if duty > 0.33}
    if out.blow.active and out.blow.remaining_s > 0.0:
        on.add(out.blow.chamber)
    return on


def check_invariants(rows: Sequence[Row], config: FirmwareConfig | None = None) -> None:
    """Raise AssertionError at the first step that breaks a promise of the firmware."""
    config = config or FirmwareConfig()
    windows = config.windows
    engaged_m = windows.stroke_m - windows.gear_tolerance_m
    last_on_ns: dict[Chamber, int] = {}
    before: Outputs | None = None
    for row in rows:
        out, status = row.out, row.out.status
        state, confirmed = status.state, status.confirmed
        on = energised(out)

        # one chamber, and never backward and forward together or in quick succession
        assert len(on) <= 1
        for chamber, other in ((Chamber.B, Chamber.F), (Chamber.F, Chamber.B)):
            if chamber in on and other in last_on_ns:
                off_ns = row.time_ns - last_on_ns[other] - config.period_ns
                assert off_ns >= config.shift.interlock_s * 1e9
        last_on_ns.update(dict.fromkeys(on, row.time_ns))

        # valves only in the states that have them; a fault has none
        assert all(duty in (0.0, config.duty) for duty in duties(out))
        assert bool(on) == (state in (ShiftState.PUSH, ShiftState.CONFIRM, ShiftState.BLOW))
        assert out.blow.active == (state is ShiftState.BLOW)
        assert out.blow.active == (out.blow.chamber is not Chamber.NONE)
        if out.blow.active:
            # the command holds a coil until the blow has taken over: in the blow's first step only
            from_command = before is not None and not before.blow.active
            was_on = duties(before) if before is not None and from_command else (0.0, 0.0, 0.0)
            expected = [0.0, 0.0, 0.0]
            expected[out.blow.chamber] = was_on[out.blow.chamber]
            assert list(duties(out)) == expected
            assert 0.0 < out.blow.remaining_s <= config.blow.duration_s
        else:
            assert out.blow.remaining_s == 0.0
        before = out
        if state is ShiftState.FAULT:
            assert confirmed is Gear.UNKNOWN
            assert status.faults & ~(Fault.REQUEST_LOST | Fault.SPEEDS_LOST)

        # a gear is confirmed only while the estimate is there, and never during a push
        if state in (ShiftState.PUSH, ShiftState.CONFIRM, ShiftState.INIT):
            assert confirmed is Gear.UNKNOWN
        if status.faults & (Fault.POSITION_LOST | Fault.POSITION_IMPLAUSIBLE | Fault.SENSOR_STUCK):
            assert confirmed is Gear.UNKNOWN
        if confirmed is Gear.NEUTRAL:
            assert abs(status.estimate_m) <= windows.neutral_tolerance_m
        elif confirmed is Gear.BACKWARD:
            assert status.estimate_m >= engaged_m
        elif confirmed is Gear.FORWARD:
            assert status.estimate_m <= -engaged_m
