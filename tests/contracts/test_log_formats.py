"""One suite over all log formats: what is written is read back, by us and by other tools."""

from __future__ import annotations

import importlib
import os
import random
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, convert, open_log, open_writer
from sil.logs.frame import DLC_LENGTHS

ROOT = Path(__file__).resolve().parent.parent.parent
ABSOLUTE_NS = 1_700_000_000_123_456_789
START_NS = ABSOLUTE_NS // 10**6 * 10**6


def same(frame: LogFrame) -> LogFrame:
    return frame


def in_asc(frame: LogFrame) -> LogFrame:
    """ASC states of an error frame only that there was one; of a classic one not the direction."""
    if not frame.error:
        return frame
    direction = frame.direction if frame.fd else ""
    return frame._replace(can_id=0, data=b"", extended=False, direction=direction)


def in_blf(frame: LogFrame) -> LogFrame:
    return frame._replace(direction="", fd=False) if frame.error else frame


def in_trc(frame: LogFrame) -> LogFrame:
    """TRC has microseconds, and no class of an error."""
    microseconds = (frame.time_ns + 500) // 1000
    frame = frame._replace(time_ns=microseconds * 1000)
    return frame._replace(can_id=0, extended=False, fd=False) if frame.error else frame


class Format(NamedTuple):
    """A format under test: suffix, channel names that it holds, and what it holds of a frame."""

    name: str
    suffix: str
    channels: tuple[str, str]
    held: Callable[[LogFrame], LogFrame]


FORMATS = (
    Format("candump", "log", ("can0", "vcan7"), same),
    Format("asc", "asc", ("1", "2"), in_asc),
    Format("blf", "blf", ("1", "2"), in_blf),
    Format("trc", "trc", ("1", "2"), in_trc),
    Format("mf4", "mf4", ("1", "2"), same),
    Format("csv", "csv", ("can0", "2"), same),
)
PYTHON_CAN = FORMATS[:6]
"""The formats of python-can; its CSV is a table of its own, which it reads and we do not write."""

PACKED = [fmt._replace(suffix=f"{fmt.suffix}.gz") for fmt in FORMATS]
every_format = pytest.mark.parametrize("fmt", FORMATS, ids=lambda fmt: fmt.name)
every_file = pytest.mark.parametrize("fmt", [*FORMATS, *PACKED], ids=lambda fmt: fmt.suffix)


def every_kind(channels: tuple[str, str], start_ns: int) -> list[LogFrame]:
    """One frame of every kind there is, a millisecond and a nanosecond apart."""
    first, second = channels
    eight = bytes(range(8))
    kinds = [
        LogFrame(0, 0x18FEF100, eight),
        LogFrame(0, 0x7FF, b"", False),
        LogFrame(0, 0, b"\x00", False),
        LogFrame(0, 0x1FFFFFFF, b"\xff" * 8),
        LogFrame(0, 0x123, b"\x01\x02\x03"),
        LogFrame(0, 0x123, eight, False, raw_dlc=9),
        LogFrame(0, 0x123, eight, raw_dlc=15),
        LogFrame(0, 0x123, b"", False, remote=True),
        LogFrame(0, 0x18EAFF00, b"", remote=True, raw_dlc=8),
        LogFrame(0, 0x04, b"\x00\x04" + bytes(6), False, error=True),
        *(LogFrame(0, 0x300, bytes(range(n)), False, fd=True) for n in DLC_LENGTHS),
        LogFrame(0, 0x1ABCDEF0, bytes(64), fd=True, brs=True),
        LogFrame(0, 0x1ABCDEF0, bytes(12), fd=True, esi=True),
        LogFrame(0, 0x1ABCDEF0, bytes(48), fd=True, brs=True, esi=True),
    ]
    return [
        frame._replace(
            time_ns=start_ns + index * 1_000_001,
            channel=second if index % 3 == 1 else first,
            direction="Tx" if index % 2 else "Rx",
        )
        for index, frame in enumerate(kinds)
    ]


def write(path: Path, frames: list[LogFrame]) -> Any:
    with open_writer(path) as writer:
        for frame in frames:
            writer.write(frame)
    return writer


