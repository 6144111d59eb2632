"""The shift state machine: changing requests, waiting in neutral, the fault state."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.messages import Gear
from controller.settings import ShiftConfig
from controller.shift import Event
from tests.support.shift_machine import B, Bench, F, N, S, U


class TestRequestsDuringAPush:
    def test_the_same_request_changes_nothing(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(requested=B, gear=U, run=1)
        assert bench.facts() == (S.PUSH, B, B, U)

    @pytest.mark.parametrize(("engaging", "wanted"), [(B, N), (B, F), (F, N), (F, B)])
    def test_a_push_into_a_gear_is_given_up_for_neutral(self, engaging: Gear, wanted: Gear) -> None:
        bench = Bench(N).pushing(engaging)
        bench.step(gear=U, run=1)
        assert bench.step(requested=wanted) is S.PUSH
        assert bench.facts() == (S.PUSH, N, wanted, U)
        assert bench.machine.event is Event.LEG_STARTED
        assert bench.step(gear=N, run=2) is S.BLOW

    @pytest.mark.parametrize("wanted", [N, B, F])
    def test_a_push_to_neutral_goes_on_whatever_follows(self, wanted: Gear) -> None:
        bench = Bench(B).pushing(F)
        bench.step(gear=U, run=1)
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

    def test_a_lost_request_lets_a_gear_be_engaged(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(gear=U, run=1, requested=None)
        assert bench.facts() == (S.PUSH, B, B, U)
        bench.step(gear=B, run=2)
        bench.until(S.IDLE)
        assert bench.machine.confirmed is B

    def test_during_the_pause_before_a_retry(self) -> None:
        bench = Bench(N).pushing(B)
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        assert bench.step() is S.VENT
        assert bench.step(requested=F) is S.PUSH
        assert bench.facts() == (S.PUSH, N, F, U)
        assert bench.machine.attempt == 0
        assert bench.machine.event is Event.LEG_STARTED

    def test_a_changed_mind_before_a_retry_to_neutral(self) -> None:
        bench = Bench(B).pushing(N)
        bench.step(gear=U, run=1)
        bench.until(S.VENT)
        assert bench.step(requested=F) is S.VENT
        assert bench.machine.final is F
        assert bench.until(S.PUSH) == 90


class TestWaiting:
    def waiting(self, **changes: Any) -> Bench:
        bench = Bench(N, shift=ShiftConfig(wait_for_sync=True)).idle()
        assert bench.step(requested=B, synchronized=False, **changes) is S.HOLD
        assert bench.facts() == (S.HOLD, B, B, N)
        assert bench.machine.in_process
        assert not bench.machine.driving
        return bench

    def test_for_the_shaft_speeds(self) -> None:
        bench = self.waiting()
        for _ in range(30):
            assert bench.step() is S.HOLD
        assert bench.step(synchronized=True) is S.PUSH
        assert bench.machine.leg is B
        assert bench.machine.event is Event.LEG_STARTED

    def test_not_for_ever(self) -> None:
        assert self.waiting().until(S.PUSH) == 1000

    def test_not_without_speeds(self) -> None:
        bench = self.waiting()
        assert bench.step(synchronized=None) is S.PUSH

    def test_not_on_the_way_to_neutral(self) -> None:
        bench = Bench(B, shift=ShiftConfig(wait_for_sync=True)).idle()
        assert bench.step(requested=N, synchronized=False) is S.PUSH

    def test_only_when_configured(self) -> None:
        bench = Bench(N).idle()
        assert bench.step(requested=B, synchronized=False) is S.PUSH

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
        for _ in range(300):
            assert bench.step() is S.HOLD
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
        for _ in range(10):
            assert bench.step() is S.IDLE

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
        assert bench.machine.event is Event.RECOVERED
        assert bench.machine.confirmed is U
        assert bench.step() is S.IDLE
        assert bench.machine.event is not Event.RECOVERED
        assert bench.machine.confirmed is N
        assert bench.step() is S.IDLE

    def test_the_failed_request_that_comes_back_during_init_is_a_new_one(self) -> None:
        bench = self.failed()
        bench.step(position_valid=True, gear=U)
        assert bench.step(requested=N) is S.INIT
        bench.step(requested=B)
        assert bench.until(S.IDLE) > 0
        assert bench.step() is S.PUSH
        assert bench.machine.leg is N
        assert bench.machine.final is B

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
        bench = Bench(N).pushing(B)
        bench.step(gear=U, run=1)
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
