"""From pulses of the commands to moves of the valves' plungers, for many policies at once.

Checked by: tests/unit/sil/studies/test_policies.py
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def stem_spans(stems: Floats) -> tuple[Floats, Floats]:
    """Return begins and ends [..., pulses] in s of the pulses of stems [..., variables] in 10 ms."""
    start, length = 0.01 * stems[..., 0::2], 0.01 * stems[..., 1::2]
    return np.maximum(start, 0.0), start + length


def changes(begin: Floats, end: Floats) -> Floats:
    """Return when the union of pulses [runs, k] in s begins and ends, in turn, infinite times last.

    At a begin one more pulse is on, at an end one less: the union changes where that count leaves or
    reaches zero. A pulse that ends before it begins is none.
    """
    none = end <= begin
    time_s = np.where(np.hstack([none, none]), np.inf, np.hstack([begin, end]))
    step = np.hstack([np.ones_like(begin), -np.ones_like(end)])
    order = np.lexsort((-step, time_s))  # at the same instant, begins first
    time_s, step = (np.take_along_axis(rows, order, axis=1) for rows in (time_s, step))
    after = np.cumsum(step, axis=1)
    changed = (after == 0) | (after - step == 0)
    found = np.sort(np.where(changed, time_s, np.inf), axis=1)
    return found[:, : max(1, int(np.isfinite(found).sum(axis=1).max(initial=0)))]


def valve_switches(
    given: list[Floats], limit_s: Floats, rise_s: float | Floats, fall_s: float | Floats
) -> Floats:
    """Return the switches [runs, k, 4] of `Strokes` for changes of the commands (B, N, F) [runs, j], s.

    rise_s, fall_s: delays of all valves, or [runs], or [3, runs] for each valve. B is on from 0 s.
    At the limit [runs] all commands return to the plain push.
    """
    plungers = []
    rises_s, falls_s = (np.broadcast_to(each, (3, len(limit_s))) for each in (rise_s, fall_s))
    for chamber, times in enumerate(given):
        coil = np.where(times < limit_s[:, None], times, np.inf)
        odd = np.isfinite(coil).sum(axis=1) % 2 == 1
        back = np.where(odd, limit_s, np.inf)[:, None]
        start = np.zeros((len(coil), 1 if chamber == 0 else 0))
        coil = np.sort(np.hstack([start, coil, back]), axis=1)
        time_s, position = plunger_moves(coil, rises_s[chamber], falls_s[chamber])
        plungers.append(np.stack([time_s, np.full_like(time_s, chamber), position], axis=2))
    switches = np.concatenate(plungers, axis=1)
    order = np.argsort(switches[:, :, 0], axis=1, kind="stable")[:, :, None]
    switches = np.take_along_axis(switches, order, axis=1)
    needed = max(1, int(np.isfinite(switches[:, :, 0]).sum(axis=1).max()))
    return np.concatenate([switches[:, :needed], np.zeros((len(switches), needed, 1))], axis=2)


def plunger_moves(
    commands: Floats, rise_s: float | Floats, fall_s: float | Floats
) -> tuple[Floats, Floats]:
    """Return times [runs, k] in s and positions (1 open) of a valve's plunger, as `Valve` moves it.

    commands [runs, k]: instants in s at which the coil changes, the first one on, ascending,
    infinite ones last. A change that is reversed before the plunger moved has no effect.
    """
    due = np.full(len(commands), np.inf)
    on = np.zeros(len(commands), dtype=np.bool_)
    times, positions = [], []
    for change in [*commands.T, np.full(len(commands), math.inf)]:
        moves = due <= change
        times.append(np.where(moves, due, np.inf))
        positions.append(on.astype(np.float64))
        due = np.where(moves, np.inf, due)
        given = np.isfinite(change)
        on = on ^ given
        delay_s = np.where(on, rise_s, fall_s)
        due = np.where(given, np.where(np.isfinite(due), np.inf, change + delay_s), due)
    return np.array(times).T, np.array(positions).T
