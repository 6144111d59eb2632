"""The end-to-end status of the frames on the bus, message by message."""

from __future__ import annotations

from collections import Counter
from typing import Any

from can_dbc.codec import can_id_of
from can_dbc.e2e import ACCEPTED, PROTECTED, E2eStatus, Receiver
from sil.recording.run_record import RunRecord


class EndToEnd:
    """A receiver for each protected message, given every frame in order of arrival."""

    def __init__(self) -> None:
        """Start without frames."""
        self._receivers: dict[type, Receiver[Any]] = {kind: Receiver(kind) for kind in PROTECTED}
        self._foreign: Counter[type] = Counter()

    def add(self, record: RunRecord) -> None:
        """Check the frames of the next piece of the run."""
        for kind, receiver in self._receivers.items():
            for entry in record.frames_of(can_id_of(kind)):
                status = receiver.receive(entry.arrival_ns, entry.frame)
                if entry.sender == "intruder" and status in ACCEPTED:
                    self._foreign[kind] += 1

    def counts(self) -> dict[str, dict[str, int]]:
        """Return frames by status, and how many of an intruder's frames were accepted."""
        statuses = [status for status in E2eStatus if status is not E2eStatus.NO_NEW_DATA]
        return {
            kind.__name__: {status.value: receiver.counts[status] for status in statuses}
            | {"intruder's taken": self._foreign[kind]}
            for kind, receiver in self._receivers.items()
        }
