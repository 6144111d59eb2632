"""Frames of other nodes that take a stated share of the bus."""

from __future__ import annotations

import random
from collections.abc import Sequence

from can_dbc.frame import Frame, join_id
from sil.coupling.clock import NS_PER_S
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits

WINDOW_NS = 10_000_000
FIRST_PGN = 0xFE00
NODES = 16
_NS_PER_US = 1000


class TrafficNode:
    """Sends 8-byte frames of J1939 broadcast groups at random instants, seeded by the scenario.

    Every 10 ms it releases as many frames as make up `load` (0..1) of the bus so far, spread over
    the next 10 ms in whole microseconds, from 16 source addresses.
    """

    name = "traffic"

    def __init__(self, load: float, priority: int, bitrate: int, seed: int) -> None:
        self._load = load
        self._priority = priority
        self._bit_ns = NS_PER_S // bitrate
        self._random = random.Random(f"{seed}:traffic")
        self._owed_ns = 0.0
        self._next_ns = 0

    def start(self) -> int:
        """Return the instant of the first window, ns."""
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Release the frames of the window that begins at `until_ns`."""
        if until_ns < self._next_ns:  # the run ends between two windows
            return [], self._next_ns
        self._next_ns = until_ns + WINDOW_NS
        self._owed_ns += self._load * WINDOW_NS
        released = []
        while self._owed_ns > 0.0:
            source = 0x80 + self._random.randrange(NODES)
            pgn = FIRST_PGN + self._random.randrange(NODES)
            frame = Frame(join_id(self._priority, pgn, source), self._random.randbytes(8))
            bits = frame_bits(frame.can_id, frame.data) + INTERMISSION_BITS
            self._owed_ns -= bits * self._bit_ns
            at_ns = until_ns + self._random.randrange(WINDOW_NS // _NS_PER_US) * _NS_PER_US
            released.append((at_ns, frame))
        return sorted(released), self._next_ns

    def close(self) -> None:
        """Do nothing: the node holds no resources."""
