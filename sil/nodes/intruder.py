"""A node that does not belong on the bus: it babbles, repeats frames, forges frames."""

from __future__ import annotations

import random
from collections.abc import Sequence

from can_dbc import messages
from can_dbc.codec import can_id_of, spec_of
from can_dbc.frame import Frame, join_id
from sil.coupling.clock import NS_PER_S, to_ns
from sil.coupling.faults import INTRUDER, Babbling, Intrusion, Replayed, Spoofed, window_of
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits

STEP_NS = 1_000_000
_NS_PER_US = 1000
BABBLED_PGN = 0xFE20
SOURCE = 0xFB


class IntruderNode:
    """Sends the frames of a scenario's intrusion faults; wakes up every millisecond."""

    name = INTRUDER

    def __init__(self, faults: Sequence[Intrusion], bitrate: int, seed: int) -> None:
        self._acts = [
            _Act(fault, NS_PER_S // bitrate, random.Random(f"{seed}:intruder:{index}"))
            for index, fault in enumerate(faults)
        ]
        self._next_ns = 0

    def start(self) -> int:
        """Return the instant at which it first wakes up, ns."""
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Release the frames of the millisecond that begins at `until_ns`."""
        if until_ns < self._next_ns:  # the run ends within a millisecond
            return [], self._next_ns
        self._next_ns = until_ns + STEP_NS
        released = [
            pair for act in self._acts for pair in act.released(until_ns, self._next_ns, deliveries)
        ]
        return sorted(released), self._next_ns

    def close(self) -> None:
        """Do nothing: the node holds no resources."""


class _Act:
    """One fault with its state."""

    def __init__(self, fault: Intrusion, bit_ns: int, generator: random.Random) -> None:
        self._fault = fault
        self._window = window_of(fault)
        self._bit_ns = bit_ns
        self._random = generator
        self._owed_ns = 0.0
        self._sent = 0

    def released(
        self, begin_ns: int, end_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> list[tuple[int, Frame]]:
        """Return the frames released from begin to before end, with their instants, ns."""
        fault = self._fault
        if isinstance(fault, Replayed):
            late_ns = to_ns(fault.delay_s)
            can_id = can_id_of(getattr(messages, fault.message))
            return [
                (at + late_ns, frame)
                for at, frame in deliveries
                if frame.can_id == can_id and self._window.holds(at)
            ]
        if isinstance(fault, Spoofed):
            return self._forged(fault, begin_ns, end_ns)
        return self._babbled(fault, begin_ns)

    def _forged(self, fault: Spoofed, begin_ns: int, end_ns: int) -> list[tuple[int, Frame]]:
        kind = getattr(messages, fault.message)
        period_ns = to_ns(fault.period_s)
        found = []
        while (at := self._window.start_ns + self._sent * period_ns) < end_ns:
            self._sent += 1
            if at < begin_ns or not self._window.holds(at):
                continue
            frame = Frame(can_id_of(kind), self._random.randbytes(spec_of(kind).length))
            found.append((at, frame))
        return found

    def _babbled(self, fault: Babbling, begin_ns: int) -> list[tuple[int, Frame]]:
        found = []
        if self._window.holds(begin_ns):
            self._owed_ns += fault.load * STEP_NS
        while self._owed_ns > 0.0 and self._window.holds(begin_ns):
            can_id = join_id(fault.priority, BABBLED_PGN, SOURCE)
            frame = Frame(can_id, self._random.randbytes(8))
            bits = frame_bits(frame.can_id, frame.data) + INTERMISSION_BITS
            self._owed_ns -= bits * self._bit_ns
            at_ns = begin_ns + self._random.randrange(STEP_NS // _NS_PER_US) * _NS_PER_US
            found.append((at_ns, frame))
        return found
