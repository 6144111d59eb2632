"""The whole firmware in a loop with a toy of the actuator: shifts, faults, strategies, the interlock."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import inf
from typing import Any

import pytest

from can_dbc.messages import (
    Chamber,
    DrivelineSpeeds,
    E2eState,
    Fault,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from controller import firmware as module
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs, Interlock
from controller.position import Estimate
from controller.settings import FilterConfig, SensorConfig
from controller.strategies import OFF, Duties, ShiftContext, one_chamber
from controller.strategies.open_loop import OpenLoop
from tests.support.toy_actuator import (
    AT,
    MS,
    STROKE_M,
    B,
    F,
    N,
    Rig,
    S,
    Stay,
    U,
    check_invariants,
    duties,
    pulse_s,
    shift,
)

ONE_LEG = ["INIT", "IDLE", "PUSH", "CONFIRM", "BLOW", "HOLD", "VENT", "IDLE"]


class TestShifts:
    @pytest.mark.parametrize(("start", "end"), [(N, B), (B, N), (N, F), (F, N)])
    def test_one_leg(self, start: Gear, end: Gear) -> None:
        rig = shift(start, (100, end)).run(600)
        assert rig.states() == ONE_LEG
        chamber = {B: Chamber.B, N: Chamber.N, F: Chamber.F}[end]
        for before, row in pairwise(rig.rows):
            driving = row.state in (S.PUSH, S.CONFIRM)
            if driving or (row.state is S.BLOW and before.state is not S.BLOW):
                assert duties(row.out) == one_chamber(chamber, 0.98)
                assert row.out.valves.target is end
            else:
                assert duties(row.out) == (0.0, 0.0, 0.0)
                assert row.out.valves.target is row.out.status.confirmed
            if row.state is S.BLOW:
                assert row.out.blow.chamber is chamber
        assert rig.spent_ms(S.BLOW) == pytest.approx(150.0)
        assert rig.spent_ms(S.HOLD) == pytest.approx(40.0)
        assert rig.spent_ms(S.VENT) == pytest.approx(110.0)
        assert rig.when(S.PUSH) == 100 * MS
        assert rig.last.status.confirmed is end and rig.stay.position_m == AT[end]
        assert rig.faults() == Fault.SPEEDS_LOST  # the rig has no speed sensors
        check_invariants(rig.rows)

    @pytest.mark.parametrize(("start", "end"), [(F, B), (B, F)])
    def test_through_neutral(self, start: Gear, end: Gear) -> None:
        rig = shift(start, (100, end)).run(900)
        assert rig.states() == ["INIT", "IDLE", "PUSH", "CONFIRM", "BLOW", *ONE_LEG[2:]]
        assert rig.last.status.confirmed is end
        assert rig.spent_ms(S.BLOW) == pytest.approx(300.0)
        # the next chamber is filled in the very step in which the blow into neutral ends
        second = rig.when(S.PUSH, 1)
        before = next(r for r in rig.rows if r.time_ns == second - 10 * MS)
        assert before.out.blow.chamber is Chamber.N
        assert before.out.blow.remaining_s == pytest.approx(0.01)
        check_invariants(rig.rows)

    def test_agreeing_speeds_save_the_rest_of_the_blow_on_the_way(self) -> None:
        full = shift(F, (100, B), speeds=lambda now_ns: DrivelineSpeeds(100.0, 97.9)).run(900)
        cut = shift(F, (100, B), speeds=lambda now_ns: DrivelineSpeeds(98.0, 100.0)).run(900)
        assert full.spent_ms(S.BLOW) == pytest.approx(300.0)
        assert cut.spent_ms(S.BLOW) == pytest.approx(150.0)
        assert full.faults() == cut.faults() == Fault.NONE
        check_invariants(cut.rows)

    def test_a_stay_held_short_of_its_end_is_not_confirmed(self) -> None:
        """Blocked at 10.5 mm: the filter overshoots into the window, the sample does not."""
        rig = shift(N, (100, B), stay=Stay(block_m=0.0105)).run(600)
        assert max(r.out.status.estimate_m for r in rig.rows) > STROKE_M - 0.0015
        assert rig.states() == ["INIT", "IDLE", "PUSH"]

    def test_a_synchronizer_only_delays(self) -> None:
        stay = Stay(block_m=0.006)
        rig = shift(N, (100, B), stay=stay).run(500)
        assert rig.last.status.state is S.PUSH
        assert rig.last.status.estimate_m == pytest.approx(0.006, abs=2e-4)
        stay.block_m = None
        rig.run(1200)
        assert rig.states() == ONE_LEG
        assert rig.faults() == Fault.SPEEDS_LOST

    def test_fast_firmware_fast_sensor(self) -> None:
        """2.5 ms throughout, without filter: the same sequence, confirmed 30 ms sooner."""
        slow = shift(N, (100, B)).run(600)
        config = FirmwareConfig(
            period_s=0.0025,
            sensor=SensorConfig(period_s=0.0025),
            filter=FilterConfig(enabled=False),
        )
        fast = shift(N, (100, B), config=config, sensor_phase_ns=0).run(600)
        assert fast.states() == ONE_LEG
        assert slow.when(S.BLOW) - fast.when(S.BLOW) >= 35 * MS
        assert fast.spent_ms(S.BLOW) == pytest.approx(150.0)
        check_invariants(fast.rows, config)

    @pytest.mark.parametrize("period_s", [0.002, 0.003, 0.02])
    def test_other_periods(self, period_s: float) -> None:
        config = FirmwareConfig(
            period_s=period_s, sensor=SensorConfig(period_s=0.0025 if period_s < 0.01 else 0.01)
        )
        rig = shift(F, (100, B), config=config, sensor_phase_ns=0).run(1200)
        assert rig.last.status.confirmed is B and rig.stay.position_m == STROKE_M
        check_invariants(rig.rows, config)


class TestChangingRequests:
    def test_confirmed_is_true_whenever_the_request_flips(self) -> None:
        """A gear is reported while the stay is there, give or take what the sensor cannot see."""
        for flip_ms in range(105, 260, 5):
            rig = shift(N, (100, B), (flip_ms, F)).run(1500)
            assert rig.last.status.confirmed is F and rig.stay.position_m == -STROKE_M
            check_invariants(rig.rows)
            for row in rig.rows:
                if row.out.status.confirmed is not U:
                    assert row.position_m == pytest.approx(AT[row.out.status.confirmed], abs=2e-3)

    def test_a_driver_who_cannot_decide(self) -> None:
        gears = [B, F, N, F, B]
        requests = [(100.0 + 35.0 * i, gears[i * i % 5]) for i in range(60)]
        rig = shift(N, *requests, (2300, F)).run(3500)
        check_invariants(rig.rows)
        assert not rig.faults() & ~Fault.SPEEDS_LOST
        assert rig.last.status.confirmed is F and rig.stay.position_m == -STROKE_M

    def test_request_lost_on_the_way_to_neutral_stops_there(self) -> None:
        rig = shift(F, (100, B))
        asked = rig.request
        rig.request = lambda now_ns: None if 150 * MS <= now_ns < 800 * MS else asked(now_ns)
        rig.run(790)
        assert rig.last.status.state is S.IDLE and rig.last.status.confirmed is N
        assert rig.last.status.faults == Fault.REQUEST_LOST | Fault.SPEEDS_LOST
        rig.run(1500)
        assert rig.last.status.confirmed is B
        assert not rig.last.status.faults & Fault.REQUEST_LOST

    def test_an_invalid_request_is_no_request(self) -> None:
        rig = shift(N, (100, U)).run(400)
        assert rig.states() == ["INIT", "IDLE"]
        assert rig.last.status.faults == Fault.REQUEST_INVALID | Fault.SPEEDS_LOST


class TestBroadcast:
    @pytest.mark.parametrize(
        ("period_s", "steps"),
        [
            (0.0025, [0, 4, 8, 12]),
            (0.003, [0, 4, 7, 10, 14]),
            (0.02, [0, 1, 2, 3]),
            (0.015, [0, 1, 2, 3]),
        ],
    )
    def test_as_near_to_10_ms_as_the_period_allows(self, period_s: float, steps: list[int]) -> None:
        firmware = Firmware(FirmwareConfig(period_s=period_s))
        start_ns = 123
        sent = []
        for k in range(steps[-1] + 1):
            out = firmware.step(start_ns + k * firmware.config.period_ns, Inputs())
            assert (out.etc1 is None) == (out.etc2 is None)
            if out.etc1 is not None:
                sent.append(k)
        assert sent == steps

    def test_a_shift_as_a_truck_tool_sees_it(self) -> None:
        rig = shift(F, (100, B)).run(900)
        seen = []
        for row in rig.rows:
            assert row.out.etc1 is not None and row.out.etc2 is not None
            etc1, etc2 = row.out.etc1, row.out.etc2
            what = (
                etc1.shift_in_process, etc1.driveline_engaged, etc2.selected_gear,
                etc2.current_gear, etc2.requested_range, etc2.current_range,
            )  # fmt: skip
            if not seen or seen[-1] != what:
                seen.append(what)
        assert seen == [
            (False, None, None, None, None, None),
            (False, True, 1, 1, " F", " F"),
            (True, None, 2, None, " B", None),
            (True, False, 2, 0, " B", " N"),
            (True, None, 2, None, " B", None),
            (False, True, 2, 2, " B", " B"),
        ]

    @pytest.mark.parametrize(
        ("given", "sent"),
        [
            ((0.0, 841.0), (0.0, 841.0)),
            ((100.0, 50.0), (100.0, 50.0)),
            ((-0.1, 841.1), (None, None)),
        ],
    )
    def test_shaft_speeds(
        self, given: tuple[float, float], sent: tuple[float | None, float | None]
    ) -> None:
        etc1 = shift(N, speeds=lambda now_ns: DrivelineSpeeds(*given)).run(50).last.etc1
        assert (etc1.input_shaft_rad_s, etc1.output_shaft_rad_s) == sent


class TestPieces:
    def test_what_has_not_arrived_is_nothing(self) -> None:
        initial = E2eState.INIT
        assert Inputs() == ((), None, None, initial, initial, initial)

    def test_a_position_can_be_implausible_and_lost(self) -> None:
        firmware = Firmware(FirmwareConfig())
        for k in range(12):
            hot = PositionPulse(0.9e-3, 500.0, k)
            out = firmware.step(k * 10 * MS, Inputs((hot,), position_state=E2eState.VALID))
        both = Fault.POSITION_LOST | Fault.POSITION_IMPLAUSIBLE
        assert out.status.faults & both == both

    def test_a_gear_that_drops_out_alone_is_reported(self) -> None:
        rig = shift(B).run(200)
        assert rig.last.status.confirmed is B
        rig.stay.position_m = 0.006
        status = rig.run(400).last.status
        assert (status.state, status.confirmed) == (S.IDLE, U)


def invalid(begin_ns: int, end_ns: int) -> Any:
    """The channel of the position is invalid for a time."""
    return lambda now_ns: E2eState.INVALID if begin_ns <= now_ns < end_ns else E2eState.VALID


def reads(reading_s: float, after_ms: float, before_ms: float = inf) -> Any:
    """The sensor gives one reading between two times."""
    return lambda now_ns, p: (
        replace(p, pulse_s=reading_s) if after_ms * MS < now_ns < before_ms * MS else p
    )


class TestPositionFaults:
    @pytest.mark.parametrize("state", [S.PUSH, S.CONFIRM, S.BLOW, S.HOLD, S.VENT])
    def test_lost_during_a_shift(self, state: ShiftState) -> None:
        undisturbed = shift(N, (100, B)).run(500)
        lost_ns = undisturbed.when(state) + 10 * MS
        hook = invalid(lost_ns, lost_ns + 100 * MS)
        rig = shift(N, (100, B), (900, N), position_state=hook).run(890)
        at = next(r for r in rig.rows if r.time_ns == lost_ns)
        assert at.state is S.FAULT
        assert at.out.status.faults & Fault.POSITION_LOST
        check_invariants(rig.rows)
        # the position is back, the fault stays reported, until another request comes
        assert rig.last.status.state is S.FAULT
        assert rig.last.status.faults == Fault.POSITION_LOST | Fault.SPEEDS_LOST
        rig.run(1800)
        assert rig.last.status.state is S.IDLE and rig.last.status.confirmed is N
        assert rig.last.status.faults == Fault.SPEEDS_LOST and rig.stay.position_m == 0.0
        check_invariants(rig.rows)

    def test_lost_when_idle(self) -> None:
        rig = shift(B, position_state=invalid(200 * MS, 300 * MS)).run(500)
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

    def test_garbage_during_a_push(self) -> None:
        rig = shift(N, (100, B), pulse=reads(0.004, 150)).run(800)
        assert rig.last.status.state is S.FAULT
        assert rig.when(S.FAULT) <= 190 * MS
        assert rig.last.status.faults & Fault.POSITION_IMPLAUSIBLE
        check_invariants(rig.rows)

    @pytest.mark.parametrize("real", [True, False])
    def test_stuck_in_a_push(self, real: bool) -> None:
        """The sensor stands still although the stay moves, or the stay does."""
        stay = Stay(frozen=not real)
        rig = shift(N, (100, B), stay=stay, pulse=reads(pulse_s(0.0), 90)).run(800)
        assert rig.when(S.FAULT) == 500 * MS
        assert rig.last.status.faults == Fault.SENSOR_STUCK | Fault.SPEEDS_LOST
        assert rig.last.status.confirmed is U
        check_invariants(rig.rows)

    def test_a_stuck_sensor_is_not_believed_until_it_moves(self) -> None:
        """It stood in neutral while backward was engaged: asked for neutral, it must not agree."""
        rig = shift(N, (100, B), (700, N), (1600, F), pulse=reads(pulse_s(0.0), 90, 1700))
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
        assert rig.last.status.state is S.IDLE and rig.last.status.confirmed is F
        assert rig.last.status.faults == Fault.SPEEDS_LOST
        check_invariants(rig.rows)

    def test_blocked_for_good_is_a_timeout_after_one_retry(self) -> None:
        rig = shift(N, (100, B), (2400, N), stay=Stay(block_m=0.006)).run(2390)
        assert rig.states() == ["INIT", "IDLE", "PUSH", "VENT", "PUSH", "FAULT"]
        assert rig.when(S.VENT) == 1100 * MS and rig.when(S.FAULT) == 2200 * MS
        assert rig.last.status.faults == Fault.SHIFT_TIMEOUT | Fault.SPEEDS_LOST
        rig.run(3000)
        assert rig.last.status.confirmed is N and rig.last.status.faults == Fault.SPEEDS_LOST
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
            0, Inputs((pulse,), ShiftRequest(N), DrivelineSpeeds(0.0, 0.0), valid, valid, valid)
        )
        for ms, states, fault in (
            (1, (none, valid, valid), Fault.POSITION_LOST),
            (2, (valid, none, valid), Fault.REQUEST_LOST),
            (3, (valid, valid, none), Fault.SPEEDS_LOST),
        ):
            assert firmware.step(ms * MS, Inputs((), None, None, *states)).status.faults == fault

    def test_an_invalid_channel_has_no_grace_either(self) -> None:
        firmware = Firmware(FirmwareConfig())
        bad = E2eState.INVALID
        out = firmware.step(0, Inputs((), None, None, bad, bad, bad))
        assert out.status.faults == Fault.POSITION_LOST | Fault.REQUEST_LOST | Fault.SPEEDS_LOST

    def test_stale_messages_of_a_channel_that_is_not_valid_are_not_used(self) -> None:
        firmware = shift(N).run(200).firmware
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
        assert rig.last.etc1.input_shaft_rad_s is None

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


class Meddler(OpenLoop):
    """A strategy that returns the commands of a test, and records its inputs."""

    def __init__(self, config: FirmwareConfig, parameters: Any) -> None:
        super().__init__(config, parameters)
        self.seen: list[tuple[int, Estimate, ShiftContext]] = []
        self.resets = 0
        self.answer: Duties | None = None

    def reset(self) -> None:
        self.resets += 1

    def command(self, now_ns: int, estimate: Estimate, shift: ShiftContext) -> Duties:
        self.seen.append((now_ns, estimate, shift))
        if self.answer is not None:
            return self.answer
        return super().command(now_ns, estimate, shift)

    def blow_s(self, configured_s: float, leg: Gear, follows: bool) -> float:
        return configured_s / 3


class TestStrategies:
    @pytest.fixture
    def meddled(self, monkeypatch: pytest.MonkeyPatch) -> Any:
        created: list[Meddler] = []

        def create(config: FirmwareConfig) -> Meddler:
            created.append(Meddler(config, OpenLoop.Parameters()))
            return created[-1]

        monkeypatch.setattr(module, "create_strategy", create)

        def make(start: Gear, *requests: tuple[float, Gear], **more: Any) -> tuple[Rig, Meddler]:
            return shift(start, *requests, **more), created[-1]

        return make

    def test_what_it_is_given(self, meddled: Any) -> None:
        rig, strategy = meddled(B, (100, F))
        rig.run(600)
        legs = [c for _, _, c in strategy.seen]
        first, second = legs[0], next(c for c in legs if c.leg is F)
        assert first == ShiftContext(N, Chamber.N, 100 * MS, 0)
        assert second.charged is Chamber.F and second.start_ns == rig.when(S.PUSH, 1)
        assert strategy.resets == 2
        assert {r.state for r in rig.rows if r.time_ns in {t for t, _, _ in strategy.seen}} <= {
            S.PUSH,
            S.CONFIRM,
        }
        for now_ns, estimate, _ in strategy.seen:
            row = next(r for r in rig.rows if r.time_ns == now_ns)
            assert estimate.position_m == row.out.status.estimate_m and estimate.valid

    def test_it_may_shorten_the_blow(self, meddled: Any) -> None:
        rig, _ = meddled(N, (100, B))
        rig.run(600)
        assert rig.spent_ms(S.BLOW) == pytest.approx(50.0)

    def test_a_retry_is_reported_and_resets_it(self, meddled: Any) -> None:
        rig, strategy = meddled(N, (100, B), stay=Stay(block_m=0.006))
        rig.run(1500)
        assert strategy.resets == 2
        first, last = strategy.seen[0][2], strategy.seen[-1][2]
        assert (first.attempt, first.start_ns) == (0, 100 * MS)
        assert (last.attempt, last.start_ns) == (1, 1200 * MS)

    @pytest.mark.parametrize(
        "answer",
        [Duties(0.34, 0.0, 0.34), Duties(0.0, float("nan"), 0.0), Duties(0.0, 0.0, float("inf"))],
    )
    def test_forbidden_duties_end_in_a_fault_for_good(self, meddled: Any, answer: Duties) -> None:
        rig, strategy = meddled(N, (100, B), (200, N), (300, F))
        strategy.answer = answer
        rig.run(500)
        assert rig.when(S.FAULT) == 100 * MS
        assert rig.last.status.state is S.FAULT
        assert rig.last.status.faults == Fault.INTERNAL | Fault.SPEEDS_LOST
        assert len(strategy.seen) == 1
        check_invariants(rig.rows)

    @pytest.mark.parametrize(
        "answer",
        [
            Duties(1.0, 1.0, 0.33),
            Duties(0.33, 1.0, 1.0),
            Duties(0.33, 0.33, 0.33),
            Duties(0.0, 0.0, 0.0),
        ],
    )
    def test_allowed_duties_go_out_as_they_are(self, meddled: Any, answer: Duties) -> None:
        rig, strategy = meddled(N, (100, B))
        strategy.answer = answer
        rig.run(200)
        assert {duties(r.out) for r in rig.rows if r.state is S.PUSH} == {answer}
        assert rig.faults() == Fault.SPEEDS_LOST

    @pytest.mark.parametrize(
        ("one", "other"),
        [(Duties(0.98, 0, 0), Duties(0, 0, 0.98)), (Duties(0, 0, 0.98), Duties(0.98, 0, 0))],
    )
    @pytest.mark.parametrize(("pause_ms", "allowed"), [(0, False), (30, False), (40, True)])
    def test_backward_and_forward_need_a_pause_between_them(
        self, meddled: Any, one: Duties, other: Duties, pause_ms: int, allowed: bool
    ) -> None:
        rig, strategy = meddled(N, (100, B), stay=Stay(frozen=True))
        strategy.answer = one
        rig.run(110)
        strategy.answer = Duties(0.0, 0.33, 0.33)
        rig.run(110 + pause_ms)
        strategy.answer = other
        rig.run(120 + pause_ms)
        assert (rig.last.status.state is S.PUSH) == allowed
        assert bool(rig.last.status.faults & Fault.INTERNAL) != allowed

    def test_it_is_given_the_speeds_the_step_that_saw_them_first_and_the_estimate(
        self, meddled: Any
    ) -> None:
        reported = [DrivelineSpeeds(12.5 + number, 2.5) for number in range(40)]

        def speeds(now_ns: int) -> DrivelineSpeeds | None:
            return reported[now_ns // (30 * MS)] if now_ns < 300 * MS else None

        rig, strategy = meddled(N, (100, B), speeds=speeds)
        rig.run(400)
        count = 0
        for now_ns, estimate, context in strategy.seen:
            assert isinstance(estimate, Estimate) and estimate.valid
            if now_ns < 300 * MS:
                newest = now_ns // (30 * MS)
                assert context.apart_rad_s == 10.0 + newest and context.apart_ns == newest * 30 * MS
                count += 1
        assert count > 3


@pytest.mark.parametrize("chamber", [Chamber.B, Chamber.N, Chamber.F])
def test_a_chamber_is_clear_after_the_interlock_and_the_period_that_it_was_on(
    chamber: Chamber,
) -> None:
    interlock = Interlock(FirmwareConfig())
    assert interlock.clear(0, chamber)
    interlock.note(7, OFF, chamber)
    assert not interlock.clear(7 + 50 * MS - 1, chamber) and interlock.clear(7 + 50 * MS, chamber)


@pytest.mark.parametrize(
    ("duties", "allowed"),
    [
        ((0.0, 0.0, 0.0), True),           ((1.0, 1.0, 0.33), True),
        ((0.33, 1.0, 1.0), True),          ((0.331, 0.0, 0.331), False),
        ((0.33, 0.0, 0.331), True),        ((0.331, 0.0, 0.33), True),
        ((-0.001, 0.0, 0.0), False),       ((1.001, 0.0, 0.0), False),
        ((0.0, -0.001, 0.0), False),       ((0.0, 1.001, 0.0), False),
        ((0.0, 0.0, -0.001), False),       ((0.0, 0.0, 1.001), False),
        ((float("nan"), 0.0, 0.0), False),
    ],
)  # fmt: skip
def test_duties_that_are_none_or_fill_both_ends_are_refused(
    duties: tuple[float, float, float], allowed: bool
) -> None:
    assert Interlock(FirmwareConfig()).allows(0, Duties(*duties)) is allowed


def test_an_end_is_not_filled_while_the_other_is_not_clear() -> None:
    b_only, f_only = Duties(0.98, 0.0, 0.0), Duties(0.0, 0.0, 0.98)
    for filled, opposite in ((f_only, b_only), (b_only, f_only)):
        interlock = Interlock(FirmwareConfig())
        interlock.note(0, filled, Chamber.NONE)
        assert not interlock.allows(50 * MS - 1, opposite) and interlock.allows(50 * MS - 1, filled)
        assert interlock.allows(50 * MS, opposite)
