"""One truck over months: parameters tracked shift by shift, changes dated, drifts extrapolated.

Every shift gives the information and the score of the tracked sizes, summed over cells
(`cells.py`). After every block of shifts the cells since the last change are split at every border, and the mean
after it is compared with the mean before it, one parameter at a time (a generalised likelihood
ratio). The scatter of the shifts, and of the trips, is estimated from the truck's own (`scatter.py`).
Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from sil.shift_diagnosis.cells import BLOCK, Cells
from sil.shift_diagnosis.change import LINEAR, SEPARABLE, Change, Confirm
from sil.shift_diagnosis.scatter import PAUSE_S, Scatter
from sil.shift_diagnosis.steps import (
    drift_instead,
    line_of,
    of_difference,
    ramp_costs,
    residual,
    step_gains,
)

Floats = NDArray[np.float64]

FEWEST_CELLS: Final = 5
"""Cells before a change that make its baseline."""
FEWEST_SHIFTS: Final = BLOCK * (FEWEST_CELLS + 1)
"""Shifts of a truck before any change can be found."""
CHANGED: Final = "changed", "drifting"
"""Verdicts of a truck in which something was found."""
THRESHOLD: Final = 5.5
"""Standard deviations by which means must differ: at most one false alarm in 1e5 shifts, by
simulation (`python -m tests.bench watch_rates`)."""
RAMP_GAIN: Final = 4.0
"""Half chi squared by which a drift must be better than a step."""
JOINED: Final = 11.0
"""Chi squared by which two changes may explain more than one drift: as their two more numbers would
among 256 cells by chance (Schwarz 1978)."""
FEWEST_TRIPS: Final = 10
"""Trips from which a change can be found where there are several: how they differ is then known."""
TRIPS: Final = 1.5
"""Trips, whole and begun, that a change must last where there are several."""


@dataclass
class Track(Cells):
    """The state of one truck.

    since: shift from which the present state counts; base: shift from which all are linearised at the
    sizes `point` [p]; drifting: parameters that have drifted since then.
    """

    since: int = 0
    base: int = 0
    point: Floats = field(default_factory=lambda: np.zeros(0))
    drifting: set[str] = field(default_factory=set)
    changes: list[Change] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin at sizes of 0."""
        self.point = np.zeros(len(self.names))

    @property
    def verdict(self) -> str:
        """Whether the truck is drifting, changed or steady, or has too few shifts to tell."""
        if self.drifting:
            return "drifting"
        if self.changes:
            return "changed"
        known = self.shifts >= FEWEST_SHIFTS and not 1 < self.scatter.trips < FEWEST_TRIPS
        return "steady" if known else "cannot_tell"

    @property
    def is_far(self) -> bool:
        """Whether shifts are still linearised at the point from before the last change."""
        return bool(self.changes) and self.base < self.changes[-1].found

    # --- taking shifts ------------------------------------------------------------------------
    def linearised_at(self, point: Floats) -> None:
        """Take the following shifts as linearised at other sizes [p].

        They are not compared with those before: the difference of two linear models is no change.
        """
        self.point, self.base, self.is_open = point, self.shifts, False

    def take(
        self, information: Floats, score: Floats, time_s: Floats, confirm: Confirm | None = None
    ) -> list[Change]:
        """Take shifts: information [n, p, p] and score [n, p] of the sizes, times [n] in s.

        confirm: returns a change found by the linear model, perhaps with another name, or None if
        the shifts after it do not show it. Returns the changes that were found.
        """
        found: list[Change] = []
        gaps = np.diff(time_s, prepend=self.last_s)
        begins = np.append(np.flatnonzero((gaps > PAUSE_S) | (gaps < 0.0)), len(score))
        at = 0
        for end in begins.tolist():
            while at < end:
                room = BLOCK - int(self.count[-1]) if self.is_open else 0
                take = min(room or BLOCK, end - at)
                part = slice(at, at + take)
                if not room:
                    self.begin_cell(float(time_s[at]))
                self.count[-1] += take
                # shift by shift: the sums must not depend on how many come in one call
                self.information[-1] = np.vstack([self.information[-1:], information[part]]).sum(0)
                self.score[-1] = np.vstack([self.score[-1:], score[part]]).sum(0)
                self.shifts += take
                at += take
                if self.count[-1] == BLOCK:
                    found += self._completed(confirm)
            if end < len(score):
                found += self.end_cell(confirm)
                self.scatter.begin_trip()
                self.trip_first, self.trip_cells = self.shifts, 0
        if len(score):
            self.last_s = float(time_s[-1])
        return found

    def end_cell(self, confirm: Confirm | None = None) -> list[Change]:
        """Test what there is of a cell, as at the end of a log; return the change found, if any."""
        return self._completed(confirm) if self.is_open else []

    def _completed(self, confirm: Confirm | None) -> list[Change]:
        """Return the change that a completed cell shows, if any."""
        self.is_open = False
        h = np.diagonal(self.information[-2:], axis1=1, axis2=2)
        change = self._tested(confirm)
        self._date(self.shifts)
        self._join()
        if change is not None:
            self.scatter.restart()
        else:
            self.scatter.add(h[-1], self.score[-1], int(self.count[-1]))
            if self.trip_cells > 1 and (self.count[-2:] == BLOCK).all():
                self.scatter.compare(h, self.score[-2:])
        self.merge(self.since, [self.base, *(change.shift for change in self.changes)])
        return [] if change is None else [change]

    # --- testing ------------------------------------------------------------------------------
    def _limits2(self, cells: slice) -> Floats:
        """Return the square of the threshold [m, p] of a step before each cell.

        It is wider the less is known of the variances (Satterthwaite 1946, Wallace 1959).
        """
        within, between = self.variances(cells)
        h = 1.0 / (within + between)
        parts = [of_difference(h, h**2 * part) for part in (within, between)]
        of_shifts, of_trips = self.scatter.freedom
        freedom = sum(parts) ** 2 / (parts[0] ** 2 / of_shifts + parts[1] ** 2 / of_trips)
        return np.asarray(freedom * np.expm1(THRESHOLD**2 / freedom))

    def _tested(self, confirm: Confirm | None) -> Change | None:
        whole, h, a, t = self.segment(max(self.since, self.base))
        if len(t) < FEWEST_CELLS + 1 or 1 < self.scatter.trips < FEWEST_TRIPS:
            return None
        for name in self.drifting:
            a = self._without(name, int(self.first[whole.start]), a)
        gain = step_gains(h, a)
        if self.scatter.trips > 1:  # one trip alone can differ by its load, weather or clocks
            later = np.cumsum(self.trips[whole][::-1])[::-1]
            gain = np.where(later[:, None] < TRIPS, 0.0, gain)
        share = gain[FEWEST_CELLS:] / self._limits2(whole)[FEWEST_CELLS:]
        j, k = divmod(int(np.argmax(share)), len(self.names))
        j += FEWEST_CELLS
        if not share.max() >= 1.0:
            return None
        shift = int(self.first[whole.start + j])
        found = Change(
            name=self.names[k], kind="step", shift=shift, low=shift, high=shift,
            time_s=float(self.time_s[whole.start + j]), found=self.shifts,
            sigma=float(np.sqrt(gain[j, k])), alike=self._alike(whole.start, whole.start + j, k),
            since=-1 if self.drifting else self.since,
        )  # fmt: skip
        change = found if confirm is None else confirm(found)
        if change is not None and change.name != self.names[k]:
            # the change is significant; has this one changed by more than it scatters?
            k = self.names.index(change.name)
            linear = float(np.sqrt(gain[j, k]))
            moved = bool(share[j - FEWEST_CELLS, k] >= 1.0 or change.sigma >= THRESHOLD)
            change = (
                msgspec.structs.replace(change, sigma=max(linear, change.sigma)) if moved else None
            )
        if change is not None:
            self._date(shift)
            self.changes.append(change)
            self.since, self.drifting = shift, set()
        return change

    def _join(self) -> None:
        """Make the latest changes one drift where that explains them about as well.

        The first steps of a drift come before it can be distinguished from them, and perhaps by the
        name of a parameter that looks like the one which drifts. Two steps soon after each other look
        like a drift until as many shifts have followed.
        """
        while len(self.changes) > 1:
            before, last = self.changes[-2:]
            lasted = self.shifts - last.shift
            if before.since < self.base or lasted < last.shift - before.shift:
                return
            whole, h, a, t = self.segment(before.since)
            at = int(np.searchsorted(self.first[whole], before.shift))
            later = a[at:] if last.since >= 0 else self._without(before.name, before.shift, a[at:])
            tried = {before.name, last.name, *before.alike, *last.alike}
            drifts = {
                name: drift_instead(t, a[:, k], h[:, k], at, later[:, k])
                for k, name in enumerate(self.names)
                if name in tried
            }
            name = max(drifts, key=drifts.__getitem__)
            gain, worse = drifts.pop(name)
            if worse > JOINED:
                return
            alike = [other for other, own in drifts.items() if own[0] > gain - SEPARABLE]
            drift = msgspec.structs.replace(last, name=name, alike=alike, since=before.since)
            self.changes[-2:] = [drift]
            self.since = drift.shift
            self._date(self.shifts)

    def _without(self, name: str, since: int, a: Floats) -> Floats:
        """Return estimates [m, p] of the cells since a shift less a parameter's line: the others see it, too."""
        whole, h, own, t = self.segment(since)
        k = self.names.index(name)
        line = line_of(t, own[:, k], h[:, k])[0]
        diagonal = np.diagonal(self.information[whole], axis1=1, axis2=2)
        return a - self.information[whole, :, k] / np.maximum(diagonal, 1e-12) * line[:, None]

    def _date(self, until: int) -> None:
        """Date the last change again by all shifts until one, as a step or the begin of a drift.

        A date's interval holds 95 % of its probability under both.
        """
        change = self.changes[-1] if self.changes else None
        if change is None or change.since < 0:
            return
        k = self.names.index(change.name)
        whole, h, a, t = self.segment(change.since)
        own = t < until
        h, a, t = h[own, k], a[own, k], t[own]
        if len(t) < FEWEST_CELLS + 1:
            return
        steps = residual(h, a) - step_gains(h, a)
        ramps = ramp_costs(t, a, h)
        steps[:FEWEST_CELLS], ramps[:FEWEST_CELLS] = np.inf, np.inf
        is_drift = bool(np.min(ramps) < np.min(steps) - 2.0 * RAMP_GAIN)
        chance = np.exp(0.5 * (min(steps.min(), ramps.min()) - steps))
        chance += np.exp(0.5 * (min(steps.min(), ramps.min()) - ramps))
        sure = np.cumsum(chance * self.count[whole][own]) / np.sum(chance * self.count[whole][own])
        low, high = np.searchsorted(sure, [0.025, 0.975]).tolist()
        cell = int(np.argmin(ramps if is_drift else steps))
        first = self.first[whole][own]
        low, high = min(low, cell + 1), max(high, cell)
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
        gains = score**2 / np.maximum(np.diag(information), 1e-12)
        gains *= self._certainty(begin)
        least = gains[k] - max(min(SEPARABLE, 0.5 * gains[k]), LINEAR * gains[k])
        return [name for j, name in enumerate(self.names) if j != k and gains[j] > least]

    def _certainty(self, begin: int) -> Floats:
        """Return the precision [p] of the estimates since a cell, by that stated of their shifts."""
        h = np.diagonal(self.information[begin:], axis1=1, axis2=2).sum(axis=0)
        precision = 1.0 / np.sum(self.variances(slice(begin, None)), axis=0)
        return np.asarray(precision.sum(axis=0) / np.maximum(h, 1e-12))

    # --- what is known now ----------------------------------------------------------------------
    def moved(self) -> list[Floats]:
        """Return how far the parameters [p] have moved since the first shifts, by the changes found.

        Once for each parameter by which the last change can be explained.
        """
        found = [np.zeros(len(self.names))]
        borders = [0, *(change.shift for change in self.changes), self.shifts]
        for change, begin, at, end in zip(
            self.changes, borders, borders[1:], borders[2:], strict=False
        ):
            is_last = change is self.changes[-1]
            ways = []
            for name in (change.name, *change.alike) if is_last else (change.name,):
                k, way = self.names.index(name), found[0].copy()
                after = self.drift(k)[0] if is_last and self.drifting else self.level(k, at, end)[0]
                way[k] += np.nan_to_num(after - self.level(k, begin, at)[0])
                ways.append(way)
            found = ways
        return found

    def drift(self, k: int) -> tuple[float, float, Floats]:
        """Return size now, slope per shift, and their covariance [2, 2], of a drifting parameter."""
        _whole, h, a, t = self.segment(self.since)
        _fit, estimate, covariance = line_of(t - self.shifts, a[:, k], h[:, k])
        return float(estimate[0]), float(estimate[1]), covariance

    # --- storing --------------------------------------------------------------------------------
    def to_bytes(self) -> bytes:
        """Return the state as it is stored."""
        return msgspec.msgpack.encode(
            vars(self) | {"scatter": vars(self.scatter)}, enc_hook=np.ndarray.tolist
        )

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
            elif name == "scatter":
                value = Scatter.from_stored(value)
            setattr(track, name, type(empty)(value) if isinstance(empty, set | tuple) else value)
        return track
