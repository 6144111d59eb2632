"""A log selected by time, identifier, group and channel; several files as one log."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.errors import InputError
from sil.cli import main
from sil.files import progress
from sil.j1939.mapping import SHIPPED
from sil.logs import LogFrame, Selection, open_log, open_logs
from tests.support.golden_logs import write

SECOND_NS = 10**9
START_NS = 1_600_000_000 * SECOND_NS
FOUR = [
    LogFrame(START_NS, 0x18F00503, bytes(8), channel="can0"),
    LogFrame(START_NS + SECOND_NS, 0x123, b"", False, channel="can0"),
    LogFrame(START_NS + 2 * SECOND_NS, 0x123, b"", True, channel="can1"),
    LogFrame(START_NS + 3 * SECOND_NS, 0x0CF00203, bytes(8), channel="can1"),
    LogFrame(START_NS + 4 * SECOND_NS, 0x123, b"", False, error=True, channel="can1"),
]


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({}, [0, 1, 2, 3, 4]),
        ({"since": "1"}, [1, 2, 3, 4]),
        ({"since": "1.5", "until": "3"}, [2, 3]),
        ({"until": "2020-09-13T12:26:41"}, [0, 1]),
        ({"until": "2020-09-13T14:26:41+02:00"}, [0, 1]),
        ({"since": "1600000003"}, [3, 4]),
        ({"ids": ["123"]}, [1]),
        ({"ids": ["00000123"]}, [2]),
        ({"ids": ["123,0x18F00503"]}, [0, 1]),
        ({"pgns": ["61442", "0xF005"]}, [0, 3]),
        ({"pgns": ["61442"], "ids": ["123"]}, [1, 3]),
        ({"channels": ["can1"]}, [2, 3, 4]),
        ({"channels": ["can1"], "pgns": ["61442"]}, [3]),
    ],
)
def test_what_is_selected(options: dict[str, str], found: list[int]) -> None:
    selection = Selection.parse(**options)  # type: ignore[arg-type]
    blocks = selection.select(iter([FOUR[:2], FOUR[2:]]))
    assert [frame for block in blocks for frame in block] == [FOUR[n] for n in found]
    assert bool(selection) is bool(options)
    assert list(selection.select(iter(()))) == []


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"since": "soon"}, "--since: 'soon'; expected seconds"),
        ({"until": "2020-13-01"}, "--until: '2020-13-01'; expected"),
        ({"ids": ["zz"]}, "--id: 'zz'; expected hex"),
        ({"ids": ["FFF"]}, "--id: 'FFF'"),
        ({"pgns": ["ETC1"]}, "--pgn: 'ETC1'; expected a parameter group"),
        ({"pgns": ["0x40000"]}, "--pgn"),
    ],
)
def test_bad_filters_are_refused(options: dict[str, str], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Selection.parse(**options)  # type: ignore[arg-type]


def test_a_date_needs_a_log_with_dates() -> None:
    relative = [frame._replace(time_ns=frame.time_ns - START_NS) for frame in FOUR]
    with pytest.raises(InputError, match="a date, but the times of the log count from its start"):
        list(Selection.parse(since="2020-01-01").select(iter([relative])))


def test_an_end_before_the_beginning_is_refused() -> None:
    with pytest.raises(InputError, match="--until: 1; expected a time after --since, 2"):
        Selection.parse(since="2", until="1")


FIRST_NS = 1_600_000_000 * 10**9
MS = 1_000_000


def made(path: Path, times_ms: range, can_id: int = 0x100, channel: str = "can0") -> list[LogFrame]:
    frames = [
        LogFrame(FIRST_NS + t * MS, can_id, t.to_bytes(4, "big"), channel=channel) for t in times_ms
    ]
    write(path, frames)
    return frames


def test_files_are_put_in_order_of_time(tmp_path: Path) -> None:
    parts = [
        made(tmp_path / f"{name}.log", times)
        for name, times in (("c", range(6000, 9000)), ("a", range(3000)), ("b", range(3000, 5000)))
    ]
    log = open_logs([tmp_path / "c.log", tmp_path / "a.log", tmp_path / "b.log"], strict=True)
    assert list(log) == [*parts[1], *parts[2], *parts[0]]
    lines = log.report.files
    assert [Path(line.split(":")[0]).name for line in lines] == ["a.log", "b.log", "c.log"]
    assert "after a gap of 0.001000 s" in lines[1]
    assert "after a gap of 1.001000 s" in lines[2]
    assert (log.report.frames, log.report.clean) == (8000, True)
    assert list(log) == [*parts[1], *parts[2], *parts[0]]  # again


def test_overlapping_files_are_interleaved_and_the_same_frames_taken_once(tmp_path: Path) -> None:
    first = made(tmp_path / "a.log", range(0, 4000, 2))
    other = made(tmp_path / "b.log", range(1001, 6000, 2), 0x200, "can1")
    again = made(tmp_path / "c.log", range(3000, 7000, 2))
    log = open_logs([tmp_path / name for name in ("a.log", "b.log", "c.log")])
    assert list(log) == sorted({*first, *other, *again}, key=lambda frame: frame.time_ns)
    assert log.repeated == 500
    assert "overlaps by 2.997000 s" in log.report.files[1]
    assert log.report.files[3] == "500 frames are in several files and were taken once"


def test_dates_in_headers_order_relative_logs(tmp_path: Path) -> None:
    for name, date in (
        ("late", "Sat Sep 30 15:06:20.000 2017"),
        ("early", "Sat Sep 30 15:06:13.000 2017"),
    ):
        (tmp_path / f"{name}.asc").write_text(
            f"date {date}\nbase hex  timestamps absolute\n"
            "   0.500000 1  100             Rx   d 1 00\n"
        )
    log = open_logs([tmp_path / "late.asc", tmp_path / "early.asc"])
    assert [frame.time_ns for frame in log] == [1506783973500000000, 1506783980500000000]
    assert "names no time zone" in log.report.notes[0]
    (tmp_path / "none.asc").write_text("base hex  timestamps absolute\n 0.5 1 100 Rx d 1 00\n")
    with pytest.raises(InputError, match="its times count from its start"):
        list(open_logs([tmp_path / "late.asc", tmp_path / "none.asc"]))
    (tmp_path / "timeless.log").write_text("can0  123   [1]  00\n")
    with pytest.raises(InputError, match="has no times"):
        list(open_logs([tmp_path / "late.asc", tmp_path / "timeless.log"]))
    with pytest.raises(InputError, match="a file given twice"):
        open_logs([tmp_path / "late.asc", tmp_path / "late.asc"])


def test_what_is_broken_is_located_in_its_file(tmp_path: Path) -> None:
    made(tmp_path / "a.log", range(10))
    made(tmp_path / "b.log", range(20, 30))
    with (tmp_path / "b.log").open("a") as file:
        file.write("garbage\n")
    (tmp_path / "empty.log").write_text("")
    log = open_logs([tmp_path / "b.log", tmp_path / "a.log", tmp_path / "empty.log"])
    assert len(list(log)) == 20
    text = "\n".join(log.report.lines())
    assert f"{tmp_path}/b.log: line 11: 'garbage'" in text
    assert f"{tmp_path}/empty.log: no frames" in text


def test_a_log_without_frames_is_refused_by_every_command(tmp_path: Path) -> None:
    empty, found = tmp_path / "empty.log", tmp_path / "a.log"
    empty.write_text("")
    made(found, range(10))
    for log, expected in (
        (open_logs([empty]), f"{empty}: no CAN frame; expected at least one"),
        (open_logs([found], selection=Selection.parse(ids=["7"])), "no CAN frame within --since"),
        (open_logs([found], selection=Selection.parse(since="9")), "no CAN frame within --since"),
    ):
        with pytest.raises(InputError, match=expected):
            list(log)


@pytest.mark.parametrize(
    "words",
    [
        ["convert", "a.log", "out.csv"],
        ["convert", "a.log", "out.csv", "--dbc", str(DBC_PATH)],
        ["replay", "a.log", "--out", "out"],
        ["replay", "a.log", "--summary", "--out", "out"],
        ["replay", "a.log", "--map", str(SHIPPED), "--out", "out"],
        ["bus", "--log", "a.log"],
    ],
)
def test_a_command_refuses_a_log_without_frames_and_writes_nothing(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.log").write_text("# nothing\n")
    assert main(words) == 2
    expected = f"opc4 {words[0]}: a.log: no CAN frame; expected at least one\n"
    assert capsys.readouterr().err == expected
    assert [path.name for path in tmp_path.iterdir()] == ["a.log"]


def test_a_selection_of_several_files(tmp_path: Path) -> None:
    made(tmp_path / "a.log", range(10))
    made(tmp_path / "b.log", range(20, 30), 0x200)
    chosen = Selection.parse(since="0.008", until="0.021")
    log = open_logs([tmp_path / "b.log", tmp_path / "a.log"], selection=chosen)
    assert [frame.time_ns // MS % 1000 for frame in log] == [8, 9, 20, 21]


def test_standard_input(tmp_path: Path) -> None:
    frames = made(tmp_path / "a.log", range(3000))
    code = "import sys; from sil.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "convert", "-", str(tmp_path / "b.csv")]
    with (tmp_path / "a.log").open() as file:
        done = subprocess.run(command, stdin=file, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(open_log(tmp_path / "b.csv")) == frames


def test_progress_is_shown_over_all_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress.Progress, "first_after_s", 0.0)
    monkeypatch.setattr(progress.Progress, "line_every_s", 0.0)
    monkeypatch.setattr(progress, "_silent", False)  # whatever command has run here with --quiet
    made(tmp_path / "a.log", range(20_000))
    made(tmp_path / "b.log", range(20_000, 40_000))
    paths = [tmp_path / "b.log", tmp_path / "a.log"]
    assert len(list(open_logs(paths))) == 40_000
    assert capsys.readouterr().err == ""
    assert len(list(open_logs(paths, show_progress=True))) == 40_000
    lines = capsys.readouterr().err.splitlines()
    shares = [int(line.partition(" %")[0].rpartition(" ")[2]) for line in lines]
    assert shares == sorted(shares) and shares[0] < 50 and shares[-1] == 100
    assert all(line.startswith("reading ") and "MB" in line for line in lines)
