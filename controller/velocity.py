"""Velocity from the last two position samples."""

from __future__ import annotations


class TwoSampleVelocity:
    """Difference of two samples over their distance, v = (x_k - x_(k-1))/T.

    It is half a sample period older than the position (thesis 4.2.1: the second sample costs
    10 ms). Checked by test_velocity.
    """

    __slots__ = ("_last_m", "_rate_hz")

    def __init__(self, period_s: float) -> None:
        self._rate_hz = 1.0 / period_s
        self._last_m = 0.0

    def settle(self, position_m: float) -> None:
        """Start at rest at a position, m."""
        self._last_m = position_m

    def update(self, position_m: float) -> float:
        """Take the next sample, m, and return the velocity, m/s."""
        velocity_m_s = (position_m - self._last_m) * self._rate_hz
        self._last_m = position_m
        return velocity_m_s
