"""Runs judged piece by piece: the same figures and the same trace as in one piece."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame
from sil.recording import run_reader
from sil.recording.recorder import EventLog, FrameWriter, TraceWriter
from sil.recording.run_reader import RowReader, event_of, open_trace
from sil.recording.run_record import STORED_FRAME, PlantEvent, StoredFrames
from sil.simulation import load_scenario, metrics, runner

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
    content = (tmp_path / "bus.frames").read_bytes()
    (tmp_path / "bus.frames").write_bytes(content[:-1])
    reader = RowReader(tmp_path / "bus.frames", STORED_FRAME, "arrival")
    assert reader.rows == 19
    stored = StoredFrames(reader.read(0, 19), SENDERS)
    assert list(stored) == frames[:19]
    assert frames[3] in stored and frames[19] not in stored and len(stored) == 19
    by_id = {can_id: list(found) for can_id, found in stored.by_id().items()}
    others = [f for f in frames[:19] if f.frame.can_id == IDS[0]]
    assert by_id == {IDS[0]: others, IDS[1]: frames[4:19:5]}
    assert [reader.first_from(at) for at in (0, 7, 8, 17, 187, 188)] == [0, 0, 1, 1, 18, 19]


def test_rows_come_back_by_number(tmp_path: Path) -> None:
    rows = np.arange(30.0).reshape(10, 3)
    with TraceWriter(tmp_path / "trace", ("time_s", "a", "b")) as writer:
        writer.write(rows)
    with open(tmp_path / "trace", "ab") as file:
        file.write(b"torn")
    reader = open_trace(tmp_path / "trace")
    assert reader.rows == 10 and reader.read(2, 5).tobytes() == rows[2:5].tobytes()
    assert [reader.first_from(value) for value in (-1.0, 0.0, 0.5, 3.0, 27.0, 28.0)] == [
        *(0, 0, 1, 1, 9, 10)
    ]


@pytest.mark.parametrize(
    "name", ["full_shift", pytest.param("lost_frames", marks=pytest.mark.slow)]
)
def test_in_many_pieces_or_one_the_result_is_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for piece_s in (run_reader.PIECE_S, 0.07):
        monkeypatch.setattr(run_reader, "PIECE_S", piece_s)
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
    lines = path.read_bytes().splitlines()
    assert [event_of(line, "line") for line in lines] == wanted
    with pytest.raises(InputError, match="line 1: not an event"):
        event_of(b'{"time_s": 0.7}', "line 1")
