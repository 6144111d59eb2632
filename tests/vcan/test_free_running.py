"""Recordings of vcan0 by candump next to a run of either mode, and a foreign controller on it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.e2e import PROTECTED
from can_dbc.messages import ValveCommand
from sil.log_replay.recorded_frames import OWN_IDS, Arrival, RecordedFrames, counter_of
from sil.log_replay.replay import ReplayRequest, replay
from sil.log_replay.signals import Options
from sil.logs import open_log
from tests.vcan.test_vcan import PATIENCE_S, Frames, candump, frames_of

pytestmark = pytest.mark.vcan

ROOT = Path(__file__).resolve().parents[2]
FOREIGN = ROOT / "tests" / "foreign_controller" / "free_controller.py"
HELD_S = 0.02
"""How late a step may be for the run's own log to replay: one that is 48 ms late misses frames."""
EARLY_S = 0.005
"""How late a step may be for candump's log to replay: half a tick, so that its frames fall to the right one."""
MISSED_S = 0.03
"""Time between two valve commands in candump's log from which the control unit has missed ticks, while the
plant was being imported, say: which ones, the times of bursts do not tell."""
ROUND_NS = 150_000_000
"""Just below 16 cycles of 10 ms, after which a counter has the same value again."""
TICK_S = 0.01
"""How far apart recording and replay may be. No log says when the control unit's ticks were, only when its
first frame after a tick came. An input just before or after a tick may count for its neighbour, and what it
causes is then one tick apart."""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sil.cli", "run", *words, "--no-report", "--out", str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def largest_jitter_s(folder: Path) -> float:
    messages = json.loads((folder / "result.json").read_text())["bus"]["messages"]
    if any(m["missing"] or not m["jitter_max_s"] for m in messages):
        return math.inf
    return max(m["jitter_max_s"] for m in messages)


def longest_pause_s(log: Path) -> float:
    times = [a.time_ns for a in RecordedFrames(open_log(log)) if a.kind is ValveCommand]
    return max(b - a for a, b in pairwise(times)) / 1e9


def require_replay(log: Path, names: tuple[str, ...]) -> None:
    comparison = replay(ReplayRequest(str(log), options=Options(time_s=TICK_S))).comparison
    assert comparison.engaged and comparison.ticks > 150
    apart = {name: count for name, count in comparison.signals.items() if count.differing}
    assert not any(name.startswith(names) for name in apart), f"{log}: {apart}"


def test_a_capture_of_a_lockstep_run_replays_without_a_difference(tmp_path: Path) -> None:
    log, folder = tmp_path / "candump.log", tmp_path / "run"
    with candump(log, "vcan0"):
        done = run(folder, "full_shift", "--transport", "vcan0")
    assert done.returncode == 0, done.stderr
    delivered = frames_of(folder / "bus.log")
    reader = open_log(log)
    assert [(f.can_id, f.data) for f in reader] == delivered
    assert reader.report.lockstep["offers, repeated when delivered"] > 1000
    assert len(frames_of(log)) > 2 * len(delivered)
    found = replay(ReplayRequest(str(log)))
    assert not found.differs and found.comparison.ticks > 150


def test_a_recorded_shift_in_real_time_has_each_message_once_and_replays(tmp_path: Path) -> None:
    jitters, pauses = [], []
    for attempt in range(3):
        log, folder = tmp_path / f"{attempt}.log", tmp_path / f"run{attempt}"
        with candump(log, "vcan0"):
            done = run(folder, "full_shift", "--transport", "vcan0", "--realtime")
        assert done.returncode in (0, 1), done.stderr
        recorded = frames_of(log)
        assert {can_id for can_id, _ in recorded} <= OWN_IDS.keys()
        require_part(frames_of(folder / "bus.log"), recorded)
        for kind in PROTECTED:
            seen = [a for a in RecordedFrames(open_log(log)) if a.kind is kind]
            assert len(seen) > 20
            assert not any(repeats(a, b) for a, b in pairwise(seen)), f"{kind.__name__} twice"
        jitters.append(largest_jitter_s(folder))
        if jitters[-1] < HELD_S:
            require_replay(folder / "bus.log", ("ValveCommand.", "SafetyBlow."))
        pauses.append(longest_pause_s(log))
        if jitters[-1] < EARLY_S and pauses[-1] < MISSED_S:
            break
    else:
        # by candump's times, a step that was executed late read frames that came after it
        pytest.skip(
            f"this machine is too busy to replay candump's log: jitter {jitters} s, pauses {pauses} s"
        )
    # candump's log also holds the start of the control unit, when nobody has requested anything yet
    require_replay(log, ("ValveCommand.duty", "SafetyBlow."))


def repeats(first: Arrival, second: Arrival) -> bool:
    """Say whether a frame came again; a machine that stands still may skip a whole round of the counter."""
    soon = second.time_ns - first.time_ns < ROUND_NS
    return soon and counter_of(first.frame) == counter_of(second.frame)


def require_part(part: Frames, whole: Frames) -> None:
    """All frames of the run and no others between them; of two nodes that send at one instant, either may be first."""
    data, all_data = by_identifier(part), by_identifier(whole)
    assert len(data) > 4
    for can_id, sent in data.items():
        at = [k for k, first in enumerate(all_data[can_id]) if first == sent[0]]
        assert any(all_data[can_id][k : k + len(sent)] == sent for k in at), f"{can_id:08X}"


def by_identifier(frames: Frames) -> dict[int, list[bytes]]:
    found: dict[int, list[bytes]] = {}
    for can_id, data in frames:
        found.setdefault(can_id, []).append(data)
    return found


def test_a_controller_of_python_can_and_cantools_shifts_on_vcan0(tmp_path: Path) -> None:
    command = [sys.executable, str(FOREIGN), DBC_PATH, "socketcan", "vcan0", str(PATIENCE_S)]
    with subprocess.Popen(command, cwd=tmp_path) as foreign:  # it waits for nobody
        words = ("lab_n_b", "--transport", "vcan0", "--realtime", "--external", "controller")
        done = run(tmp_path / "run", *words)
        foreign.terminate()
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["complete"], done.stderr
    checks = {check["name"]: check for check in result["expectations"]}
    assert checks["final gear"]["passed"]
