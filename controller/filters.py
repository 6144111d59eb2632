"""Butterworth low-pass, designed in closed form and run as second-order sections."""

from __future__ import annotations

import math
from typing import NamedTuple


class Section(NamedTuple):
    """One section (b0 + b1 z^-1 + b2 z^-2)/(1 + a1 z^-1 + a2 z^-2) with unit gain at rest."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


def butterworth(order: int, fc_hz: float, rate_hz: float) -> tuple[Section, ...]:
    """Design a digital Butterworth low-pass by the bilinear transform, prewarped at the cut-off.

    K = tan(pi fc/rate), pole pairs s^2 + s/Q_k + 1, 1/Q_k = 2 sin((2k - 1) pi/(2 n)): each gives b = K^2 (1, 2, 1)/D,
    a1 = 2 (K^2 - 1)/D, a2 = (1 - K/Q + K^2)/D, D = 1 + K/Q + K^2; an odd order adds K (1 + z^-1)/((1 + K) + (K - 1)
    z^-1). Raises ValueError for an order below 1 or a cut-off outside (0, rate/2). Source: textbook bilinear design.
    """
    if order < 1 or not 0.0 < fc_hz < 0.5 * rate_hz:
        raise ValueError(f"no Butterworth low-pass of order {order}, {fc_hz} Hz at {rate_hz} Hz")
    k = math.tan(math.pi * fc_hz / rate_hz)
    sections = []
    for pair in range(1, order // 2 + 1):
        damping = 2.0 * math.sin((2 * pair - 1) * math.pi / (2 * order))
        scale = 1.0 / (1.0 + k * damping + k * k)
        gain = k * k * scale
        a1, a2 = 2.0 * (k * k - 1.0) * scale, (1.0 - k * damping + k * k) * scale
        sections.append(Section(gain, 2.0 * gain, gain, a1, a2))
    if order % 2:
        scale = 1.0 / (1.0 + k)
        sections.append(Section(k * scale, k * scale, 0.0, (k - 1.0) * scale, 0.0))
    return tuple(sections)


class SectionFilter:
    """A cascade of sections in transposed direct form II; 5 multiplications a section and step."""

    __slots__ = ("_sections", "_state")

    def __init__(self, sections: tuple[Section, ...]) -> None:
        self._sections = sections
        self._state = [(0.0, 0.0)] * len(sections)

    def settle(self, value: float) -> None:
        """Set the state of rest at a constant input and output, so that no start-up step shows."""
        for index, section in enumerate(self._sections):
            second = (section.b2 - section.a2) * value
            self._state[index] = ((1.0 - section.b0) * value, second)

    def update(self, value: float) -> float:
        """Take one sample and return the filtered one."""
        state = self._state
        for index, (b0, b1, b2, a1, a2) in enumerate(self._sections):
            first, second = state[index]
            out = b0 * value + first
            state[index] = (b1 * value - a1 * out + second, b2 * value - a2 * out)
            value = out
        return value
