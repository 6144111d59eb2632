"""Which strokes train and which are held out: whole strokes, every kind on both sides.

Checked by: tests/unit/sil/inference/campaign/test_split.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sil.inference.campaign.observations import StrokeObservation

Stratum = tuple[str, str, bool, str]


def stratum(stroke: StrokeObservation) -> Stratum:
    """Return what makes strokes alike: kind, load, whether a chamber is still charged, and the day."""
    conditions = stroke.conditions
    charged = bool(conditions.charged_before)
    return conditions.kind, conditions.load, charged, stroke.entry.session


def split(
    strokes: Sequence[StrokeObservation], most_training: int = 14
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of training and held-out strokes; one or two strokes all train.

    A third is held out, strata in turn, the first stroke of each trains; at most `most_training` train.
    Every rest before a stroke that occurs is among those that train, as far as there are strokes.
    """
    n = len(strokes)
    if n < 3:
        return tuple(range(n)), ()
    groups: dict[Stratum, list[int]] = {}
    for k, stroke in enumerate(strokes):
        groups.setdefault(stratum(stroke), []).append(k)
    ordered = sorted(
        (position / len(members), rank, k)
        for rank, members in enumerate(sorted(groups.values(), key=len, reverse=True))
        for position, k in enumerate(members)
    )
    queue = [k for _position, _rank, k in ordered]
    training = min(most_training, n - max(1, round(1.0 / 3.0 * n)))
    chosen = _with_every_rest(queue[:training], queue[training:], strokes)
    return tuple(sorted(chosen)), tuple(sorted(set(range(n)) - set(chosen)))


def _with_every_rest(
    training: list[int], held_out: Sequence[int], strokes: Sequence[StrokeObservation]
) -> list[int]:
    """Training strokes, some changed for held-out ones that rested as long as none of them did."""
    chosen = list(training)
    rest_s = [stroke.conditions.rest_s for stroke in strokes]
    strata = list(map(stratum, strokes))
    for k in held_out:
        rests = [rest_s[j] for j in chosen]
        if rest_s[k] in rests:
            continue
        present = [strata[i] for i in (*chosen, k)]
        spare = [
            j
            for j in reversed(chosen)
            if rests.count(rest_s[j]) > 1 and present.count(strata[j]) > 1
        ]
        alike = [j for j in spare if strata[j] == strata[k]]
        if spare:
            chosen[chosen.index((alike or spare)[0])] = k
    return chosen


def odd_ones_in(
    training: tuple[int, ...],
    held_out: tuple[int, ...],
    squares: Mapping[int, float],
    strokes: Sequence[StrokeObservation],
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Split anew where only held-out strokes show that something is wrong: half of those train.

    squares: mean squared residual of every stroke under the healthy fit. As many training strokes that
    have another of their kind are held out instead.
    """
    usual = float(np.median([squares[k] for k in training]))
    odd = sorted((k for k in held_out if squares[k] > 1.3 * usual), key=lambda k: -squares[k])
    moved = set(odd[: (len(odd) + 1) // 2])
    freed: set[int] = set()
    for k in reversed(training):
        left = [stratum(strokes[i]) for i in training if i not in freed]
        if len(freed) < len(moved) and left.count(stratum(strokes[k])) > 1:
            freed.add(k)
    return (tuple(sorted({*training, *moved} - freed)), tuple(sorted({*held_out, *freed} - moved)))
