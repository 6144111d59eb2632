"""A brake timed by the shaft speeds, which predict when the synchronizer will release the stay."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import sqrt
from typing import Annotated

from msgspec import Struct

from controller.settings import ControlConfig, bounded
from controller.strategies import into_gear


class SynchroBrakeParameters(into_gear.IntoGearParameters, frozen=True):
    """When to act before the forecast release, and for how long; when to leave it."""

    brake_lead_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.03
    burst_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.005
    rest_lead_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.04
    rest_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.005
    least_lead_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.03
    """A release nearer than this is not braked: the counter-pressure would come after it."""
    least_rad_s: Annotated[float, bounded(0.0, 10.0, "rad/s")] = 0.5
    """Fall of the difference from report to report that counts as one."""
    least_fall_rad_s2: Annotated[float, bounded(0.0, 10000.0, "rad/s2")] = 600.0
    """Fall at the release, and twice that of now, below which the force on the synchronizer is
    too small to be braked: the stay would not get past the dogs, nor hit its stop hard."""


class SynchroBrake(into_gear.IntoGear):
    """Brake so that the counter-pressure is there when the shafts run together.

    While the synchronizer blocks, the difference of the speeds falls; the parabola through its last three reports says
    when it is zero and the stay let go. The neutral chamber is filled from `brake_lead_s` before that instant for
    `burst_s`, the driving one left from `rest_lead_s` before it for `rest_s` (a valve follows only if it closes in
    less). Every report renews the forecast until the first of the two begins; no brake if the release is too near or
    the force too small. Some 50 operations and a root a step. Assumes that the engine gives no torque meanwhile.
    Without a synchronizer, or without speeds, it is the open loop.
    """

    Parameters = SynchroBrakeParameters
    parameters: SynchroBrakeParameters

    _release_s: float | None = None
    _brake_s: float | None = None
    _rest_s: float | None = None

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        super().__init__(config, parameters)
        self._reports: deque[tuple[float, float]] = deque(maxlen=3)

    def reset(self) -> None:
        """Forget the reports, the forecast and what has begun."""
        self._reports.clear()
        self._release_s = self._brake_s = self._rest_s = None

    def decide(self, progress: into_gear.PushProgress) -> into_gear.Command:
        """Push but for the two intervals before and after the forecast release."""
        parameters = self.parameters
        # the step nearest to an instant acts for it
        now_s = progress.spent_s + 0.5 * self.config.period_s
        if self._brake_s is None and self._rest_s is None:
            self._note(progress)
            if self._release_s is None or self._release_s - now_s < parameters.least_lead_s:
                return into_gear.PUSH
        assert self._release_s is not None
        if self._brake_s is None and now_s >= self._release_s - parameters.brake_lead_s:
            self._brake_s = now_s
        if self._rest_s is None and now_s >= self._release_s - parameters.rest_lead_s:
            self._rest_s = now_s
        brake = into_gear.within(self._brake_s, now_s, parameters.burst_s)
        rest = into_gear.within(self._rest_s, now_s, parameters.rest_s)
        return into_gear.Command(not rest, brake)

    def _note(self, progress: into_gear.PushProgress) -> None:
        """Take a new report, and forecast when the speeds will be equal."""
        if progress.apart_rad_s is None:
            self._reports.clear()
            self._release_s = None
            return
        if self._reports and progress.apart_s <= self._reports[-1][0]:
            return
        self._reports.append((progress.apart_s, progress.apart_rad_s))
        if len(self._reports) == 3:
            self._release_s = release_s(self._reports, self.parameters)


def release_s(
    reports: Iterable[tuple[float, float]], parameters: SynchroBrakeParameters
) -> float | None:
    """Return when the parabola through three reports is zero, None if it falls too little.

    `reports`: time, s, and difference of the speeds, rad/s. With the fall and its growth at the
    last report, difference(t) = d2 - fall t - growth t^2 / 2.
    """
    (t0_s, d0), (t1_s, d1), (t2_s, d2) = reports
    if d1 - d2 < parameters.least_rad_s:
        return None
    first, second = (d0 - d1) / (t1_s - t0_s), (d1 - d2) / (t2_s - t1_s)
    growth = max(0.0, 2.0 * (second - first) / (t2_s - t0_s))
    fall = second + 0.5 * growth * (t2_s - t1_s)
    last = sqrt(fall * fall + 2.0 * growth * d2)
    if last < parameters.least_fall_rad_s2 or fall < 0.5 * parameters.least_fall_rad_s2:
        return None
    return t2_s + 2.0 * d2 / (fall + last)
