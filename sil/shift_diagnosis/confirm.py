"""Changes of a watched truck confirmed, and named, by fits to the shifts after them.

The track finds a change by shifts that were linearised before it. Far from that point they are not
linear: one cause looks like others, and shifts about to stick look like a change.
Checked by: tests/unit/sil/shift_diagnosis/test_confirm.py, test_watch.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np

from sil.shift_diagnosis.change import Change, renamed
from sil.shift_diagnosis.healthy import FIT_SHIFTS
from sil.shift_diagnosis.linear import Linear
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.shifts import Shift
from sil.shift_diagnosis.track import THRESHOLD, Track
from sil.shift_diagnosis.verdict import LARGEST

ROUNDS: Final = 3
"""Steps of the fit of one cause to shifts after a change."""
CONFIRMED: Final = 0.25
"""Share of the expected gain that shifts after a change must show."""


@dataclass(frozen=True)
class Confirming:
    """Confirms changes of a truck by fits to its shifts instead of by the linear model.

    shifts: those that are taken, the first of which is number `begin` of the track; linear:
    linearises shifts with sizes of causes; before: sizes before a change.
    """

    track: Track
    begin: int
    shifts: Sequence[Shift]
    linear: Callable[..., Linear]
    causes: Sequence[Cause]
    before: dict[Cause, float]

    def __call__(self, change: Change) -> Change | None:
        """Return a change by its best name, or None if the shifts do not show it.

        The shifts after it must gain CONFIRMED of what the linear model expects of them, where that
        is more than their noise.
        """
        own = self.shifts[max(0, change.shift - self.begin) : self.track.shifts - self.begin]
        own = own[-2 * FIT_SHIFTS :]
        if not own:
            return None  # those of an earlier log: found again by the next ones
        here = self.linear(own, causes=self.causes, active=self.before)
        n, cost = here.units, float(here.misfit.sum())
        h, g = here.information.sum(axis=0)[n:, n:], here.score.sum(axis=0)[n:]
        costs, sizes = {}, {}
        for k, cause in enumerate(self.causes):
            step = float(g[k]) / max(float(h[k, k]), 1e-12)
            best, sizes[cause.effect.id] = self._fitted(cause, own, step)
            costs[cause.effect.id] = min(cost, best)
        k = self.track.names.index(change.name)
        last = max([self.track.base, *(each.shift for each in self.track.changes)])
        moved = self.track.level(k, change.shift)[0] - self.track.level(k, last, change.shift)[0]
        expected = float(h[k, k]) * moved**2
        if expected > THRESHOLD**2 and cost - min(costs.values()) < CONFIRMED * expected:
            return None
        found = renamed(change, costs)
        if found.name != change.name:  # by how much more than this one scatters from trip to trip?
            k = self.track.names.index(found.name)
            size, deviation = self.track.level(k, last, change.shift)
            scatter = self.track.scatter
            variance = scatter.within2[k] / max(float(h[k, k]), 1e-12) + scatter.between2[k]
            sigma = abs(sizes[found.name] - size) / np.hypot(deviation, np.sqrt(variance))
            found = msgspec.structs.replace(found, sigma=float(sigma))
        return found

    def _fitted(self, cause: Cause, shifts: Sequence[Shift], step: float) -> tuple[float, float]:
        """Return chi squared of shifts with a cause of the best size, and that size.

        step: the first one, from the size before the change.
        """
        low, high = cause.sizes(LARGEST)
        size = found = self.before.get(cause, 0.0)
        best = np.inf
        for _ in range(ROUNDS):
            size = min(max(size + step, low), high)
            linear = self.linear(shifts, causes=[cause], active=self.before | {cause: size})
            cost = float(linear.misfit.sum())
            if cost >= best:
                break
            best, found, n = cost, size, linear.units
            h = max(float(linear.information[:, n, n].sum()), 1e-12)
            step = float(linear.score[:, n].sum()) / h
        return best, found
