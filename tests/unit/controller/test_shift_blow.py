"""The shift state machine from the confirmation on: blow, hold, vent."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.messages import Gear, ShiftState
from controller.settings import BlowConfig
from controller.shift import Event
from tests.support.shift_machine import MS, B, Bench, F, N, S, U


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
        bench = Bench(B, **config).pushing(F)
        bench.step(gear=U, run=1)
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
        bench = Bench(B).pushing(F)
        bench.step(gear=U, run=1)
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
        bench = Bench(N, blow=blow).pushing(B)
        bench.step(gear=U, run=1)
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
        bench = Bench(N, blow_s=wished(-1.0)).pushing(B)
        bench.step(gear=U, run=1)
        assert bench.step(gear=B, run=2) is S.HOLD
        assert asked == [(0.15, B, False)] * 3
        bench = Bench(B, blow_s=wished(0.05)).pushing(F)
        bench.step(gear=U, run=1)
        bench.step(gear=N, run=2)
        assert asked[-1] == (0.15, N, True)
        bench = Bench(N, blow_s=wished(0.1), blow=BlowConfig(cut="confirmation")).pushing(B)
        bench.step(gear=U, run=1)
        assert bench.step(gear=B, run=2) is S.HOLD
        assert asked[-1] == (0.0, B, False)

    def test_a_gear_that_slips_out_is_pushed_again_under_the_same_timeout(self) -> None:
        bench = Bench(N).blowing(B)
        pushed_ns = bench.machine.attempt_ns
        assert bench.step(gear=U, run=1) is S.BLOW
        assert bench.machine.confirmed is U
        assert bench.step(gear=U, run=2) is S.PUSH
        assert bench.machine.leg is B
        assert bench.machine.event is not Event.LEG_STARTED
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
        for _ in range(14):
            assert bench.step() is S.BLOW
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

    @pytest.mark.parametrize(("state", "ms"), [(S.HOLD, 40), (S.VENT, 110)])
    def test_a_new_request_in_the_last_moment_too(self, state: ShiftState, ms: int) -> None:
        bench = Bench(N).blowing(B)
        bench.until(state)
        for _ in range(ms // 10 - 1):
            assert bench.step() is state
        assert bench.step(requested=F) is S.PUSH

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
        for _ in range(10):
            assert bench.step() is S.IDLE
