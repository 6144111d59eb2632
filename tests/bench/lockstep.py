"""Lockstep turns a second by transport; floors: the plant alone, a ping-pong over a Unix socket, the same in CAN frames."""

from __future__ import annotations

import os
import socket
import statistics
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

SCENARIO = "full_shift"
REPEATS = 3
GRANT_S = 0.01
FRAME_BYTES = 13
CAN_FRAME = struct.Struct("=IB3x8s")


def measure() -> Iterator[str]:
    """Lines of the table; CAN interfaces that exist are measured too."""
    from sil.simulation.load_scenario import load
    from sil.simulation.runner import run

    loaded = load(SCENARIO)
    simulated = loaded.scenario.duration_s
    plant = median(lambda: plant_alone(simulated))
    yield f"{SCENARIO}: {simulated:g} simulated s, medians of {REPEATS}"
    yield f"plant alone: {simulated / plant:.0f} simulated s per wall s"
    interfaces = [name for _i, name in socket.if_nameindex() if name.startswith("vcan")]
    if not interfaces:
        yield "no vcan interface here: run it through a command that gives one to measure it"
    for transport in ("inproc", "local", *interfaces):
        walls, turns, frames = [], 0, 0
        for _ in range(REPEATS):
            with tempfile.TemporaryDirectory() as folder:
                result = run(loaded, Path(folder), transport=transport).result
            walls.append(result.speed["loop_wall_s"])
            turns = int(result.speed["turns"])
            frames = int(result.metrics["frames"])
        wall = statistics.median(walls)
        if transport == "inproc":
            floor, what = plant, "the plant alone"
        elif transport == "local":
            size = FRAME_BYTES * max(1, round(2 * frames / turns))
            floor = median(lambda: ping_pong(turns, size))  # noqa: B023 - called at once
            what = f"a ping-pong of {size} bytes"
        else:
            each = max(1, round(2 * frames / turns))
            floor = median(lambda: can_ping_pong(transport, turns, each))  # noqa: B023
            what = f"a ping-pong of {each} frames"
        yield (
            f"{transport:8} {turns / wall:8.0f} turns/s  {simulated / wall:7.1f} simulated s per wall s"
            f"  {wall / floor:6.1f} x {what}"
        )


def median(once: Callable[[], float]) -> float:
    """Median of REPEATS measurements, after one that warms up."""
    once()
    return statistics.median(once() for _ in range(REPEATS))


def plant_alone(simulated_s: float) -> float:
    """Wall seconds of the plant's equations over the same grants, valves switching as in a shift."""
    import numpy as np

    from plant.kernel.packing import Load
    from plant.parameters import load
    from plant.systems.length_stroke import LengthStroke

    stroke = LengthStroke(load(), initial="B", load=Load(mounted=True))
    switches = {10: [(0, 1, 1.0)], 40: [(0, 1, 0.0), (0, 2, 1.0)], 70: [(0, 2, 0.0)]}
    grant = round(GRANT_S * 1e9)
    begin = time.perf_counter()
    for k in range(round(simulated_s / GRANT_S)):
        now = k * grant
        samples = np.arange(now + grant // 20, now + grant + 1, grant // 20, dtype=np.int64)
        moves = [(now + 1, chamber, u) for _t, chamber, u in switches.get(k, [])]
        stroke.advance(now + grant, moves, samples)
    return time.perf_counter() - begin


def ping_pong(turns: int, size: int) -> float:
    """Wall seconds of `turns` round trips of `size` bytes between two sleeping processes."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    child = os.fork()
    if child == 0:
        ours.close()
        for _ in range(turns):
            theirs.send(theirs.recv(65536))
        os._exit(0)
    theirs.close()
    message = bytes(size)
    begin = time.perf_counter()
    for _ in range(turns):
        ours.send(message)
        ours.recv(65536)
    wall = time.perf_counter() - begin
    os.waitpid(child, 0)
    ours.close()
    return wall


def can_ping_pong(interface: str, turns: int, frames: int) -> float:
    """Wall seconds of `turns` round trips of `frames` CAN frames each way."""

    def opened(wanted: int) -> socket.socket:
        found = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        found.setsockopt(
            socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", wanted, 0x7FF)
        )
        found.bind((interface,))
        return found

    ours, theirs = opened(0x101), opened(0x100)
    child = os.fork()
    if child == 0:
        answer = CAN_FRAME.pack(0x101, 8, bytes(8))
        for _ in range(turns):
            for _ in range(frames):
                theirs.recv(16)
            for _ in range(frames):
                theirs.send(answer)
        os._exit(0)
    request = CAN_FRAME.pack(0x100, 8, bytes(8))
    begin = time.perf_counter()
    for _ in range(turns):
        for _ in range(frames):
            ours.send(request)
        for _ in range(frames):
            ours.recv(16)
    wall = time.perf_counter() - begin
    os.waitpid(child, 0)
    ours.close()
    theirs.close()
    return wall
