"""The plant's events on disk: one JSON object per line, written as they happen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from can_dbc.errors import InputError
from sil.recording.run_record import PlantEvent

EVENTS = "events.jsonl"


class EventLog:
    """Appends events to a new file, each on disk when the call returns."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close

    def __call__(self, time_s: float, name: str, values: Mapping[str, float]) -> None:
        """Append one event."""
        line = json.dumps({"time_s": time_s, "name": name, **values})
        self._file.write(line.encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_events(path: Path) -> list[PlantEvent]:
    """Read the events of a run, also of one that was killed: a torn last line is left out.

    Raises InputError for a file that holds something else. Checked by test_run_files.
    """
    lines = path.read_bytes().split(b"\n")
    lines.pop()  # empty, or torn
    return [event_of(line, f"{path}: line {n}") for n, line in enumerate(lines, start=1)]


def event_of(line: bytes, place: str) -> PlantEvent:
    """Return the event of one line. Raises InputError, naming the place, for something else."""
    try:
        values = json.loads(line)
        return PlantEvent(float(values.pop("time_s")), str(values.pop("name")), values)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{place}: not an event; expected time_s, name and values") from None
