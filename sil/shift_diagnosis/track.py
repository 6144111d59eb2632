"""One truck over months: parameters tracked shift by shift, changes dated, drifts extrapolated.

Every shift gives the information and the score of the tracked sizes. They are summed over BLOCK
shifts, and blocks over ever longer cells as they get older, so that the memory of a truck is
bounded. After every block the cells since the last change are split at every border, and the mean
after it is compared with the mean before it, one parameter at a time (a generalised likelihood
ratio). The scatter of the shifts is estimated from the blocks themselves.
Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BLOCK: Final = 20
"""Shifts that are summed before anything is tested."""
CELLS: Final = 256
"""Cells that a truck has at most; then two neighbours are merged for every new one."""
FEWEST_CELLS: Final = 5
"""Cells before a change that make its baseline."""
FEWEST_SHIFTS: Final = BLOCK * (FEWEST_CELLS + 1)
"""Shifts of a truck before any change can be found."""
CHANGED: Final = "changed", "drifting"
"""Verdicts of a truck in which something was found."""
THRESHOLD: Final = 5.5
"""Standard deviations by which means must differ: at most one false alarm in 1e5 shifts, by
simulation (`python -m tests.bench watch_rates`)."""
PSEUDO_BLOCKS: Final = 5.0
"""Blocks that the stated scatter of a shift counts as, when the scatter is estimated."""
RAMP_GAIN: Final = 4.0
"""Half chi squared by which a drift must be better than a step."""
SEPARABLE: Final = 9.0


class Change(msgspec.Struct, kw_only=True):
    """A step or the begin of a drift. Numbers of shifts count from the truck's first, 0.

    shift: the first one after the change, low to high its 95 % interval; time_s: when that was;
    found: the shift after which it was found. sigma: standard deviations. alike: parameters whose
    change the shifts cannot distinguish from this one. since: from which shift on it is dated; -1: not again.
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
    since: int = 0


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

    @property
    def verdict(self) -> str:
        """Whether the truck is drifting, changed or steady, or has too few shifts to tell."""
        if self.drifting:
            return "drifting"
        if self.changes:
            return "changed"
        return "steady" if self.shifts >= FEWEST_SHIFTS else "cannot_tell"

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
        """Merge two neighbours, the finest for their distance from now and from the last change."""
        if len(self.count) < CELLS:
            return
        second = self.first[1:]
        reach = np.minimum(self.shifts - second, np.abs(second - self.since)) + BLOCK
        width = (self.count[:-1] + self.count[1:]) / reach
        width[np.isin(second, [self.since, *(change.shift for change in self.changes)])] = np.inf
        groups = np.delete(np.arange(len(self.count)), int(np.argmin(width)) + 1)
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
            self._date(self.shifts)
            return None
        shift = int(self.first[whole.start + j])
        self._date(shift)
        change = Change(
            name=self.names[k], kind="step", shift=shift, low=shift, high=shift,
            time_s=float(self.time_s[whole.start + j]), found=self.shifts,
            sigma=float(np.sqrt(gain[j, k])), alike=self._alike(whole.start, whole.start + j, k),
            since=-1 if self.drifting else self.since,
        )  # fmt: skip
        self.changes.append(change)
        self.since, self.drifting = shift, set()
        self._date(self.shifts)
        return change

    def _date(self, until: int) -> None:
        """Date the last change again by all shifts until one, as a step or the begin of a drift.

        A date's interval holds 95 % of its probability under both.
        """
        change = self.changes[-1] if self.changes else None
        if change is None or change.since < 0:
            return
        k = self.names.index(change.name)
        whole, h, a, t = self._segment(change.since)
        own = t < until
        h, a, t = h[own, k], a[own, k], t[own]
        if len(t) < FEWEST_CELLS + 1:
            return
        steps = float(np.sum(h * (a - np.average(a, weights=h)) ** 2)) - _step_gains(h, a)
        ramps = _ramp_costs(t, a, h)
        steps[:FEWEST_CELLS], ramps[:FEWEST_CELLS] = np.inf, np.inf
        is_drift = bool(np.min(ramps) < np.min(steps) - 2.0 * RAMP_GAIN)
        chance = np.exp(0.5 * (min(steps.min(), ramps.min()) - steps))
        chance += np.exp(0.5 * (min(steps.min(), ramps.min()) - ramps))
        sure = np.cumsum(chance * self.count[whole][own]) / np.sum(chance * self.count[whole][own])
        low, high = np.searchsorted(sure, [0.025, 0.975]).tolist()
        cell = int(np.argmin(ramps if is_drift else steps))
        first = self.first[whole][own]
        self.changes[-1] = msgspec.structs.replace(
            change, kind="drift" if is_drift else "step", shift=int(first[cell]),
            low=int(first[max(low - 1, 0)]), high=int(first[high] + self.count[whole][own][high]),
            time_s=float(self.time_s[whole][own][cell]),
        )  # fmt: skip
        if self.since == change.shift:
            self.since = self.changes[-1].shift
            self.drifting = {change.name} if is_drift else set()

    def _alike(self, begin: int, at: int, k: int) -> list[str]:
        """Return the parameters whose step the shifts cannot distinguish from that of parameter k."""
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
        return msgspec.msgpack.encode(vars(self), enc_hook=np.ndarray.tolist)

    @classmethod
    def from_bytes(cls, stored: bytes) -> Track:
        """Return the state that was stored."""
        found: dict[str, Any] = msgspec.msgpack.decode(stored)
        track = cls.of(tuple(found["names"]))
        for name, empty in vars(track).items():
            value = found[name]
            if isinstance(empty, np.ndarray):
                value = np.array(value, empty.dtype).reshape(-1, *empty.shape[1:])
            elif name == "changes":
                value = msgspec.convert(value, list[Change])
            setattr(track, name, type(empty)(value) if isinstance(empty, set | tuple) else value)
        return track


def _step_gains(h: Floats, a: Floats) -> Floats:
    """Return chi squared gained by a step before each cell [m] or [m, p]; 0 before the first."""
    score = h * a
    before_h = np.cumsum(h, axis=0) - h
    before = np.cumsum(score, axis=0) - score
    after_h, after = h.sum(axis=0) - before_h, score.sum(axis=0) - before
    gains = np.zeros_like(h)
    mean = after[1:] / after_h[1:] - before[1:] / before_h[1:]
    gains[1:] = mean**2 / (1.0 / after_h[1:] + 1.0 / before_h[1:])
    return gains


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
    rest = a - np.average(a, weights=h)
    ramps = np.maximum(0.0, t - t[:, None])
    ramps -= (ramps @ h / h.sum())[:, None]
    gains = (ramps @ (h * rest)) ** 2 / np.maximum(ramps**2 @ h, 1e-12)
    return np.asarray(np.sum(h * rest**2) - gains)
