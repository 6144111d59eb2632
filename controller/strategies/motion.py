"""What the samples of the position tell of a push: when the stay began to move, was released, and arrived.

All times are those of the step that has a sample first: later than the motion by the age of a sample, which is
constant in a unit, since the sensor is sampled by its own clock. The constants are fitted to pushes of the
plant (`tests/bench/_learned_motion.py`), over the root of the way in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

from controller.position import Sample

LOWEST_M, HIGHEST_M = 0.0003, 0.0054
"""Way of the stay in a sample that tells its onset: above the ticks of the sensor, before the block."""
ROOT_S, SQUARE_S, CUBE_S = 0.012612, -0.002094, 0.000401
PER_PA, ROOT_PER_PA = -1.956e-8, -0.443e-8
MEAN_PA = 8.5e5
"""Time from the onset on, and by how much shorter it is under more pressure: within 0.2 ms."""
BLOCK_M, NEAR_M, CLEAR_M, FAR_M = 0.005995, 0.00012, 0.00025, 0.0018
"""Where the synchronizer blocks the stay; how near a sample there is, the scale of the sensor being inexact; how
far from the block one is that has left it; from which way beyond it on the teeth may hold the stay."""
MOVED_M = BLOCK_M + NEAR_M
START_S = 0.0275
"""From a command to the onset that it leads to, by a valve of nominal delay."""
LEFT_S = {
    (True, False): (0.0, -0.000051, 0.002721, 0.001291),
    (True, True): (-0.006061, 0.005837, 0.004406, -0.000865),
    (False, False): (-0.000107, 0.002895, 0.001064, 0.000587),
    (False, True): (-0.013781, 0.018189, 0.001239, -0.003433),
}
SCATTER_S = {
    (True, False): 0.00035,
    (True, True): 0.00075,
    (False, False): 0.0006,
    (False, True): 0.0008,
}
"""Time from the release to a way beyond the block, and how well it is known: after a plain push or a programme,
whose delay of the release is known to 0.5 ms, and is 0.45 ms more than in its table; far beyond it or not."""
ARRIVED = 0.9
"""Share of the stroke at which the stay has passed the teeth."""


class Motion:
    """Take the samples of one push.

    onset_s, arrived_s: None until they are found. left: time of the first sample beyond the block, and
    how far beyond it is in m.
    """

    def __init__(self, sample_period_s: float, stroke_m: float, supply_pa: float) -> None:
        self.onset_s: float | None = None
        self.left: tuple[float, float] | None = None
        self.arrived_s: float | None = None
        self.seeks_onset = True
        self._period_s, self._arrived_m = sample_period_s, ARRIVED * stroke_m
        self._above_pa = supply_pa - MEAN_PA
        self._rest_m = self._before_m = self._largest_m = 0.0
        self._block_m = BLOCK_M
        self._has_begun = False

    def position(self, samples: Sequence[Sample], spent_s: float, is_falling: bool) -> bool:
        """Take the samples of a step. Return whether the onset is found by them.

        spent_s: since the push began. is_falling: whether the speeds have begun to fall.
        """
        found = False
        for sample in samples:
            if not self._has_begun:
                self._has_begun = True
                self._rest_m = self._before_m = sample.raw_m
            way_m = abs(sample.raw_m - self._rest_m)
            if is_falling:
                self._take(way_m, abs(sample.raw_m), spent_s)
            elif self.seeks_onset and way_m >= LOWEST_M:
                self.seeks_onset = False
                if way_m <= HIGHEST_M and len(samples) == 1:
                    self.onset_s = spent_s - self._taken(way_m)
                    found = True
            self._before_m = abs(sample.raw_m)
        return found

    def _taken(self, way_m: float) -> float:
        """Return the time from the onset to a way."""
        root = sqrt(1000.0 * way_m)
        taken_s = root * (ROOT_S + root * (SQUARE_S + root * CUBE_S))
        return taken_s + self._above_pa * (PER_PA + root * ROOT_PER_PA)

    def _take(self, way_m: float, at_m: float, spent_s: float) -> None:
        """Take a sample after the speeds began to fall: the stay is at the block, or has left it."""
        step_m = abs(at_m - self._before_m)
        self._largest_m = max(self._largest_m, step_m)
        if way_m < MOVED_M:
            if abs(way_m - BLOCK_M) < NEAR_M:
                self._block_m = way_m
            return
        if self.left is None and way_m > self._block_m + CLEAR_M:
            self.left = spent_s, way_m - self._block_m
        over_m = at_m - self._arrived_m
        if over_m > 0.0 and self.arrived_s is None and step_m > 0.0:
            self.arrived_s = spent_s - min(over_m / step_m, 1.0) * self._period_s

    @property
    def fastest_m_s(self) -> float:
        """Greatest speed between two samples since the speeds of the shafts began to fall."""
        return self._largest_m / self._period_s

    def released_s(self, expected_s: float, is_plain: bool) -> tuple[float, float] | None:
        """Return when the stay left the block, and the variance of that; None if no sample tells it.

        expected_s: when it is expected to: the later, the more pressure drives the stay.
        """
        if self.left is None:
            return None
        at_s, beyond_m = self.left
        kind = is_plain, beyond_m >= FAR_M
        first_s, root_s, inverse_s, square_s = LEFT_S[kind]
        root = sqrt(1000.0 * beyond_m)
        taken_s = first_s + root * (root_s + 0.1 / expected_s * inverse_s + root * square_s)
        return at_s - taken_s, SCATTER_S[kind] * SCATTER_S[kind]
