"""One run of the toy nodes over any transport; the driver always lives with the coordinator."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sil.coupling.bus import BusModel
from sil.coupling.faults import BusFault, FaultPlan
from sil.coupling.lockstep import Lockstep
from sil.coupling.processes import ChildProcess
from sil.coupling.real_time import Pacer
from sil.coupling.transports.channel import Channel, InProcess, Timeouts
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.remote import RemoteChannel
from sil.coupling.transports.socketcan import SocketCan
from sil.recording.recorder import BUS_LOG, PLANT_TRACE, BusLog, TraceWriter, trace_sha256
from tests.contracts.toy_nodes import COLUMNS, ToyNode

ROOT = Path(__file__).resolve().parents[2]
REMOTE = ("controller", "plant")
TIMEOUTS = Timeouts(start_s=20.0, answer_s=2.0, close_s=5.0)


@dataclass
class ToyRun:
    """A coordinator with its toy nodes, ready to run; `log` and `trace` are in `folder`."""

    lockstep: Lockstep
    bus: BusModel
    plan: FaultPlan
    log: BusLog
    folder: Path
    remote: RemoteChannel | None
    children: dict[str, ChildProcess]
    nodes: dict[str, ToyNode] = field(default_factory=dict)

    def sha256(self) -> str:
        return trace_sha256(self.log.digest(), self.folder / PLANT_TRACE)


def channel_name(transport: str) -> str:
    """Return the channel that a node is given: the toy runs' local channel is named after this process."""
    return f"local:toy-{os.getpid()}" if transport == "local" else transport


def command(name: str, channel: str, *options: str) -> list[str]:
    """Return what starts a toy node in a process of its own."""
    node = [sys.executable, "-m", "tests.contracts.toy_nodes", name, channel, *options]
    return ["env", f"PYTHONPATH={ROOT}", *node]


@contextlib.contextmanager
def toy_run(
    transport: str,
    folder: Path,
    end_ns: int,
    *,
    options: Mapping[str, Sequence[str]] | None = None,
    external: Sequence[str] = (),
    faults: Sequence[BusFault] = (),
    pacer: Pacer | None = None,
    timeouts: Timeouts = TIMEOUTS,
    scenario: int = 0,
    say: Callable[[str], None] = lambda message: None,
) -> Iterator[ToyRun]:
    """Open a run; `options` go to the node processes, `external` ones the test starts itself."""
    folder.mkdir()
    trace = folder / PLANT_TRACE
    given = dict(options or {})
    children: dict[str, ChildProcess] = {}
    remote: RemoteChannel | None = None
    nodes: list[ToyNode]
    if transport == "inproc":
        burst = _burst(given.get("controller", ()))
        writer = TraceWriter(trace, COLUMNS)
        nodes = [ToyNode("driver"), ToyNode("controller", burst=burst), ToyNode("plant", writer)]
        channels: list[Channel] = [InProcess(nodes)]
    else:
        nodes = [ToyNode("driver")]
        channel = channel_name(transport)
        given["plant"] = [*given.get("plant", ()), "--trace", str(trace)]
        kind = Hub if transport == "local" else SocketCan
        name = channel.removeprefix("local:")
        remote = kind(name, REMOTE, scenario=scenario, timeouts=timeouts, say=say)
        channels = [remote, InProcess(nodes)]
        for name in REMOTE:
            if name not in external:
                children[name] = remote.spawn(name, command(name, channel, *given.get(name, ())))
    log = BusLog(folder / BUS_LOG)
    plan = FaultPlan(faults, seed=1)
    bus = BusModel(500_000, frame_filter=plan.frame_filter, is_off=plan.is_off)
    lockstep = Lockstep(
        bus, channels, end_ns, record=log.record, outages=plan if faults else None, pacer=pacer
    )
    try:
        with lockstep:
            yield ToyRun(
                lockstep,
                bus,
                plan,
                log,
                folder,
                remote,
                children,
                {node.name: node for node in nodes},
            )
    finally:
        log.close()


def _burst(options: Sequence[str]) -> int:
    return int(options[options.index("--burst") + 1]) if "--burst" in options else 1
