"""Captures of a channel on which a lockstep run was coordinated.

Such a capture holds every frame up to twice, as the offer of its sender and as delivered, and the
control frames of the protocol in between. Only what was delivered is on the simulated bus; the
control frame BusTime before it gives its arrival in simulated time.
"""

from __future__ import annotations

from itertools import pairwise

from can_dbc.frame import EDP_BIT, PAGE_BITS, checksum
from sil.logs.format import Batch
from sil.logs.frame import LogFrame
from sil.logs.report import LogReport


class LockstepFilter:
    """Reduces the capture of a lockstep run to the frames delivered, at their simulated time.

    A log in which no BusTime is followed by its frame passes unchanged.
    """

    def __init__(self, report: LogReport) -> None:
        self._report = report
        self._active = False
        self._control: frozenset[int] = frozenset()
        self._bus_time = 0
        self._announced_by: LogFrame | None = None

    def take(self, batch: Batch) -> Batch:
        """Return the batch without the frames of the protocol."""
        if not self._active:
            ids = {frame[1] for frame in batch.frames}
            if not any(can_id & PAGE_BITS == PAGE_BITS for can_id in ids):
                return batch
            self._load_contract()
            self._active = any(
                self._is_control(first) and self._announces(first, second)
                for first, second in pairwise(batch.frames)
            )
            if not self._active:
                return batch
            self._report.time_base = "relative"
        pairs = zip(map(self._delivered, batch.frames), batch.locations, strict=True)
        delivered = [(frame, location) for frame, location in pairs if frame is not None]
        return Batch([frame for frame, _ in delivered], [location for _, location in delivered])

    def _load_contract(self) -> None:
        from can_dbc.contract import contract

        specs = contract().values()
        self._control = frozenset(s.can_id for s in specs if s.can_id & PAGE_BITS == PAGE_BITS)
        self._bus_time = next(s.can_id for s in specs if s.name == "BusTime")

    def _is_control(self, frame: LogFrame) -> bool:
        return frame.can_id in self._control and frame.extended and len(frame.data) == 8

    def _announces(self, control: LogFrame, frame: LogFrame) -> bool:
        """Whether a control frame is the BusTime of a data frame."""
        plain = frame.extended and not (frame.remote or frame.error or frame.fd)
        return (
            control.can_id == self._bus_time
            and plain
            and not frame.can_id & EDP_BIT
            and control.data[1] == checksum(frame.can_id, frame.data)
        )

    def _delivered(self, frame: LogFrame) -> LogFrame | None:
        left_out = self._report.lockstep
        if self._is_control(frame):
            left_out["control frames"] += 1
            if frame.can_id == self._bus_time:
                self._announced_by = frame
        elif frame.extended and frame.can_id & PAGE_BITS == EDP_BIT:
            left_out["offers, repeated when delivered"] += 1
        elif self._announced_by and self._announces(self._announced_by, frame):
            arrival_ns = int.from_bytes(self._announced_by.data[2:], "little")
            self._announced_by = None
            return frame._replace(time_ns=arrival_ns)
        else:
            left_out["frames of other programs"] += 1
        return None
