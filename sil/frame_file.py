"""The frames of a run on disk while it goes on, as they are needed to judge it afterwards.

The bus log has arrivals only; this file also has when each frame was released, and by whom.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.frame import Frame
from sil.recorder import AppendedFile
from sil.run_record import BusFrame

if TYPE_CHECKING:
    from sil.bus import Delivery

BUS_FRAMES = "bus.frames"
_ENTRY = struct.Struct("<QQIBB8s")
_ARRIVAL = struct.Struct("<8xQ")


class FrameWriter(AppendedFile):
    """Appends the frames delivered in each step.  Checked by test_kept_run."""

    def __init__(self, path: Path, senders: Sequence[str]) -> None:
        """`senders`: everybody who can send, in the order that the reader is told, too."""
        super().__init__(path)
        self._number = {name: number for number, name in enumerate(senders)}
        self.frames = 0

    def record(self, deliveries: Sequence[Delivery]) -> None:
        """Append the frames delivered in one step."""
        pack, number = _ENTRY.pack, self._number
        self.frames += len(deliveries)
        self.append(
            b"".join(
                pack(
                    d.queued_ns,
                    d.arrival_ns,
                    d.frame.can_id,
                    len(d.frame.data),
                    number[d.sender],
                    d.frame.data,
                )
                for d in deliveries
            )
        )


class FrameReader:
    """Reads frames by their place in the order of arrival.  A torn last one is left out."""

    def __init__(self, path: Path, senders: Sequence[str]) -> None:
        self._senders = tuple(senders)
        self._file = open(path, "rb", buffering=0)  # noqa: SIM115 - closed by close
        self.frames = os.fstat(self._file.fileno()).st_size // _ENTRY.size

    def read(self, begin: int, end: int) -> list[BusFrame]:
        """Return frames begin..end-1."""
        size = _ENTRY.size
        content = os.pread(self._file.fileno(), (end - begin) * size, begin * size)
        senders = self._senders
        return [
            BusFrame(released, arrival, senders[sender], Frame(can_id, data[:length]))
            for released, arrival, can_id, length, sender, data in _ENTRY.iter_unpack(content)
        ]

    def first_from(self, arrival_ns: int) -> int:
        """Return the place of the first frame that arrived at this instant or later."""
        low, high = 0, self.frames
        while low < high:
            middle = (low + high) // 2
            entry = os.pread(self._file.fileno(), _ARRIVAL.size, middle * _ENTRY.size)
            if _ARRIVAL.unpack(entry)[0] < arrival_ns:
                low = middle + 1
            else:
                high = middle
        return low

    def close(self) -> None:
        """Close the file."""
        self._file.close()
