"""What is known of a watched truck, as watch.json has it: levels, changes, and when a limit is reached.

Checked by: tests/unit/sil/shift_diagnosis/test_watch.py
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from sil.files.quantity import counted
from sil.fitting.hypotheses import scaled_of
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.store import Watched
from sil.shift_diagnosis.track import Track
from sil.shift_diagnosis.verdict import LARGEST
from sil.shift_diagnosis.watch import tracked_causes


def as_json(watched: Watched, limits: dict[str, float]) -> dict[str, Any]:
    """Return one truck's object in watch.json; limits: by parameter, in its unit."""
    track, causes = watched.track, {c.effect.id: c for c in tracked_causes()}
    changes = [
        _change_json(track, number, causes) | {"log": watched.change_logs[number]}
        for number in range(len(track.changes))
    ]
    parameters = []
    for k, name in enumerate(track.names):
        size, deviation = track.level(k, track.since)
        parameters.append(
            {"name": name, **_valued(causes.get(name), size, deviation), "since_shift": track.since}
        )
    return {
        "truck": watched.name,
        "verdict": track.verdict,
        "logs": watched.logs,
        "shifts": track.shifts,
        "trips": track.scatter.trips,
        "left_out": watched.skipped,
        "late_logs": watched.late_logs,
        "faulty_logs": [{"log": path, "fault": fault} for path, fault in watched.faults],
        "odd_shifts": [
            dict(zip(("shift", "time_s", "log", "chi2"), row, strict=True)) for row in watched.odd
        ],
        "parameters": parameters,
        "changes": changes,
        "forecast": [
            forecast(track, name, causes.get(name), limits.get(name))
            for name in sorted(track.drifting)
        ],
    }


def _change_json(track: Track, number: int, causes: dict[str, Cause]) -> dict[str, Any]:
    change = track.changes[number]
    k = track.names.index(change.name)
    before = max([0, *(c.shift for c in track.changes[:number])])
    after = next((c.shift for c in track.changes[number + 1 :]), None)
    cause = causes.get(change.name)
    found = msgspec.to_builtins(change)
    del found["since"]
    found["before"] = _valued(cause, *track.level(k, before, change.shift))
    found["after"] = _valued(cause, *track.level(k, change.shift, after))
    return dict(found)


def _valued(cause: Cause | None, size: float, deviation: float) -> dict[str, Any]:
    """Return a size with its 95 % interval, in the parameter's unit; nothing if shifts do not show it."""
    if not np.isfinite(size) or (cause is not None and deviation > LARGEST):
        return {"value": None, "low": None, "high": None, "unit": "-"}
    ends = [size + k * deviation for k in (0.0, -1.96, 1.96)]
    if cause is not None and np.isfinite(deviation):
        ends = [_unbounded(cause, end) for end in ends]
    unit = "-" if cause is None else cause.parameter.unit
    return {"value": ends[0], "low": min(ends[1:]), "high": max(ends[1:]), "unit": unit}


def _unbounded(cause: Cause, size: float) -> float:
    """Return a parameter's value at a size, relative to the first shifts: of either sign."""
    own = cause.parameter
    if own.neutral > 0.0:
        return cause.value(size)
    return own.neutral + size * own.typical


def forecast(track: Track, name: str, cause: Cause | None, limit: float | None) -> dict[str, Any]:
    """Return when a drifting parameter reaches its limit, with a 95 % interval, or why that is open.

    limit: in the parameter's unit; None: two typical sizes in the drift's direction.
    """
    now, slope, covariance = track.drift(track.names.index(name))
    goal = 2.0 * float(np.sign(slope))
    stated = _unbounded(cause, goal) if cause is not None else goal
    if limit is not None:
        stated, goal = limit, limit
        if cause is not None:
            own = cause.parameter
            goal = scaled_of(own, min(max(limit, own.low), own.high))
    found: dict[str, Any] = {"name": name, "limit": stated, "per_1000_shifts": 1000.0 * slope}
    draws = np.random.default_rng(1).multivariate_normal([now, slope], covariance, 4000)
    left = (goal - draws[:, 0]) / draws[:, 1]
    low, middle, high = np.quantile(np.where(left < 0.0, np.inf, left), [0.025, 0.5, 0.975])
    seen = track.shifts - track.since
    if (goal - now) * np.sign(slope) <= 0.0:
        return found | {"shifts_left": 0, "low": 0, "high": 0, "why": "the limit is passed"}
    if not np.isfinite(high) or high > 10.0 * seen:
        why = f"not extrapolated: {counted(seen, 'shift')} of drift cannot bound it"
        return found | {"shifts_left": None, "low": None, "high": None, "why": why}
    ends = (int(middle), int(low), int(high))
    return found | dict(zip(("shifts_left", "low", "high"), ends, strict=True)) | {"why": ""}
