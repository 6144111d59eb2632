"""Bus log and trace on disk: exact, readable by others, readable after a kill."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame
from sil.recording.recorder import BusLog, TraceWriter, trace_sha256
from sil.recording.run_reader import open_trace

COLUMNS = ("time_s", "position_m", "pressure_B_pa")


def delivery(arrival_ns: int, can_id: int, payload: bytes) -> BusFrame:
    return BusFrame(0, arrival_ns, "plant", Frame(can_id, payload))


def test_lines_are_those_of_candump(tmp_path: Path) -> None:
    with BusLog(tmp_path / "bus.log") as log:
        log.record([delivery(0, 0x0CFF2503, b"")])
        log.record([delivery(1_234_567_000, 3, bytes(range(8))), delivery(10**14, 7, b"\xab")])
        assert log.frames == 3
        log.record([delivery(10**14 + 1, 7, b"\xab")])
    assert (tmp_path / "bus.log").read_text() == (
        "(0000000000.000000) opc4 0CFF2503#\n"
        "(0000000001.234567) opc4 00000003#0001020304050607\n"
        "(0000100000.000000) opc4 00000007#AB\n"
        "(0000100000.000000001) opc4 00000007#AB\n"
    )


arrivals = st.lists(
    st.tuples(st.integers(0, 10**14), st.integers(0, (1 << 29) - 1), st.binary(max_size=8)),
    max_size=20,
).map(sorted)


@given(entries=arrivals)
def test_python_can_reads_the_log(
    entries: list[tuple[int, int, bytes]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("log") / "bus.log"
    with BusLog(path) as log:
        log.record([delivery(*entry) for entry in entries])
    with can.LogReader(path) as reader:
        read = list(reader)
    assert [(m.arbitration_id, bytes(m.data)) for m in read] == [(i, d) for _, i, d in entries]
    assert all(m.is_extended_id and m.channel == "opc4" for m in read)
    assert [round(m.timestamp * 1e6) for m in read] == [round(t / 1e3) for t, _, _ in entries]


def test_the_digest_is_that_of_instant_identifier_length_and_data(tmp_path: Path) -> None:
    with BusLog(tmp_path / "bus.log") as log:
        log.record([delivery(258, 0x0CFF2503, b"\x01\x02")])
        once = log.digest()
        log.record([delivery(258, 0x0CFF2503, b"\x01\x02")])
        assert log.digest() != once
    written = bytes.fromhex("02010000000000000325ff0c020102")
    assert once == hashlib.sha256(written).digest()


def rows(count: int, start: int = 0) -> np.ndarray:
    return np.arange(3 * start, 3 * (start + count), dtype=np.float64).reshape(count, 3) / 7.0


def stored(path: Path) -> bytes:
    trace = open_trace(path)
    return trace.read(0, trace.rows).tobytes()


def test_a_trace_comes_back_bit_by_bit(tmp_path: Path) -> None:
    path = tmp_path / "plant.trace"
    with TraceWriter(path, COLUMNS) as writer:
        writer.write(rows(0))
        writer.write(rows(4))
        assert stored(path) == rows(4).tobytes(), "readable while it is written"
        writer.write(np.asfortranarray(rows(3, 4)))
    trace = open_trace(path)
    assert trace.kind.names == COLUMNS and trace.rows == 7
    assert stored(path) == rows(7).tobytes()
    special = np.array([[np.nan, -0.0, np.inf]])
    with TraceWriter(path, COLUMNS) as writer:
        writer.write(special)
    assert stored(path) == special.tobytes()


def test_a_torn_last_row_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "plant.trace"
    with TraceWriter(path, COLUMNS) as writer:
        writer.write(rows(5))
    whole = path.read_bytes()
    for torn in range(1, 24):
        path.write_bytes(whole[:-torn])
        assert stored(path) == rows(4).tobytes()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"time_s,position_m\n0,0\n",
        b'{"format": "opc4-trace-1", "columns": []}\n',
        b'{"format": "opc4-trace-1", "columns": [1]}\n',
        b'{"format": "opc4-trace-2", "columns": ["a"]}\n',
        b'{"format": "opc4-trace-1"}\n',
        b"[1]\n",
        b'{"format": "opc4-trace-1", "columns": ["a", "a"]}\n',
        b'{"format": "opc4-trace-1", "columns": ["a"]}',
        b"\xff" * 100_000,
        b"[" * 60_000 + b"\n",
    ],
    ids=range(12),
)
def test_a_file_that_is_no_trace_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "plant.trace"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"plant.trace: line 1: .*expected "):
        open_trace(path)


def test_the_run_hash_covers_frames_and_trace(tmp_path: Path) -> None:
    first, second = tmp_path / "a.trace", tmp_path / "b.trace"
    for path, count in ((first, 2), (second, 3)):
        with TraceWriter(path, COLUMNS) as writer:
            writer.write(rows(count))
    assert trace_sha256(b"x" * 32, first) == trace_sha256(b"x" * 32, first)
    assert len({trace_sha256(d, p) for d in (b"x", b"y") for p in (first, second)}) == 4


WRITE_FOR_EVER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import numpy as np
from sil.recording.recorder import BusLog, TraceWriter
from tests.unit.sil.recording.test_recorder import COLUMNS, delivery
folder = Path(sys.argv[1])
log = BusLog(folder / "bus.log")
trace = TraceWriter(folder / "plant.trace", COLUMNS)
step = 0
while True:
    step += 1
    log.record([delivery(1000 * step, step, step.to_bytes(8, "big"))] * 5)
    trace.write(np.full((5, 3), float(step)))
"""


def test_everything_is_on_disk_when_the_writer_is_killed(tmp_path: Path) -> None:
    root = str(Path(__file__).resolve().parents[4])
    writer = subprocess.Popen([sys.executable, "-c", WRITE_FOR_EVER, str(tmp_path), root])
    trace_path = tmp_path / "plant.trace"
    deadline = time.monotonic() + 60.0
    while not trace_path.exists() or trace_path.stat().st_size < 20_000:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(writer.pid, signal.SIGKILL)
    writer.wait()
    with can.LogReader(tmp_path / "bus.log") as reader:
        frames = [int.from_bytes(message.data, "big") for message in reader]
    trace = open_trace(trace_path)
    steps = trace.read(0, trace.rows)[COLUMNS[0]]
    assert frames == [1 + i // 5 for i in range(len(frames))]
    assert steps.tolist() == [1.0 + i // 5 for i in range(len(steps))]
    assert 0 <= len(frames) - len(steps) <= 5, "a step is complete before the next one starts"


def test_a_full_disk_is_named_with_the_file() -> None:
    assert Path("/dev/full").is_char_device()
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        TraceWriter(Path("/dev/full"), COLUMNS)
