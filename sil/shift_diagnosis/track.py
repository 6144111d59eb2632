"""One truck over months: parameters tracked shift by shift, changes dated, drifts extrapolated.

Every shift gives the information and the score of the tracked sizes. They are summed over BLOCK
shifts, and blocks over ever longer cells as they get older, so that the memory of a truck is
bounded. After every block the cells since the last change are split at every border, and the mean
after it is compared with the mean before it, one parameter at a time (a generalised likelihood
ratio). The scatter of the shifts is estimated from the blocks themselves.
Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BLOCK: Final = 20
"""Shifts that are summed before anything is tested."""
CELLS: Final = 256
"""Cells that a truck has at most; then the older half of them are merged in pairs."""
FEWEST_CELLS: Final = 5
"""Cells before a change that make its baseline."""
THRESHOLD: Final = 5.5
"""Standard deviations by which means must differ: at most one false alarm in 1e5 shifts, by
simulation (`python -m tests.bench watch_rates`)."""
PSEUDO_BLOCKS: Final = 5.0
"""Blocks that the stated scatter of a shift counts as, when the scatter is estimated."""
RAMP_GAIN: Final = 4.0
"""Chi squared by which a drift may be worse than two steps; twice that, and it is better than one."""
SEPARABLE: Final = 9.0
WITHIN: Final = 3.84
"""Chi squared within which a date is in its 95 % interval."""


class Change(msgspec.Struct, kw_only=True):
    """A step or the begin of a drift. Numbers of shifts count from the truck's first, 0.

    shift: the first one after the change, low to high its 95 % interval; time_s: when that was;
    found: the shift after which it was found. sigma: standard deviations. alike: parameters whose
    change the shifts cannot tell from this one.
    """

    name: str
    kind: str
    shift: int
    low: int
    high: int
    time_s: float
    found: int
    sigma: float
    alike: list[str]


@dataclass
class Track:
    """The state of one truck.

    names: of the parameters [p]. count, first, time_s [cells]; information [cells, p, p] and
    score [cells, p] of the sizes; since: shift from which the present state counts; drifting:
    parameters that have drifted since then.
    """

    names: tuple[str, ...]
    count: NDArray[np.int64]
    first: NDArray[np.int64]
    time_s: Floats
    information: Floats
    score: Floats
    shifts: int = 0
    since: int = 0
    drifting: set[str] = field(default_factory=set)
    changes: list[Change] = field(default_factory=list)
    squares: Floats = field(default_factory=lambda: np.zeros(0))
    pairs: float = 0.0

    @classmethod
    def of(cls, names: tuple[str, ...]) -> Track:
        """Return the state of a truck of which nothing is known."""
        p = len(names)
        return cls(
            names, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0),
            np.zeros((0, p, p)), np.zeros((0, p)), squares=np.zeros(p),
        )  # fmt: skip

    # --- taking shifts ------------------------------------------------------------------------
    def take(self, information: Floats, score: Floats, time_s: Floats) -> list[Change]:
        """Take shifts: information [n, p, p] and score [n, p] of the sizes, times [n] in s.

        Returns the changes that were found.
        """
        found: list[Change] = []
        at = 0
        while at < len(score):
            room = BLOCK - int(self.count[-1]) if len(self.count) else 0
            begins = room <= 0
            take = min(BLOCK if begins else room, len(score) - at)
            part = slice(at, at + take)
            if begins:
                self._append(float(time_s[at]))
            self.count[-1] += take
            self.information[-1] += information[part].sum(axis=0)
            self.score[-1] += score[part].sum(axis=0)
            self.shifts += take
            at += take
            if self.count[-1] == BLOCK:
                self._note_scatter()
                change = self._tested()
                if change is not None:
                    found.append(change)
                self._merge()
        return found

    def _append(self, time_s: float) -> None:
        p = len(self.names)
        self.count = np.append(self.count, 0)
        self.first = np.append(self.first, self.shifts)
        self.time_s = np.append(self.time_s, time_s)
        self.information = np.concatenate([self.information, np.zeros((1, p, p))])
        self.score = np.concatenate([self.score, np.zeros((1, p))])

    def _note_scatter(self) -> None:
        """Compare the latest block with the one before it."""
        if len(self.count) < 2 or self.count[-2] != BLOCK:
            return
        h = np.diagonal(self.information[-2:], axis1=1, axis2=2)
        h = np.maximum(h, 1e-12)
        a = self.score[-2:] / h
        square = (a[1] - a[0]) ** 2 / (1.0 / h).sum(axis=0)
        self.squares += np.minimum(square, 12.0 * self.scatter2)
        self.pairs += 1.0

    @property
    def scatter2(self) -> Floats:
        """Variance of the shifts [p] relative to the stated one."""
        return np.asarray((PSEUDO_BLOCKS + self.squares) / (PSEUDO_BLOCKS + self.pairs))

    @property
    def _limit2(self) -> float:
        """Square of the threshold, wider while the scatter is known from few blocks (Wallace 1959)."""
        freedom = PSEUDO_BLOCKS + self.pairs
        return freedom * float(np.expm1(THRESHOLD**2 / freedom))

    def _merge(self) -> None:
        """Merge the older half of the cells in pairs, never over the date of a change."""
        if len(self.count) < CELLS:
            return
        borders = {0, self.since, *(change.shift for change in self.changes)}
        groups, k = [], 0
        while k < len(self.count):
            mergeable = k + 1 < CELLS // 2 and int(self.first[k + 1]) not in borders
            groups.append(k)
            k += 2 if mergeable else 1
        for name in ("count", "information", "score"):
            setattr(self, name, np.add.reduceat(getattr(self, name), groups, axis=0))
        self.first, self.time_s = self.first[groups], self.time_s[groups]

    # --- testing ------------------------------------------------------------------------------
    def _segment(self, since: int) -> tuple[slice, Floats, Floats, Floats]:
        """Return the whole cells since a shift, their information and estimates [m, p], mid shifts [m]."""
        whole = slice(int(np.searchsorted(self.first, since)), len(self.count))
        h = np.diagonal(self.information[whole], axis1=1, axis2=2) / self.scatter2
        h = np.maximum(h, 1e-12)
        a = self.score[whole] / self.scatter2 / h
        return whole, h, a, self.first[whole] + 0.5 * self.count[whole]

    def _tested(self) -> Change | None:
        whole, h, a, t = self._segment(self.since)
        if len(t) < FEWEST_CELLS + 1:
            return None
        for name in self.drifting:  # the others see it, too
            k = self.names.index(name)
            line = _line(t, a[:, k], h[:, k])[0]
            a -= self.information[whole, :, k] / self.scatter2 / h * line[:, None]
        gain = _step_gains(h, a)
        j, k = divmod(int(np.argmax(gain[FEWEST_CELLS:])), len(self.names))
        j += FEWEST_CELLS
        if gain[j, k] < self._limit2:
            return None
        return self._changed(whole, h[:, k], a[:, k], t, j, k, gain)

    def _changed(
        self, whole: slice, h: Floats, a: Floats, t: Floats, j: int, k: int, gain: Floats
    ) -> Change:
        """Date a change of parameter k, found at cell j of the segment, and begin a new segment."""
        name, offset = self.names[k], whole.start
        steps = _ramp_costs(t, a, h)
        ramp, kind = int(np.argmin(steps)), "step"
        mean_gain = gain[:, k]
        base = float(np.sum(h * (a - np.average(a, weights=h)) ** 2))
        profile = base - mean_gain
        profile[:FEWEST_CELLS] = np.inf
        alike = self._alike(offset, offset + j, k)
        last = self.changes[-1] if self.changes else None
        if last is not None and last.name in (name, *alike):
            replaced = self._as_drift(last, self.names.index(last.name))
            if replaced is not None:
                return replaced
        if len(t) - j >= FEWEST_CELLS and steps[ramp] < profile[j] - 2.0 * RAMP_GAIN:
            kind, j, profile = "drift", ramp, steps
        near = np.flatnonzero(profile <= profile[j] + WITHIN)
        cell = offset + j
        change = Change(
            name=name, kind=kind, shift=int(self.first[cell]),
            low=int(self.first[offset + near[0]]) - (BLOCK if near[0] else 0),
            high=int(self.first[offset + near[-1]] + self.count[offset + near[-1]]),
            time_s=float(self.time_s[cell]), found=self.shifts,
            sigma=float(np.sqrt(np.max(gain[FEWEST_CELLS:, k]))), alike=alike,
        )  # fmt: skip
        self._begin(change)
        return change

    def _begin(self, change: Change) -> None:
        self.changes.append(change)
        self.since = change.shift
        self.drifting = {change.name} if change.kind == "drift" else set()

    def _as_drift(self, last: Change, k: int) -> Change | None:
        """Return a drift instead of a step and another one after it, if it explains both as well."""
        before = [c.shift for c in self.changes[:-1] if c.shift < last.shift]
        _whole, h, a, t = self._segment(before[-1] if before else 0)
        h, a = h[:, k], a[:, k]
        middle = int(np.searchsorted(t, last.shift))
        two = _step_cost(h[:middle], a[:middle]) + min(
            _step_cost(h[middle:j], a[middle:j]) + _step_cost(h[j:], a[j:])
            for j in range(middle + 1, len(t))
        )
        ramps = _ramp_costs(t, a, h)
        ramp = int(np.argmin(ramps))
        if ramps[ramp] > two + RAMP_GAIN:
            return None
        near = np.flatnonzero(ramps <= ramps[ramp] + WITHIN)
        first = self.first[-len(t) :]
        change = msgspec.structs.replace(
            last, kind="drift", shift=int(first[ramp]), low=int(first[near[0]]),
            high=int(first[near[-1]]), time_s=float(self.time_s[-len(t) :][ramp]),
            found=self.shifts,
        )  # fmt: skip
        self.changes.pop()
        self._begin(change)
        return change

    def _alike(self, begin: int, at: int, k: int) -> list[str]:
        """Return the parameters whose step the shifts cannot tell from that of parameter k."""
        pieces = []
        for part in (slice(begin, at), slice(at, None)):
            h = self.information[part].sum(axis=0) + 1e-9 * np.eye(len(self.names))
            pieces.append((np.linalg.inv(h), np.linalg.solve(h, self.score[part].sum(axis=0))))
        information = np.linalg.inv(pieces[0][0] + pieces[1][0])
        score = information @ (pieces[1][1] - pieces[0][1])
        gains = score**2 / np.maximum(np.diag(information), 1e-12) / self.scatter2
        return [
            name
            for j, name in enumerate(self.names)
            if j != k and gains[j] > gains[k] - SEPARABLE and gains[j] > 0.5 * gains[k]
        ]

    # --- what is known now ----------------------------------------------------------------------
    def level(self, k: int, begin: int, end: int | None = None) -> tuple[float, float]:
        """Return the mean size of parameter k over shifts from begin to end, and its deviation."""
        first = self.first
        own = (first >= begin) & (first < (end if end is not None else self.shifts))
        h = float(self.information[own, k, k].sum()) / self.scatter2[k]
        score = float(self.score[own, k].sum()) / self.scatter2[k]
        return (score / h, h**-0.5) if h > 0.0 else (float("nan"), float("inf"))

    def drift(self, k: int) -> tuple[float, float, Floats]:
        """Return size now, slope per shift, and their covariance [2, 2], of a drifting parameter."""
        _whole, h, a, t = self._segment(self.since)
        _fit, estimate, covariance = _line(t - self.shifts, a[:, k], h[:, k])
        return float(estimate[0]), float(estimate[1]), covariance

    # --- storing --------------------------------------------------------------------------------
    def to_bytes(self) -> bytes:
        """Return the state as it is stored."""
        return msgspec.msgpack.encode(
            {
                "names": self.names, "shifts": self.shifts, "since": self.since,
                "drifting": sorted(self.drifting), "changes": self.changes, "pairs": self.pairs,
                "arrays": {n: getattr(self, n).astype(d).tobytes() for n, d in _ARRAYS.items()},
            }
        )  # fmt: skip

    @classmethod
    def from_bytes(cls, stored: bytes) -> Track:
        """Return the state that was stored."""
        found: dict[str, Any] = msgspec.msgpack.decode(stored)
        track = cls.of(tuple(found["names"]))
        p = len(track.names)
        for name, kind in _ARRAYS.items():
            shape = {"information": (-1, p, p), "score": (-1, p)}.get(name, (-1,))
            array = np.frombuffer(found["arrays"][name], dtype=kind).reshape(shape)
            setattr(track, name, array.copy())
        changes = [msgspec.convert(item, Change) for item in found["changes"]]
        return replace(
            track, shifts=found["shifts"], since=found["since"], pairs=found["pairs"],
            drifting=set(found["drifting"]), changes=changes,
        )  # fmt: skip


_ARRAYS: Final = {
    "count": "<i8", "first": "<i8", "time_s": "<f8", "information": "<f8", "score": "<f8",
    "squares": "<f8",
}  # fmt: skip


def _step_gains(h: Floats, a: Floats) -> Floats:
    """Return chi squared gained by a step before each cell [m, p]; 0 before the first."""
    score = h * a
    before_h = np.cumsum(h, axis=0) - h
    before = np.cumsum(score, axis=0) - score
    after_h, after = h.sum(axis=0) - before_h, score.sum(axis=0) - before
    gains = np.zeros_like(h)
    mean = after[1:] / after_h[1:] - before[1:] / before_h[1:]
    gains[1:] = mean**2 / (1.0 / after_h[1:] + 1.0 / before_h[1:])
    return gains


def _step_cost(h: Floats, a: Floats) -> float:
    """Return chi squared of cells [m] around their mean."""
    return float(np.sum(h * (a - np.average(a, weights=h)) ** 2)) if len(h) else 0.0


def _line(t: Floats, a: Floats, h: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the weighted straight line at t [m], its value at 0 and slope [2], covariance [2, 2]."""
    design = np.stack([np.ones_like(t), t], axis=1)
    scale = np.array([1.0, 1.0 / max(1.0, float(np.abs(t).max()))])
    design = design * scale
    covariance = np.linalg.inv(design.T @ (design * h[:, None]) + 1e-12 * np.eye(2))
    estimate = covariance @ (design.T @ (h * a))
    return design @ estimate, estimate * scale, covariance * np.outer(scale, scale)


def _ramp_costs(t: Floats, a: Floats, h: Floats) -> Floats:
    """Return chi squared [m] of a level that becomes a line at each cell."""
    costs = np.full(len(t), np.inf)
    for k in range(len(t) - 2):
        fitted = _line(np.maximum(0.0, t - t[k]), a, h)[0]
        costs[k] = float(np.sum(h * (a - fitted) ** 2))
    return costs
