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
        """Create the file."""
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close

    def __call__(self, time_s: float, name: str, values: Mapping[str, float]) -> None:
        """Append one event."""
        line = json.dumps({"time_s": time_s, "name": name, **values})
        self._file.write(line.encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def event_of(line: bytes, location: str) -> PlantEvent:
    """Return the event of one line.  Raises InputError naming `location` for something else."""
    try:
        values = json.loads(line)
        return PlantEvent(float(values.pop("time_s")), str(values.pop("name")), values)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{location}: not an event; expected time_s, name and values") from None
