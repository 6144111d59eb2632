"""Runs recorded and read again: rows, tables, interpolation."""

from __future__ import annotations

import csv
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
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame
from sil.recording import run_record
from sil.recording.interpolation import hermite, monotone_slopes
from sil.recording.recorder import BusLog, EventLog, FrameWriter, TraceWriter, trace_sha256
from sil.recording.run_reader import event_of, open_trace, stored_rows
from sil.recording.run_record import STORED_FRAME, PlantEvent, StoredFrames
from sil.recording.runs import longest_run, true_runs
from sil.recording.trace_csv import TraceCsv
from sil.simulation import load_scenario, metrics, runner
from tests.support import made_run

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
    assert once == hashlib.sha256(bytes.fromhex("02010000000000000325ff0c020102")).digest()


def rows(count: int, start: int = 0) -> np.ndarray:
    return np.arange(3 * start, 3 * (start + count), dtype=np.float64).reshape(count, 3) / 7.0


def stored(path: Path) -> bytes:
    return open_trace(path).tobytes()


def test_a_trace_comes_back_bit_by_bit(tmp_path: Path) -> None:
    path = tmp_path / "plant.trace"
    with TraceWriter(path, COLUMNS) as writer:
        writer.write(rows(0))
        writer.write(rows(4))
        assert stored(path) == rows(4).tobytes(), "readable while it is written"
        writer.write(np.asfortranarray(rows(3, 4)))
    trace = open_trace(path)
    assert trace.dtype.names == COLUMNS and len(trace) == 7
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
    steps = open_trace(trace_path)[COLUMNS[0]]
    assert frames == [1 + i // 5 for i in range(len(frames))]
    assert steps.tolist() == [1.0 + i // 5 for i in range(len(steps))]
    assert 0 <= len(frames) - len(steps) <= 5, "a step is complete before the next one starts"


def test_a_full_disk_is_named_with_the_file() -> None:
    assert Path("/dev/full").is_char_device()
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        TraceWriter(Path("/dev/full"), COLUMNS)


SENDERS = ("driver", "controller")
IDS = (0x0CFF2503, 0x18FF2690)


def written(path: Path) -> list[BusFrame]:
    frames = [
        BusFrame(10 * k, 10 * k + 7, SENDERS[k % 2], Frame(IDS[k % 5 == 4], bytes(range(k % 9))))
        for k in range(20)
    ]
    with FrameWriter(path, SENDERS) as writer:
        for f in frames:
            writer.record([f])
    return frames


def test_frames_come_back_and_a_torn_last_one_is_left_out(tmp_path: Path) -> None:
    frames = written(tmp_path / "bus.frames")
    (tmp_path / "bus.frames").write_bytes((tmp_path / "bus.frames").read_bytes()[:-1])
    stored = StoredFrames(stored_rows(tmp_path / "bus.frames", STORED_FRAME), SENDERS)
    assert list(stored) == frames[:19]
    assert frames[3] in stored and frames[19] not in stored and len(stored) == 19
    by_id = {can_id: list(found) for can_id, found in stored.by_id().items()}
    others = [f for f in frames[:19] if f.frame.can_id == IDS[0]]
    assert by_id == {IDS[0]: others, IDS[1]: frames[4:19:5]}


def test_rows_come_back_by_number(tmp_path: Path) -> None:
    rows = np.arange(30.0).reshape(10, 3)
    with TraceWriter(tmp_path / "trace", ("time_s", "a", "b")) as writer:
        writer.write(rows)
    with open(tmp_path / "trace", "ab") as file:
        file.write(b"torn")
    assert open_trace(tmp_path / "trace").tobytes() == rows.tobytes()


@pytest.mark.parametrize(
    "name", ["full_shift", pytest.param("lost_frames", marks=pytest.mark.slow)]
)
def test_in_many_pieces_or_one_the_result_is_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for piece_s in (run_record.PIECE_S, 0.07):
        monkeypatch.setattr(run_record, "PIECE_S", piece_s)
        (folder := tmp_path / str(piece_s)).mkdir()
        finished = runner.run(load_scenario.load(name), folder)
        assert finished.result.complete and finished.record is not None
        rows = len(finished.record.truth["time_s"])
        found.append((finished, rows, (folder / "trace.csv").read_bytes()))
        assert not list(folder.glob("*.part")) and not (folder / "bus.frames").exists()
    (whole, rows, csv), (pieces, few, csv_of_pieces) = found
    assert pieces.shifts == whole.shifts and csv_of_pieces == csv and few < rows / 5
    for field in ("expectations", "metrics", "trace_sha256", "bus", "balances", "passed"):
        assert getattr(pieces.result, field) == getattr(whole.result, field)


def test_a_shift_is_followed_for_two_minutes_at_most() -> None:
    changes = [(1.0, "a", "b"), (2.0, "b", "c"), (500.0, "c", "d")]
    spans = metrics.spans(changes, 501.0)  # type: ignore[arg-type]
    assert [(start, until) for start, _, _, until in spans] == [
        *((1.0, 2.0), (2.0, 122.0), (500.0, 501.0))
    ]
    assert metrics.spans([], 3.0) == []


def test_events_read_back(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    log = EventLog(path)
    log(0.5, "stay_stop", {"speed_m_s": 0.1 + 0.2})
    log(0.6, "valve_B_open", {})
    log.close()
    wanted = [
        PlantEvent(0.5, "stay_stop", {"speed_m_s": 0.1 + 0.2}),
        PlantEvent(0.6, "valve_B_open"),
    ]
    assert [event_of(line, "line") for line in path.read_bytes().splitlines()] == wanted
    with pytest.raises(InputError, match="line 1: not an event"):
        event_of(b'{"time_s": 0.7}', "line 1")


def test_trace_csv_begins_like_a_measured_stroke_and_keeps_every_bit(tmp_path: Path) -> None:
    record = made_run.made()
    truth = record.truth
    with (tmp_path / "trace.csv").open("wb") as file:
        TraceCsv(file).add(record)
    rows = list(csv.DictReader((tmp_path / "trace.csv").read_text().splitlines()))
    pressures, commands = [f"pressure_{c}_pa" for c in "BNF"], [f"cmd_{c}" for c in "BNF"]
    names = ["time_s", "position_m", *pressures, *commands, "position_internal_m"]
    assert list(rows[0])[:9] == names
    assert [float(r["position_m"]) for r in rows] == truth["position_m"].tolist()
    assert rows[0]["position_internal_m"] == ""  # before the first status frame
    assert float(rows[-1]["position_internal_m"]) == pytest.approx(made_run.STROKE, abs=1e-7)


STEPS = st.floats(0.1, 10.0)
VALUES = st.floats(-100.0, 100.0)
SAMPLES = st.integers(3, 12).flatmap(
    lambda n: st.tuples(
        st.lists(STEPS, min_size=n, max_size=n),
        st.lists(VALUES, min_size=n, max_size=n),
        st.lists(VALUES, min_size=n, max_size=n),
    )
)


@given(SAMPLES)
def test_hermite_is_scipys(samples: tuple[list[float], list[float], list[float]]) -> None:
    times, values, slopes = (np.array(s) for s in samples)
    times = np.cumsum(times)
    at = np.linspace(times[0], times[-1], 57)
    wanted = CubicHermiteSpline(times, values, slopes)(at)
    assert np.allclose(hermite(times, values, slopes, at), wanted, rtol=1e-9, atol=1e-9)


@given(SAMPLES)
def test_monotone_slopes_are_scipys(samples: tuple[list[float], list[float], list[float]]) -> None:
    times, values, _ = (np.array(s) for s in samples)
    times, values = np.cumsum(times), np.round(values, 3)  # differences that do not underflow
    wanted = PchipInterpolator(times, values).derivative()(times)
    assert np.allclose(monotone_slopes(times, values), wanted, rtol=1e-9, atol=1e-9)


def test_runs_begin_and_end_also_at_the_ends_of_the_samples() -> None:
    assert true_runs(np.array([True, False, True, True])).tolist() == [[0, 1], [2, 4]]
    assert true_runs(np.zeros(3, dtype=bool)).tolist() == []


def test_longest_run() -> None:
    assert longest_run(np.array([False, True, True, False, True])) == 2
    assert longest_run(np.array([True, True, True])) == 3
    assert longest_run(np.zeros(4, dtype=bool)) == 0
