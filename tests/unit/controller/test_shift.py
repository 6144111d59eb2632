"""The shift state machine: start, idle and push, transition by transition."""

from __future__ import annotations

import random

import pytest

from can_dbc.messages import Fault, Gear, ShiftState
from controller.settings import BlowConfig, ShiftConfig, WindowConfig
from controller.shift import TRANSITIONS, Event
from tests.support.shift_machine import MS, B, Bench, F, N, S, U


class TestInit:
    def test_begins_blind(self) -> None:
        machine = Bench().machine
        assert (machine.state, machine.confirmed, machine.leg, machine.final) == (S.INIT, U, U, U)
        assert not machine.driving
        assert not machine.in_process
        assert machine.blow_remaining_ns(0) == 0
        assert machine.raised is Fault.NONE

    @pytest.mark.parametrize("gear", [N, B, F])
    def test_a_gear_seen_for_40_ms_is_believed(self, gear: Gear) -> None:
        bench = Bench(gear)
        assert bench.step(run=1) is S.INIT
        assert bench.step(run=2) is S.INIT
        assert bench.step(run=3) is S.INIT
        assert bench.machine.confirmed is U
        assert bench.step(run=4) is S.IDLE
        assert bench.machine.confirmed is gear

    @pytest.mark.parametrize(
        ("settle_s", "samples", "needed"),
        [(0.04, 2, 4), (0.041, 2, 5), (0.0, 3, 3), (0.04, 7, 7), (0.04, 4, 4)],
    )
    def test_samples_needed(self, settle_s: float, samples: int, needed: int) -> None:
        bench = Bench(
            shift=ShiftConfig(init_settle_s=settle_s), windows=WindowConfig(samples=samples)
        )
        assert bench.step(run=needed - 1) is S.INIT
        assert bench.step(run=needed) is S.IDLE

    def test_between_gears_it_gives_up_looking_after_300_ms(self) -> None:
        bench = Bench(U)
        bench.step()
        assert bench.until(S.IDLE) == 300
        assert bench.machine.confirmed is U

    def test_the_wait_begins_with_a_valid_position(self) -> None:
        bench = Bench(U)
        for _ in range(50):
            assert bench.step(position_valid=False) is S.INIT
        bench.step(position_valid=True)
        assert bench.until(S.IDLE) == 300

    def test_an_interruption_begins_it_anew(self) -> None:
        bench = Bench(U)
        for _ in range(20):
            bench.step()
        bench.step(position_valid=False)
        bench.step(position_valid=True)
        assert bench.until(S.IDLE) == 300

    def test_requests_wait(self) -> None:
        bench = Bench(N)
        assert bench.step(requested=B, run=1) is S.INIT
        assert bench.step(run=4) is S.IDLE
        assert bench.step() is S.PUSH


class TestIdle:
    def test_no_request_no_shift(self) -> None:
        bench = Bench(N).idle()
        for _ in range(20):
            assert bench.step() is S.IDLE
        assert bench.machine.confirmed is N

    @pytest.mark.parametrize(
        ("here", "wanted", "leg"),
        [(N, B, B), (N, F, F), (B, N, N), (F, N, N), (B, F, N), (F, B, N), (U, N, N), (U, B, N)],
    )
    def test_a_request_starts_the_first_leg(self, here: Gear, wanted: Gear, leg: Gear) -> None:
        bench = Bench(here)
        bench.until(S.IDLE)
        assert bench.step(requested=wanted) is S.PUSH
        assert bench.facts() == (S.PUSH, leg, wanted, U)
        machine = bench.machine
        assert machine.event is Event.LEG_STARTED
        assert machine.attempt == 0
        assert machine.attempt_ns == bench.now_ns
        assert machine.driving
        assert machine.in_process
        assert machine.blow_remaining_ns(bench.now_ns) == 0
        bench.step()
        assert machine.event is not Event.LEG_STARTED

    @pytest.mark.parametrize("gear", [N, B, F])
    def test_a_request_for_the_engaged_gear_is_served_already(self, gear: Gear) -> None:
        bench = Bench(gear).idle()
        assert bench.step(requested=gear) is S.IDLE
        # it drops out: not engaged again by itself, however long the request stands
        for _ in range(20):
            assert bench.step(gear=U, run=1) is S.IDLE
            assert bench.machine.confirmed is U

    def test_a_gear_that_comes_back_is_confirmed_again_after_two_samples(self) -> None:
        bench = Bench(B).idle()
        bench.step(gear=U, run=1)
        bench.step(gear=B, run=1)
        assert bench.machine.confirmed is U
        bench.step(gear=B, run=2)
        assert bench.machine.confirmed is B

    def test_a_dropped_gear_is_left_by_a_new_request(self) -> None:
        bench = Bench(B).idle()
        bench.step(requested=B)
        bench.step(gear=U)
        assert bench.step(requested=F) is S.PUSH
        assert bench.machine.leg is N

    def test_lost_position_leads_back_to_init_not_to_fault(self) -> None:
        bench = Bench(B).idle()
        assert bench.step(position_valid=False) is S.INIT
        assert bench.machine.confirmed is U
        assert bench.machine.raised is Fault.NONE
        assert bench.step(position_valid=True) is S.IDLE
        assert bench.machine.confirmed is B


