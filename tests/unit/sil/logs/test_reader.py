"""Reports, locations, refusals and the frame record that all formats share."""

from __future__ import annotations

import errno
import gzip
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.contract import DBC_PATH
from can_dbc.errors import InputError
from sil.logs import FORMATS, LogFrame, open_log, open_writer
from sil.logs.frame import all_ordinary, frame_problem, ordinary_frame
from sil.logs.report import Location, LogReport, printable
from tests.support.golden_logs import log_of, write


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (LogFrame(0, 1, b""), 0),
        (LogFrame(0, 1, bytes(8)), 8),
        (LogFrame(0, 1, bytes(8), raw_dlc=13), 13),
        (LogFrame(0, 1, bytes(12), fd=True), 9),
        (LogFrame(0, 1, bytes(64), fd=True), 15),
        (LogFrame(0, 1, b"", remote=True, raw_dlc=5), 5),
        (LogFrame(0, 1, b"", remote=True), 0),
    ],
)
def test_length_code_on_the_wire(frame: LogFrame, code: int) -> None:
    assert frame.dlc == code
    assert frame_problem(frame) is None


any_frames = st.builds(
    LogFrame,
    st.integers(-(2**64), 2**64),
    st.integers(-5, 2**29 + 5) | st.integers(0x7F0, 0x810),
    st.binary(max_size=10) | st.binary(min_size=60, max_size=66),
    *[st.booleans()] * 6,
    st.sampled_from(("", "can0", "a b", "ä")),
    st.sampled_from(("", "Rx", "Tx", "up")),
    st.integers(-1, 17),
)


@settings(deadline=None)
@given(st.lists(any_frames, min_size=1, max_size=4))
def test_the_quick_look_is_never_wrong(found: list[LogFrame]) -> None:
    if all_ordinary(found, {"", "can0"}):
        assert all(frame_problem(frame) is None for frame in found)


def test_the_quick_look_knows_the_ordinary() -> None:
    found = [
        LogFrame(0, 0x7FF, b"", False, channel="can0", direction="Rx"),
        LogFrame(2**63 - 1, 0x1FFFFFFF, bytes(8), direction="Tx"),
    ]
    assert all_ordinary(found, {"", "can0"})
    assert not all_ordinary(found, {""})
    assert not all_ordinary([found[0]._replace(can_id=0x800)], {"can0"})


def test_ordinary_frame_is_the_same_record() -> None:
    quick = ordinary_frame(5, 0x123, b"\x01", False, "can0", "Rx")
    assert quick == LogFrame(5, 0x123, b"\x01", False, channel="can0", direction="Rx")
    assert type(quick) is LogFrame


def test_refusal_names_the_place(tmp_path: Path) -> None:
    path = str(tmp_path / "a.asc")
    with (
        pytest.raises(
            InputError, match=r"a.asc: frame 1: standard identifier 0x800 .*; expected a CAN"
        ),
        open_writer(path) as writer,
    ):
        writer.write(LogFrame(0, 0x800, b"", False))


@pytest.mark.parametrize("text", ["can0 zwölf", "größe", "ß", "plain", "日本"])
def test_utf8_read_as_latin1_is_shown_as_utf8(text: str) -> None:
    read = text.encode().decode("latin-1")
    assert printable(read) == text
    assert str(Location(f"{read!r} is no line", line=3)) == f"line 3: '{text}' is no line"


def test_latin1_stays_and_control_characters_do_not() -> None:
    assert printable("zw\xf6lf\x07") == "zwölf?"


def test_what_is_not_whole_is_said_in_one_line() -> None:
    report = LogReport("a.log", "candump", frames=3)
    assert report.clean and report.faults == ""
    report.skip(Location("no frame", line=7))
    report.skip(Location("no frame", line=8))
    report.note("a remark")
    report.cut(Location("half a line", line=9))
    cut = "cut off at line 9: half a line"
    assert report.faults == f"{cut}; broken and skipped: 2, the first line 7: no frame"
    assert cut in LogReport.joined([report, report]).faults


VSPY = "Vehicle Spy 3 Export\nLine,Abs Time(Sec),Rel Time (Sec),Status,Er,Tx,Description\n"
FOREIGN = {
    "busmaster.log": "***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n10:1:2:3 Rx 1 0x123 s 1 00\n",
    "vspy.csv": VSPY,
    "car.crtd": "1320745424.000 CXX OVMS CRTD\n1320745424.002 R11 402 FA 01 C3 A0 96 00 07 01\n",
    "bus.txt": "1320745424.002 1R29 18F00503 FA 01 C3 A0 96 00 07 01\n",
    "old.txt": "# Logger type: CL2000\nTimestamp;Type;ID;Data\n",
    "trace.txt": "ASCII Trace IXXAT V1.3\n",
    "log.db": "SQLite format 3\0",
    "canoe.csv": "Time[s];Channel;ID;Name;Dir;DLC;Data\n0.1;CAN 1;123;X;Rx;1;00\n",
    "kvaser.csv": "Time,Channel,ID,Flags,DLC,Data0\n",
}


