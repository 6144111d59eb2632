"""Frames a second read and replayed, beside python-can's reader and virtual bus; memory: a process's peak (VmHWM)."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import cycle, islice
from pathlib import Path

SHORT_S, LONG_S = 30, 120
REPEATS = 3
GEARS = ("backward", "neutral", "forward", "neutral")
FORMATS = ("log", "asc", "blf")

MEMORY = r"""
import re, sys
from sil.log_replay.replay import ReplayRequest, replay
from sil.logs import open_log
if sys.argv[1] == "read":
    frames = sum(1 for _ in open_log(sys.argv[2]))
else:
    frames = replay(ReplayRequest(sys.argv[2])).frames
peak = re.search(r"VmHWM:\s+(\d+) kB", open("/proc/self/status").read())
print(frames, peak[1])
"""


def measure() -> Iterator[str]:
    """Lines of the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        short, long = made_log(folder / "short.log", SHORT_S), made_log(folder / "long.log", LONG_S)
        frames = long.read_bytes().count(b"\n")
        yield f"{LONG_S} s of shifts, {frames} frames, {long.stat().st_size >> 10} KiB; medians of {REPEATS}"
        ours = theirs = 0.0
        for suffix in reversed(FORMATS):
            log = converted(long, suffix)
            ours = frames / median(lambda: read(log))  # noqa: B023 - called at once
            theirs = frames / median(lambda: read_by_python_can(log))  # noqa: B023
            yield f"read {suffix:4} {ours:9.0f} frames/s  {ours / theirs:5.2f} x python-can's {theirs:.0f}"
        passed = frames / median(lambda: pass_through(long))
        replayed = frames / median(lambda: replay_whole(long))
        yield f"pass-through {passed:9.0f} frames/s  {passed / theirs:5.2f} x python-can's reader alone"
        yield (
            f"replay       {replayed:9.0f} frames/s  {replayed / theirs:5.2f} x python-can's reader "
            f"alone  {replayed / passed:5.2f} x pass-through  {LONG_S * replayed / frames:.0f} x real time"
        )
        for what in ("read", "replay"):
            (few, low), (many, high) = (peak_memory(what, log) for log in (short, long))
            yield (
                f"memory, {what:6} {low >> 10} MiB for {few} frames, {high >> 10} MiB for {many}: "
                f"{high / low:.2f} x"
            )


def made_log(path: Path, duration_s: int) -> Path:
    """Write the log of a run that shifts twice a second."""
    from sil.recording.recorder import BusLog
    from sil.simulation.in_memory import run_in_memory
    from sil.simulation.load_scenario import from_table

    gears = islice(cycle(GEARS), 2 * duration_s - 1)
    requests = [{"at_s": 0.1 + 0.5 * k, "gear": gear} for k, gear in enumerate(gears)]
    table = {
        "name": "many shifts",
        "duration_s": float(duration_s),
        "request": requests,
        "trace_period_s": 0.01,
    }
    run = run_in_memory(from_table(table, "bench"))
    log = BusLog(path)
    with log:
        log.record(list(run.record.frames))
    return path


def converted(log: Path, suffix: str) -> Path:
    """The log in another format."""
    from sil.logs import convert

    target = log.with_suffix(f".{suffix}")
    if target != log:
        convert(log, target)
    return target


def median(once: Callable[[], None]) -> float:
    """Median wall seconds of REPEATS measurements, after one that warms up."""
    walls = []
    for _ in range(REPEATS + 1):
        begin = time.perf_counter()
        once()
        walls.append(time.perf_counter() - begin)
    return statistics.median(walls[1:])


def read(log: Path) -> None:
    """Read by our own reader."""
    from sil.logs import open_log

    for _ in open_log(log):
        pass


def read_by_python_can(log: Path) -> None:
    """Read by python-can's."""
    import can

    with can.LogReader(log) as reader:
        for _ in reader:
            pass


def pass_through(log: Path) -> None:
    """Read by python-can and hand every frame to a receiver over its virtual bus."""
    import can

    with (
        can.Bus("bench", interface="virtual", receive_own_messages=False) as sender,
        can.Bus("bench", interface="virtual") as receiver,
        can.LogReader(log) as reader,
    ):
        for message in reader:
            message.channel = None
            sender.send(message)
            receiver.recv(0)


def replay_whole(log: Path) -> None:
    """Replay a log, without report."""
    from sil.log_replay.replay import ReplayRequest, replay

    assert not replay(ReplayRequest(str(log))).differs


def peak_memory(what: str, log: Path) -> tuple[int, int]:
    """Frames and peak memory in KiB of a process that reads or replays a log."""
    root = Path(__file__).resolve().parent.parent.parent
    command = [sys.executable, "-c", MEMORY, what, str(log)]
    reported = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(root)},
    )
    frames, peak = reported.stdout.split()
    return int(frames), int(peak)
