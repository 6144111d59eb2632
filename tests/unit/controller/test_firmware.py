"""The whole firmware in a loop with a toy of the actuator: shifts, requests, broadcasts."""

from __future__ import annotations

from itertools import pairwise

import pytest

from can_dbc.messages import (
    Chamber,
    DrivelineSpeeds,
    E2eState,
    Fault,
    Gear,
    PositionPulse,
)
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.settings import BlowConfig, FilterConfig, SensorConfig, ShiftConfig
from controller.strategies import one_chamber
from tests.support.toy_actuator import (
    AT,
    MS,
    STROKE_M,
    B,
    F,
    N,
    S,
    Stay,
    U,
    check_invariants,
    duties,
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
        assert rig.last.status.confirmed is end
        assert rig.stay.position_m == AT[end]
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

    def test_blow_counts_down(self) -> None:
        rig = shift(N, (100, B)).run(400)
        left = [r.out.blow.remaining_s for r in rig.rows if r.state is S.BLOW]
        assert left == [(150 - 10 * i) / 1000 for i in range(15)]

    def test_agreeing_speeds_save_the_rest_of_the_blow_on_the_way(self) -> None:
        full = shift(F, (100, B), speeds=lambda now_ns: DrivelineSpeeds(100.0, 97.9)).run(900)
        cut = shift(F, (100, B), speeds=lambda now_ns: DrivelineSpeeds(98.0, 100.0)).run(900)
        assert full.spent_ms(S.BLOW) == pytest.approx(300.0)
        assert cut.spent_ms(S.BLOW) == pytest.approx(150.0)
        assert full.faults() == cut.faults() == Fault.NONE
        check_invariants(cut.rows)

    def test_speeds_that_become_equal_end_it(self) -> None:
        rig = shift(
            F,
            (100, B),
            speeds=lambda now_ns: DrivelineSpeeds(100.0, 100.0 if now_ns >= 250 * MS else 50.0),
        ).run(900)
        assert rig.when(S.PUSH, 1) == 250 * MS

    def test_waits_for_the_speeds_when_told_to(self) -> None:
        config = FirmwareConfig(shift=ShiftConfig(wait_for_sync=True))
        rig = shift(
            N,
            (100, B),
            config=config,
            speeds=lambda now_ns: DrivelineSpeeds(0.0, 0.0 if now_ns >= 300 * MS else 9.0),
        ).run(800)
        assert rig.states() == ["INIT", "IDLE", "HOLD", *ONE_LEG[2:]]
        assert rig.when(S.PUSH) == 300 * MS

    @pytest.mark.parametrize("blow", [BlowConfig(cut="confirmation"), BlowConfig(duration_s=0.0)])
    def test_without_a_blow(self, blow: BlowConfig) -> None:
        rig = shift(N, (100, B), config=FirmwareConfig(blow=blow)).run(500)
        assert rig.states() == [s for s in ONE_LEG if s != "BLOW"]
        assert rig.last.status.confirmed is B

    def test_a_stay_held_short_of_its_end_is_not_confirmed(self) -> None:
        """Blocked at 10.5 mm: the filter overshoots into the window, the sample does not."""
        rig = shift(N, (100, B), stay=Stay(block_m=0.0105)).run(600)
        estimates = [r.out.status.estimate_m for r in rig.rows]
        assert max(estimates) > STROKE_M - 0.0015
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

    def test_slow_firmware_fast_sensor(self) -> None:
        """10 ms steps, a sample every 2.5 ms: four samples a step, confirmed within one step."""
        config = FirmwareConfig(
            sensor=SensorConfig(period_s=0.0025), filter=FilterConfig(enabled=False)
        )
        rig = shift(N, (100, B), config=config, sensor_phase_ns=0).run(600)
        assert rig.states() == [s for s in ONE_LEG if s != "CONFIRM"]
        assert rig.last.status.confirmed is B
        check_invariants(rig.rows, config)

    @pytest.mark.parametrize("period_s", [0.002, 0.003, 0.02])
    def test_other_periods(self, period_s: float) -> None:
        config = FirmwareConfig(
            period_s=period_s, sensor=SensorConfig(period_s=0.0025 if period_s < 0.01 else 0.01)
        )
        rig = shift(F, (100, B), config=config, sensor_phase_ns=0).run(1200)
        assert rig.last.status.confirmed is B
        assert rig.stay.position_m == STROKE_M
        check_invariants(rig.rows, config)


class TestChangingRequests:
    def test_back_to_neutral_in_the_middle_of_a_push(self) -> None:
        for back_ms in range(110, 200, 10):
            rig = shift(N, (100, B), (back_ms, N)).run(900)
            assert rig.last.status.state is S.IDLE
            assert rig.last.status.confirmed is N
            assert rig.stay.position_m == 0.0
            check_invariants(rig.rows)

    def test_confirmed_is_true_whenever_the_request_flips(self) -> None:
        """A gear is reported while the stay is there, give or take what the sensor cannot see."""
        for flip_ms in range(105, 260, 5):
            rig = shift(N, (100, B), (flip_ms, F)).run(1500)
            assert rig.last.status.confirmed is F
            assert rig.stay.position_m == -STROKE_M
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
        assert rig.last.status.confirmed is F
        assert rig.stay.position_m == -STROKE_M

    def test_request_lost_on_the_way_to_neutral_stops_there(self) -> None:
        rig = shift(F, (100, B))
        asked = rig.request
        rig.request = lambda now_ns: None if 150 * MS <= now_ns < 800 * MS else asked(now_ns)
        rig.run(790)
        assert rig.last.status.state is S.IDLE
        assert rig.last.status.confirmed is N
        assert rig.last.status.faults == Fault.REQUEST_LOST | Fault.SPEEDS_LOST
        rig.run(1500)
        assert rig.last.status.confirmed is B
        assert not rig.last.status.faults & Fault.REQUEST_LOST

    def test_request_lost_when_idle_keeps_the_gear(self) -> None:
        rig = shift(B)
        asked = rig.request
        rig.request = lambda now_ns: None if now_ns >= 200 * MS else asked(now_ns)
        rig.run(1000)
        assert rig.states() == ["INIT", "IDLE"]
        assert rig.last.status.confirmed is B
        assert rig.last.status.faults & Fault.REQUEST_LOST

    def test_an_invalid_request_is_no_request(self) -> None:
        rig = shift(N, (100, U)).run(400)
        assert rig.states() == ["INIT", "IDLE"]
        assert rig.last.status.faults == Fault.REQUEST_INVALID | Fault.SPEEDS_LOST


class TestBroadcast:
    def test_every_10_ms_at_10_ms(self) -> None:
        rig = shift(N).run(200)
        assert all(r.out.etc1 is not None and r.out.etc2 is not None for r in rig.rows)

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
            assert row.out.etc1 is not None
            assert row.out.etc2 is not None
            etc1, etc2 = row.out.etc1, row.out.etc2
            what = (
                etc1.shift_in_process,
                etc1.driveline_engaged,
                etc2.selected_gear,
                etc2.current_gear,
                etc2.requested_range,
                etc2.current_range,
            )
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
        rig = shift(N, speeds=lambda now_ns: DrivelineSpeeds(*given)).run(50)
        etc1 = rig.last.etc1
        assert etc1 is not None
        assert (etc1.input_shaft_rad_s, etc1.output_shaft_rad_s) == sent

    def test_without_speeds(self) -> None:
        etc1 = shift(N).run(50).last.etc1
        assert etc1 is not None
        assert etc1.input_shaft_rad_s is None
        assert etc1.output_shaft_rad_s is None


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
