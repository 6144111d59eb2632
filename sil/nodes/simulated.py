"""Driver, other traffic and intruder of a scenario, and a participant whose clock drifts."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial

from can_dbc import messages
from can_dbc.codec import can_id_of, spec_of
from can_dbc.e2e import Protector
from can_dbc.frame import Frame, join_id
from can_dbc.instants import NS_PER_S
from can_dbc.messages import Gear, ShiftRequest
from sil.coupling.clock import next_tick, to_ns
from sil.coupling.faults import Babbling, Intrusion, Replayed, Sent, Spoofed, window_of
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits
from sil.coupling.transports.channel import Participant, Received, Turn

Released = list[tuple[int, Frame]]  # frames with their release instants, ns

INTRUDER_STEP_NS = 1_000_000


class Node:
    """A node that holds no resources and has its first event at the start of the run."""

    def start(self) -> int:
        """Return the instant of the first event, ns."""
        return 0

    def close(self) -> None:
        """Do nothing."""


class DriverNode(Node):
    """Sends a protected ShiftRequest every period; the gear it carries follows a schedule.

    A request is sent with the first frame at or after its instant.
    """

    name = "driver"

    def __init__(
        self, initial: Gear, schedule: Sequence[tuple[int, Gear]], period_ns: int, phase_ns: int = 0
    ) -> None:
        """`schedule`: instants in ns, ascending, and the gear requested from then on."""
        self._gear = initial
        self._schedule = list(schedule)
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        self._protector = Protector(ShiftRequest)

    def start(self) -> int:
        """Return the instant of the first frame, ns."""
        return self._phase_ns

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Send the frame that is due at `until_ns`; frames of others are ignored."""
        while self._schedule and self._schedule[0][0] <= until_ns:
            self._gear = self._schedule.pop(0)[1]
        following = next_tick(until_ns, self._period_ns, self._phase_ns)
        if until_ns < self._phase_ns or following - until_ns != self._period_ns:
            return [], following
        return [(until_ns, self._protector.protect(ShiftRequest(self._gear)))], following


class _Load:
    """8-byte frames at random instants, in whole microseconds, that take a share of the bus."""

    def __init__(
        self,
        share: float,
        window_ns: int,
        bitrate: int,
        draw: random.Random,
        can_id: Callable[[], int],
    ) -> None:
        self._owed_per_window_ns = share * window_ns
        self._instants = window_ns // 1000
        self._bit_ns = NS_PER_S // bitrate
        self._random = draw
        self._can_id = can_id
        self._owed_ns = 0.0

    def released(self, begin_ns: int) -> Released:
        """Return the frames of the window that begins at `begin_ns`."""
        frames: Released = []
        self._owed_ns += self._owed_per_window_ns
        while self._owed_ns > 0.0:
            frame = Frame(self._can_id(), self._random.randbytes(8))
            bits = frame_bits(frame.can_id, frame.data) + INTERMISSION_BITS
            self._owed_ns -= bits * self._bit_ns
            at_ns = begin_ns + self._random.randrange(self._instants) * 1000
            frames.append((at_ns, frame))
        return frames


