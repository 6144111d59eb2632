"""The coordinator: owns simulated time and the bus, grants the participants their turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from can_dbc.errors import RunError
from sil.coupling.clock import NEVER_NS, to_seconds
from sil.coupling.real_time import Lateness, Pacer
from sil.coupling.transports.channel import Channel, InProcess, ParticipantLost, Turn
from sil.coupling.transports.wire import can_be_offered

if TYPE_CHECKING:
    from sil.coupling.bus import BusFrame, BusModel
    from sil.coupling.faults import FaultPlan

TURN_ORDER = ("driver", "controller", "plant")  # who queues first at equal instants


@dataclass(frozen=True)
class RunSummary:
    """The figures of a finished run; `lateness` in real time only."""

    turns: int
    frames: int
    wall_s: float
    lateness: Lateness | None


class Lockstep:
    """Runs participants over any channels in simulated time.

    A step at instant T, the earliest next event: the bus delivers what arrived up to and at T;
    everybody with an event at T is granted T; their frames enter the bus in the order of `TURN_ORDER`.
    At the end everybody is granted the end. Neither the wall clock nor the channels change the result.
    A context manager: leaving it ends participants and channels; before the end, as aborted.
    """

    def __init__(
        self,
        bus: BusModel,
        channels: Sequence[Channel],
        end_ns: int,
        *,
        record: Callable[[list[BusFrame]], None],
        outages: FaultPlan | None = None,
        pacer: Pacer | None = None,
        order: Sequence[str] = TURN_ORDER,
    ) -> None:
        """Prepare a run; `record` receives each step's deliveries. Each participant is on one channel."""
        names = [name for channel in channels for name in channel.names]
        self.names = tuple(name for name in order if name in names)
        self.now_ns = 0
        self.end_ns = end_ns
        self._bus = bus
        # Participants elsewhere are granted first: they work while ours do.
        self._channels = sorted(channels, key=lambda channel: isinstance(channel, InProcess))
        self._channel_of = {name: channel for channel in channels for name in channel.names}
        self._record = record
        self._outages = outages
        self._pacer = pacer
        self._next: dict[str, int] = {}
        self._turns = 0
        self._frames = 0
        self._wall_s = 0.0
        self._started = False
        self._finished = False

    def __enter__(self) -> Lockstep:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End participants and channels, aborted if unfinished. Raises RunError if one cannot close."""
        failures = []
        for channel in self._channels:
            try:
                channel.close(aborted=not self._finished)
            except RunError as error:
                failures.append(error)
        if failures and self._finished:
            raise failures[0]

    @property
    def warnings(self) -> list[str]:
        """Lines for the user about foreign frames, slow monitors and the like."""
        return [line for channel in self._channels for line in channel.warnings]

    def start(self) -> None:
        """Wait for all participants.  Raises ParticipantLost when one does not come in time."""
        self._started = True
        for channel in self._channels:
            for name, event_ns in channel.start(self.end_ns).items():
                self._next[name] = self._running_event(name, event_ns, -1, 0)

    def run(self) -> RunSummary:
        """Run from the present instant to the end.  Raises ParticipantLost, and RunError of the bus."""
        self.advance(self.end_ns - 1)
        self._timed_step(self.end_ns, [name for name in self.names if name in self._next])
        self._finished = True
        lateness = self._pacer.lateness() if self._pacer is not None else None
        return RunSummary(self._turns, self._frames, self._wall_s, lateness)

    def advance(self, until_ns: int) -> None:
        """Take all steps up to and at `until_ns`, which is before the end."""
        if not self._started:
            self.start()
        while (now_ns := min(self._next.values(), default=NEVER_NS)) <= until_ns:
            self._timed_step(
                now_ns, [name for name in self.names if self._next.get(name) == now_ns]
            )

    def _timed_step(self, now_ns: int, due: Sequence[str]) -> None:
        started = time.perf_counter()
        try:
            self._step(now_ns, due)
        except ParticipantLost as lost:
            raise lost.at(to_seconds(now_ns)) from lost.__cause__
        self._wall_s += time.perf_counter() - started

    def _step(self, now_ns: int, due: Sequence[str]) -> None:
        if deliveries := self._bus.advance(now_ns):
            self._frames += len(deliveries)
            self._record(deliveries)
            self._deliver(deliveries)
        if self._pacer is not None:
            self._pacer.wait(now_ns, self._idle)
        self.now_ns = now_ns
        turns: dict[str, Turn] = {}
        for channel in self._channels:
            channel.begin_turn(now_ns, due)
        for channel in self._channels:
            turns.update(channel.end_turn())
        for name in due:
            self._take(name, now_ns, turns[name])
        self._turns += len(due)

    def _deliver(self, deliveries: list[BusFrame]) -> None:
        if self._pacer is None and self._outages is None:
            for channel in self._channels:
                channel.deliver(deliveries)
            return
        for delivery in deliveries:
            if self._pacer is not None:
                self._pacer.wait(delivery.arrival_ns, self._idle)
            bus_off = self._outages.bus_off(delivery.arrival_ns) if self._outages else frozenset()
            for channel in self._channels:
                channel.deliver((delivery,), bus_off)

    def _take(self, name: str, now_ns: int, turn: Turn) -> None:
        frames, next_ns = turn
        for release_ns, frame in frames:
            if release_ns < now_ns or not can_be_offered(frame):
                expected = "a classic 29-bit frame with EDP clear, not released before the grant"
                what = f"released {frame} at {release_ns} ns, granted {now_ns} ns"
                raise ParticipantLost(name, f"{what}; expected {expected}")
            self._bus.queue(release_ns, frame, name)
        self._next[name] = self._running_event(name, next_ns, now_ns, next_ns - now_ns)
        if self._next[name] >= NEVER_NS > next_ns:
            del self._next[name]
            self._channel_of[name].retire(name)

    def _running_event(self, name: str, event_ns: int, now_ns: int, period_ns: int) -> int:
        """Return the participant's next event from `event_ns` on at which it runs."""
        if event_ns <= now_ns:
            what = f"named {event_ns} ns as its next event at {now_ns} ns; expected a later one"
            raise ParticipantLost(name, what)
        if self._outages is None:
            return event_ns
        return self._outages.next_event(name, event_ns, period_ns)

    def _idle(self, seconds: float) -> None:
        """Pass wall time, serving all channels."""
        deadline = time.monotonic() + seconds
        served = [c for c in self._channels if not isinstance(c, InProcess)] or self._channels
        while (left := deadline - time.monotonic()) > 0.0:
            share = left if len(served) < 2 else min(left, 0.02) / len(served)
            for channel in served:
                channel.idle(share)
