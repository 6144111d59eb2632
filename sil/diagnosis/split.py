"""Which strokes train and which are held out: whole strokes, every kind on both sides.

Checked by: tests/unit/sil/diagnosis/test_split.py
"""

from __future__ import annotations

from collections.abc import Sequence

from .observations import StrokeObservation

HELD_OUT_SHARE = 1.0 / 3.0
MOST_TRAINING = 14


def stratum(stroke: StrokeObservation) -> tuple[str, str, bool]:
    """What makes strokes alike: kind, load, and whether a chamber still stands charged."""
    conditions = stroke.conditions
    return conditions.kind, conditions.load, bool(conditions.charged_before)


def split(strokes: Sequence[StrokeObservation]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Places of training and held-out strokes.

    A third is held out, strata in turn, the first stroke of each stratum trains; one or two strokes
    all train.  No more than MOST_TRAINING train: more would cost time and add nothing.
    """
    n = len(strokes)
    if n < 3:
        return tuple(range(n)), ()
    groups: dict[tuple[str, str, bool], list[int]] = {}
    for k, stroke in enumerate(strokes):
        groups.setdefault(stratum(stroke), []).append(k)
    ordered: list[tuple[float, int, int]] = []
    for rank, members in enumerate(sorted(groups.values(), key=len, reverse=True)):
        for place, k in enumerate(members):
            ordered.append((place / len(members), rank, k))
    queue = [k for _place, _rank, k in sorted(ordered)]
    training = min(MOST_TRAINING, n - max(1, round(HELD_OUT_SHARE * n)))
    chosen = sorted(queue[:training])
    return tuple(chosen), tuple(sorted(set(range(n)) - set(chosen)))