@pytest.mark.parametrize("name", FOREIGN)
def test_what_converts_a_foreign_log_is_said(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(FOREIGN[name])
    with pytest.raises(InputError, match="which is not read; expected one of ") as no:
        open_log(tmp_path / name)
    assert "\n" not in str(no.value)
    assert ("python-can" in str(no.value)) is (name == "log.db")


DATA = Path(__file__).resolve().parents[3] / "data" / "logs"


def test_everything_wrong_is_counted_and_located() -> None:
    reader = open_log(DATA / "torn.log")
    frames = list(reader)
    report = reader.report
    assert [(f.time_ns // 10**6, f.can_id) for f in frames] == [
        (10_000, 0x123),
        (10_000, 0x123),
        (9_500, 0x124),
        (11_300, 0x125),
    ]
    assert report.skipped == 6
    assert [place.split(":")[0] for place in report.places["skipped"][:2]] == ["line 3", "line 4"]
    text = (DATA / "torn.log").read_bytes()
    assert text[48:].startswith(b"garbage\n")
    assert text[56:].startswith(b"(10.100000) can0 123#1\n")
    assert report.duplicates == 1
    assert report.places["duplicates"] == [
        "line 2: the frame 123 at 10.000000 s is in the log twice"
    ]
    assert report.backwards == 1
    assert report.places["backwards"][0].startswith("line 5: the clock steps back from 10.000000 s")
    assert report.truncated
    assert report.other == {"CAN XL frame": 1, "frame dropped by the recorder": 7}
    assert (report.first_ns, report.last_ns) == (10 * 10**9, 11_300_000_000)
    assert json.loads(json.dumps(report.as_dict()))["skipped"] == 6
    lines = report.lines()
    assert lines[0] == "4 frames (candump, relative times)"
    assert "broken and skipped: 6" in lines
    assert "not frames: 7 frame dropped by the recorder" in lines


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("garbage", r"line 2: 'garbage' is no candump line; expected a whole candump log"),
        ("(0.5) can0 123#11", r"line 2: the clock steps back"),
        ("(1.000000) can0 123#11", r"line 2: the frame 123 .* twice"),
    ],
)
def test_strict_refuses_at_the_line(line: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    path.write_text(f"(1.000000) can0 123#11\n{line}\n")
    assert len(list(open_log(path))) >= 1
    with pytest.raises(InputError, match=expected) as caught:
        list(open_log(path, strict=True))
    assert str(caught.value).startswith(f"{path}: ")


def test_strict_refuses_a_cut_log(tmp_path: Path) -> None:
    log_of(tmp_path / "log.log", "(1.000000) can0 123#11\n(2.000000) can0 12")
    with pytest.raises(InputError, match="not cut off"):
        list(open_log(tmp_path / "log.log", strict=True))


def test_garbage_alone_is_never_silence(tmp_path: Path) -> None:
    reason = r"line 1: .* no CAN frame found, expected a log of format candump"
    with pytest.raises(InputError, match=reason):
        list(log_of(tmp_path / "log.log", "nothing\nof a log\n"))


def test_locations_are_few_and_counts_are_all(tmp_path: Path) -> None:
    reader = log_of(tmp_path / "log.log", "(1.000000) can0 123#11\n" + "?\n" * 5000)
    list(reader)
    assert reader.report.skipped == 5000
    assert len(reader.report.places["skipped"]) == 10
    assert "  and 4990 more" in reader.report.lines()


def test_each_reading_begins_anew() -> None:
    reader = open_log(DATA / "candump_log.log")
    first, second = list(reader), list(reader)
    assert first == second
    assert reader.report.frames == len(first)


def test_duplicates_are_found_among_frames_of_one_instant(tmp_path: Path) -> None:
    words = ["(1.0) can0 123#11", "(1.0) can0 123#12", "(1.0) can1 123#11", "(1.0) can0 123#11"]
    reader = log_of(tmp_path / "log.log", "\n".join([*words, "(2.0) can0 123#11", ""]))
    assert len(list(reader)) == 5
    assert reader.report.duplicates == 1
    assert "line 4" in reader.report.places["duplicates"][0]


def test_times_across_batches_are_watched(tmp_path: Path) -> None:
    lines = [f"({i}.000000) can0 123#11" for i in range(5000)]
    lines[3000] = f"({2998}.500000) can0 123#11"
    reader = log_of(tmp_path / "log.log", "\n".join([*lines, ""]))
    assert len(list(reader)) == 5000
    assert reader.report.places["backwards"] == [
        "line 3001: the clock steps back from 2999.000000 s to 2998.500000 s"
    ]


def test_unknown_formats_and_names(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'pcap' is unknown; expected one of blf"):
        open_log(DATA / "candump_log.log", format="pcap")
    with pytest.raises(InputError, match="is of no log format"):
        open_writer(tmp_path / "log.xyz")
    with pytest.raises(InputError, match="times 'later'"):
        open_log(DATA / "candump_log.log", times="later")
    strange = tmp_path / "log.xyz"
    strange.write_text("?")
    with pytest.raises(InputError, match="neither content nor name"):
        open_log(strange)
    with pytest.raises(InputError, match=r"is a folder|Is a directory"):
        open_writer(tmp_path, format="candump")
    with pytest.raises(InputError, match="No such file"):
        open_writer(tmp_path / "missing" / "log.log")


def test_devices_are_refused() -> None:
    """They would be read without an end, or replaced by the log."""
    for path in ("/dev/zero", "/dev/full"):
        with pytest.raises(InputError, match=r"is a device; expected a log file, or -"):
            open_log(path, format="candump")
        with pytest.raises(InputError, match=r"is a device; expected the name of a file$"):
            open_writer(path, format="candump")


@pytest.mark.parametrize("more", [[], ["--dbc", DBC_PATH]])
def test_logs_come_from_and_go_to_pipes(tmp_path: Path, more: list[str]) -> None:
    log = tmp_path / "a.log"
    write(log, [LogFrame(0, 0xCFF0005, bytes(8), channel="can0")])
    to = ["--to", "candump"] if not more else []
    command = [sys.executable, "-m", "sil.cli", "convert", "-", "-", *to, *more]
    done = subprocess.run(command, input=log.read_bytes(), capture_output=True, check=True)
    assert done.stdout == log.read_bytes() if to else b"ShiftRequest" in done.stdout
    assert b"1 frame" in done.stderr
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    feeder = threading.Thread(target=fifo.write_bytes, args=(log.read_bytes(),))
    feeder.start()
    assert len(list(open_log(fifo))) == 1
    feeder.join()


@pytest.mark.parametrize("name", FORMATS)
def test_a_stated_format_is_used(name: str, tmp_path: Path) -> None:
    path = tmp_path / "bare"
    with open_writer(path, format=name) as writer:
        writer.write(LogFrame(10**9, 0x123, b"\x01", channel="1", direction="Rx"))
    assert [frame.can_id for frame in open_log(path, format=name)] == [0x123]
    other = "blf" if name != "blf" else "mf4"
    with pytest.raises(InputError):
        list(open_log(path, format=other))


def test_close_twice_abort_after_close(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    writer = open_writer(path)
    writer.write(LogFrame(0, 1, b""))
    writer.close()
    writer.close()
    writer.abort()
    assert path.exists()


@pytest.mark.parametrize(
    "name", ["log.log", "log.asc", "log.blf", "log.log.gz", "log.blf.gz", "log.trc"]
)
def test_a_log_that_finds_no_room_leaves_nothing_behind(name: str, tmp_path: Path) -> None:
    """No file may grow beyond 64 bytes, which ends a write as a full disk does."""
    allowed = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = open_writer(tmp_path / name)
    for i in range(100):
        writer.write(LogFrame(i * 10**6, i, bytes(8), channel="1", direction="Rx"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, allowed[1]))
    try:
        with pytest.raises(InputError, match=r"File too large; expected room to write$"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, allowed)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["log", "asc", "trc", "csv", "blf"])
def test_only_what_is_patched_waits_to_be_packed(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a usable folder for temporary files, and then without any temporary file."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    frames = [LogFrame(i * 10**6, i, bytes(8), channel="1", direction="Rx") for i in range(3000)]
    plain, packed = tmp_path / f"plain.{suffix}", tmp_path / f"packed.{suffix}.gz"
    for path in (plain, packed):
        write(path, frames)
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    packed.unlink()

    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    if suffix == "blf":
        with pytest.raises(InputError, match=r"gz: No space left on device; expected a folder to"):
            open_writer(packed)
    else:
        open_writer(packed).abort()
    assert list(tmp_path.iterdir()) == [plain]


def test_channels_get_numbers_and_losses_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.asc"
    names = ["can0", "vcan0", "can4", "engine", "5", ""]
    with open_writer(path) as writer:
        for i, name in enumerate(names):
            writer.write(LogFrame(i * 1000, 1, b"", channel=name, direction="Rx"))
    found = [frame.channel for frame in open_log(path)]
    assert found[0] == "1"
    assert found[2] == "5"
    assert len(set(found)) == len(names)
    assert writer.channel_numbers == dict(zip(names, map(int, found), strict=True))
    assert writer.losses["channel can0 written as 1"] == 1


def test_too_many_channels_for_numbers(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "log.blf")
    with pytest.raises(InputError, match="more than 255 channels"), writer:
        for i in range(300):
            writer.write(LogFrame(i, 1, b"", channel=f"bus{i}x"))
