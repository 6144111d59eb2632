"""A free-running run: every node by its own clock, only messages of the DBC on the bus."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import threading
import time
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from can_dbc.contract import contract
from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from sil.coupling.bus import BusFrame
from sil.coupling.clock import to_ns
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.coupling.free_running import FreeNode, epoch_s, frame_of, open_bus
from sil.coupling.lockstep import RunSummary
from sil.coupling.processes import ChildProcess
from sil.coupling.transports.channel import ParticipantLost
from sil.coupling.transports.server import Relay
from sil.coupling.transports.wire import GUEST
from sil.files.quantity import counted
from sil.recording.recorder import CLOCK_ZERO, EVENTS, PLANT_TRACE, EventLog, TraceWriter
from sil.recording.run_reader import event_of, open_trace
from sil.simulation import build
from sil.simulation.build import REMOTE, TIMEOUTS, Say
from sil.simulation.bus_figures import COUNTS, message_rows
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import FAULT_TABLES

_SENDERS = {s.can_id: build.PARTICIPANT.get(s.senders[0], GUEST) for s in contract().values()}

SETTLING_S = 1.0
"""The run begins this long after the last node has come, when all have received the others' frames."""
_LOOK_S = 0.05


class FreeRun:
    """The nodes of a scenario on a bus, and what crosses it."""

    def __init__(
        self,
        loaded: Loaded,
        folder: Path,
        transport: str,
        external: Collection[str],
        say: Say,
        closing: contextlib.ExitStack,
    ) -> None:
        """Open the bus and start plant and controller, unless external; `closing` ends and closes them.

        Raises InputError for what only a lockstep run has, or for a channel that cannot exist.
        """
        scenario = loaded.scenario
        # the clocks of the nodes know neither instants of the run nor how long chambers stay charged
        for key in (*FAULT_TABLES, "bus.guest", "plant.charged"):
            if attrgetter(key)(scenario):
                expected = "none on a free-running bus, or --speed 1, which paces a lockstep run"
                what = f"{key}: of a lockstep run only"
                raise InputError(f"{loaded.source}: {what}; expected {expected}")
        self._loaded, self._folder = loaded, folder
        self.warnings: list[str] = []
        self._children: list[ChildProcess] = []
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(thread_name_prefix="node")
        self._nodes: list[Future[None]] = []
        self._closing = closing
        self._zero_ns = 0
        self._arrivals: defaultdict[int, list[int]] = defaultdict(list)
        self._bits = 0
        self._channel, name = build.channel_of(transport)
        if name is not None:
            closing.callback(Relay(name).close)
        if self._channel.startswith("virtual:"):
            what = "inside one process; expected a bus that all nodes reach"
            raise InputError(f"--transport {transport}: {what}")
        self._bus = open_bus(self._channel, bitrate=scenario.bus.bitrate)
        closing.callback(self._bus.shutdown)
        closing.callback(self._end_nodes)
        for participant in REMOTE:
            arguments = (participant, self._channel, folder, external, say, "--realtime")
            if command := build.node_command(*arguments):
                self._children.append(ChildProcess(participant, command))

    def run(self, record: Callable[[list[BusFrame]], None]) -> RunSummary:
        """Wait for plant and controller, then run; `record` receives each frame. Raises ParticipantLost."""
        self._wait_for_all()
        duration_ns = to_ns(self._loaded.scenario.duration_s)
        for name in build.participant_names(self._loaded.scenario):
            if name not in REMOTE:
                self._start_node(name)
        begun = time.perf_counter()
        # Whole microseconds, so that canplayer reads the log.
        self._zero_ns = time.time_ns() // 1000 * 1000 + to_ns(SETTLING_S)
        end_ns = self._zero_ns + duration_ns
        while time.time_ns() < end_ns + to_ns(_LOOK_S):
            self._look_after_nodes()
            time.sleep(_LOOK_S)
            if deliveries := self._deliveries(duration_ns):
                record(deliveries)
        wall_s = time.perf_counter() - begun
        self._end_nodes()
        self._align_recordings()
        figures = self.figures()
        worst_s = 0.0
        for m in figures["messages"]:
            if (m["missing"] or 0) > 0.05 * m["frames"]:
                what = f"{counted(m['missing'], 'frame')} missing, {m['frames']} on the bus"
                why = "this machine was too busy, or its sender was away"
                self.warnings.append(f"{m['name']}: {what}; {why}")
            if (m["jitter_max_s"] or 0.0) > 0.5 * m["period_s"]:
                worst_s = max(worst_s, m["jitter_max_s"])
        if worst_s:
            why = "this machine was too busy for limits on times"
            self.warnings.append(f"frames up to {1e3 * worst_s:.1f} ms off their period: {why}")
        return RunSummary(0, figures["frames"], wall_s, None)

    def figures(self) -> dict[str, Any]:
        """Return load, counts, and per message: frames, period, gaps and jitter."""
        scenario = self._loaded.scenario

        def row(can_id: int, period_ns: int) -> dict[str, Any]:
            arrivals = self._arrivals.get(can_id, [])
            return {"frames": len(arrivals), **jitter(arrivals, period_ns)}

        return {
            "mode": "free-running",
            "clock": "every node ran by the wall clock; another run gives other times and bits",
            "bitrate": scenario.bus.bitrate,
            "load": self._bits / scenario.bus.bitrate / scenario.duration_s,
            **dict.fromkeys(COUNTS, 0),
            "frames": sum(map(len, self._arrivals.values())),
            "fault_hits": {},
            "messages": message_rows(scenario, row),
        }

    def _wait_for_all(self) -> None:
        missing = set(REMOTE)
        deadline = time.monotonic() + TIMEOUTS.start_s
        while missing:
            if time.monotonic() > deadline:
                what = f"sent nothing on {self._channel} within {TIMEOUTS.start_s:g} s"
                raise ParticipantLost(min(missing), what)
            self._look_after_nodes()
            message = self._bus.recv(_LOOK_S)
            if message is not None and (frame := frame_of(message)):
                missing.discard(_SENDERS.get(frame.can_id, ""))

    def _look_after_nodes(self) -> None:
        for child in self._children:
            if how := child.how_it_ended(0.0):
                raise ParticipantLost(child.name, how)
        for node in self._nodes:
            if node.done():
                node.result()

    def _start_node(self, name: str) -> None:
        scenario = self._loaded.scenario
        later = [replace(each, at_s=each.at_s + SETTLING_S) for each in scenario.request]
        loaded = dataclasses.replace(self._loaded, scenario=replace(scenario, request=later))
        participant = build.make_participant(name, loaded, self._folder)
        received = build.received().get(name, frozenset({0}))  # a sender only: none would mean all
        bus = open_bus(self._channel, receives=received, bitrate=scenario.bus.bitrate)
        self._closing.callback(bus.shutdown)
        node = FreeNode(participant, bus, catches_up=False, receives=received)
        self._nodes.append(self._threads.submit(node.run, self._stop))

    def _end_nodes(self) -> None:
        self._stop.set()
        self._threads.shutdown()
        for child in self._children:
            if child.how_it_ended(0.0) is None:
                os.kill(child.pid, signal.SIGTERM)
        for child in self._children:
            child.end(10.0)
        self._children.clear()

    def _deliveries(self, duration_ns: int) -> list[BusFrame]:
        """Return the frames that have arrived, of those within the duration of the run."""
        deliveries = []
        while (message := self._bus.recv(0.0)) is not None:
            arrival_ns = 1000 * round(epoch_s(message) * 1e6) - self._zero_ns
            frame = frame_of(message)
            if frame is not None and 0 <= arrival_ns < duration_ns:
                sender = _SENDERS.get(frame.can_id, GUEST)
                deliveries.append(BusFrame(arrival_ns, arrival_ns, sender, frame))
                self._bits += frame_bits(frame.can_id, frame.data) + INTERMISSION_BITS
                self._arrivals[frame.can_id].append(arrival_ns)
        return deliveries

    def _align_recordings(self) -> None:
        """Count the plant's times from the beginning of the run; what was before is left out."""
        zero, trace, events = (self._folder / name for name in (CLOCK_ZERO, PLANT_TRACE, EVENTS))
        if not zero.exists():
            return
        late_s = (int(zero.read_text()) - self._zero_ns) / NS_PER_S
        rows = open_trace(trace)
        last_s = self._loaded.scenario.duration_s - late_s
        rows = rows[bisect_left(rows["time_s"], -late_s) : bisect_right(rows["time_s"], last_s)]
        aligned = trace.with_suffix(".aligned")
        with TraceWriter(aligned, rows.dtype.names or ()) as file:
            for begin in range(0, len(rows), 1 << 16):
                block = np.array(rows[begin : begin + (1 << 16)])
                block["time_s"] += late_s
                file.append(block.tobytes())
        aligned.replace(trace)
        recorded = [event_of(line, str(events)) for line in events.read_bytes().splitlines()]
        with EventLog(events) as log:
            for event in recorded:
                if event.time_s + late_s >= 0.0:
                    log(event.time_s + late_s, event.name, event.values)
        zero.unlink()


