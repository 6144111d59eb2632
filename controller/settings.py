"""Settings of the firmware, typed, bounded and with units; of the strategy only what all share."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal, get_type_hints

from msgspec import Meta, Struct

from can_dbc.errors import InputError


@cache
def _bounds(kind: type[Struct]) -> tuple[tuple[str, Any], ...]:
    """Return the name and the bounds of every bounded field of a settings record."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple((k, m) for k, hint in hints.items() for m in getattr(hint, "__metadata__", ()))


def _wrong(name: str, value: object, expected: str) -> InputError:
    return InputError(f"{name}: {value!r} is wrong; expected {expected}")


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """A settings record with bounds. Raises InputError 'NAME: VALUE is wrong; expected LOW to HIGH UNIT'."""

    def __post_init__(self) -> None:
        for name, meta in _bounds(type(self)):
            value = getattr(self, name)
            if not meta.ge <= value <= meta.le:
                expected = f"{meta.ge:g} to {meta.le:g} {meta.description}"
                raise _wrong(name, value, expected.rstrip())


def bounded(low: float, high: float, unit: str) -> Any:
    """Return the annotation that keeps a setting from `low` to `high` in its unit."""
    return Meta(ge=low, le=high, description=unit)


class SensorConfig(Settings, frozen=True):
    """Calibration of the inductive position sensor and the limits of what it can truly report.

    Pulse law: t8V = (t_mid_s + slope_s_per_m x)(1 + temp_coeff_per_k (T - t_ref_k)), x in m from
    neutral. Source: thesis 2.2.4 (0.9 ms), the slope and temperature inferred.
    """

    period_s: Annotated[float, bounded(0.001, 0.1, "s")] = 0.01
    """Time between two pulses; the filter is designed for it."""
    t_mid_s: Annotated[float, bounded(1e-5, 0.01, "s")] = 0.0009
    """Pulse duration in neutral at the calibration temperature."""
    slope_s_per_m: Annotated[float, bounded(1e-4, 1.0, "s/m")] = 0.022
    """Change of the pulse duration with the position."""
    temp_coeff_per_k: Annotated[float, bounded(-0.005, 0.005, "1/K")] = 0.0012
    """Relative change of the pulse duration with the coil temperature."""
    t_ref_k: Annotated[float, bounded(200.0, 450.0, "K")] = 293.15
    """Calibration temperature."""
    timer_resolution_s: Annotated[float, bounded(1e-9, 1e-4, "s")] = 1e-6
    """One tick of the timer that measures the pulse."""
    temperature_min_k: Annotated[float, bounded(200.0, 450.0, "K")] = 233.15
    """Lowest plausible coil temperature."""
    temperature_max_k: Annotated[float, bounded(200.0, 450.0, "K")] = 423.15
    """Coil temperatures outside these two make a sample implausible."""
    overtravel_m: Annotated[float, bounded(0.0, 0.01, "m")] = 0.003
    """A sample this far beyond an end position is still plausible."""
    max_speed_m_s: Annotated[float, bounded(0.1, 100.0, "m/s")] = 4.0
    """A jump from sample to sample faster than this is implausible."""
    travel_limit_m: Annotated[float, bounded(0.005, 1.0, "m")] = 0.035
    """More travel than this within a short time is implausible: the stay moves one stroke a leg."""
    travel_leak_m_s: Annotated[float, bounded(0.0, 10.0, "m/s")] = 0.3
    """Rate at which old travel is forgotten."""
    bad_limit: Annotated[int, bounded(1, 100, "")] = 6
    """The position counts as lost at this level; a bad sample adds 2, a good one takes 1."""
    still_ticks: Annotated[int, bounded(0, 100, "")] = 2
    """Changes up to this many timer ticks are no motion."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.temperature_min_k >= self.temperature_max_k:
            expected = f"below temperature_max_k, {self.temperature_max_k!r} K"
            raise _wrong("temperature_min_k", self.temperature_min_k, expected)
        for limit in (self.temperature_min_k, self.temperature_max_k):
            if 1.0 + self.temp_coeff_per_k * (limit - self.t_ref_k) <= 0.0:
                expected = f"a pulse longer than zero at {limit!r} K"
                raise _wrong("temp_coeff_per_k", self.temp_coeff_per_k, expected)


class FilterConfig(Settings, frozen=True):
    """Butterworth low-pass on the position, one step per sensor sample (thesis 2.2.4)."""

    enabled: bool = True
    """Whether the position is filtered; controller.filter = false is short for it."""
    order: Annotated[int, bounded(1, 8, "")] = 6
    """Order of the filter."""
    fc_hz: Annotated[float, bounded(0.1, 500.0, "Hz")] = 22.0
    """Cut-off; below half the sensor's sample rate."""