@every_file
@pytest.mark.parametrize("start_ns", [0, ABSOLUTE_NS], ids=["relative", "absolute"])
def test_frames_come_back(fmt: Format, start_ns: int, tmp_path: Path) -> None:
    frames = every_kind(fmt.channels, start_ns)
    path = tmp_path / f"log.{fmt.suffix}"
    writer = write(path, frames)
    reader = open_log(path)
    assert list(reader) == [fmt.held(frame) for frame in frames]
    report = reader.report
    assert report.clean
    assert (report.frames, report.error, report.remote) == (len(frames), 1, 2)
    assert report.fd == sum(frame.fd for frame in frames) and report.format == fmt.name
    assert report.time_base == ("absolute" if start_ns else "relative")
    lossless = [fmt.held(frame) for frame in frames] == frames
    assert bool(writer.losses) is not lossless


def random_frames(
    fmt: Format,
    seed: int,
    kinds: str = "data data fd remote error raw",
    start_ns: int = START_NS,
    remote_codes: int = 9,
) -> list[LogFrame]:
    """2,500 frames of these kinds, several at one instant now and then."""
    rng = random.Random(seed)
    time_ns, found = start_ns, []
    for _ in range(2500):
        time_ns += rng.choice((0, 1000, rng.randrange(1000, 10**7) // 1000 * 1000))
        extended, kind = rng.random() < 0.6, rng.choice(kinds.split())
        frame = LogFrame(
            time_ns,
            rng.randrange(1 << 29 if extended else 1 << 11),
            rng.randbytes(rng.randrange(9)),
            extended,
            channel=rng.choice(fmt.channels),
            direction=rng.choice(("Rx", "Tx")),
        )
        if kind == "fd":
            brs, esi = rng.random() < 0.5, rng.random() < 0.5
            data = rng.randbytes(rng.choice(DLC_LENGTHS))
            frame = frame._replace(fd=True, brs=brs, esi=esi, data=data)
        elif kind == "remote":
            frame = frame._replace(remote=True, data=b"", raw_dlc=rng.randrange(remote_codes))
        elif kind == "raw":
            frame = frame._replace(data=rng.randbytes(8), raw_dlc=rng.randrange(9, 16))
        elif kind == "error":
            error_class, data = rng.randrange(1, 1 << 9), rng.randbytes(8)
            frame = frame._replace(error=True, extended=False, can_id=error_class, data=data)
        found.append(frame)
    return found


@every_format
@pytest.mark.parametrize("start_ns", [0, 1000, 10**9, START_NS])
def test_any_log_comes_back(fmt: Format, start_ns: int, tmp_path: Path) -> None:
    """Not kept: class and details of an error frame (ASC; TRC: class), its flags (BLF)."""
    frames = random_frames(fmt, 1, start_ns=start_ns, remote_codes=16)
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, frames)
    reader = open_log(path)
    assert list(reader) == [fmt.held(frame) for frame in frames]
    assert reader.report.skipped == 0


@every_format
@given(
    first_ns=st.integers(10**18, 4 * 10**18),
    later_ns=st.lists(st.integers(0, 10**15), max_size=20, unique=True),
)
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_times_are_exact_over_days(
    fmt: Format, first_ns: int, later_ns: list[int], tmp_path: Path
) -> None:
    frames = [
        LogFrame(first_ns + t, 1, b"", channel=fmt.channels[0], direction="Rx")
        for t in sorted({0, *later_ns})
    ]
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, frames)
    assert list(open_log(path)) == [fmt.held(frame) for frame in frames]


@every_format
def test_the_sniffed_format_needs_no_suffix(fmt: Format, tmp_path: Path) -> None:
    frames = every_kind(fmt.channels, ABSOLUTE_NS)
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, frames)
    bare = tmp_path / "log_without_suffix"
    path.rename(bare)
    assert open_log(bare).format == fmt.name
    assert len(list(open_log(bare))) == len(frames)
    misnamed = tmp_path / "log.asc"
    bare.rename(misnamed)
    assert open_log(misnamed).format == fmt.name


@every_format
def test_an_empty_log(fmt: Format, tmp_path: Path) -> None:
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, [])
    reader = open_log(path)
    assert list(reader) == []
    assert reader.report.clean
    assert any("no CAN frames" in note for note in reader.report.notes)


@every_file
def test_a_log_appears_only_when_whole(fmt: Format, tmp_path: Path) -> None:
    path = tmp_path / f"log.{fmt.suffix}"
    path.write_bytes(b"older")
    frames = every_kind(fmt.channels, 0)
    with open_writer(path) as writer:
        for frame in frames * 100:
            writer.write(frame._replace(time_ns=frame.time_ns + writer.frames))
        writer.flush()
        assert path.read_bytes() == b"older"
    assert path.read_bytes() != b"older"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@every_file
