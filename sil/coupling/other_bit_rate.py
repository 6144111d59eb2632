"""A node on another bit rate: what the others on the bus experience."""

from __future__ import annotations

from typing import NamedTuple

from sil.coupling.bus import ErrorFrame, Transmission


class Window(NamedTuple):
    """From one instant to before another, ns."""

    start_ns: int
    end_ns: int

    def holds(self, instant_ns: int) -> bool:
        """Return whether the instant is inside."""
        return self.start_ns <= instant_ns < self.end_ns


class MisfitNode:
    """A node on another bit rate within a window of time, with its error counters.

    Each error that a receiver flags adds 1 and then 8 to its counter; from 128 on it is error-passive
    and disturbs no more. Each failed transmission adds 8 to a sender's; from 256 on it is bus-off
    (ISO 11898-1, fault confinement).
    Assumptions: none of the frames that it receives or sends passes by chance; bus-off is not
    recovered from.
    """

    def __init__(self, node: str, window: Window) -> None:
        self.node = node
        self.acts = window.holds
        self._receive_errors = self._send_errors = 0

    @property
    def is_off(self) -> bool:
        """Whether the node is bus-off."""
        return self._send_errors >= 256

    def verdict(self, transmission: Transmission) -> ErrorFrame | None:
        """Return the error frame in which a transmission ends, None if it does not."""
        if not self.acts(transmission.start_ns) or self.is_off:
            return None
        if transmission.sender == self.node:
            self._send_errors += 8
            return ErrorFrame(retransmit=not self.is_off)
        if self._receive_errors >= 128:
            return None
        self._receive_errors += 1 + 8
        return ErrorFrame()
