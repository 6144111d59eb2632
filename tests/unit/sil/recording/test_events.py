"""Events on disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.recording.events import EventLog, event_of
from sil.recording.run_record import PlantEvent


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
