"""Proportional valve with a closed centre: the path of its spool, as moves that the equations take."""

from __future__ import annotations

from cmath import sqrt
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import pi

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.devices.valve import ValveTiming

Move = tuple[int, float, float]
"""Instant [ns], opening, slope [1/s]."""


@dataclass(frozen=True)
class Spool:
    """Spool of a proportional 3/2 valve.

    Its position follows the signal s, 0 to 1, as x'' = w^2 (s - x) - 2 damping w x', w = 2 pi
    frequency_hz; with damping 0 as x' = w (s - x). Opening 1: supply, 0: atmosphere, 0.5: closed, as
    the spool is within `dead_zone` (a share of half its travel) of its middle; linear beyond.
    """

    frequency_hz: float
    damping: float
    dead_zone: float

    def opening(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the openings [n] at positions [n] of the spool, no unit; its ends limit it."""
        way = np.clip(2.0 * position - 1.0, -1.0, 1.0)
        share = np.maximum(np.abs(way) - self.dead_zone, 0.0) / (1.0 - self.dead_zone)
        return np.asarray(0.5 + 0.5 * np.sign(way) * share)

    def moves(
        self, signal: Sequence[tuple[int, float]], start: float, until_ns: int, creep_s: float
    ) -> Iterator[Move]:
        """Yield the moves by a signal (instant ns, value) from rest at `start`; creep_s: least time of the whole travel."""
        w = 2.0 * pi * self.frequency_hz
        # 100 moves per period of the natural frequency: straight between them within 0.05 %
        step_ns = max(1, round(NS_PER_S / (100 * self.frequency_hz)))
        root = sqrt(complex(self.damping**2 - 1.0)) or 1e-6
        fast, slow = -w * (self.damping + root), -w * (self.damping - root)
        if self.damping == 0.0:
            fast = slow = complex(-w)
        # after 10 time constants the spool has arrived, within 5e-5 of its step
        settled_ns = round((10.0 / -slow.real + creep_s) * NS_PER_S)
        position, speed = start, 0.0
        for (begin_ns, target), (end_ns, _) in pairwise([*signal, (until_ns, 0.0)]):
            lasts_ns = min(end_ns - begin_ns, settled_ns)
            instants = np.append(np.arange(0, lasts_ns, step_ns), lasts_ns)
            # x - target = a exp(slow t) + b exp(fast t)
            away = position - target
            a = away if fast == slow else (speed - fast * away) / (slow - fast)
            parts = np.exp(np.outer([slow, fast], instants / NS_PER_S)) * [[a], [away - a]]
            path = target + parts.sum(axis=0).real
            if creep_s > 0.0:
                path[0] = position
                for k, most in enumerate(np.diff(instants) / NS_PER_S / creep_s):
                    path[k + 1] = path[k] + min(max(path[k + 1] - path[k], -most), most)
            if lasts_ns < end_ns - begin_ns:
                path[-1] = target
            opening = self.opening(path)
            slopes = np.diff(opening) / np.diff(instants) * NS_PER_S
            yield from zip(
                (begin_ns + instants).tolist(),
                opening.tolist(),
                [*slopes.tolist(), 0.0],
                strict=True,
            )
            position, speed = float(path[-1]), float((slow * parts[0] + fast * parts[1])[-1].real)


def spool_moves(
    spool: Spool,
    timing: ValveTiming,
    commands: Sequence[tuple[int, float]],
    start: float,
    until_ns: int,
    creep_s: float,
) -> Iterator[Move]:
    """Yield the moves of one valve by commands (instant ns, signal), each after the valve's delay.

    A larger signal acts after the opening delay, a smaller one after the closing delay; one that overtakes another
    cancels it.
    """
    signal: list[tuple[int, float]] = []
    before = start
    for instant, value in commands:
        acts_ns = instant + (timing.rise_ns if value > before else timing.fall_ns)
        signal = [change for change in signal if change[0] < acts_ns]
        signal.append((acts_ns, value))
        before = value
    signal = [change for change in signal if change[0] < until_ns]
    yield from spool.moves(signal, start, until_ns, creep_s)
