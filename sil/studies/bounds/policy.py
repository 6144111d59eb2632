"""A policy: pulses of the valves that know no load, and pulses that answer the release.

The stem is the plain push with pulses at fixed times: closures of B, openings of N and F. The information
delay after the release, what is left of it is cancelled, and pulses follow whose starts and lengths are
piecewise linear in the instant of release. Values: for each valve the starts of the stem's pulses, then
their lengths; then for each valve the same of the answer, for each knot. Their unit is 10 ms; a length
counts from that of the shortest pulse that moves the plunger.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from plant.effects.stroke_conditions import FULL_DUTY
from sil.studies.policies import Bools, Commands, Floats, Ints

STEM = {"B": 3, "N": 4, "F": 2}
ANSWER = {"B": 1, "N": 2, "F": 1}
STEM_SIZE = 2 * sum(STEM.values())
NO_PULSE = -1.0  # length of a pulse that is not there, in units of a policy
Edges = Mapping[str, Floats]
"""When the command of each valve changes, [strokes, changes] in s; at first it is off."""


class SwitchingDelays(NamedTuple):
    """Delays in s from a command to the plunger's move."""

    rise_s: float
    fall_s: float


def places_of(valves: Iterable[str], knots: int) -> tuple[Ints, Ints]:
    """Return where a policy has its values of some valves: of the stem [k], of the answer [knots, k]."""
    stem, answer, begin, answer_begin = [], [], 0, STEM_SIZE
    for valve, n in STEM.items():
        size, answer_size = 2 * n, 2 * ANSWER[valve]
        if valve in valves:
            stem.append(np.arange(begin, begin + size))
            places = np.arange(answer_begin, answer_begin + knots * answer_size)
            answer.append(places.reshape(knots, answer_size))
        begin, answer_begin = begin + size, answer_begin + knots * answer_size
    return np.concatenate(stem), np.concatenate(answer, axis=1)


def edges_of(
    values: Floats,
    knots_s: Sequence[float],
    release_s: Floats,
    delay_s: float,
    timing: SwitchingDelays,
) -> Edges:
    """Return the commands of policies [policies, size] for releases [policies, strokes] in s.

    knots_s: instants of release between which the answer is linear; none: there is no answer.
    """
    known_s, edges = (release_s + delay_s)[..., None], {}
    for valve in STEM:
        stem, answer = places_of(valve, len(knots_s))
        shortest_s = timing.fall_s if valve == "B" else timing.rise_s
        parts = [np.zeros_like(known_s)] if valve == "B" else []
        pulses = values[:, None, stem].reshape(len(values), 1, 2, -1)
        parts.append(np.minimum(_pulses(pulses, shortest_s), known_s))
        if len(knots_s):
            pulses = at_releases(values[:, answer], knots_s, release_s)
            pulses = pulses.reshape(*release_s.shape, 2, -1)
            parts.append(known_s + _pulses(pulses, shortest_s))
        each = np.concatenate(parts, axis=2)
        edges[valve] = each.reshape(-1, each.shape[-1])
    return edges


def at_releases(knots: Floats, knots_s: Sequence[float], release_s: Floats) -> Floats:
    """Return values [policies, knots, k] at releases [policies, strokes] in s, linear in between."""
    at = np.array(knots_s)
    left = np.clip(np.searchsorted(at, release_s, side="right") - 1, 0, max(len(at) - 2, 0))
    right = np.minimum(left + 1, len(at) - 1)
    part = (release_s - at[left]) / np.where(right > left, at[right] - at[left], 1.0)
    part = np.clip(part, 0.0, 1.0)[..., None]
    row = np.arange(len(knots))[:, None]
    between: Floats = (1.0 - part) * knots[row, left] + part * knots[row, right]
    return between


def _pulses(values: Floats, shortest_s: float) -> Floats:
    """Return begin and end of pulses [..., 2 pulses] in s, ascending; one that another cuts ends there."""
    start_s = 0.01 * np.maximum(values[..., 0, :], 0.0)
    length_s = np.maximum(shortest_s + 0.01 * values[..., 1, :], 0.0)
    order = np.argsort(start_s, axis=-1, kind="stable")
    start_s, length_s = (np.take_along_axis(each, order, axis=-1) for each in (start_s, length_s))
    end_s = start_s + length_s
    end_s[..., :-1] = np.minimum(end_s[..., :-1], start_s[..., 1:])
    return np.stack([start_s, end_s], axis=-1).reshape(*start_s.shape[:-1], -1)


def _is_last(edges: Floats, k: int) -> Bools:
    """Return whether change k of [strokes, changes] is the last of its instant."""
    last: Bools = edges[:, k] < (edges[:, k + 1] if k + 1 < edges.shape[1] else np.inf)
    return last


def switches_of(edges: Edges, rise_s: Floats, fall_s: Floats) -> Floats:
    """Return the plungers' moves [strokes, k, 4] as `plant.batch.batch.Strokes` has them.

    rise_s, fall_s: [strokes, 3] in s. The same as `plant.devices.valve.switch_schedule`, for many.
    """
    rows = []
    for chamber, at in enumerate(edges.values()):
        is_open = np.zeros(len(at), dtype=np.bool_)
        energised, move_s = is_open, np.full(len(at), np.inf)
        for k in range(at.shape[1] + 1):
            now_s = at[:, k] if k < at.shape[1] else np.full(len(at), 1e9)
            due = move_s <= now_s
            is_open = is_open ^ due
            still = np.zeros(len(at))
            rows.append([np.where(due, move_s, np.inf), still + chamber, is_open, still])
            move_s = np.where(due, np.inf, move_s)
            if k < at.shape[1]:
                on = k % 2 == 0
                acts = _is_last(at, k) & (energised != on)
                energised = np.where(acts, on, energised)
                delay_s = (rise_s if on else fall_s)[:, chamber]
                cancelled = np.isfinite(move_s)
                move_s = np.where(acts, np.where(cancelled, np.inf, now_s + delay_s), move_s)
    switches = np.moveaxis(np.array(rows, dtype=np.float64), 2, 0)
    order = np.argsort(switches[:, :, 0], axis=1, kind="stable")
    most = max(1, int(np.isfinite(switches[:, :, 0]).sum(axis=1).max()))
    return np.take_along_axis(switches, order[..., None], axis=1)[:, :most]


def commands_of(edges: Edges, stroke: int) -> Commands:
    """Return the commands of one of the strokes, as in a campaign."""
    commands = []
    for valve, each in edges.items():
        at, on = each[stroke : stroke + 1], False
        for k in range(at.shape[1]):
            if _is_last(at, k)[0] and on != (k % 2 == 0):
                on = not on
                commands.append((float(at[0, k]), valve, FULL_DUTY if on else 0.0))
    return sorted(commands)