class TestPush:
    @pytest.mark.parametrize("target", [B, F])
    def test_confirmed_by_two_samples_in_the_window(self, target: Gear) -> None:
        bench = Bench(N).pushing(target)
        assert bench.step(gear=U, run=1) is S.PUSH
        assert bench.step(gear=target, run=1) is S.CONFIRM
        assert bench.machine.driving
        assert bench.machine.in_process
        assert bench.machine.confirmed is U
        assert bench.step(gear=target, run=2) is S.BLOW
        assert bench.facts() == (S.BLOW, target, target, target)
        assert not bench.machine.driving

    def test_confirmed_at_once_when_one_sample_is_enough(self) -> None:
        bench = Bench(N, windows=WindowConfig(samples=1)).pushing(B)
        assert bench.step(gear=B, run=1) is S.BLOW

    def test_back_to_push_when_it_leaves_the_window(self) -> None:
        bench = Bench(N).pushing(B)
        assert bench.step(gear=B, run=1) is S.CONFIRM
        assert bench.step(gear=U, run=1) is S.PUSH
        assert bench.step(gear=B, run=1) is S.CONFIRM

    def test_another_gear_does_not_confirm(self) -> None:
        bench = Bench(N).pushing(B)
        assert bench.step(gear=F, run=5) is S.PUSH
        assert bench.machine.confirmed is U

    def test_a_push_that_starts_in_its_window_must_stay_there_for_120_ms(self) -> None:
        bench = Bench(N).pushing(B)
        assert (
            bench.step(requested=N) is S.PUSH
        )  # at once back: sensor and filter still see neutral
        assert bench.facts() == (S.PUSH, N, N, U)
        for _ in range(11):
            assert bench.step() is S.CONFIRM
        assert bench.step() is S.BLOW

    def test_and_when_it_leaves_meanwhile_two_samples_confirm_as_ever(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(requested=N)
        bench.step(gear=U, run=1)
        for _ in range(14):
            assert bench.step() is S.PUSH
        assert bench.step(gear=N, run=1) is S.CONFIRM
        assert bench.step(gear=N, run=2) is S.BLOW

    def test_no_motion_at_all_means_stuck(self) -> None:
        bench = Bench(N).pushing(B)
        pushed_ns = bench.now_ns
        bench.step(moved=False)
        bench.until(S.FAULT)
        assert bench.now_ns - pushed_ns == 400 * MS
        assert bench.machine.raised is Fault.SENSOR_STUCK
        assert bench.machine.confirmed is U
        assert not bench.machine.in_process

    def test_motion_just_in_time(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(moved=False)
        for _ in range(38):
            assert bench.step() is S.PUSH
        assert bench.step(moved=True) is S.PUSH
        assert bench.step() is S.PUSH

    def test_no_motion_needed_where_it_shall_be(self) -> None:
        config = ShiftConfig(reversal_settle_s=1.0, no_motion_s=0.05)
        bench = Bench(N, shift=config).pushing(B)
        bench.step(requested=N, moved=False)
        for _ in range(80):
            assert bench.step() is S.CONFIRM

    def test_timeout_then_pause_then_retry_then_fault(self) -> None:
        bench = Bench(N).pushing(B)
        pushed_ns = bench.now_ns
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        assert bench.now_ns - pushed_ns == 1000 * MS
        machine = bench.machine
        assert (machine.attempt, machine.leg) == (1, B)
        assert not machine.driving
        assert machine.in_process
        assert bench.until(S.PUSH) == 100
        assert machine.event is Event.PAUSE_OVER
        assert machine.attempt_ns == bench.now_ns
        assert machine.in_process
        assert bench.until(S.FAULT) == 1000
        assert machine.raised is Fault.SHIFT_TIMEOUT
        assert machine.attempt == 1

    @pytest.mark.parametrize("retries", [0, 3])
    def test_as_many_retries_as_configured(self, retries: int) -> None:
        shift = ShiftConfig(retries=retries, push_timeout_s=0.2, retry_pause_s=0.05)
        bench = Bench(N, shift=shift).pushing(B)
        bench.step(gear=U, run=1)
        pushes = 1
        for _ in range(200):
            before = bench.machine.state
            pushes += bench.step() is S.PUSH and before is S.VENT
        assert bench.machine.state is S.FAULT
        assert pushes == 1 + retries

    def test_a_retry_that_succeeds_ends_as_any_shift(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        bench.until(S.PUSH)
        assert bench.step(gear=B, run=2) is S.BLOW
        assert not bench.machine.in_process
        bench.until(S.HOLD)
        assert bench.until(S.VENT) == 40
        assert bench.until(S.IDLE) == 110
        assert bench.machine.confirmed is B

    def test_a_new_leg_has_all_its_attempts(self) -> None:
        bench = Bench(B).pushing(F)
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        bench.until(S.PUSH)
        assert bench.machine.attempt == 1
        bench.step(gear=N, run=2)
        bench.until(S.PUSH)
        assert (bench.machine.leg, bench.machine.attempt) == (F, 0)

    @pytest.mark.parametrize("state", [S.PUSH, S.CONFIRM, S.BLOW, S.HOLD, S.VENT])
    def test_a_lost_position_ends_a_shift_in_fault(self, state: ShiftState) -> None:
        bench = Bench(N).pushing(B)
        bench.step(gear=U, run=1)
        if state is not S.PUSH:
            bench.step(gear=B, run=1)
        if state not in (S.PUSH, S.CONFIRM):
            bench.step(gear=B, run=2)
            bench.until(state)
        assert bench.machine.state is state
        assert bench.step(position_valid=False) is S.FAULT
        assert bench.machine.confirmed is U
        assert bench.machine.raised is Fault.NONE  # the firmware knows why
        assert bench.step(position_valid=False) is S.FAULT


class TestTable:
    def test_every_transition_of_the_table_is_made_and_no_other(self) -> None:
        """Random observations make the machine use the whole table."""
        rng = random.Random(1)
        transitions: set[tuple[ShiftState, Event]] = set()
        for wait in (False, True):
            for cut in ("none", "sync", "confirmation"):
                bench = Bench(shift=ShiftConfig(wait_for_sync=wait), blow=BlowConfig(cut=cut))
                for _ in range(8000):
                    before = bench.machine.state
                    gear = rng.choice((bench.machine.leg, bench.view.gear, N, B, F, U))
                    bench.step(
                        rng.choice((10, 10, 10, 120, 1100)),
                        position_valid=rng.random() < 0.98,
                        gear=gear,
                        run=1
                        if gear != bench.view.gear
                        else bench.view.run + rng.choice((0, 1, 5)),
                        moved=rng.random() < 0.9,
                        requested=rng.choice((bench.view.requested,) * 8 + (N, B, F, None)),
                        synchronized=rng.choice((True, False, None)),
                        clear_b=rng.random() < 0.8,
                        clear_f=rng.random() < 0.8,
                    )
                    event, after = bench.machine.event, bench.machine.state
                    if event is None:
                        assert after is before
                    else:
                        transitions.add((before, event))
                        assert after is TRANSITIONS[before, event]
        assert transitions == set(TRANSITIONS)

    def test_a_strategy_that_fails_ends_a_push(self) -> None:
        bench = Bench().pushing(B)
        bench.machine.fail(Fault.INTERNAL)
        assert (bench.machine.state, bench.machine.event) == (S.FAULT, Event.FAILED)
