"""What the firmware tells a strategy, and what it lets it do."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.messages import (
    Chamber,
    DrivelineSpeeds,
    Fault,
    Gear,
)
from controller import firmware as module
from controller.config import FirmwareConfig
from controller.position import Estimate
from controller.strategies import Duties, ShiftContext
from controller.strategies.open_loop import OpenLoop
from tests.support.toy_actuator import (
    MS,
    B,
    F,
    N,
    Rig,
    S,
    Stay,
    check_invariants,
    duties,
    shift,
)


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
        assert second.charged is Chamber.F
        assert second.start_ns == rig.when(S.PUSH, 1)
        assert strategy.resets == 2
        assert {r.state for r in rig.rows if r.time_ns in {t for t, _, _ in strategy.seen}} <= {
            S.PUSH,
            S.CONFIRM,
        }
        for now_ns, estimate, _ in strategy.seen:
            row = next(r for r in rig.rows if r.time_ns == now_ns)
            assert estimate.position_m == row.out.status.estimate_m
            assert estimate.valid

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
        [
            Duties(0.34, 0.0, 0.34),
            Duties(0.0, float("nan"), 0.0),
            Duties(0.0, 0.0, float("inf")),
        ],
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
                assert context.apart_rad_s == 10.0 + newest
                assert context.apart_ns == newest * 30 * MS
                count += 1
        assert count > 3