def test_nothing_half_written_is_left(fmt: Format, tmp_path: Path) -> None:
    path = tmp_path / f"log.{fmt.suffix}"
    frames = every_kind(fmt.channels, 0)

    def interrupted() -> None:
        with open_writer(path) as writer:
            for frame in frames:
                writer.write(frame)
            writer.flush()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


IMPOSSIBLE = {
    "identifier": LogFrame(0, 1 << 29, b""),
    "negative identifier": LogFrame(0, -1, b""),
    "standard identifier": LogFrame(0, 0x800, b"", False),
    "classic length": LogFrame(0, 1, bytes(9)),
    "FD length": LogFrame(0, 1, bytes(9), fd=True),
    "remote data": LogFrame(0, 1, b"\x00", remote=True),
    "raw code": LogFrame(0, 1, b"\x00", raw_dlc=9),
    "direction": LogFrame(0, 1, b"", direction="up"),
    "channel": LogFrame(0, 1, b"", channel="a b"),
    "time": LogFrame(2**63, 1, b""),
}


@every_format
@pytest.mark.parametrize("frame", IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_impossible_frames_are_refused(fmt: Format, frame: LogFrame, tmp_path: Path) -> None:
    writer = open_writer(tmp_path / f"log.{fmt.suffix}")
    with pytest.raises(InputError, match=r"frame 1: .*; expected"), writer:
        writer.write(frame)
    assert list(tmp_path.iterdir()) == []


@every_format
def test_the_clock_may_step_back(fmt: Format, tmp_path: Path) -> None:
    """Within a log every format holds a step back; before its start some cannot, and say so."""
    times_ns = [3_000_000, 2_000_000, 5_000_000]
    frames = [
        LogFrame(ABSOLUTE_NS // 1000 * 1000 + t, 0x123, bytes([i]), channel=fmt.channels[0])
        for i, t in enumerate(times_ns)
    ]
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, frames)
    reader = open_log(path)
    assert [(f.time_ns, f.data) for f in reader] == [(f.time_ns, f.data) for f in frames]
    assert reader.report.backwards == 1
    assert "steps back" in reader.report.places["backwards"][0]
    with pytest.raises(InputError, match="steps back"):
        list(open_log(path, strict=True))


@every_format
def test_duplicates_stay_and_are_counted(fmt: Format, tmp_path: Path) -> None:
    frame = LogFrame(ABSOLUTE_NS // 1000 * 1000, 0x123, b"\x01", channel=fmt.channels[0])
    other = frame._replace(data=b"\x02")
    path = tmp_path / f"log.{fmt.suffix}"
    write(path, [frame, other, frame])
    reader = open_log(path)
    assert len(list(reader)) == 3
    assert reader.report.duplicates == 1
    with pytest.raises(InputError, match="in the log twice"):
        list(open_log(path, strict=True))


def as_python_can(frame: LogFrame) -> tuple[Any, ...]:
    return (
        frame.can_id,
        frame.extended,
        frame.data,
        frame.remote,
        frame.fd,
        frame.brs,
        frame.esi,
        frame.raw_dlc if frame.remote else len(frame.data),
    )


def from_python_can(message: Any) -> tuple[Any, ...]:
    return (
        message.arbitration_id,
        message.is_extended_id,
        bytes(message.data or b""),
        message.is_remote_frame,
        message.is_fd,
        message.bitrate_switch,
        message.error_state_indicator,
        message.dlc,
    )


@pytest.mark.parametrize("fmt", PYTHON_CAN[:-1], ids=lambda fmt: fmt.name)
def test_python_can_reads_ours(fmt: Format, tmp_path: Path) -> None:
    """Not kept by python-can: length codes above 8 of classic frames; it takes ASC's CAN FD lines without data for remote frames, and leaves TRC's code where a length belongs."""
    can = importlib.import_module("can")
    frames = random_frames(fmt, 2, "data data fd remote")
    if fmt.name == "asc":
        frames = [frame for frame in frames if frame.data or not frame.fd]
    write(tmp_path / f"log.{fmt.suffix}", frames)
    with can.LogReader(tmp_path / f"log.{fmt.suffix}") as reader:
        messages = list(reader)
    if fmt.name == "mf4":  # it orders frames of one instant by kind
        messages.sort(key=lambda m: (m.timestamp, from_python_can(m)))
        frames.sort(key=lambda f: (f.time_ns, as_python_can(f)))
    compared = 7 if fmt.name == "trc" else 8
    assert [from_python_can(m)[:compared] for m in messages] == [
        as_python_can(f)[:compared] for f in frames
    ]
    assert [m.is_rx for m in messages] == [f.direction == "Rx" for f in frames]
    offset_s = messages[0].timestamp - frames[0].time_ns / 1e9
    assert abs(offset_s) < 2e-6 or fmt.name == "asc"
    times_s = [m.timestamp - offset_s for m in messages]
    assert times_s == pytest.approx([f.time_ns / 1e9 for f in frames], rel=0, abs=2e-6)


@pytest.mark.parametrize("fmt", PYTHON_CAN, ids=lambda fmt: fmt.name)
def test_we_read_python_can(fmt: Format, tmp_path: Path) -> None:
    """Not kept by python-can: CAN FD in TRC and CSV, remote frames in TRC, their length in candump."""
    can = importlib.import_module("can")
    lossy = {"trc": "data", "csv": "data remote"}
    frames = random_frames(fmt, 3, lossy.get(fmt.name, "data data fd remote"))
    with can.Logger(tmp_path / f"log.{fmt.suffix}") as logger:
        for frame in frames:
            logger.on_message_received(
                can.Message(
                    timestamp=frame.time_ns / 1e9,
                    arbitration_id=frame.can_id,
                    is_extended_id=frame.extended,
                    data=None if frame.remote else frame.data,
                    dlc=as_python_can(frame)[7],
                    is_remote_frame=frame.remote,
                    is_fd=frame.fd,
                    bitrate_switch=frame.brs,
                    error_state_indicator=frame.esi,
                    is_rx=frame.direction == "Rx",
                    channel=0,
                )
            )
    reader = open_log(tmp_path / f"log.{fmt.suffix}")
    found = list(reader)
    if fmt.name == "candump":
        frames = [f._replace(raw_dlc=0) if f.remote else f for f in frames]
    if fmt.name == "mf4":  # groups apart: frames of one instant come by kind
        frames.sort(key=lambda f: (f.time_ns, as_python_can(f)))
        found.sort(key=lambda f: (f.time_ns, as_python_can(f)))
    assert [as_python_can(f) for f in found] == [as_python_can(f) for f in frames]
    assert reader.report.skipped == 0


@pytest.mark.skipif(shutil.which("log2asc") is None, reason="can-utils is not installed")
def test_can_utils_there_and_back(tmp_path: Path) -> None:
    """Not kept by log2asc and asc2log: error classes, length codes above 8, the direction without R or T."""
    fmt = FORMATS[0]._replace(channels=("can0", "can1"))
    frames = random_frames(fmt, 5, "data data fd remote")
    write(tmp_path / "a.log", frames)
    subprocess.run(
        ["log2asc", "-I", tmp_path / "a.log", "-O", tmp_path / "b.asc", "can0", "can1"], check=True
    )
    found = list(open_log(tmp_path / "b.asc"))
    assert [as_python_can(f) for f in found] == [as_python_can(f) for f in frames]
    with open_writer(tmp_path / "c.asc") as writer:
        for frame in frames:
            writer.write(frame)
    subprocess.run(["asc2log", "-I", tmp_path / "c.asc", "-O", tmp_path / "d.log"], check=True)
    found = list(open_log(tmp_path / "d.log"))
    assert [as_python_can(f) for f in found] == [as_python_can(f) for f in frames]


def test_asammdf_decodes_our_bus_log_with_the_dbc(tmp_path: Path) -> None:
    """Engine speed of EEC1 out of our MF4, decoded by asammdf with a DBC."""
    asammdf = importlib.import_module("asammdf")
    dbc = tmp_path / "eec1.dbc"
    dbc.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: X\n'
        "BO_ 2364540158 EEC1: 8 X\n"
        ' SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" X\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\nBA_ "ProtocolType" "J1939";\n'
        'BA_ "VFrameFormat" BO_ 2364540158 3;\n'
    )
    frames = [
        LogFrame(i * 10**7, 0x0CF00400, bytes((0, 0, 0)) + raw.to_bytes(2, "little") + bytes(3))
        for i, raw in enumerate((8000, 8008, 16000))
    ]
    path = tmp_path / "log.mf4"
    write(path, frames)
    with asammdf.MDF(path) as measurement:
        decoded = measurement.extract_bus_logging({"CAN": [(str(dbc), 0)]})
        speed = decoded.get("EngineSpeed")
        assert list(speed.samples) == [1000.0, 1001.0, 2000.0]
        assert list(speed.timestamps) == [0.0, 0.01, 0.02]
        decoded.close()


def pairs() -> Iterator[tuple[Format, Format]]:
    for source in FORMATS:
        for target in FORMATS:
            if source is not target:
                yield source, target


@pytest.mark.parametrize(
    ("source", "target"), list(pairs()), ids=lambda fmt: fmt.name if isinstance(fmt, Format) else ""
)
def test_conversion_keeps_every_frame(source: Format, target: Format, tmp_path: Path) -> None:
    begin = tmp_path / f"begin.{source.suffix}"
    middle = tmp_path / f"middle.{target.suffix}"
    frames = [
        f._replace(time_ns=f.time_ns // 1000 * 1000)
        for f in every_kind(source.channels, ABSOLUTE_NS)
        if not f.error
    ]
    write(begin, frames)
    report = convert(begin, middle)
    assert report.written == len(frames) and report.read.clean
    found = [f._replace(channel="") for f in open_log(middle)]
    assert found == [f._replace(channel="") for f in frames]


def test_importing_logs_is_light() -> None:
    code = (
        "import sys, sil.logs, sil.shifts.cutter;"
        "heavy = {'numpy', 'can', 'asammdf', 'cantools', 'numba', 'scipy', 'pandas'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"


def many_frames(fmt: Format, count: int) -> Iterator[LogFrame]:
    data = [bytes((i, 255 - i)) * 4 for i in range(256)]
    for index in range(count):
        yield LogFrame(
            ABSOLUTE_NS // 1000 * 1000 + index * 200_000,
            0x18FEF100 + index % 40,
            data[index % 256],
            channel=fmt.channels[0],
            direction="Rx",
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "fmt",
    [fmt for fmt in (*FORMATS, PACKED[0], PACKED[2]) if fmt.name != "mf4"],
    ids=lambda fmt: fmt.suffix,
)
def test_memory_is_flat(fmt: Format, tmp_path: Path) -> None:
    """Some MB, whatever the log holds; a frame in memory is more than 250 bytes. An MF4 is read as a whole, as its page says."""
    count, most = 80_000, 6 << 20
    assert most < count * 250
    path = tmp_path / f"log.{fmt.suffix}"
    tracemalloc.start()
    with open_writer(path) as writer:
        for frame in many_frames(fmt, count):
            writer.write(frame)
    written = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    tracemalloc.start()
    assert sum(1 for _ in open_log(path)) == count
    read = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert written < most
    assert read < most


def found_canlogs() -> Path | None:
    """Logs of other tools, where the environment or a folder next to the checkout has them."""
    named = os.environ.get("OPC4_CANLOGS")
    folders = [Path(named)] if named else [ROOT.parent / "shared" / "canlogs"]
    return next((folder for folder in folders if (folder / "README.md").is_file()), None)


def canlogs_table(folder: Path) -> list[tuple[str, str, str]]:
    """File, frames and notes of the table in the folder's README."""
    rows = []
    for line in (folder / "README.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split("|")]
        if line.startswith("| ") and len(cells) == 3 and "/" in cells[0]:
            rows.append((cells[0], cells[1], cells[2]))
    return rows


CANLOGS = found_canlogs()
if CANLOGS is not None:

    @pytest.mark.slow
    @pytest.mark.parametrize(("name", "frames", "notes"), canlogs_table(CANLOGS))
    def test_logs_of_other_tools(name: str, frames: str, notes: str) -> None:
        """Counts as in the folder's table; for files python-can cannot read, one per line."""
        assert CANLOGS is not None
        path = CANLOGS / name
        reader = open_log(path)
        if "decoded signals only" in notes:
            with pytest.raises(InputError, match="decoded signals only"):
                list(reader)
            return
        found = list(reader)
        report = reader.report
        lines = [] if frames.isdecimal() else path.read_text().splitlines()
        expected = int(frames) if not lines else sum(1 for line in lines if line.strip())
        assert len(found) == report.frames == expected
        assert not report.skipped and not report.truncated
        counts = dict(word.split("=") for word in notes.split() if "=" in word)
        assert report.error == int(counts.get("err", 0))
        assert report.remote == int(counts.get("rtr", 0))
        if path.name != "single_frame.asc":
            assert report.fd == int(counts.get("fd", 0))
        if "time " in notes:
            first, last = notes.split("time ")[1].split("..")
            assert report.first_ns is not None and report.last_ns is not None
            assert report.first_ns / 1e9 == pytest.approx(float(first), abs=1e-6)
            assert report.last_ns / 1e9 == pytest.approx(float(last), abs=1e-6)
