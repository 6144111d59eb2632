"""A run whose control unit is two: what they are told is the same, what they answer must be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

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
