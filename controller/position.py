"""Pulse duration to position: calibration, plausibility, filter, and the gear windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from can_dbc.messages import Gear, PositionPulse
from controller.filters import SectionFilter, butterworth
from controller.settings import ControlConfig, SensorConfig, WindowConfig


class Sample(NamedTuple):
    """One accepted sensor sample: as measured, filtered, and the filtered velocity."""

    raw_m: float
    position_m: float
    velocity_m_s: float


class Estimate(NamedTuple):
    """Estimate of the motion of the stay; positions in m from neutral, backward positive.

    `samples`: those accepted in this step, oldest first; the other fields repeat the newest, void while not `valid`.
    """

    valid: bool
    raw_m: float
    position_m: float
    velocity_m_s: float
    samples: tuple[Sample, ...]


class Calibration:
    """Inverse of t8V = (t_mid + slope x)(1 + temp_coeff (T - T_ref)) (thesis 2.2.4)."""

    def __init__(self, sensor: SensorConfig) -> None:
        self._sensor = sensor
        self.still_m = sensor.still_ticks * sensor.timer_resolution_s / sensor.slope_s_per_m

    def position_m(self, pulse_s: float, coil_temperature_k: float) -> float:
        """Return the position, m from neutral, of a pulse at a coil temperature."""
        sensor = self._sensor
        warmth = 1.0 + sensor.temp_coeff_per_k * (coil_temperature_k - sensor.t_ref_k)
        return (pulse_s / warmth - sensor.t_mid_s) / sensor.slope_s_per_m


class Plausibility:
    """Separate samples that the stay can have produced from those that it cannot.

    A sample is bad when temperature or position is out of range, it is further from the one before than the stay can
    move, or the latest travel exceeds what a shift can need. Bad ones raise the level by 2, good ones lower it by 1;
    at the limit the position is implausible until the level is back at zero.
    """

    def __init__(self, sensor: SensorConfig, stroke_m: float, slack_m: float) -> None:
        self._sensor = sensor
        self._range_m = stroke_m + sensor.overtravel_m
        self._reach_m = sensor.max_speed_m_s * sensor.period_s
        self._slack_m = slack_m
        self._leak_m = sensor.travel_leak_m_s * sensor.period_s
        self._travel_top_m = sensor.travel_limit_m + stroke_m
        self._travel_m = 0.0
        self._level = 0
        self.implausible = False

    def restart(self) -> None:
        """Forget the travel; the level stays."""
        self._travel_m = 0.0

    def in_range(self, raw_m: float, coil_temperature_k: float) -> bool:
        """Return whether a sample on its own is possible."""
        sensor = self._sensor
        return (
            sensor.temperature_min_k <= coil_temperature_k <= sensor.temperature_max_k
            and -self._range_m <= raw_m <= self._range_m
        )

    def follows(self, distance_m: float, samples: int) -> bool:
        """Return whether the stay can move that far in so many sample periods, and add to the travel."""
        way_m = abs(distance_m)
        travel_m = max(0.0, self._travel_m - self._leak_m * samples) + way_m
        self._travel_m = min(travel_m, self._travel_top_m)
        reach_m = self._reach_m * samples + self._slack_m
        return way_m <= reach_m and travel_m <= self._sensor.travel_limit_m

    def count(self, good: bool) -> None:
        """Move the level by one verdict."""
        if good:
            self._level = max(0, self._level - 1)
            if self._level == 0:
                self.implausible = False
        else:
            self._level = min(self._sensor.bad_limit, self._level + 2)
            if self._level == self._sensor.bad_limit:
                self.implausible = True


def position_filter(config: ControlConfig) -> SectionFilter | None:
    """Return the filter of the position, one step per sensor sample; None if it is off."""
    design = config.filter
    if not design.enabled:
        return None
    return SectionFilter(butterworth(design.order, design.fc_hz, 1.0 / config.sensor.period_s))


class PositionEstimator:
    """From pulses to the estimate: one filter step per sensor sample, bounded work per step.

    The filter starts at rest at the first valid sample. Missing samples (index skipped, or bad) are interpolated, so
    that it keeps its time base; after a longer gap it starts afresh.
    """

    def __init__(self, config: ControlConfig) -> None:
        sensor = config.sensor
        self._calibration = Calibration(sensor)
        self._still_m = self._calibration.still_m
        self._plausibility = Plausibility(sensor, config.windows.stroke_m, self._still_m)
        self._rate_hz = 1.0 / sensor.period_s
        self._filter = position_filter(config)
        self._most_pulses = int(config.period_s / sensor.period_s) + 3
        self._longest_gap = min(64, int(config.e2e.position_timeout_s / sensor.period_s))
        self._settled = False
        self._index = 0  # of the last good sample
        self._has_plausible = False
        self._plausible_index = 0  # of the last sample in range
        self._plausible_m = 0.0
        self._last = Sample(0.0, 0.0, 0.0)
        self._lowest_m = 0.0
        self._highest_m = 0.0
        self._stuck_at_m: float | None = None

    @property
    def implausible(self) -> bool:
        """Whether too many samples were implausible."""
        return self._plausibility.implausible

    @property
    def stuck(self) -> bool:
        """Whether the sensor was found stuck and has not moved since."""
        return self._stuck_at_m is not None

    @property
    def moved(self) -> bool:
        """Whether the sensor has changed by more than its ticks since `mark`."""
        return self._highest_m - self._lowest_m > self._still_m

    def mark(self) -> None:
        """Watch for motion from here on."""
        self._lowest_m = self._highest_m = self._last.raw_m

    def distrust(self) -> None:
        """Take the sensor for stuck until it changes."""
        self._stuck_at_m = self._last.raw_m

    def update(self, pulses: Sequence[PositionPulse], lost: bool) -> Estimate:
        """Take the pulses since the last step, the newest if they are too many; `lost`: the estimate is void."""
        accepted: list[Sample] = []
        if lost:
            self._settled = self._has_plausible = False
            self._plausibility.restart()
        else:
            for pulse in pulses[-self._most_pulses :]:
                self._take(pulse, accepted)
        raw_m, position_m, velocity_m_s = self._last
        return Estimate(self._settled, raw_m, position_m, velocity_m_s, tuple(accepted))

    def _take(self, pulse: PositionPulse, accepted: list[Sample]) -> None:
        raw_m = self._calibration.position_m(pulse.pulse_s, pulse.coil_temperature_k)
        index = pulse.sample_index
        if not self._plausibility.in_range(raw_m, pulse.coil_temperature_k):
            self._judge(False)
            return
        good = True
        if self._has_plausible:
            steps = (index - self._plausible_index) % 256
            if steps == 0:  # a repeated sample holds no information
                return
            good = self._plausibility.follows(raw_m - self._plausible_m, steps)
        self._has_plausible, self._plausible_m, self._plausible_index = True, raw_m, index
        self._judge(good)
        if not good or self._plausibility.implausible:
            return
        gap = (index - self._index) % 256
        if not self._settled or gap > self._longest_gap:
            if self._filter is not None:
                self._filter.settle(raw_m)
            self._settled, self._last = True, Sample(raw_m, raw_m, 0.0)
        else:
            self._filter_to(raw_m, gap)
        self._accept(index, accepted)

    def _judge(self, good: bool) -> None:
        self._plausibility.count(good)
        if self._plausibility.implausible:
            self._settled = False

    def _filter_to(self, raw_m: float, steps: int) -> None:
        """Filter up to a new sample; the velocity is the last difference over the period."""
        start_m, before_m, _ = self._last
        for step in range(1, steps + 1):
            position_m = start_m + (raw_m - start_m) * step / steps
            if self._filter is not None:
                position_m = self._filter.update(position_m)
            velocity_m_s = (position_m - before_m) * self._rate_hz
            before_m = position_m
        self._last = Sample(raw_m, position_m, velocity_m_s)

    def _accept(self, index: int, accepted: list[Sample]) -> None:
        self._index = index
        raw_m = self._last.raw_m
        self._lowest_m = min(self._lowest_m, raw_m)
        self._highest_m = max(self._highest_m, raw_m)
        if self._stuck_at_m is not None and abs(raw_m - self._stuck_at_m) > self._still_m:
            self._stuck_at_m = None
        accepted.append(self._last)


class GearWindows:
    """Find the gear whose window the estimate is in, and for how many samples in a row.

    A sample is in a window only if it is so both as measured and filtered: the filter overshoots,
    and alone would report a stay held short of its end position as arrived.
    """

    def __init__(self, windows: WindowConfig) -> None:
        self._neutral_m = windows.neutral_tolerance_m
        self._engaged_m = windows.stroke_m - windows.gear_tolerance_m
        self.gear = Gear.UNKNOWN
        self.run = 0

    def gear_at(self, position_m: float) -> Gear:
        """Return the gear whose window holds a position, or UNKNOWN between the windows."""
        if position_m >= self._engaged_m:
            return Gear.BACKWARD
        if position_m <= -self._engaged_m:
            return Gear.FORWARD
        if -self._neutral_m <= position_m <= self._neutral_m:
            return Gear.NEUTRAL
        return Gear.UNKNOWN

    def update(self, estimate: Estimate) -> None:
        """Take the samples of a step; an invalid estimate belongs to no gear."""
        if not estimate.valid:
            self.gear = Gear.UNKNOWN
            self.run = 0
            return
        for sample in estimate.samples:
            gear = self.gear_at(sample.position_m)
            if gear != self.gear_at(sample.raw_m):
                gear = Gear.UNKNOWN
            self.run = self.run + 1 if gear == self.gear else 1
            self.gear = gear
