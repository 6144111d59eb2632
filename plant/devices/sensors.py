"""Sensors of the position: inductive sensor and its filtered chain."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from can_dbc.instants import NS_PER_S
from plant.devices.valve import seconds_to_ns
from plant.errors import InputError
from plant.parameters import ParameterSet

Floats = NDArray[np.float64]
Instants = NDArray[np.int64]


def named_generator(seed: int, *names: object) -> np.random.Generator:
    """Random generator that depends on `seed` and the names alone, so no draw disturbs another."""
    digest = hashlib.sha256("\0".join(str(name) for name in names).encode()).digest()
    words = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))


@dataclass(frozen=True)
class InductiveSensor:
    """Coil with a movable core: the time its voltage takes to reach 8 V depends on the position.

    t8V(x, T) = (t_mid + slope x) (1 + temp_coeff (T - T_ref)), x in m from neutral; times and tick in s.
    Raises InputError for a time, slope or tick that cannot be. Source: thesis 2.2.4; numbers inferred.
    """

    t_mid_s: float
    slope_s_m: float
    temp_coeff_1_k: float
    t_ref_k: float
    tick_s: float

    def __post_init__(self) -> None:
        for name, size in (
            ("t_mid", self.t_mid_s),
            ("slope", abs(self.slope_s_m)),
            ("timer_resolution", self.tick_s),
        ):
            if not size > 0.0:
                raise InputError(f"position_sensor.{name}: {size:g}; expected other than 0")

    @classmethod
    def from_parameters(cls, parameters: ParameterSet) -> InductiveSensor:
        """Sensor from the section `position_sensor` of a parameter set."""
        value = parameters.value
        return cls(
            t_mid_s=value("position_sensor.t_mid"),
            slope_s_m=value("position_sensor.slope"),
            temp_coeff_1_k=value("position_sensor.temp_coeff"),
            t_ref_k=value("position_sensor.T_ref"),
            tick_s=value("position_sensor.timer_resolution"),
        )

    def duration_s(self, position_m: ArrayLike, temperature_k: float) -> Floats:
        """Time to 8 V [s] at a stay position [m] and coil temperature [K]."""
        cold = self.t_mid_s + self.slope_s_m * np.asarray(position_m, dtype=np.float64)
        return np.asarray(cold * self._warmth(temperature_k))

    def ticks(self, duration_s: ArrayLike) -> Floats:
        """Whole timer ticks nearest to a duration [s]."""
        return np.rint(np.asarray(duration_s, dtype=np.float64) / self.tick_s)

    def pulse_s(self, position_m: float, temperature_k: float, noise_s: float = 0.0) -> float:
        """Pulse duration [s] as the timer counts it, `noise_s` added before it does."""
        cold = self.t_mid_s + self.slope_s_m * position_m
        return self.counted_s(cold * self._warmth(temperature_k) + noise_s)

    def counted_s(self, duration_s: float) -> float:
        """Duration [s] as the timer counts it."""
        return max(0, round(duration_s / self.tick_s)) * self.tick_s

    def position_m(self, pulse_s: ArrayLike, temperature_k: float) -> Floats:
        """Position [m] of a pulse [s] if the coil is at `temperature_k` [K]."""
        cold = np.asarray(pulse_s, dtype=np.float64) / self._warmth(temperature_k)
        return np.asarray((cold - self.t_mid_s) / self.slope_s_m)

    @property
    def measurement_offset_ns(self) -> int:
        """Time [ns] from the start of a pulse to the instant whose position it measures."""
        return seconds_to_ns(0.5 * self.t_mid_s)

    def _warmth(self, temperature_k: float) -> float:
        return 1.0 + self.temp_coeff_1_k * (temperature_k - self.t_ref_k)


@lru_cache(maxsize=64)
def _butterworth(order: int, cutoff_hz: float, rate_hz: float) -> tuple[Floats, Floats]:
    """Return second-order sections and their state at rest under 1."""
    from scipy.signal import butter, sosfilt_zi

    if not 1 <= order <= 12:
        raise InputError(f"position_sensor.butter_order: {order}; expected 1 to 12, or 0 for none")
    if not 0.0 < cutoff_hz < 0.5 * rate_hz:
        raise InputError(
            f"position_sensor.butter_fc: {cutoff_hz:g}; expected above 0 and below "
            f"{0.5 * rate_hz:g} Hz, half the sample rate"
        )
    sections = butter(order, cutoff_hz, fs=rate_hz, output="sos")
    return sections, sosfilt_zi(sections)


def low_passed(samples: Floats, order: int, cutoff_hz: float, rate_hz: float) -> Floats:
    """Filter samples [n] by a Butterworth low-pass that was settled at the first one.

    Raises InputError unless 1 <= order <= 12 and 0 < cutoff_hz < rate_hz/2.
    """
    from scipy.signal import sosfilt

    sections, at_rest = _butterworth(order, cutoff_hz, rate_hz)
    return np.asarray(sosfilt(sections, samples, zi=at_rest * samples[0])[0])


@dataclass(frozen=True)
class InternalChain:
    """The position as the control unit reports it: pulse, timer, conversion, filter, hold.

    A pulse starts at every tick, measures the position at tick + t_mid/2, is counted in timer ticks, converted back
    with `calibration` and the measured temperature, filtered once per period, and holds from tick + latency + t8V
    until the next one. period_s, latency_s [s]; filter_order 0: none; cutoff_hz [Hz]; coil_temperature_k: its own,
    measured_temperature_k: the one compensated for [K]. Source: thesis 2.2.4; numbers inferred. Matches
    `position_internal_m` of recorded strokes.
    """

    sensor: InductiveSensor
    calibration: InductiveSensor
    period_s: float
    latency_s: float
    filter_order: int
    cutoff_hz: float
    coil_temperature_k: float
    measured_temperature_k: float

    def __post_init__(self) -> None:
        if not 1e-6 <= self.period_s <= 10.0:
            raise InputError(f"position_sensor.period: {self.period_s:g}; expected 1e-6 to 10 s")
        if not 0.0 <= self.latency_s <= 10.0:
            raise InputError(f"position_sensor.latency: {self.latency_s:g}; expected 0 to 10 s")

    @classmethod
    def from_parameters(cls, parameters: ParameterSet) -> InternalChain:
        """Chain from the section `position_sensor` of a parameter set, coil at T_ref."""
        sensor = InductiveSensor.from_parameters(parameters)
        value = parameters.value
        return cls(
            sensor=sensor,
            calibration=sensor,
            period_s=value("position_sensor.period"),
            latency_s=value("position_sensor.latency"),
            filter_order=round(value("position_sensor.butter_order")),
            cutoff_hz=value("position_sensor.butter_fc"),
            coil_temperature_k=sensor.t_ref_k,
            measured_temperature_k=sensor.t_ref_k,
        )

    def ticks_s(self, end_s: float, phase_s: float = 0.0) -> Floats:
        """Return the starts of the pulses [s] of a record 0 <= t <= end_s, one at `phase_s`, from the last one before 0 on."""
        first_s = phase_s % self.period_s
        last_s = end_s - 0.5 * self.sensor.t_mid_s
        count = max(0, int(np.floor((last_s - first_s) / self.period_s + 1e-9)) + 1)
        return np.asarray(first_s + np.arange(-1, count) * self.period_s, dtype=np.float64)

    def measurement_instants_ns(self, end_s: float, phase_s: float = 0.0) -> Instants:
        """Instants [ns] whose position the pulses of `ticks_s` measure; rest before time 0."""
        started = np.rint(self.ticks_s(end_s, phase_s) * NS_PER_S).astype(np.int64)
        return np.maximum(started + self.sensor.measurement_offset_ns, 0)

    def held_m(self, time_s: Floats, tick_s: Floats, measured_m: Floats) -> Floats:
        """Return the reported position [n] in m at `time_s` [n] of positions measured [k] at ticks [k].

        Before the first publication that of the first; one published at the instant of a record, but for rounding, is
        in it.
        """
        duration_s = self.sensor.duration_s(measured_m, self.coil_temperature_k)
        pulse_s = self.sensor.ticks(duration_s) * self.sensor.tick_s
        values = self.calibration.position_m(pulse_s, self.measured_temperature_k)
        if self.filter_order:
            rate_hz = 1.0 / self.period_s
            values = low_passed(values, self.filter_order, self.cutoff_hz, rate_hz)
        published_s = tick_s + self.latency_s + pulse_s
        index = np.searchsorted(published_s, time_s, side="right") - 1
        return np.asarray(values[np.maximum(index, 0)])
