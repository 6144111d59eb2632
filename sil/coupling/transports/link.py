"""A participant in its own process: its end of the channel, and its main loop."""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence

from can_dbc.errors import InputError, RunError
from can_dbc.frame import EDP_BIT, Frame, checksum
from can_dbc.messages import StopReason
from sil.coupling.transports import address, wire
from sil.coupling.transports.channel import Participant, Received, silent
from sil.coupling.transports.socketcan import PARTICIPANT_VIEW, CanSocket, lifeline_address
from sil.coupling.transports.wire import Kind


class LocalLink:
    """The link to a `Hub`, for which it waits as `address.connect` does."""

    hello_again_s = math.inf  # time after which an unanswered Hello is repeated

    def __init__(
        self, channel: str, start_timeout_s: float, say: Callable[[str], None] = silent
    ) -> None:
        self._path = address.socket_path(channel)
        self._buffer = bytearray(wire.LONGEST_BATCH * wire.RECORD_BYTES)
        self._socket = address.connect(channel, start_timeout_s, say)

    def read(self, timeout_s: float | None) -> list[tuple[int, bytes]]:
        """Return the next records, none in time. Raises RunError when the coordinator is gone."""
        try:
            self._socket.settimeout(timeout_s)
            length = self._socket.recv_into(self._buffer)
        except TimeoutError:
            return []
        except OSError as error:
            raise RunError(f"{self._path}: {error.strerror}: the coordinator is gone") from None
        if length == 0:
            raise RunError(f"{self._path}: the coordinator is gone")
        try:
            with memoryview(self._buffer) as view:
                return list(wire.split(view[:length]))
        except wire.WireError as error:
            raise RunError(f"{self._path}: not the coordinator of a run: {error}") from None

    def write(self, records: Sequence[bytes]) -> None:
        """Send records.  Raises RunError when the coordinator is gone."""
        try:
            self._socket.settimeout(None)
            for start in range(0, len(records), wire.LONGEST_BATCH):
                self._socket.send(b"".join(records[start : start + wire.LONGEST_BATCH]))
        except OSError as error:
            raise RunError(f"{self._path}: {error.strerror}: the coordinator is gone") from None

    def welcomed(self, number: int) -> None:
        """Do nothing: the connection itself shows who is alive."""

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class CanLink:
    """The link to a `SocketCan` coordinator. Raises InputError for a channel that does not exist."""

    hello_again_s = 0.1

    def __init__(self, interface: str) -> None:
        self._can = CanSocket(interface, PARTICIPANT_VIEW)
        self._lifeline: socket.socket | None = None
        self._poll = select.poll()
        self._poll.register(self._can.fileno(), select.POLLIN)

    def read(self, timeout_s: float | None) -> list[tuple[int, bytes]]:
        """Return the next record.  Raises RunError when the coordinator is gone."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            received = self._can.receive()
            if received is not None:
                return [received]
            left = None if deadline is None else max(0.0, deadline - time.monotonic()) * 1000.0
            ready = self._poll.poll(left)
            if not ready:
                return []
            if all(fileno != self._can.fileno() for fileno, _ in ready):
                received = self._can.receive()  # its Stop may have come just before
                if received is not None:
                    return [received]
                raise RunError(f"channel {self._can.interface!r}: the coordinator is gone")

    def write(self, records: Sequence[bytes]) -> None:
        """Send records."""
        self._can.send(b"".join(records))

    def welcomed(self, number: int) -> None:
        """Connect to the coordinator's lifeline. Raises RunError when it is not on this machine."""
        self._lifeline = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._lifeline.connect(lifeline_address(self._can.interface))
            self._lifeline.send(bytes([number]))
        except OSError as error:
            what = f"its coordinator is not reached by Unix socket ({error.strerror})"
            expected = "expected one on this machine"
            raise RunError(f"channel {self._can.interface!r}: {what}; {expected}") from None
        self._poll.register(self._lifeline.fileno(), select.POLLIN)

    def close(self) -> None:
        """Close the channel and the lifeline."""
        self._can.close()
        if self._lifeline is not None:
            self._lifeline.close()


Link = LocalLink | CanLink  # moves records between a participant and its coordinator


