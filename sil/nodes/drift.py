"""A participant whose clock runs fast or slow, so that its ticks drift against all others."""

from __future__ import annotations

from collections.abc import Sequence

from can_dbc.frame import Frame
from sil.coupling.transports.channel import Participant

_MILLION = 1_000_000_000
_PER_PPM = 1000


class Drifting:
    """A participant whose own clock advances by `1 + ppm / 10^6` s per simulated second.

    Times are converted between the two clocks in whole numbers, so that a run repeats bit by bit.
    """

    def __init__(self, participant: Participant, ppm: float) -> None:
        self._inner = participant
        self._own = _MILLION + round(ppm * _PER_PPM)
        self._before_own_ns = self._next_own_ns = 0

    @property
    def name(self) -> str:
        """The participant's name."""
        return self._inner.name

    def start(self) -> int:
        """Return the simulated instant of its first event, ns."""
        self._before_own_ns = self._next_own_ns = self._inner.start()
        return self._simulated(self._next_own_ns)

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Advance the participant to what its own clock shows at `until_ns`."""
        due_ns = self._simulated(self._next_own_ns)
        own_ns = self._next_own_ns
        if until_ns < due_ns:
            own_ns = min(self._own_ns(until_ns), own_ns - 1)
        elif until_ns > due_ns:  # it was stalled: it wakes up at a tick of its own
            period_ns = max(1, self._next_own_ns - self._before_own_ns)
            own_ns += round((self._own_ns(until_ns) - own_ns) / period_ns) * period_ns
        heard = [(min(self._own_ns(at), own_ns), frame) for at, frame in deliveries]
        released, next_own_ns = self._inner.advance(own_ns, heard)
        self._before_own_ns, self._next_own_ns = own_ns, next_own_ns
        frames = [(max(until_ns, self._simulated(at)), frame) for at, frame in released]
        return frames, max(until_ns + 1, self._simulated(next_own_ns))

    def close(self) -> None:
        """Close the participant."""
        self._inner.close()

    def _own_ns(self, simulated_ns: int) -> int:
        return simulated_ns * self._own // _MILLION

    def _simulated(self, own_ns: int) -> int:
        """Return the first simulated ns at which the participant's clock shows `own_ns` or later."""
        return -(-own_ns * _MILLION // self._own)
