"""The frames of a run on disk while it goes on, as they are needed to judge it afterwards.

The bus log has arrivals only; this file also has when each frame was released, and by whom.
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_left
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sil.recording.recorder import AppendedFile
from sil.recording.run_record import STORED, StoredFrames

if TYPE_CHECKING:
    from sil.coupling.bus import Delivery

BUS_FRAMES = "bus.frames"
_ARRIVAL = struct.Struct("<8xQ")
_TIMES = np.dtype(
    {
        "names": ["released", "arrival"],
        "formats": ["<i8"] * 2,
        "offsets": [0, 8],
        "itemsize": STORED.size,
    }
)
_AT_ONCE = 1 << 18


class FrameWriter(AppendedFile):
    """Appends the frames delivered in each step."""

    def __init__(self, path: Path, senders: Sequence[str]) -> None:
        """Create the file; `senders`: everybody who can send, in the order given to the reader."""
        super().__init__(path)
        self._number = {name: number for number, name in enumerate(senders)}

    def record(self, deliveries: Sequence[Delivery]) -> None:
        """Append the frames delivered in one step."""
        pack, number = STORED.pack, self._number
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
    """Reads frames by their index in the order of arrival; a torn last one is ignored."""

    def __init__(self, path: Path, senders: Sequence[str]) -> None:
        """Open the file; `senders` as for the writer."""
        self._senders = tuple(senders)
        self._file = open(path, "rb", buffering=0)  # noqa: SIM115 - closed by close
        self.frames = os.fstat(self._file.fileno()).st_size // STORED.size

    def read(self, begin: int, end: int) -> StoredFrames:
        """Return frames begin to end - 1."""
        size = STORED.size
        content = os.pread(self._file.fileno(), (end - begin) * size, begin * size)
        return StoredFrames(content, self._senders)

    @cached_property
    def longest_way_ns(self) -> int:
        """The longest time from the release of a frame to its arrival, ns."""
        longest = 0
        for begin in range(0, self.frames, _AT_ONCE):
            count = min(_AT_ONCE, self.frames - begin)
            content = os.pread(self._file.fileno(), count * STORED.size, begin * STORED.size)
            times = np.frombuffer(content, _TIMES)
            longest = max(longest, int((times["arrival"] - times["released"]).max()))
        return longest

    def first_from(self, arrival_ns: int) -> int:
        """Return the index of the first frame that arrived at this instant or later."""
        return bisect_left(range(self.frames), arrival_ns, key=self._arrival_ns)

    def _arrival_ns(self, index: int) -> int:
        entry = os.pread(self._file.fileno(), _ARRIVAL.size, index * STORED.size)
        arrival: int = _ARRIVAL.unpack(entry)[0]
        return arrival

    def close(self) -> None:
        """Close the file."""
        self._file.close()
