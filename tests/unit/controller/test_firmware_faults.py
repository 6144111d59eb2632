"""The whole firmware when the position fails, and at its start."""

from __future__ import annotations

from dataclasses import replace

import pytest

from can_dbc.messages import (
    DrivelineSpeeds,
    E2eState,
    Fault,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from tests.support.toy_actuator import (
    MS,
    STROKE_M,
    B,
    F,
    N,
    S,
    Stay,
    U,
    check_invariants,
    pulse_s,
    shift,
)

ONE_LEG = ["INIT", "IDLE", "PUSH", "CONFIRM", "BLOW", "HOLD", "VENT", "IDLE"]


class TestPositionFaults:
    @pytest.mark.parametrize("state", [S.PUSH, S.CONFIRM, S.BLOW, S.HOLD, S.VENT])
    def test_lost_during_a_shift(self, state: ShiftState) -> None:
        undisturbed = shift(N, (100, B)).run(500)
        lost_ns = undisturbed.when(state) + 10 * MS
        rig = shift(
            N,
            (100, B),
            (900, N),
            position_state=lambda now_ns: (
                E2eState.INVALID if lost_ns <= now_ns < lost_ns + 100 * MS else E2eState.VALID
            ),
        ).run(890)
        at = next(r for r in rig.rows if r.time_ns == lost_ns)
        assert at.state is S.FAULT
        assert at.out.status.faults & Fault.POSITION_LOST
        check_invariants(rig.rows)
        # the position is back, the fault stays reported, until another request comes
        assert rig.last.status.state is S.FAULT
        assert rig.last.status.faults == Fault.POSITION_LOST | Fault.SPEEDS_LOST
        rig.run(1800)
        assert rig.last.status.state is S.IDLE
        assert rig.last.status.confirmed is N
        assert rig.last.status.faults == Fault.SPEEDS_LOST
        assert rig.stay.position_m == 0.0
        check_invariants(rig.rows)

    def test_lost_when_idle(self) -> None:
        rig = shift(
            B,
            position_state=lambda now_ns: (
                E2eState.INVALID if 200 * MS <= now_ns < 300 * MS else E2eState.VALID
            ),
        ).run(500)
        assert rig.states() == ["INIT", "IDLE", "INIT", "IDLE"]
        assert rig.last.status.confirmed is B
        assert rig.faults() & Fault.POSITION_LOST
        assert rig.last.status.faults == Fault.SPEEDS_LOST
        lost = [r for r in rig.rows if r.out.status.faults & Fault.POSITION_LOST]
        assert {r.out.status.confirmed for r in lost} == {U}
        assert lost[0].time_ns == 200 * MS

    def test_a_valid_channel_without_samples_is_lost_after_its_timeout(self) -> None:
        rig = shift(N, (100, B), pulse=lambda now_ns, p: p if now_ns < 110 * MS else None).run(400)
        faulty = next(r for r in rig.rows if r.state is S.FAULT)
        assert faulty.time_ns == 170 * MS  # the last sample came at 110 ms, the timeout is 50 ms
        assert faulty.out.status.faults & Fault.POSITION_LOST
        check_invariants(rig.rows)

    def test_short_gaps_do_not_matter(self) -> None:
        rig = shift(
            N, (100, B), pulse=lambda now_ns, p: p if p.sample_index % 4 in (0, 1) else None
        ).run(700)
        assert rig.states() == ONE_LEG
        assert rig.last.status.confirmed is B

    def test_garbage_during_a_push(self) -> None:
        rig = shift(
            N,
            (100, B),
            pulse=lambda now_ns, p: replace(p, pulse_s=0.004) if now_ns > 150 * MS else p,
        ).run(800)
        assert rig.last.status.state is S.FAULT
        assert rig.when(S.FAULT) <= 190 * MS
        assert rig.last.status.faults & Fault.POSITION_IMPLAUSIBLE
        check_invariants(rig.rows)

    def test_garbage_within_the_range(self) -> None:
        places = [0.0, 0.011, -0.008, 0.0125, -0.012, 0.003]

        def garbled(now_ns: int, pulse: PositionPulse) -> PositionPulse:
            if now_ns < 120 * MS:
                return pulse
            return replace(pulse, pulse_s=pulse_s(places[pulse.sample_index * 7 % 6]))

        rig = shift(N, (100, B), pulse=garbled).run(800)
        assert rig.last.status.state is S.FAULT
        assert rig.when(S.FAULT) <= 320 * MS
        assert rig.last.status.faults & Fault.POSITION_IMPLAUSIBLE
        assert {r.out.status.confirmed for r in rig.rows if r.time_ns >= 100 * MS} == {U}
        check_invariants(rig.rows)

    @pytest.mark.parametrize("real", [True, False])
    def test_stuck_in_a_push(self, real: bool) -> None:
        """The sensor stands still although the stay moves, or the stay does."""
        stay = Stay(frozen=not real)
        stuck = pulse_s(0.0)
        rig = shift(
            N,
            (100, B),
            stay=stay,
            pulse=lambda now_ns, p: replace(p, pulse_s=stuck) if now_ns > 90 * MS else p,
        ).run(800)
        assert rig.when(S.FAULT) == 500 * MS
        assert rig.last.status.faults == Fault.SENSOR_STUCK | Fault.SPEEDS_LOST
        assert rig.last.status.confirmed is U
        check_invariants(rig.rows)

    def test_a_stuck_sensor_is_not_believed_until_it_moves(self) -> None:
        """It stood in neutral while backward was engaged: asked for neutral, it must not agree."""
        stuck = pulse_s(0.0)
        rig = shift(
            N,
            (100, B),
            (700, N),
            (1600, F),
            pulse=lambda now_ns, p: (
                replace(p, pulse_s=stuck) if 90 * MS < now_ns < 1700 * MS else p
            ),
        )
        rig.run(690)
        assert rig.stay.position_m == STROKE_M
        rig.run(1590)
        states = [r.state for r in rig.rows if r.time_ns >= 700 * MS]
        assert states[0] is S.INIT
        assert S.PUSH in states
        assert states[-1] is S.FAULT
        assert {r.out.status.confirmed for r in rig.rows if r.time_ns >= 100 * MS} == {U}
        reported = [r.out.status.faults for r in rig.rows if 700 * MS <= r.time_ns < 1590 * MS]
        assert all(f & Fault.SENSOR_STUCK for f in reported)
        # it comes back to life: the push for neutral cannot show it, the one for forward does
        rig.stay.position_m = 0.004
        rig.run(3500)
        assert rig.last.status.state is S.IDLE
        assert rig.last.status.confirmed is F
        assert rig.last.status.faults == Fault.SPEEDS_LOST
        check_invariants(rig.rows)

    def test_blocked_for_good_is_a_timeout_after_one_retry(self) -> None:
        rig = shift(N, (100, B), (2400, N), stay=Stay(block_m=0.006)).run(2390)
        assert rig.states() == ["INIT", "IDLE", "PUSH", "VENT", "PUSH", "FAULT"]
        assert rig.when(S.VENT) == 1100 * MS
        assert rig.when(S.FAULT) == 2200 * MS
        assert rig.last.status.faults == Fault.SHIFT_TIMEOUT | Fault.SPEEDS_LOST
        rig.run(3000)
        assert rig.last.status.confirmed is N
        assert rig.last.status.faults == Fault.SPEEDS_LOST
        check_invariants(rig.rows)


class TestStart:
    def test_channels_that_never_come_are_lost_after_200_ms(self) -> None:
        firmware = Firmware(FirmwareConfig())
        lost = Fault.POSITION_LOST | Fault.REQUEST_LOST | Fault.SPEEDS_LOST
        start_ns = 7 * 10**12
        for k in range(40):
            out = firmware.step(start_ns + k * 10 * MS, Inputs())
            assert out.status.faults == (Fault.NONE if k < 20 else lost)
            assert out.status.state is S.INIT

    def test_a_channel_that_was_valid_has_no_grace(self) -> None:
        firmware = Firmware(FirmwareConfig())
        valid, none = E2eState.VALID, E2eState.INIT
        pulse = PositionPulse(pulse_s(0.0), 293.15, 0)
        firmware.step(
            0,
            Inputs((pulse,), ShiftRequest(N), DrivelineSpeeds(0.0, 0.0), valid, valid, valid),
        )
        for ms, states, fault in (
            (1, (none, valid, valid), Fault.POSITION_LOST),
            (2, (valid, none, valid), Fault.REQUEST_LOST),
            (3, (valid, valid, none), Fault.SPEEDS_LOST),
        ):
            inputs = Inputs((), None, None, *states)
            assert firmware.step(ms * MS, inputs).status.faults == fault

    def test_an_invalid_channel_has_no_grace_either(self) -> None:
        firmware = Firmware(FirmwareConfig())
        bad = E2eState.INVALID
        out = firmware.step(0, Inputs((), None, None, bad, bad, bad))
        assert out.status.faults == Fault.POSITION_LOST | Fault.REQUEST_LOST | Fault.SPEEDS_LOST

    def test_stale_messages_of_a_channel_that_is_not_valid_are_not_used(self) -> None:
        rig = shift(N).run(200)
        firmware = rig.firmware
        for k in range(5):
            out = firmware.step(
                (300 + k) * MS,
                Inputs(
                    (PositionPulse(pulse_s(0.0), 293.15, 100 + k),),
                    ShiftRequest(B),
                    DrivelineSpeeds(1.0, 1.0),
                    E2eState.VALID,
                    E2eState.INVALID,
                    E2eState.INVALID,
                ),
            )
            assert out.status.state is S.IDLE

    def test_stale_speeds_do_not_cut_a_blow_and_are_not_broadcast(self) -> None:
        rig = shift(F, (100, B))
        step = rig.firmware.step
        equal = DrivelineSpeeds(70.0, 70.0)
        rig.firmware.step = lambda now_ns, inputs: step(  # type: ignore[method-assign]
            now_ns, inputs._replace(speeds=equal)
        )
        rig.run(900)
        assert rig.spent_ms(S.BLOW) == pytest.approx(300.0)
        assert rig.last.etc1 is not None
        assert rig.last.etc1.input_shaft_rad_s is None

    def test_half_engaged_at_start_neutral_can_be_reached(self) -> None:
        rig = shift(N, stay=Stay(position_m=0.006)).run(1200)
        assert rig.states() == ONE_LEG
        assert rig.last.status.confirmed is N
        assert rig.when(S.IDLE) >= 300 * MS

    def test_time_must_increase(self) -> None:
        firmware = Firmware(FirmwareConfig())
        firmware.step(5, Inputs())
        with pytest.raises(ValueError, match=r"step at 5 ns after one at 5 ns"):
            firmware.step(5, Inputs())
        firmware.step(6, Inputs())
        with pytest.raises(ValueError, match=r"step at 3 ns after one at 6 ns"):
            firmware.step(3, Inputs())

    def test_same_inputs_same_outputs(self) -> None:
        runs = [shift(F, (100, B), (300, N)).run(900) for _ in range(2)]
        assert runs[0].rows == runs[1].rows

    def test_temperature_is_compensated(self) -> None:
        cold = shift(N, (100, B)).run(600)
        hot = shift(
            N,
            (100, B),
            pulse=lambda now_ns, p: PositionPulse(
                p.pulse_s * (1.0 + 0.0012 * 60.0), 353.15, p.sample_index
            ),
        ).run(600)
        for a, b in zip(cold.rows, hot.rows, strict=True):
            assert a.out.status.estimate_m == pytest.approx(b.out.status.estimate_m, abs=1e-12)
