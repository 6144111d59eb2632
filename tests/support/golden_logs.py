"""The golden logs as material for tests, whole or taken apart."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from sil.log_replay.recorded_frames import Arrival, RecordedFrames
from sil.logs import LogFrame, LogReader, open_log, open_writer
from tests.conftest import ROOT

GOLDEN = ROOT / "tests" / "golden"


def golden(name: str) -> Path:
    return GOLDEN / f"{name}.log.gz"


def frames(name: str) -> list[LogFrame]:
    return list(open_log(golden(name)))


def arrivals(name: str) -> list[Arrival]:
    return list(RecordedFrames(open_log(golden(name))))


def write(path: Path, log: Iterable[LogFrame]) -> Path:
    with open_writer(path) as writer:
        for frame in log:
            writer.write(frame)
    return path


def log_of(path: Path, content: str | bytes) -> LogReader:
    """A log with this content."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return open_log(path)