class WindowConfig(Settings, frozen=True):
    """Where the stay counts as being in neutral, backward or forward."""

    stroke_m: Annotated[float, bounded(0.001, 0.1, "m")] = 0.01285
    """Distance of either engaged position from neutral."""
    neutral_tolerance_m: Annotated[float, bounded(1e-4, 0.05, "m")] = 0.0025
    """Neutral: at most this far from it. The filter overshoots a full stroke by 2.2 mm."""
    gear_tolerance_m: Annotated[float, bounded(1e-4, 0.05, "m")] = 0.0015
    """Engaged: no more than this short of the end position."""
    samples: Annotated[int, bounded(1, 100, "")] = 2
    """Consecutive sensor samples inside a window that confirm it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.neutral_tolerance_m + self.gear_tolerance_m >= self.stroke_m:
            limit_m = self.stroke_m - self.gear_tolerance_m
            expected = (
                f"windows that do not overlap: below stroke_m - gear_tolerance_m, {limit_m:g} m"
            )
            raise _wrong("neutral_tolerance_m", self.neutral_tolerance_m, expected)


class BlowConfig(Settings, frozen=True):
    """Filling that goes on after a position is confirmed (thesis 6.1)."""

    duration_s: Annotated[float, bounded(0.0, 0.25, "s")] = 0.15
    """Duration of the blow."""
    cut: Literal["none", "sync", "confirmation"] = "sync"
    """What ends the blow before its time: nothing; agreeing shaft speeds, when a gear is to follow
    neutral; or the confirmation itself, so that there is no blow."""


class ShiftConfig(Settings, frozen=True):
    """Times and tolerances of the shift state machine."""

    push_timeout_s: Annotated[float, bounded(0.05, 30.0, "s")] = 1.0
    """A push that has not confirmed its position by then has failed."""
    retries: Annotated[int, bounded(0, 5, "")] = 1
    """Further pushes after a failed one, before the fault state."""
    retry_pause_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.1
    """Everything vented this long before another push."""
    no_motion_s: Annotated[float, bounded(0.05, 30.0, "s")] = 0.4
    """A push under which the sensor has not changed at all by then: sensor (or actuator) stuck."""
    reversal_settle_s: Annotated[float, bounded(0.0, 5.0, "s")] = 0.12
    """A push that starts inside its own window is confirmed only after this time: sensor, filter
    and closing valve still hide a motion out of the window."""
    hold_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.04
    """After the blow, until the valve has closed (35 ms)."""
    vent_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.11
    """After that, until the chamber has vented."""
    interlock_s: Annotated[float, bounded(0.0, 1.0, "s")] = 0.04
    """Backward is not filled sooner than this after forward was, and vice versa."""
    sync_tolerance_rad_s: Annotated[float, bounded(0.0, 1000.0, "rad/s")] = 2.0
    """Shaft speeds no further apart than this agree."""
    wait_for_sync: bool = False
    """Leave neutral only when the shaft speeds agree (otherwise the synchronizer does it all)."""
    sync_wait_s: Annotated[float, bounded(0.0, 30.0, "s")] = 1.0
    """Longest such wait; the push starts then all the same."""
    init_settle_s: Annotated[float, bounded(0.0, 5.0, "s")] = 0.04
    """After start or fault: a gear counts once its window holds the position this long without a break."""
    init_timeout_s: Annotated[float, bounded(0.0, 30.0, "s")] = 0.3
    """After start or fault: ready with an unknown gear when none was found by then."""


class E2eConfig(Settings, frozen=True):
    """Supervision of the received channels."""

    position_timeout_s: Annotated[float, bounded(0.001, 10.0, "s")] = 0.05
    """Position pulses count as lost after this long without a good one."""
    request_timeout_s: Annotated[float, bounded(0.001, 10.0, "s")] = 0.1
    """Gear requests count as lost after this long without a good one."""
    speeds_timeout_s: Annotated[float, bounded(0.001, 10.0, "s")] = 0.05
    """Shaft speeds count as lost after this long without good ones."""
    startup_s: Annotated[float, bounded(0.0, 10.0, "s")] = 0.2
    """A channel that has never been valid this long after the first step counts as lost."""


class BroadcastConfig(Settings, frozen=True):
    """What the firmware says in ETC1 and ETC2 of the gears that it engages."""

    etc2_period_s: Annotated[float, bounded(0.01, 1.0, "s")] = 0.01
    """Period of ETC2: 0.1 s in SAE J1939-71, by default that of ETC1 so that a shift can be followed."""
    gear_backward: Annotated[int, bounded(-125, 125, "")] = 2
    """Number of the gear in the backward position; negative is reverse."""
    gear_forward: Annotated[int, bounded(-125, 125, "")] = 1
    """Number of the gear in the forward position."""
    ratio_backward: Annotated[float, bounded(0.0, 64.0, "")] = 0.0
    """Input by output speed in the backward gear; 0: not known, speeds are sent as they come."""
    ratio_forward: Annotated[float, bounded(0.0, 64.0, "")] = 0.0
    """The same in the forward gear."""


class ControlConfig(Settings, frozen=True):
    """All settings of the firmware but its strategy, by default today's. Raises InputError 'FIELD: what; expected ...'."""

    period_s: Annotated[float, bounded(0.002, 0.02, "s")] = 0.01
    """Time between two steps, a whole number of nanoseconds (thesis 2.2.1: 10 ms)."""
    computation_s: Annotated[float, bounded(0.0, 0.02, "s")] = 0.0001
    """From the start of a step until its frames wait for the bus; below period_s."""
    ns_per_instruction: Annotated[float, bounded(0.0, 10_000.0, "ns")] = 0.0
    """Of a firmware in C: its frames wait for the bus after the time of their step's instructions, in
    place of computation_s; a step longer than period_s misses ticks. 0: computation_s."""
    duty: Annotated[float, bounded(0.35, 1.0, "")] = 0.98
    """Duty that opens a valve (thesis 3.1.3)."""
    duty_closed: Annotated[float, bounded(0.0, 0.35, "")] = 0.33
    """A duty up to this surely leaves a valve closed; above it the valve counts as energised."""
    sensor: SensorConfig = SensorConfig()
    filter: FilterConfig = FilterConfig()
    windows: WindowConfig = WindowConfig()
    blow: BlowConfig = BlowConfig()
    shift: ShiftConfig = ShiftConfig()
    e2e: E2eConfig = E2eConfig()
    broadcast: BroadcastConfig = BroadcastConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.period_s * 1e9 - self.period_ns) > 1e-3:
            raise _wrong("period_s", self.period_s, "a whole number of nanoseconds")
        if self.computation_s >= self.period_s:
            expected = f"below period_s, {self.period_s!r} s"
            raise _wrong("computation_s", self.computation_s, expected)
        nyquist_hz = 0.5 / self.sensor.period_s
        if self.filter.fc_hz >= nyquist_hz:
            expected = f"below {nyquist_hz:g} Hz, half the rate of the sensor"
            raise _wrong("filter.fc_hz", self.filter.fc_hz, expected)
        timeout_s = self.e2e.position_timeout_s
        if timeout_s <= self.sensor.period_s:
            expected = f"above sensor.period_s, {self.sensor.period_s!r} s"
            raise _wrong("e2e.position_timeout_s", timeout_s, expected)

    @property
    def period_ns(self) -> int:
        """Time between two steps, ns."""
        return nanoseconds(self.period_s)

    @property
    def computation_ns(self) -> int:
        """From the start of a step until its frames wait for the bus, ns."""
        return nanoseconds(self.computation_s)


def nanoseconds(seconds: float) -> int:
    """Return seconds as whole nanoseconds, ties to even."""
    return round(seconds * 1e9)
