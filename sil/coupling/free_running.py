"""Nodes that run by the wall clock, on a bus that carries their messages and nothing else.

A node steps at its own events by its own clock and sends a frame when it is due; it may start before
or after the others. Such a run cannot be repeated to the bit; its participants are those of a lockstep run.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection
from heapq import heappop, heappush
from itertools import count
from typing import Any

import can

from can_dbc.errors import InputError, RunError
from can_dbc.frame import MAX_ID, Frame
from can_dbc.instants import NS_PER_S
from sil.coupling.real_time import Pacer
from sil.coupling.transports.channel import Participant, silent
from sil.coupling.transports.local import LocalBus, RunEnded

STALE_NS = 100_000_000
"""A node that is later than this stood still; up to then it makes up for its steps. Frames that were
due longer ago are not sent."""


def open_bus(
    channel: str,
    wait_s: float = 0.0,
    say: Callable[[str], None] = silent,
    receives: Collection[int] | None = None,
    bitrate: int | None = None,
) -> can.BusABC:
    """Open a bus for a free-running node: `local:NAME`, waiting for it, or a CAN interface.

    `INTERFACE:CHANNEL`, as `pcan:PCAN_USBBUS1`, is one of python-can's. `receives`: identifiers (29
    bits) that the bus filters, where it can; None for all. `bitrate`: bit/s, set where it can be.
    Raises InputError for a channel that cannot exist, RunError when no local bus opens in time.
    """
    kind, colon, name = channel.partition(":")
    common: dict[str, Any] = {"can_mask": MAX_ID, "extended": True}
    filters: Any = receives and [{"can_id": can_id, **common} for can_id in receives]
    if kind != "local":
        logging.getLogger("can").addHandler(logging.NullHandler())  # drivers that are missing
        try:
            if colon:  # a filter of software ends recv
                return can.Bus(name, interface=kind, bitrate=bitrate)
            how = {"interface": "socketcan", "ignore_config": True}
            return can.Bus(channel, can_filters=filters, **how)
        except Exception as error:  # a driver that is missing: python-can has no one error for it
            why = " ".join(str((isinstance(error, OSError) and error.strerror) or error).split())
            raise InputError(
                f"channel {channel!r}: {why}; expected local:NAME, the name of a CAN interface "
                "that is up, or INTERFACE:CHANNEL of python-can"
            ) from None
    try:
        return LocalBus(name, filters, wait_s=wait_s, say=say)
    except can.CanInitializationError as error:
        raise error.__cause__ or error from None


def epoch_s(message: can.Message) -> float:
    """Return when a message arrived, s since 1970; by our clock, where the interface has another."""
    now_s = time.time_ns() / NS_PER_S
    return message.timestamp if abs(now_s - message.timestamp) < 60.0 else now_s


def frame_of(message: can.Message) -> Frame | None:
    """Return the frame of a classic data message with a 29-bit identifier, else None."""
    if not message.is_extended_id or message.is_remote_frame or message.is_fd:
        return None
    return None if message.is_error_frame else Frame(message.arbitration_id, bytes(message.data))


class FreeNode:
    """One participant on a bus, driven by the wall clock.

    A frame that arrived at or before an event counts for it, by the bus's time stamp. A node later than
    `STALE_NS` has missed steps; the plant, with `catches_up`, makes up for them without sending.
    """

    def __init__(
        self,
        participant: Participant,
        bus: can.BusABC,
        *,
        catches_up: bool,
        receives: Collection[int] | None = None,
        on_start: Callable[[int], None] = lambda zero_ns: None,
    ) -> None:
        """`receives`: identifiers, None for all; `on_start` receives the instant (ns since 1970) at which the node's clock is zero."""
        self._participant = participant
        self._bus = bus
        self._catches_up = catches_up
        self._receives = receives
        self._on_start = on_start
        self.pacer = Pacer()
        self._zero_ns = 0
        self._before_ns = 0
        self._inbox: deque[tuple[int, Frame]] = deque()
        self._due: list[tuple[int, int, Frame]] = []
        self._serial = count()
        self.counts: Counter[str] = Counter()
        """Frames sent and lost, steps missed and the like, by name."""

    def run(self, stop: threading.Event, duration_s: float | None = None) -> None:
        """Run for the duration, until `stop`, or a local bus ends. Raises RunError for a bus that is gone."""
        next_ns = self._participant.start()
        end_ns = None if duration_s is None else next_ns + round(duration_s * NS_PER_S)
        self.pacer.wait(next_ns, time.sleep)
        self._zero_ns = time.time_ns() - next_ns
        self._on_start(self._zero_ns)
        period_ns = 0
        self._before_ns = next_ns
        try:
            while not stop.is_set() and (end_ns is None or next_ns < end_ns):
                due_ns = self._due[0][0] if self._due else next_ns
                self.pacer.wait(min(due_ns, next_ns), time.sleep)
                self._send_due()
                now_ns = self.pacer.now_ns()
                if now_ns < next_ns:  # frames of the last step were due
                    continue
                if not self._catches_up and period_ns and now_ns - next_ns > STALE_NS:
                    missed = (now_ns - next_ns) // period_ns
                    self.counts["steps missed"] += missed
                    next_ns += missed * period_ns
                self._receive()
                released, following_ns = self._participant.advance(next_ns, self._arrived(next_ns))
                for release_ns, frame in released:
                    heappush(self._due, (release_ns, next(self._serial), frame))
                self._before_ns, period_ns, next_ns = next_ns, following_ns - next_ns, following_ns
                self._send_due()
        except RunEnded:
            return

    def report(self) -> str:
        """Return lateness and counts in one line."""
        late = self.pacer.lateness()
        figures = [f"{n} {name}" for name, n in sorted(self.counts.items())]
        return (
            f"{self._participant.name}: {', '.join(figures) or 'nothing sent'}; late by p50 "
            f"{1e3 * late.p50_s:.2f} ms, p99 {1e3 * late.p99_s:.2f} ms, max {1e3 * late.max_s:.2f} ms"
        )

    def _arrived(self, until_ns: int) -> list[tuple[int, Frame]]:
        """Return the frames for an event; one that came too late for the last event counts as of it."""
        arrivals = []
        while self._inbox and self._inbox[0][0] <= until_ns:
            arrival_ns, frame = self._inbox.popleft()
            arrivals.append((max(arrival_ns, self._before_ns), frame))
        return arrivals

    def _send_due(self) -> None:
        now_ns = self.pacer.now_ns()
        while self._due and self._due[0][0] <= now_ns:
            release_ns, _, frame = heappop(self._due)
            if now_ns - release_ns > STALE_NS:
                self.counts["frames too late to send"] += 1
                continue
            message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=True)
            try:
                self._bus.send(message)
                self.counts["frames sent"] += 1
            except can.CanOperationError as error:
                self._pass(error)
                self.counts["frames lost, the bus took none"] += 1

    def _receive(self) -> None:
        """Take what has arrived."""
        now_ns = self.pacer.now_ns()
        try:
            while (message := self._bus.recv(0.0)) is not None:
                if message.is_error_frame:
                    off = bool(message.arbitration_id & 0x40)  # CAN_ERR_BUSOFF of SocketCAN
                    self.counts["bus-off reports" if off else "error frames"] += 1
                elif (frame := frame_of(message)) is not None and (
                    self._receives is None or frame.can_id in self._receives
                ):
                    arrival_ns = round(epoch_s(message) * NS_PER_S) - self._zero_ns
                    last_ns = self._inbox[-1][0] if self._inbox else 0
                    self._inbox.append((max(last_ns, min(arrival_ns, now_ns)), frame))
        except can.CanOperationError as error:
            self._pass(error)

    @staticmethod
    def _pass(error: can.CanOperationError) -> None:
        """Tolerate an interface that is bus-off, down or full for a while.  Raises RunEnded as it is, RunError when the bus is gone."""
        if isinstance(error, RunEnded):
            raise error
        if error.error_code not in (errno.ENETDOWN, errno.ENOBUFS, errno.EAGAIN):
            raise RunError(f"the bus is gone: {error}") from None
