"""Participants whose words depend on all they hear; `toy_nodes.py NAME CHANNEL [--trace FILE] [--at NS WHAT]` runs one."""

from __future__ import annotations

import argparse
import os
import signal
import struct
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from can_dbc.codec import can_id_of
from can_dbc.frame import Frame
from can_dbc.messages import PositionPulse, ShiftRequest, ValveCommand
from sil.coupling.transports.link import open_link, take_part
from sil.recording.recorder import TraceWriter

MS = 1_000_000
PERIODS_NS = {"driver": 20 * MS, "controller": 10 * MS, "plant": 5 * MS}
PHASES_NS = {"driver": 0, "controller": 0, "plant": 2 * MS + 500_000}
IDS = {
    "driver": can_id_of(ShiftRequest),
    "controller": can_id_of(ValveCommand),
    "plant": can_id_of(PositionPulse),
}
COLUMNS = ("time_s", "heard", "position_m")


class ToyNode:
    """Two frames an event, the second 100 µs late: a running checksum of all heard, arrivals included; a trace row each."""

    def __init__(
        self,
        name: str,
        trace: TraceWriter | None = None,
        misbehave: Callable[[int], None] = lambda now_ns: None,
        burst: int = 1,
    ) -> None:
        self.name = name
        self.closed = False
        self.heard = 0
        self.instants: list[int] = []
        self._sum = zlib.crc32(name.encode())
        self._trace = trace
        self._misbehave = misbehave
        self._burst = burst

    def start(self) -> int:
        return PHASES_NS[self.name]

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        self._misbehave(until_ns)
        self.instants.append(until_ns)
        for arrival_ns, frame in deliveries:
            self.heard += 1
            heard = struct.pack("<QI", arrival_ns, frame.can_id) + frame.data
            self._sum = zlib.crc32(heard, self._sum)
        if self._trace is not None:
            row = (until_ns / 1e9, float(self.heard), self._sum / 3.0e11)
            self._trace.write(np.array([row]))
        content = struct.pack("<IHBB", self._sum, self.heard & 0xFFFF, 0xAA, len(deliveries) & 0xFF)
        frame = Frame(IDS[self.name], content)
        late = Frame(IDS[self.name] + (1 << 26), content[: self._sum % 9])
        period_ns = PERIODS_NS[self.name]
        next_ns = until_ns - (until_ns - PHASES_NS[self.name]) % period_ns + period_ns
        return [*[(until_ns, frame)] * self._burst, (until_ns + 100_000, late)], next_ns

    def close(self) -> None:
        self.closed = True
        if self._trace is not None:
            self._trace.close()


def misbehaviour(at_ns: int, what: str) -> Callable[[int], None]:
    """Return what does nothing until `at_ns` and then dies, stalls, fails or exits."""

    def misbehave(now_ns: int) -> None:
        if now_ns < at_ns:
            return
        if what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif what == "stall":
            time.sleep(600.0)
        elif what == "exit":
            os._exit(7)
        elif what == "fail":
            raise ValueError("toy node asked to fail")
        elif what == "slow":
            time.sleep(0.002)
        else:
            raise ValueError(what)

    return misbehave


def main(arguments: Sequence[str]) -> None:
    """Take part in a run as one toy node."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("channel")
    parser.add_argument("--trace", type=Path)
    parser.add_argument("--at", nargs=2, metavar=("NS", "WHAT"))
    parser.add_argument("--scenario", type=int, default=0)
    parser.add_argument("--burst", type=int, default=1)
    parser.add_argument("--start-timeout", type=float, default=10.0)
    given = parser.parse_args(arguments)
    trace = TraceWriter(given.trace, COLUMNS) if given.trace else None
    misbehave = misbehaviour(int(given.at[0]), given.at[1]) if given.at else lambda now_ns: None
    take_part(
        ToyNode(given.name, trace, misbehave, given.burst),
        open_link(given.channel, given.start_timeout),
        scenario=given.scenario,
        start_timeout_s=given.start_timeout,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
