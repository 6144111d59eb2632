"""Ten thousand random frames of all kinds through each format, python-can, asammdf and can-utils.

What a format or another tool does not keep is listed here; everything else comes back identical.
"""

from __future__ import annotations

import importlib
import random
import shutil
import subprocess
from pathlib import Path

import pytest

from sil.logs import LogFrame, open_log, open_writer
from sil.logs.frame import DLC_LENGTHS
from tests.contracts.test_log_formats import (
    ABSOLUTE_NS,
    FORMATS,
    PYTHON_CAN,
    Format,
    as_python_can,
    from_python_can,
    write,
)

COUNT = 10_000
KINDS = ("data", "data", "fd", "remote", "error", "raw")


def random_frames(fmt: Format, seed: int, kinds: tuple[str, ...] = KINDS) -> list[LogFrame]:
    rng = random.Random(seed)
    time_ns, found = ABSOLUTE_NS // 10**6 * 10**6, []
    for _ in range(COUNT):
        time_ns += rng.choice((0, 1000, rng.randrange(1000, 10**7) // 1000 * 1000))
        extended, kind = rng.random() < 0.6, rng.choice(kinds)
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
            frame = frame._replace(
                fd=True, brs=brs, esi=esi, data=rng.randbytes(rng.choice(DLC_LENGTHS))
            )
        elif kind == "remote":
            frame = frame._replace(remote=True, data=b"", raw_dlc=rng.randrange(9))
        elif kind == "raw":
            frame = frame._replace(data=rng.randbytes(8), raw_dlc=rng.randrange(9, 16))
        elif kind == "error":
            data = rng.randbytes(8)
            frame = frame._replace(
                error=True, extended=False, can_id=rng.randrange(1, 1 << 9), data=data
            )
        found.append(frame)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("fmt", FORMATS, ids=lambda fmt: fmt.name)
def test_ours(fmt: Format, tmp_path: Path) -> None:
    """Not kept: class and details of an error frame (ASC; TRC: class), its flags (BLF)."""
    frames = random_frames(fmt, 1)
    write(tmp_path / f"log.{fmt.suffix}", frames)
    reader = open_log(tmp_path / f"log.{fmt.suffix}")
    assert list(reader) == [fmt.held(frame) for frame in frames]
    assert reader.report.skipped == 0


@pytest.mark.slow
@pytest.mark.parametrize("fmt", PYTHON_CAN[:-1], ids=lambda fmt: fmt.name)
def test_python_can_reads_ours(fmt: Format, tmp_path: Path) -> None:
    """Not kept by python-can: length codes above 8 of classic frames; it takes ASC's CAN FD lines without data for remote frames, and leaves TRC's code where a length belongs."""
    can = importlib.import_module("can")
    frames = random_frames(fmt, 2, ("data", "data", "fd", "remote"))
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


@pytest.mark.slow
@pytest.mark.parametrize("fmt", PYTHON_CAN, ids=lambda fmt: fmt.name)
def test_we_read_python_can(fmt: Format, tmp_path: Path) -> None:
    """Not kept by python-can: CAN FD in TRC and CSV, remote frames in TRC, their length in candump."""
    can = importlib.import_module("can")
    lossy = {"trc": ("data",), "csv": ("data", "remote")}
    frames = random_frames(fmt, 3, lossy.get(fmt.name, ("data", "data", "fd", "remote")))
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


@pytest.mark.slow
def test_asammdf_reads_ours(tmp_path: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    frames = random_frames(FORMATS[4], 4)
    write(tmp_path / "log.mf4", frames)
    rows = []
    with asammdf.MDF(tmp_path / "log.mf4") as measurement:
        start_ns = measurement.header.abs_time
        for number, group in enumerate(measurement.groups):
            name = group.channel_group.acq_name
            signal = measurement.get(name, group=number)
            for row, time_s in zip(signal.samples, signal.timestamps, strict=True):
                part = {key.partition(".")[2]: row[key] for key in row.dtype.names}
                data = bytes(part.get("DataBytes", b""))[: int(part.get("DataLength", 0))]
                flags = tuple(bool(part[flag]) for flag in ("IDE", "EDL", "BRS", "ESI", "Dir"))
                head = int(part["Order"]), start_ns + round(time_s * 1e9), name
                rows.append((*head, int(part["ID"]), data, *flags))
    expected = [
        (
            *(number, f.time_ns),
            "CAN_ErrorFrame" if f.error else "CAN_RemoteFrame" if f.remote else "CAN_DataFrame",
            *(f.can_id, f.data, f.extended, f.fd, f.brs, f.esi, f.direction == "Tx"),
        )
        for number, f in enumerate(frames)
    ]
    assert sorted(rows) == expected


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("log2asc") is None, reason="can-utils is not installed")
def test_can_utils_there_and_back(tmp_path: Path) -> None:
    """Not kept by log2asc and asc2log: error classes, length codes above 8, the direction without R or T."""
    fmt = FORMATS[0]._replace(channels=("can0", "can1"))
    frames = random_frames(fmt, 5, ("data", "data", "fd", "remote"))
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
