"""A run whose control unit is two: what they are told is the same, what they answer must be."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from can_dbc.codec import can_id_of, decode
from can_dbc.e2e import Protector
from can_dbc.frame import Frame
from can_dbc.messages import DrivelineSpeeds, Gear, PositionPulse, ShiftRequest, ValveCommand
from controller.c_settings import STRATEGIES
from controller.config import FirmwareConfig, load_config
from sil.coupling.transports.channel import Participant, Received, Turn
from sil.simulation import build
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import Loaded


class Twins:
    """Two participants as one. Raises AssertionError when their answers differ."""

    name = "controller"

    def __init__(self, first: Participant, second: Participant) -> None:
        self.first, self.second = first, second
        self.start = first.start
        second.start()

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        turn = self.first.advance(until_ns, deliveries)
        assert self.second.advance(until_ns, deliveries) == turn, f"{until_ns} ns"
        return turn

    def close(self) -> None:
        self.first.close()
        self.second.close()


def run_with_twins(loaded: Loaded, firmware: str) -> Run:
    """Run a scenario with the firmware in Python, and another one beside it."""
    scenario = msgspec.structs.replace(loaded.scenario, firmware=firmware)
    other = Loaded(scenario, loaded.parameters, loaded.source)
    make = build.make_participant

    def twins(name: str, loaded: Loaded, folder: Path | None) -> Any:
        first = make(name, loaded, folder)
        return Twins(first, make(name, other, folder)) if name == "controller" else first

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "make_participant", twins)
        return run_in_memory(loaded)


MS = 1_000_000
STROKE_M = 0.01285


def drawn_config(rng: random.Random) -> FirmwareConfig:
    """Settings of a firmware, short times so that all that waits comes to its end."""
    table = {
        "strategy": rng.choice(STRATEGIES),
        "filter": {"enabled": rng.random() < 0.5},
        "windows": {"samples": rng.randint(1, 6)},
        "blow": {"duration_s": rng.choice((0.0, 0.05, 0.15)),
                 "cut": rng.choice(("none", "sync", "confirmation"))},
        "shift": {"retries": rng.randint(0, 2), "wait_for_sync": rng.random() < 0.5,
                  "push_timeout_s": rng.choice((0.1, 0.3)), "no_motion_s": rng.choice((0.05, 0.2)),
                  "retry_pause_s": 0.03, "sync_wait_s": 0.1, "init_timeout_s": 0.1,
                  "init_settle_s": rng.choice((0.0, 0.04)), "hold_s": rng.choice((0.0, 0.04)),
                  "vent_s": rng.choice((0.0, 0.1)), "reversal_settle_s": rng.choice((0.0, 0.12)),
                  "interlock_s": rng.choice((0.0, 0.04, 0.3))},
    }  # fmt: skip
    return load_config(table, "drawn")


class Surroundings:
    """Sends requests, pulses and speeds of every tick; each of its traits lasts a while."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._request = Protector(ShiftRequest)
        self._pulse = Protector(PositionPulse)
        self._speeds = Protector(DrivelineSpeeds)
        self._position_m = rng.choice((-STROKE_M, 0.0, STROKE_M, 0.006))
        self._towards_m = self._position_m
        self._index = 0
        self._target = rng.choice(list(Gear))
        self._trait = "follows"
        self._apart_rad_s = 0.0

    def heed(self, frames: list[Frame]) -> None:
        """Take the valve command."""
        command = next(f for f in frames if f.can_id == can_id_of(ValveCommand))
        message = decode(command)
        assert isinstance(message, ValveCommand)
        goals = ((message.duty_b, STROKE_M), (message.duty_n, 0.0), (message.duty_f, -STROKE_M))
        for duty, goal_m in goals:
            if duty > 0.5:
                self._towards_m = goal_m

    def frames(self) -> Iterator[Frame]:
        """The frames that arrive before the next tick."""
        rng = self._rng
        if rng.random() < 0.04:
            self._trait = rng.choice(("follows",) * 4 + ("sticks", "slips", "lies", "silent"))
        if rng.random() < 0.05:
            self._target = rng.choice([*list(Gear)[:3], Gear(rng.randint(0, 3))])
            self._apart_rad_s = rng.choice((0.0, 1.0, 40.0))
        if self._trait == "slips":
            self._towards_m = rng.choice((0.006, -0.006, 0.0))
        if self._trait != "sticks":
            way_m = self._towards_m - self._position_m
            self._position_m += max(-0.005, min(0.005, way_m))
        self._apart_rad_s = max(0.0, self._apart_rad_s - rng.choice((0.0, 5.0, 8.0)))
        if rng.random() < 0.95:
            yield self._request.protect(ShiftRequest(self._target))
        if self._trait != "silent" and rng.random() < 0.97:
            at_m = rng.uniform(-0.03, 0.03) if self._trait == "lies" else self._position_m
            yield self._pulse.protect(PositionPulse(0.0009 + 0.022 * at_m, 293.15, self._index))
        self._index = (self._index + 1) % 256
        if rng.random() < 0.9:
            speeds = DrivelineSpeeds(100.0 + self._apart_rad_s, 100.0, Gear(rng.randint(0, 3)))
            yield self._speeds.protect(speeds)


def feed(first: Participant, second: Participant, rng: random.Random, ticks: int = 400) -> None:
    """Feed both with the same frames. Raises AssertionError when their answers differ."""
    around = Surroundings(rng)
    arrived: list[tuple[int, Frame]] = []
    for tick in range(ticks):
        now_ns = 10 * MS * tick
        answer = first.advance(now_ns, arrived)
        assert second.advance(now_ns, arrived) == answer, tick
        around.heed([frame for _, frame in answer[0]])
        frames = [f for f in around.frames() if rng.random() < 0.995]
        if rng.random() < 0.01:  # a bit is flipped
            frames = [Frame(f.can_id, bytes([f.data[0] ^ 1]) + f.data[1:]) for f in frames]
        arrived = [(now_ns + (k + 1) * MS, frame) for k, frame in enumerate(frames)]