def jitter(arrivals: Sequence[int], period_ns: int) -> dict[str, float | int | None]:
    """Return how far a message's frames are from whole periods, in s; None with fewer than two frames."""
    if len(arrivals) < 2:
        return dict.fromkeys(("missing", "jitter_p50_s", "jitter_p99_s", "jitter_max_s"))
    steps = np.diff(arrivals)
    missing = max(round(steps.sum() / period_ns) - len(steps), 0)
    periods = np.maximum(np.rint(steps / period_ns), 1) if missing else 1
    off_s = np.abs(steps - periods * period_ns) / NS_PER_S
    p50_s, p99_s, max_s = np.percentile(off_s, [50, 99, 100]).tolist()
    return {
        "missing": missing,
        "jitter_p50_s": p50_s,
        "jitter_p99_s": p99_s,
        "jitter_max_s": max_s,
    }


def jitter_lines(figures: dict[str, Any]) -> list[str]:
    """Return the figures of each message as text."""
    lines = ["real time, each node by its own clock; distance of frames from their period:"]
    for m in figures["messages"]:
        if m["jitter_max_s"] is None:
            lines.append(f"  {m['name']}: {counted(m['frames'], 'frame')}")
            continue
        off = [f"{q} {1e3 * m[f'jitter_{q}_s']:.2f} ms" for q in ("p50", "p99", "max")]
        lost = [f"{m['missing']} missing"] if m["missing"] else []
        figures_of = ", ".join([counted(m["frames"], "frame"), *lost, *off])
        lines.append(f"  {m['name']} every {1e3 * m['period_s']:g} ms: {figures_of}")
    return lines
