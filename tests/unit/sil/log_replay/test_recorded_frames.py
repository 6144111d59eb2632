"""Frames sorted and counted; identifiers of other databases."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import PositionPulse, ShiftRequest, ValveCommand
from sil.log_replay.recorded_frames import ID_OF, RecordedFrames, bare, ids_of_database, is_intact
from sil.logs import LogFrame
from tests.support.golden_logs import arrivals

REQUEST = ID_OF[ShiftRequest]
DBC = Path(DBC_PATH).read_text(encoding="ascii")


def request(time_ns: int, **changes: object) -> LogFrame:
    return LogFrame(time_ns, REQUEST, bytes(8))._replace(**changes)


def test_every_frame_is_passed_on_or_counted() -> None:
    log = [
        request(1),
        LogFrame(2, 0x123, b"\x01", extended=False),
        LogFrame(3, 0x1, b"", error=True),
        LogFrame(4, REQUEST, b"", remote=True),
        LogFrame(5, REQUEST, bytes(12), fd=True),
        LogFrame(6, 0x18FEF100, bytes(8)),
        request(7, channel="can1"),
    ]
    traffic = RecordedFrames(log, channel="")
    assert [(a.time_ns, a.kind) for a in traffic] == [(1, ShiftRequest), (6, None)]
    assert traffic.total == 7
    assert dict(traffic.counts) == {
        "frames with an 11-bit identifier": 1,
        "error frames": 1,
        "remote frames": 1,
        "CAN FD frames": 1,
        "on another channel": 1,
    }
    assert dict(traffic.foreign) == {0x18FEF100: 1}


def test_slightly_reordered_frames_are_taken_and_a_jump_back_is_refused() -> None:
    traffic = RecordedFrames([request(100_000_000), request(60_000_000), request(101_000_000)])
    assert [a.time_ns for a in traffic] == [100_000_000, 100_000_000, 101_000_000]
    assert traffic.reordered == 1
    with pytest.raises(
        InputError, match=r"log: frame 2: the clock steps back by 1\.000 s; expected"
    ):
        list(RecordedFrames([request(2_000_000_000), request(1_000_000_000)]))


def test_a_damaged_frame_is_not_intact() -> None:
    pulse = next(a.frame for a in arrivals("lab_n_b") if a.kind is PositionPulse)
    assert is_intact(PositionPulse, pulse)
    broken = Frame(pulse.can_id, pulse.data[:4] + bytes((pulse.data[4] ^ 1,)) + pulse.data[5:])
    assert not is_intact(PositionPulse, broken)
    assert not is_intact(PositionPulse, Frame(pulse.can_id, pulse.data[:7]))
    assert bare(PositionPulse, pulse.data)[2:] == pulse.data[2:]
    assert bare(PositionPulse, pulse.data)[:2] == bytes((0, pulse.data[1] & 0xF0))


def test_identifiers_of_another_database(tmp_path: Path) -> None:
    other = tmp_path / "other.dbc"
    moved = (ID_OF[ValveCommand] ^ 0x10) | 1 << 31
    other.write_text(DBC.replace(str(ID_OF[ValveCommand] | 1 << 31), str(moved)), encoding="ascii")
    ids, names = ids_of_database(str(other))
    assert ids[moved & ~(1 << 31)] is ValveCommand
    assert ID_OF[ValveCommand] not in ids
    assert names[REQUEST] == "ShiftRequest"


def test_a_database_with_another_layout_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.dbc"
    wrong = DBC.replace("SG_ DutyB : 16|", "SG_ DutyB : 17|", 1)
    assert wrong != DBC
    other.write_text(wrong, encoding="ascii")
    with pytest.raises(InputError, match=r"other\.dbc.*DutyB"):
        ids_of_database(str(other))
    other.write_text('VERSION ""\nBU_: A\nBO_ 2566834709 Other: 8 A\n', encoding="ascii")
    with pytest.raises(InputError, match="no message of the control unit"):
        ids_of_database(str(other))