class Session:
    """One participant's exchange with its coordinator. Raises InputError for an unknown name."""

    def __init__(self, name: str, link: Link, scenario: int = 0) -> None:
        if name not in wire.PARTICIPANTS:
            raise InputError(f"participant {name!r}: expected {', '.join(wire.PARTICIPANTS)}")
        self.name = name
        self.ending: StopReason | None = None
        self._number = wire.PARTICIPANTS[name]
        self._link = link
        self._scenario = scenario
        self._received = 0
        self._inbox: list[tuple[int, Frame]] = []
        self._announced: wire.Control | None = None
        self._records: deque[tuple[int, bytes]] = deque()
        self._skip = False
        self._now_ns = 0
        self._first_event_ns = 0

    def join(
        self, first_event_ns: int, timeout_s: float, say: Callable[[str], None] = silent
    ) -> None:
        """Send Hello until it is answered, `first_event_ns` at the start; `say` takes that it waits.

        Raises InputError when refused, RunError when nobody answers in time.
        """
        nonce = int.from_bytes(os.urandom(2), "little")
        hello = wire.control(Kind.HELLO, self._number, wire.VERSION, nonce | self._scenario << 16)
        deadline = time.monotonic() + timeout_s
        next_hello = 0.0
        say_at = time.monotonic() + 0.3
        while (now := time.monotonic()) <= deadline:
            if now >= say_at:
                say_at = math.inf
                say(f"waiting up to {timeout_s:g} s for a run that needs {self.name}")
            if now >= next_hello:
                self._link.write([hello])
                next_hello = now + self._link.hello_again_s
            self._records.extend(self._link.read(max(0.0, min(deadline, next_hello, say_at) - now)))
            while self._records:
                control = self._parse(*self._records.popleft())
                if control is None or control[1::2] != (self._number, nonce):
                    continue
                if control.kind == Kind.REFUSED:
                    raise InputError(f"{self.name}: refused: {wire.reason(control.extra)}")
                if control.kind == Kind.WELCOME:
                    self._link.welcomed(self._number)
                    self._first_event_ns = first_event_ns
                    return
        raise RunError(f"{self.name}: no run answered within {timeout_s:g} s")

    def next_grant(self) -> tuple[int, Received] | None:
        """Wait for a grant; return its instant (ns) and the frames since the last one.

        None at the end of the run, see `ending`. Raises RunError for a lost coordinator or frame.
        """
        while True:
            while self._records:
                can_id, payload = self._records.popleft()
                if not can_id & EDP_BIT:
                    self._receive(can_id, payload)
                    continue
                control = self._parse(can_id, payload)
                if control is None:
                    continue
                if control.kind == Kind.BUS_TIME:
                    if self._announced is not None:
                        raise self._lost_frames()
                    self._announced = control
                elif control.kind == Kind.START:
                    done = wire.control(Kind.DONE, self._number, 0, self._first_event_ns)
                    self._link.write([done])
                elif control.kind == Kind.STOP:
                    regular = control.participant == StopReason.END
                    self.ending = StopReason.END if regular else StopReason.ABORTED
                    return None
                elif control.participant != self._number:
                    continue
                elif control.kind == Kind.SKIP:
                    self._skip = True
                elif control.kind == Kind.SYNC:
                    self._link.write([wire.control(Kind.ACK, self._number)])
                elif control.kind == Kind.GRANT:
                    if self._announced is not None or control.extra != self._received & 0xFF:
                        raise self._lost_frames()
                    self._received = 0
                    self._now_ns = control.value
                    inbox, self._inbox = self._inbox, []
                    return control.value, inbox
            self._records.extend(self._link.read(None))

    def answer(self, frames: Sequence[tuple[int, Frame]], next_ns: int) -> None:
        """Offer frames at their release instants (ns), name the next event. Raises ValueError."""
        records = []
        release_ns = self._now_ns
        for instant_ns, frame in frames:
            if instant_ns < self._now_ns or not wire.can_be_offered(frame):
                raise ValueError(f"{self.name} at {self._now_ns} ns: {frame} at {instant_ns} ns")
            if instant_ns != release_ns:
                release_ns = instant_ns
                records.append(wire.control(Kind.RELEASE, self._number, value=release_ns))
            records.append(wire.offer(frame))
        records.append(wire.control(Kind.DONE, self._number, len(frames), next_ns))
        self._link.write(records)

    def fail(self) -> None:
        """Report to the coordinator that this participant cannot go on."""
        self._link.write([wire.control(Kind.FAILED, self._number)])

    def _parse(self, can_id: int, payload: bytes) -> wire.Control | None:
        """Return the control frame, or None for another frame or one that is malformed."""
        try:
            return wire.parse_control(can_id, payload)
        except wire.WireError:
            return None

    def _receive(self, can_id: int, payload: bytes) -> None:
        """Accept the frame if it is the announced one and was sent by another participant."""
        announced = self._announced
        if announced is None or announced.extra != checksum(can_id, payload):
            return
        self._announced = None
        skip, self._skip = self._skip, False
        if announced.participant != self._number and not skip:
            self._received += 1
            self._inbox.append((announced.value, Frame(can_id, payload)))

    def _lost_frames(self) -> RunError:
        return RunError(f"{self.name}: frames were lost between the coordinator and this process")


def open_link(
    channel: str, start_timeout_s: float = 60.0, say: Callable[[str], None] = silent
) -> Link:
    """Return the link to a run: `local:NAME` (waits for its hub, which `say` takes), or a CAN interface's name.

    Raises InputError for a channel that cannot exist, RunError when no hub comes in time.
    """
    kind, _, name = channel.partition(":")
    return LocalLink(name, start_timeout_s, say) if kind == "local" else CanLink(channel)


def take_part(
    participant: Participant,
    link: Link,
    *,
    scenario: int = 0,
    start_timeout_s: float = 60.0,
    say: Callable[[str], None] = silent,
) -> None:
    """Run one participant from Hello to Stop; the main loop of `opc4 node`.

    `scenario`: its number, or 0 for any. `say` takes the message that no run has answered yet.
    Participant and link are closed in any case. Raises InputError when refused, RunError when the
    coordinator dies or ends the run early, and what the participant raises.
    """
    with contextlib.ExitStack() as closing:
        closing.callback(link.close)
        closing.callback(participant.close)
        session = Session(participant.name, link, scenario)
        first_ns = participant.start()
        session.join(first_ns, start_timeout_s, say)
        while (grant := session.next_grant()) is not None:
            try:
                session.answer(*participant.advance(*grant))
            except Exception:
                with contextlib.suppress(RunError):  # the first error is the one to report
                    session.fail()
                raise
        if session.ending == StopReason.ABORTED:
            raise RunError(f"{participant.name}: the coordinator ended the run early")
