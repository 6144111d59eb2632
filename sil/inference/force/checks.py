"""Channels of a body's record: their noise, and what forbids conclusions from them.

Checked by: tests/unit/sil/inference/force/test_diagnosis.py
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sil.campaign.campaign import Floats
from sil.files.quantity import counted
from sil.inference.campaign.noise import rounding_of


def odd_channels(file: str, signals: Floats, first: int) -> list[str]:
    """Return what forbids conclusions from channels [3, n], which begin at sample `first`."""
    findings = []
    position, force, _pressure = signals
    for name, values in zip(("position", "force", "pressure"), signals, strict=True):
        if np.isnan(values[0]):
            continue
        flaws = {"spike": _spikes(values)}
        if name == "position":
            flaws["jump"] = _jumps(values)
            what, run = name, _held(values, force)
        else:
            what, travel = f"driving {name}", 0.05 * np.ptp(position)
            run = next((k for k in _runs(values) if np.ptp(position[k]) > travel), None)
        # where the body turns, a drive may change its sign for a sample or two
        if name == "force" and not np.any(_moves(position)[flaws["spike"]]):
            flaws = {}
        for flaw, rows in flaws.items():
            if len(rows):
                where = f"the first at sample {first + rows[0] + 1}"
                findings.append(f"{file}: {name}: {counted(len(rows), flaw)}, {where}")
        if run is not None:
            findings.append(
                f"{file}: the {what} keeps one value over {run.stop - run.start} samples in motion from "
                f"sample {first + run.start + 1} on: stuck or saturated"
            )
    return findings


def _spikes(values: Floats) -> NDArray[np.int64]:
    """Return where one or two samples are far from all of their neighbours in values [n]."""
    span = float(np.diff(np.quantile(values, (0.01, 0.99)))[0])
    far = np.zeros(len(values), dtype=bool)
    for k in (1, 2):
        out = np.abs(values[k:-k] - 0.5 * (values[: -2 * k] + values[2 * k :]))
        far[k:-k] |= out > max(
            15.0 * float(np.median(out)), 10.0 * np.quantile(out, 0.9), 0.05 * span
        )
    spikes = []
    for row in np.flatnonzero(far[6:-6]) + 6:
        around = np.concatenate([values[row - 6 : row - 1], values[row + 2 : row + 7]])
        height = np.abs(values[row] - np.median(around))
        if height > 2.0 * np.ptp(around) and not _continues(values, int(row), 0.25 * height):
            spikes.append(row)
    rows = np.array(spikes, dtype=np.int64)
    return rows[np.diff(rows, prepend=-2) > 1]


def _continues(values: Floats, row: int, most: float) -> bool:
    """Return whether two values [n] before or after a sample run straight on to it, as where a force steps."""
    lines = (2.0 * values[row + k] - values[row + 2 * k] for k in (-1, 1))
    return any(abs(float(values[row] - line)) < most for line in lines)


def _moves(position: Floats) -> NDArray[np.bool_]:
    """Return where a position [n] changes over 13 samples by a tenth of the most it does."""
    travels = np.abs(np.convolve(position, [1.0, *[0.0] * 11, -1.0], "same"))
    return np.asarray(travels > 0.1 * np.quantile(travels, 0.99))


def _jumps(position: Floats) -> NDArray[np.int64]:
    """Return where a position [n] moves within one sample as far as it never does otherwise.

    A single step counts, too, if it is five times any other and the body moves without it.
    """
    moves = np.diff(position)
    steps, span = np.abs(moves), float(np.ptp(position))
    usual = float(np.quantile(steps, 0.98)) + rounding_of(position)
    rows = np.flatnonzero(steps > max(20.0 * usual, 0.02 * span))
    k = int(np.argmax(steps))
    others = np.delete(steps, np.arange(max(k - 1, 0), min(k + 2, len(steps))))
    if not len(rows) and steps[k] > max(5.0 * float(others.max(initial=0.0)), 0.1 * span):
        without = position - np.where(np.arange(len(position)) > k, moves[k], 0.0)
        if np.ptp(without) > 0.3 * span:
            return np.array([k])
    return rows


def _runs(values: Floats) -> Iterator[slice]:
    """Yield the unusually long runs of one value, the longest first."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0.0) + 1, [len(values)]])
    lengths = np.diff(edges)
    usual = float(np.quantile(lengths, 0.98))
    for k in np.argsort(-lengths)[:20]:
        if lengths[k] >= max(20.0, 10.0 * usual):
            yield slice(int(edges[k]), int(edges[k + 1]))


def _held(position: Floats, force: Floats) -> slice | None:
    """Return a run of one position, not at a stop, under forces that move the body, None if there is none."""
    low, high = np.min(position), np.max(position)
    moving = _moves(position)
    if not moving.any():
        return None
    strong = np.abs(force) > np.median(np.abs(force[moving]))
    for run in _runs(position):
        inside = 0.02 < (position[run.start] - low) / (high - low) < 0.98
        if inside and np.mean(strong[run]) > 0.25:
            return run
    return None