class TrafficNode(Node):
    """Sends frames of J1939 broadcast groups at random instants, seeded by the scenario.

    Every 10 ms it releases as many frames as make up `load` (0..1) of the bus so far, spread over
    the next 10 ms, from 16 source addresses.
    """

    name = "traffic"

    def __init__(self, load: float, priority: int, bitrate: int, seed: int) -> None:
        draw = random.Random(f"{seed}:traffic")

        def can_id() -> int:
            source = 0x80 + draw.randrange(16)
            return join_id(priority, 0xFE00 + draw.randrange(16), source)

        self._load = _Load(load, 10_000_000, bitrate, draw, can_id)
        self._next_ns = 0

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Release the frames of the window that begins at `until_ns`."""
        if until_ns < self._next_ns:  # the run ends between two windows
            return [], self._next_ns
        self._next_ns = until_ns + 10_000_000
        return sorted(self._load.released(until_ns)), self._next_ns


class IntruderNode(Node):
    """Sends the frames of a scenario's intrusion faults; wakes up every millisecond."""

    name = "intruder"

    def __init__(self, faults: Sequence[Intrusion], bitrate: int, seed: int) -> None:
        draws = [random.Random(f"{seed}:intruder:{index}") for index in range(len(faults))]
        self._acts = [
            _Intrusion(fault, bitrate, draw) for fault, draw in zip(faults, draws, strict=True)
        ]
        self._next_ns = 0

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Release the frames of the millisecond that begins at `until_ns`."""
        if until_ns < self._next_ns:  # the run ends within a millisecond
            return [], self._next_ns
        self._next_ns = until_ns + INTRUDER_STEP_NS
        released = (pair for act in self._acts for pair in act.released(until_ns, deliveries))
        return sorted(released), self._next_ns


class _Intrusion:
    """One fault of the intruder with its state."""

    def __init__(self, fault: Intrusion, bitrate: int, draw: random.Random) -> None:
        self._fault = fault
        self._window = window_of(fault)
        self._random = draw
        if isinstance(fault, Babbling):
            can_id = join_id(fault.priority, 0xFE20, source=0xFB)
            self._load = _Load(fault.load, INTRUDER_STEP_NS, bitrate, draw, partial(int, can_id))

    def released(self, begin_ns: int, deliveries: Received) -> Released:
        """Return the frames released in the step that begins at `begin_ns`."""
        fault = self._fault
        if isinstance(fault, Replayed):
            late_ns = to_ns(fault.delay_s)
            can_id = can_id_of(getattr(messages, fault.message))
            repeated = (pair for pair in deliveries if pair[1].can_id == can_id)
            return [(at + late_ns, frame) for at, frame in repeated if self._window.holds(at)]
        if isinstance(fault, Spoofed):
            return self._forged(fault, begin_ns)
        if isinstance(fault, Sent):
            at = self._window.start_ns
            frame = Frame(fault.can_id, bytes.fromhex(fault.data))
            return [(at, frame)] if begin_ns <= at < begin_ns + INTRUDER_STEP_NS else []
        return self._load.released(begin_ns) if self._window.holds(begin_ns) else []

    def _forged(self, fault: Spoofed, begin_ns: int) -> Released:
        kind = getattr(messages, fault.message)
        start_ns, period_ns = self._window.start_ns, to_ns(fault.period_s)
        first_ns = start_ns + max(0, -((start_ns - begin_ns) // period_ns)) * period_ns
        draw, length = self._random.randbytes, spec_of(kind).length
        instants = filter(
            self._window.holds, range(first_ns, begin_ns + INTRUDER_STEP_NS, period_ns)
        )
        return [(at, Frame(can_id_of(kind), draw(length))) for at in instants]


class Drifting:
    """A participant whose own clock begins at `start_ns` and advances by `1 + ppm / 10^6` s per simulated second.

    Times are converted between the two clocks in whole numbers, so that a run repeats bit by bit.
    """

    def __init__(self, participant: Participant, ppm: float, start_ns: int = 0) -> None:
        self.name = participant.name
        self.close = participant.close
        self.inner = participant
        self._own = NS_PER_S + round(ppm * 1000)
        self._start_ns = start_ns
        self._before_own_ns = self._next_own_ns = 0

    def start(self) -> int:
        """Return the simulated instant of its first event, ns."""
        self._before_own_ns = self._next_own_ns = self._start_ns + self.inner.start()
        return self._simulated(self._next_own_ns)

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Advance the participant to what its own clock shows at `until_ns`."""
        due_ns = self._simulated(self._next_own_ns)
        own_ns = self._next_own_ns
        if until_ns < due_ns:
            own_ns = min(self._own_ns(until_ns), own_ns - 1)
        elif until_ns > due_ns:  # it was stalled: it wakes up at a tick of its own
            period_ns = max(1, self._next_own_ns - self._before_own_ns)
            own_ns += round((self._own_ns(until_ns) - own_ns) / period_ns) * period_ns
        received = [(min(self._own_ns(at), own_ns), frame) for at, frame in deliveries]
        released, next_own_ns = self.inner.advance(own_ns, received)
        self._before_own_ns, self._next_own_ns = own_ns, next_own_ns
        frames = [(max(until_ns, self._simulated(at)), frame) for at, frame in released]
        return frames, max(until_ns + 1, self._simulated(next_own_ns))

    def _own_ns(self, simulated_ns: int) -> int:
        return self._start_ns + simulated_ns * self._own // NS_PER_S

    def _simulated(self, own_ns: int) -> int:
        """Return the first simulated ns at which the participant's clock shows `own_ns` or later."""
        return -((self._start_ns - own_ns) * NS_PER_S // self._own)
