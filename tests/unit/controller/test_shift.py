"""The shift state machine, transition by transition."""

from __future__ import annotations

import random
from typing import Any

import pytest

from can_dbc.messages import Fault, Gear, ShiftState
from controller.settings import BlowConfig, ShiftConfig, WindowConfig
from controller.shift import TRANSITIONS, Event
from tests.support.shift_machine import MS, B, Bench, F, N, S, U


class TestInit:
    def test_begins_blind(self) -> None:
        machine = Bench().machine
        assert (machine.state, machine.confirmed, machine.leg, machine.final) == (S.INIT, U, U, U)
        assert not machine.driving and not machine.in_process
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
        bench.stays(S.INIT, 50, position_valid=False)
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
        bench.stays(S.IDLE, 20)
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
        assert machine.event is Event.LEG_STARTED and machine.attempt == 0
        assert machine.attempt_ns == bench.now_ns and machine.driving
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
        assert bench.machine.confirmed is U and bench.machine.raised is Fault.NONE
        assert bench.step(position_valid=True) is S.IDLE
        assert bench.machine.confirmed is B


class TestPush:
    @pytest.mark.parametrize("target", [B, F])
    def test_confirmed_by_two_samples_in_the_window(self, target: Gear) -> None:
        bench = Bench(N).pushing(target)
        assert bench.step(gear=U, run=1) is S.PUSH
        assert bench.step(gear=target, run=1) is S.CONFIRM
        assert bench.machine.driving and bench.machine.in_process
        assert bench.machine.confirmed is U
        assert bench.step(gear=target, run=2) is S.BLOW
        assert bench.facts() == (S.BLOW, target, target, target)
        assert not bench.machine.driving

    def test_confirmed_at_once_when_one_sample_is_enough(self) -> None:
        assert Bench(N, windows=WindowConfig(samples=1)).pushing(B).step(gear=B, run=1) is S.BLOW

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
        bench.stays(S.CONFIRM, 11)
        assert bench.step() is S.BLOW

    def test_and_when_it_leaves_meanwhile_two_samples_confirm_as_ever(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(requested=N)
        bench.step(gear=U, run=1)
        bench.stays(S.PUSH, 14)
        assert bench.step(gear=N, run=1) is S.CONFIRM
        assert bench.step(gear=N, run=2) is S.BLOW

    def test_no_motion_at_all_means_stuck(self) -> None:
        bench = Bench(N).pushing(B)
        pushed_ns = bench.now_ns
        bench.step(moved=False)
        bench.until(S.FAULT)
        assert bench.now_ns - pushed_ns == 400 * MS
        assert bench.machine.raised is Fault.SENSOR_STUCK and bench.machine.confirmed is U
        assert not bench.machine.in_process

    def test_motion_just_in_time(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(moved=False)
        bench.stays(S.PUSH, 38)
        assert bench.step(moved=True) is S.PUSH
        assert bench.step() is S.PUSH

    def test_no_motion_needed_where_it_shall_be(self) -> None:
        bench = Bench(N, shift=ShiftConfig(reversal_settle_s=1.0, no_motion_s=0.05)).pushing(B)
        bench.step(requested=N, moved=False)
        bench.stays(S.CONFIRM, 80)

    def test_timeout_then_pause_then_retry_then_fault(self) -> None:
        bench = Bench(N).pushing(B)
        pushed_ns = bench.now_ns
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        assert bench.now_ns - pushed_ns == 1000 * MS
        machine = bench.machine
        assert (machine.attempt, machine.leg) == (1, B)
        assert not machine.driving and machine.in_process
        assert bench.until(S.PUSH) == 100
        assert machine.event is Event.PAUSE_OVER and machine.attempt_ns == bench.now_ns
        assert machine.in_process
        assert bench.until(S.FAULT) == 1000
        assert machine.raised is Fault.SHIFT_TIMEOUT and machine.attempt == 1

    @pytest.mark.parametrize("retries", [0, 3])
    def test_as_many_retries_as_configured(self, retries: int) -> None:
        shift = ShiftConfig(retries=retries, push_timeout_s=0.2, retry_pause_s=0.05)
        bench = Bench(N, shift=shift).underway(B)
        pushes = 1
        for _ in range(200):
            before = bench.machine.state
            pushes += bench.step() is S.PUSH and before is S.VENT
        assert bench.machine.state is S.FAULT
        assert pushes == 1 + retries

    def test_a_new_leg_has_all_its_attempts(self) -> None:
        bench = Bench(B).underway(F)
        bench.until(S.VENT)
        bench.until(S.PUSH)
        assert bench.machine.attempt == 1
        bench.step(gear=N, run=2)
        bench.until(S.PUSH)
        assert (bench.machine.leg, bench.machine.attempt) == (F, 0)

    @pytest.mark.parametrize("state", [S.PUSH, S.CONFIRM, S.BLOW, S.HOLD, S.VENT])
    def test_a_lost_position_ends_a_shift_in_fault(self, state: ShiftState) -> None:
        bench = Bench(N).underway(B)
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


class TestBlow:
    def test_lasts_150_ms(self) -> None:
        bench = Bench(N).blowing(B)
        machine = bench.machine
        assert machine.blow_remaining_ns(bench.now_ns) == 150 * MS
        bench.step()
        assert machine.blow_remaining_ns(bench.now_ns) == 140 * MS
        assert not machine.in_process  # the wanted gear is there
        assert bench.until(S.HOLD) == 140
        assert machine.blow_remaining_ns(bench.now_ns) == 0

    @pytest.mark.parametrize("target", [B, F])
    def test_agreeing_speeds_do_not_shorten_it_in_a_gear(self, target: Gear) -> None:
        bench = Bench(N).blowing(target)
        bench.step(synchronized=True)
        assert bench.until(S.HOLD) == 140

    def test_agreeing_speeds_do_not_shorten_it_when_nothing_follows(self) -> None:
        bench = Bench(B).blowing(N)
        bench.step(synchronized=True)
        assert bench.until(S.HOLD) == 140

    def to_neutral_on_the_way(self, **config: Any) -> Bench:
        bench = Bench(B, **config).underway(F)
        bench.step(gear=N, run=2, synchronized=False)
        return bench

    def test_agreeing_speeds_end_it_when_a_gear_follows(self) -> None:
        bench = self.to_neutral_on_the_way()
        assert bench.facts() == (S.BLOW, N, F, N)
        assert bench.machine.in_process
        assert bench.step() is S.BLOW
        assert bench.step(synchronized=True) is S.PUSH
        assert bench.facts() == (S.PUSH, F, F, U)
        assert bench.machine.event is Event.LEG_STARTED

    def test_agreeing_speeds_at_confirmation_skip_it(self) -> None:
        bench = Bench(B).underway(F)
        assert bench.step(gear=N, run=2, synchronized=True) is S.PUSH
        assert bench.facts() == (S.PUSH, F, F, U)

    @pytest.mark.parametrize("synchronized", [False, None])
    def test_else_it_is_full_and_the_next_push_follows_at_once(
        self, synchronized: bool | None
    ) -> None:
        bench = self.to_neutral_on_the_way()
        bench.step(synchronized=synchronized)
        assert bench.until(S.PUSH) == 140
        assert bench.machine.leg is F

    def test_cut_by_nothing(self) -> None:
        bench = self.to_neutral_on_the_way(blow=BlowConfig(cut="none"))
        bench.step(synchronized=True)
        assert bench.until(S.PUSH) == 140

    @pytest.mark.parametrize("blow", [BlowConfig(cut="confirmation"), BlowConfig(duration_s=0.0)])
    def test_cut_at_confirmation(self, blow: BlowConfig) -> None:
        assert self.to_neutral_on_the_way(blow=blow).facts() == (S.PUSH, F, F, U)
        bench = Bench(N, blow=blow).underway(B)
        assert bench.step(gear=B, run=2) is S.HOLD
        assert bench.machine.confirmed is B

    def test_a_strategy_may_shorten_it_but_not_lengthen_it(self) -> None:
        asked = []

        def wished(length_s: float) -> Any:
            def blow_s(configured_s: float, leg: Gear, follows: bool) -> float:
                asked.append((configured_s, leg, follows))
                return length_s

            return blow_s

        for wish_s, ms in ((0.05, 50), (9.0, 150)):
            bench = Bench(N, blow_s=wished(wish_s)).blowing(B)
            assert bench.machine.blow_remaining_ns(bench.now_ns) == ms * MS
        bench = Bench(N, blow_s=wished(-1.0)).underway(B)
        assert bench.step(gear=B, run=2) is S.HOLD
        assert asked == [(0.15, B, False)] * 3
        bench = Bench(B, blow_s=wished(0.05)).underway(F)
        bench.step(gear=N, run=2)
        assert asked[-1] == (0.15, N, True)
        bench = Bench(N, blow_s=wished(0.1), blow=BlowConfig(cut="confirmation")).underway(B)
        assert bench.step(gear=B, run=2) is S.HOLD
        assert asked[-1] == (0.0, B, False)

    def test_a_gear_that_slips_out_is_pushed_again_under_the_same_timeout(self) -> None:
        bench = Bench(N).blowing(B)
        pushed_ns = bench.machine.attempt_ns
        assert bench.step(gear=U, run=1) is S.BLOW
        assert bench.machine.confirmed is U
        assert bench.step(gear=U, run=2) is S.PUSH
        assert bench.machine.leg is B and bench.machine.event is not Event.LEG_STARTED
        bench.until(S.VENT)
        assert bench.now_ns - pushed_ns == 1000 * MS

    def test_a_single_sample_outside_does_not_end_it(self) -> None:
        bench = Bench(N).blowing(B)
        bench.step(gear=U, run=1)
        bench.step(gear=B, run=1)
        assert bench.machine.confirmed is U
        bench.step(gear=B, run=2)
        assert bench.facts() == (S.BLOW, B, B, B)
        assert bench.until(S.HOLD) == 120

    def test_outside_at_its_end_it_is_pushed_again(self) -> None:
        bench = Bench(N).blowing(B)
        bench.stays(S.BLOW, 14)
        assert bench.step(gear=U, run=1) is S.PUSH
        assert bench.machine.leg is B

    @pytest.mark.parametrize("wanted", [N, F])
    def test_a_new_request_in_a_gear_leaves_it_at_once(self, wanted: Gear) -> None:
        bench = Bench(N).blowing(B)
        assert bench.step(requested=wanted) is S.PUSH
        assert bench.facts() == (S.PUSH, N, wanted, U)
        assert bench.machine.event is Event.LEG_STARTED

    def test_a_new_request_in_neutral_changes_what_follows(self) -> None:
        bench = Bench(B).blowing(N)
        assert bench.step(requested=F) is S.BLOW
        assert bench.facts() == (S.BLOW, N, F, N)
        assert bench.machine.in_process
        assert bench.until(S.PUSH) == 140
        assert bench.machine.leg is F

    @pytest.mark.parametrize("wanted", [N, None])
    def test_a_request_taken_back_in_neutral_ends_there(self, wanted: Gear | None) -> None:
        bench = self.to_neutral_on_the_way()
        bench.step(requested=wanted)
        assert bench.until(S.HOLD) == 140
        assert bench.machine.final is N


class TestAfterwards:
    def test_hold_40_ms_and_vent_110_ms(self) -> None:
        bench = Bench(N).blowing(B)
        bench.until(S.HOLD)
        assert not bench.machine.driving
        assert bench.until(S.VENT) == 40
        assert bench.until(S.IDLE) == 110
        assert bench.facts() == (S.IDLE, B, B, B)
        assert not bench.machine.in_process

    @pytest.mark.parametrize("state", [S.HOLD, S.VENT])
    def test_a_new_request_starts_at_once(self, state: ShiftState) -> None:
        bench = Bench(N).blowing(B)
        bench.until(state)
        assert not bench.machine.in_process
        assert bench.step(requested=F) is S.PUSH
        assert bench.facts() == (S.PUSH, N, F, U)

    @pytest.mark.parametrize("state", [S.HOLD, S.VENT])
    def test_a_gear_that_slips_out_is_reported_and_seen_again(self, state: ShiftState) -> None:
        bench = Bench(N).blowing(B)
        bench.until(state)
        assert bench.step(gear=U, run=1) is state
        assert bench.machine.confirmed is U
        bench.step(gear=B, run=1)
        assert bench.machine.confirmed is U
        bench.step(gear=B, run=2)
        assert bench.machine.confirmed is B

    @pytest.mark.parametrize("state", [S.HOLD, S.VENT])
    def test_but_not_pushed_again(self, state: ShiftState) -> None:
        bench = Bench(N).blowing(B)
        bench.until(state)
        bench.step(gear=U, run=1)
        bench.until(S.IDLE)
        bench.stays(S.IDLE, 10)


class TestRequestsDuringAPush:
    def test_the_same_request_changes_nothing(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(requested=B, gear=U, run=1)
        assert bench.facts() == (S.PUSH, B, B, U)

    @pytest.mark.parametrize(("engaging", "wanted"), [(B, N), (B, F), (F, N), (F, B)])
    def test_a_push_into_a_gear_is_given_up_for_neutral(self, engaging: Gear, wanted: Gear) -> None:
        bench = Bench(N).underway(engaging)
        assert bench.step(requested=wanted) is S.PUSH
        assert bench.facts() == (S.PUSH, N, wanted, U)
        assert bench.machine.event is Event.LEG_STARTED
        assert bench.step(gear=N, run=2) is S.BLOW

    @pytest.mark.parametrize("wanted", [N, B, F])
    def test_a_push_to_neutral_goes_on_whatever_follows(self, wanted: Gear) -> None:
        bench = Bench(B).underway(F)
        assert bench.step(requested=wanted) is S.PUSH
        assert bench.facts() == (S.PUSH, N, wanted, U)
        assert bench.machine.event is not Event.LEG_STARTED

    def test_a_lost_request_lets_the_leg_finish_and_nothing_follow(self) -> None:
        bench = Bench(B).pushing(F)
        bench.step(gear=U, run=1, requested=None)
        assert bench.facts() == (S.PUSH, N, N, U)
        bench.step(gear=N, run=2)
        bench.until(S.IDLE)
        assert bench.machine.confirmed is N
        assert bench.step(requested=F) is S.PUSH  # it is back: now it is new

    def test_during_the_pause_before_a_retry(self) -> None:
        bench = Bench(N).underway(B)
        bench.until(S.VENT)
        assert bench.step() is S.VENT
        assert bench.step(requested=F) is S.PUSH
        assert bench.facts() == (S.PUSH, N, F, U)
        assert bench.machine.attempt == 0 and bench.machine.event is Event.LEG_STARTED

    def test_a_changed_mind_before_a_retry_to_neutral(self) -> None:
        bench = Bench(B).underway(N)
        bench.until(S.VENT)
        assert bench.step(requested=F) is S.VENT
        assert bench.machine.final is F
        assert bench.until(S.PUSH) == 90


class TestWaiting:
    def waiting(self, **changes: Any) -> Bench:
        bench = Bench(N, shift=ShiftConfig(wait_for_sync=True)).idle()
        assert bench.step(requested=B, synchronized=False, **changes) is S.HOLD
        assert bench.facts() == (S.HOLD, B, B, N)
        assert bench.machine.in_process and not bench.machine.driving
        return bench

    def test_for_the_shaft_speeds(self) -> None:
        bench = self.waiting()
        bench.stays(S.HOLD, 30)
        assert bench.step(synchronized=True) is S.PUSH
        assert bench.machine.leg is B and bench.machine.event is Event.LEG_STARTED

    def test_not_for_ever(self) -> None:
        assert self.waiting().until(S.PUSH) == 1000

    def test_not_without_speeds(self) -> None:
        assert self.waiting().step(synchronized=None) is S.PUSH

    def test_not_on_the_way_to_neutral(self) -> None:
        bench = Bench(B, shift=ShiftConfig(wait_for_sync=True)).idle()
        assert bench.step(requested=N, synchronized=False) is S.PUSH

    def test_only_when_configured(self) -> None:
        assert Bench(N).idle().step(requested=B, synchronized=False) is S.PUSH

    def test_after_the_blow_on_neutral(self) -> None:
        bench = Bench(F, shift=ShiftConfig(wait_for_sync=True)).pushing(B)
        bench.step(gear=U, run=1, synchronized=False)
        bench.step(gear=N, run=2)
        assert bench.until(S.HOLD) == 150
        assert bench.facts() == (S.HOLD, B, B, N)
        assert bench.until(S.PUSH) == 1000

    @pytest.mark.parametrize(
        ("wanted", "mine", "other"), [(B, "clear_b", "clear_f"), (F, "clear_f", "clear_b")]
    )
    def test_for_the_opposite_chamber_however_long(
        self, wanted: Gear, mine: str, other: str
    ) -> None:
        bench = Bench(N).idle()
        assert bench.step(requested=wanted, **{mine: False, other: True}) is S.HOLD
        bench.stays(S.HOLD, 300)
        assert bench.step(**{mine: True, other: False}) is S.PUSH
        assert bench.machine.leg is wanted

    def test_both_conditions(self) -> None:
        bench = self.waiting(clear_b=False)
        assert bench.step(synchronized=True) is S.HOLD
        assert bench.step(synchronized=False, clear_b=True) is S.HOLD
        assert bench.step(synchronized=True) is S.PUSH

    @pytest.mark.parametrize("wanted", [N, None])
    def test_a_request_taken_back_ends_it(self, wanted: Gear | None) -> None:
        bench = self.waiting()
        assert bench.step(requested=wanted) is S.VENT
        assert bench.facts() == (S.VENT, N, N, N)
        assert not bench.machine.in_process
        assert bench.until(S.IDLE) == 110
        assert bench.machine.confirmed is N
        assert bench.step(requested=B, synchronized=True) is S.PUSH

    def test_another_gear_instead(self) -> None:
        bench = self.waiting()
        assert bench.step(requested=F) is S.HOLD
        assert bench.step(synchronized=True) is S.PUSH
        assert bench.facts() == (S.PUSH, F, F, U)

    def test_drifting_out_of_neutral_it_is_pushed_there_first(self) -> None:
        bench = self.waiting()
        assert bench.step(gear=U, run=1) is S.PUSH
        assert bench.facts() == (S.PUSH, N, B, U)

    def test_taken_back_and_slipped_out_it_is_not_pushed_again(self) -> None:
        bench = self.waiting()
        assert bench.step(requested=N) is S.VENT
        bench.step(gear=U, run=1)
        bench.until(S.IDLE)
        bench.stays(S.IDLE, 10)

    def test_having_slipped_before_the_wait_it_must_be_seen_again(self) -> None:
        bench = self.waiting()
        bench.step(gear=U, run=1)
        bench.step(gear=N, run=2, synchronized=False)
        assert bench.until(S.HOLD) == 150
        assert bench.step(synchronized=True) is S.PUSH
        assert bench.machine.leg is B


class TestFault:
    def failed(self) -> Bench:
        bench = Bench(N).pushing(B)
        bench.step(position_valid=False)
        return bench

    def test_left_by_a_different_request_only(self) -> None:
        bench = self.failed()
        for _ in range(10):
            assert bench.step(position_valid=True) is S.FAULT
            assert bench.machine.event is not Event.RECOVERED
        assert bench.step(requested=None) is S.FAULT
        assert bench.step(requested=B) is S.FAULT
        assert bench.step(requested=N) is S.INIT
        assert bench.machine.event is Event.RECOVERED and bench.machine.confirmed is U
        assert bench.step() is S.IDLE
        assert bench.machine.event is not Event.RECOVERED and bench.machine.confirmed is N
        assert bench.step() is S.IDLE

    def test_the_failed_request_that_comes_back_during_init_is_a_new_one(self) -> None:
        bench = self.failed()
        bench.step(position_valid=True, gear=U)
        assert bench.step(requested=N) is S.INIT
        bench.step(requested=B)
        assert bench.until(S.IDLE) > 0
        assert bench.step() is S.PUSH
        assert bench.machine.leg is N and bench.machine.final is B

    def test_not_while_the_position_is_lost(self) -> None:
        bench = self.failed()
        assert bench.step(requested=N) is S.FAULT
        assert bench.step(requested=B) is S.FAULT
        assert bench.step(position_valid=True) is S.FAULT
        assert bench.step(requested=N) is S.INIT

    def test_not_while_the_firmware_forbids_it(self) -> None:
        bench = self.failed()
        assert bench.step(position_valid=True, requested=N, recoverable=False) is S.FAULT
        assert bench.step(recoverable=True) is S.INIT

    def test_init_after_it_waits_its_full_time(self) -> None:
        bench = self.failed()
        assert bench.step(position_valid=True, requested=N, gear=U) is S.INIT
        bench.step()
        assert bench.until(S.IDLE) == 300
        assert bench.step() is S.PUSH
        assert bench.machine.leg is N

    def test_the_failed_request_is_the_final_one(self) -> None:
        bench = Bench(B).pushing(F)
        bench.step(position_valid=False)
        bench.step(position_valid=True, gear=U)
        assert bench.step(requested=F) is S.FAULT
        assert bench.step(requested=B) is S.INIT

    def test_no_longer_in_process_when_it_fails_before_a_retry(self) -> None:
        bench = Bench(N).underway(B)
        bench.until(S.VENT)
        bench.step(position_valid=False)
        assert not bench.machine.in_process


@pytest.mark.parametrize("sync_wait_s", [0.0, 1.0])
def test_a_wish_that_comes_as_hold_or_vent_ends_begins_its_shift(sync_wait_s: float) -> None:
    for state, left_ms in ((S.HOLD, 40), (S.VENT, 110)):
        bench = Bench(shift=ShiftConfig(sync_wait_s=sync_wait_s)).blowing(B)
        bench.until(state)
        assert bench.step(left_ms, requested=N) is S.PUSH
        assert bench.machine.leg is N
