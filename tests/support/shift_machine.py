"""A machine and its observations, for the tests of the shift sequence."""

from __future__ import annotations

from typing import Any

from can_dbc.messages import Gear, ShiftState
from controller.config import FirmwareConfig
from controller.shift import Observation, ShiftMachine

MS = 1_000_000
N, B, F, U = Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD, Gear.UNKNOWN
S = ShiftState


def as_configured(configured_s: float, leg: Gear, follows: bool) -> float:
    return configured_s


class Bench:
    """A machine, and a view that stays as it is until a test changes it."""

    def __init__(self, gear: Gear = N, blow_s: Any = as_configured, **config: Any) -> None:
        self.machine = ShiftMachine(FirmwareConfig(**config), blow_s)
        self.now_ns = 0
        self.view = Observation(
            position_valid=True,
            gear=gear,
            run=10,
            moved=True,
            requested=None,
            synchronized=None,
            clear_b=True,
            clear_f=True,
            recoverable=True,
        )

    def step(self, ms: float = 10, **changes: Any) -> ShiftState:
        """Change the view, let time pass, step once."""
        self.view = self.view._replace(**changes)
        self.now_ns += round(ms * MS)
        machine = self.machine
        machine.step(self.now_ns, self.view)
        assert type(machine.in_process) is bool  # None would be sent as unknown
        return machine.state

    def stays(self, state: ShiftState, steps: int, **changes: Any) -> None:
        """Step a number of times, in a state that must not change."""
        assert {self.step(**changes) for _ in range(steps)} == {state}

    def until(self, state: ShiftState, limit_ms: int = 5000) -> int:
        """Step every 10 ms until a state is there; return the ms that took."""
        start_ns = self.now_ns
        while self.machine.state is not state:
            self.step()
            assert self.now_ns - start_ns <= limit_ms * MS, f"{state.name} never came"
        return (self.now_ns - start_ns) // MS

    def idle(self) -> Bench:
        assert self.step() is S.IDLE
        return self

    def pushing(self, target: Gear) -> Bench:
        """From idle in the present gear into a push for the first leg to a target."""
        self.idle()
        assert self.step(requested=target) is S.PUSH
        return self

    def underway(self, target: Gear) -> Bench:
        """Into a push for a target whose start has been left."""
        self.pushing(target).step(gear=U, run=1)
        return self

    def blowing(self, target: Gear) -> Bench:
        """Into the blow after a leg that ends in a target."""
        self.underway(target)
        assert self.step(gear=target, run=2) is S.BLOW
        return self

    def facts(self) -> tuple[ShiftState, Gear, Gear, Gear]:
        m = self.machine
        return m.state, m.leg, m.final, m.confirmed
