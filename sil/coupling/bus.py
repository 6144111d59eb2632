"""The simulated CAN bus: arbitration, exact frame lengths, bit rate, load.

Whenever the bus is idle, the frame with the lowest identifier among those released starts and is not
interrupted; it arrives everywhere at the end of its end-of-frame field; three bits of intermission
follow. Of an identifier with a mailbox, one frame waits per sender, overwritten by newer content.
Faults enter through `frame_filter` and `is_off`; without them the bus is perfect.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.instants import NS_PER_S
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits


class BusFrame(NamedTuple):
    """One frame as it crossed the bus: released by its sender, arrived at everybody else."""

    released_ns: int
    arrival_ns: int
    sender: str
    frame: Frame


class Transmission(NamedTuple):
    """A frame that has won the arbitration; from start to end of frame; `attempt` counts from 1."""

    start_ns: int
    end_ns: int
    frame: Frame
    sender: str
    released_ns: int
    attempt: int

    def delivered(self) -> tuple[BusFrame, ...]:
        """Return what a perfect bus delivers."""
        return (BusFrame(self.released_ns, self.end_ns, self.sender, self.frame),)


class ErrorFrame(NamedTuple):
    """All nodes rejected a transmission for its CRC; it is sent again with `retransmit`, else lost."""

    retransmit: bool = True


FrameFilter = Callable[[Transmission], Iterable[BusFrame] | ErrorFrame]
"""Called once per transmission, when its start is certain, in order of time.

Returns what arrives and when, never before `end_ns`: `transmission.delivered()`, changed or delayed
BusFrames or further ones, nothing for a frame that is lost unnoticed; or an ErrorFrame, which alone
changes the time that the frame takes on the bus."""

IsOff = Callable[[str, int], bool]
"""Whether a sender is bus-off at an instant in ns. Its released and waiting frames are dropped; one
already on the bus is left to the `frame_filter`."""


@dataclass(slots=True)
class BusStatistics:
    """Counts and times of a bus.

    `frames`: transmissions begun, among them `error_frames` that nobody accepted and `lost` that
    the filter let vanish; `dropped_...`, `overwritten`: never sent. `busy_ns`: time taken with
    intermissions. `sent`, `longest_wait_ns` (release to end of frame): by identifier, without errors.
    """

    frames: int = 0
    error_frames: int = 0
    lost: int = 0
    overwritten: int = 0
    dropped_bus_off: int = 0
    dropped_full: int = 0
    busy_ns: int = 0
    sent: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    longest_wait_ns: dict[int, int] = field(default_factory=lambda: defaultdict(int))


_Ready = tuple[int, int, int, Frame, str, int]
"""A released frame in the order of the bus: identifier, released [ns], serial, frame, sender, attempt."""


class BusModel:
    """A CAN bus in simulated time; the module docstring states the model.

    bitrate: bit/s, a bit lasting whole ns, or it raises InputError. capacity: frames that a sender may have waiting, None for no
    limit. mailboxes: identifiers of which only the newest content of a sender waits.
    """

    def __init__(
        self,
        bitrate: int = 500_000,
        frame_filter: FrameFilter | None = None,
        is_off: IsOff | None = None,
        capacity: int | None = None,
        mailboxes: Container[int] = (),
    ) -> None:
        if not 10_000 <= bitrate <= 1_000_000 or NS_PER_S % bitrate:
            rates = (
                "10000 to 1000000 with a bit of whole ns, such as 125000, 250000, 500000 or 1000000"
            )
            raise InputError(f"bus: bitrate: {bitrate} bit/s; expected {rates}")
        self.bitrate = bitrate
        self.bit_ns = NS_PER_S // bitrate
        self.statistics = BusStatistics()
        self._filter = frame_filter
        self._is_off = is_off
        self._capacity = capacity
        self._mailboxes = mailboxes
        self.now_ns = 0  # the instant up to which the bus has advanced
        self._free_ns = 0
        self._released_later: list[tuple[int, int, Frame, str]] = []
        self._ready: list[_Ready] = []
        self._arriving: list[tuple[int, int, BusFrame]] = []
        self._waiting: dict[str, int] = defaultdict(int)
        self._serial = 0

    @property
    def waiting(self) -> int:
        """Number of frames queued and not yet on the bus."""
        return len(self._ready) + len(self._released_later)

    @property
    def load(self) -> float:
        """Share of the time up to now in which the bus was busy or in intermission, 0 to 1."""
        if self.now_ns == 0:
            return 0.0
        still_to_come = max(0, self._free_ns - self.now_ns)
        return (self.statistics.busy_ns - still_to_come) / self.now_ns

    def queue(self, release_ns: int, frame: Frame, sender: str) -> None:
        """Hand over a frame released at `release_ns`; checked: 29-bit, not released in the past."""
        if self._capacity is not None and self._waiting[sender] >= self._capacity:
            self.statistics.dropped_full += 1
            return
        self._waiting[sender] += 1
        self._serial += 1
        heappush(self._released_later, (release_ns, self._serial, frame, sender))

    def advance(self, until_ns: int) -> list[BusFrame]:
        """Return all frames that arrive up to and at `until_ns`, in order of arrival.

        The frame that starts at `until_ns` is chosen by the next call, when all released then are known.
        """
        self.now_ns = until_ns
        released_later, ready = self._released_later, self._ready
        while ready or released_later:
            start_ns = self._free_ns
            if not ready and released_later[0][0] > start_ns:
                start_ns = released_later[0][0]
            if start_ns >= until_ns:
                break
            while released_later and released_later[0][0] <= start_ns:
                self._release(*heappop(released_later))
            if self._is_off is not None:
                self._drop_senders_off(start_ns, self._is_off)
            if ready:
                self._send(start_ns, heappop(ready))
        arriving = self._arriving
        arrived: list[BusFrame] = []
        while arriving and arriving[0][0] <= until_ns:
            arrived.append(heappop(arriving)[2])
        return arrived

    def _release(self, release_ns: int, serial: int, frame: Frame, sender: str) -> None:
        if self._is_off is not None and self._is_off(sender, release_ns):
            self._drop(sender)
            return
        entry = (frame.can_id, release_ns, serial, frame, sender, 1)
        if frame.can_id in self._mailboxes:
            for index, waiting in enumerate(self._ready):
                if waiting[0] == entry[0] and waiting[4] == sender:
                    self._ready[index] = entry
                    heapify(self._ready)
                    self.statistics.overwritten += 1
                    self._waiting[sender] -= 1
                    return
        heappush(self._ready, entry)

    def _drop(self, sender: str) -> None:
        self.statistics.dropped_bus_off += 1
        self._waiting[sender] -= 1

    def _drop_senders_off(self, now_ns: int, is_off: IsOff) -> None:
        off = {sender for sender in {entry[4] for entry in self._ready} if is_off(sender, now_ns)}
        for entry in self._ready:
            if entry[4] in off:
                self._drop(entry[4])
        if off:
            self._ready[:] = sorted(entry for entry in self._ready if entry[4] not in off)

    def _send(self, start_ns: int, entry: _Ready) -> None:
        can_id, released_ns, _, frame, sender, attempt = entry
        bits = frame_bits(can_id, frame.data)
        end_ns = start_ns + bits * self.bit_ns
        self._free_ns = end_ns + INTERMISSION_BITS * self.bit_ns
        statistics = self.statistics
        if self._filter is None:
            self._arrive(BusFrame(released_ns, end_ns, sender, frame))
        else:
            sent = Transmission(start_ns, end_ns, frame, sender, released_ns, attempt)
            verdict = self._filter(sent)
            if isinstance(verdict, ErrorFrame):
                self._reject(start_ns, bits, entry, verdict)
                return
            deliveries = tuple(verdict)
            for delivery in deliveries:
                self._arrive(delivery)
            statistics.lost += not deliveries
        self._waiting[sender] -= 1
        statistics.frames += 1
        statistics.busy_ns += self._free_ns - start_ns
        statistics.sent[can_id] += 1
        wait_ns = end_ns - released_ns
        if wait_ns > statistics.longest_wait_ns[can_id]:
            statistics.longest_wait_ns[can_id] = wait_ns

    def _arrive(self, delivery: BusFrame) -> None:
        self._serial += 1
        heappush(self._arriving, (delivery.arrival_ns, self._serial, delivery))

    def _reject(self, start_ns: int, bits: int, entry: _Ready, error: ErrorFrame) -> None:
        # instead of a frame's last 7 bits the longest error frame: flags of 12, delimiter 8, intermission 3
        self._free_ns = start_ns + (bits - 7 + 12 + 8 + 3) * self.bit_ns
        self.statistics.frames += 1
        self.statistics.error_frames += 1
        self.statistics.busy_ns += self._free_ns - start_ns
        if error.retransmit:
            heappush(self._ready, (*entry[:5], entry[5] + 1))
        else:
            self._waiting[entry[4]] -= 1
