"""Circuit of the inductive sensor: when it pulses, what it reports, and how it may fail."""

from __future__ import annotations

from collections import deque
from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta
from numpy.random import Generator

from plant.devices.sensors import InductiveSensor, named_generator
from plant.devices.signal_faults import ActiveFault, FaultWindow, Thermometer
from plant.devices.valve import seconds_to_ns
from plant.errors import InputError


class SensorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When pulses start and how they are reported.

    Pulse k starts at phase_s + k period_s (phase_s left out: 5 ms before a multiple of the period)
    and is reported at its start + capture_s + delay_s; capture_s covers the longest pulse.
    coil_temperature_k is the coil's own; measured_temperature_k, left out: the same, is the
    reported one. noise_sd_s is white noise on the pulse before the timer counts it.
    """

    period_s: Annotated[float, Meta(ge=0.001, le=0.1)] = 0.01
    """Period of the pulses. On it depend, in the firmware (controller.sensor.period_s is the same unless
    it is set): filter, speed, plausible jump and travel, pulses of a step, longest gap, samples before
    the first gear; e2e.position_timeout_s must be longer, filter.fc_hz below half the rate. Besides: load
    and worst case of PositionPulse on the bus, and by when the rules expect a motion to show."""
    phase_s: Annotated[float, Meta(ge=0.0, le=0.1)] | None = None
    """Start of the first pulse; if left out, 5 ms before a multiple of the period."""
    capture_s: Annotated[float, Meta(gt=0.0, le=0.1)] = 0.0015
    """Time from a pulse's start to its report; covers the longest pulse."""
    delay_s: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.0
    """Further delay of each report."""
    coil_temperature_k: Annotated[float, Meta(ge=200.0, le=450.0)] = 293.15
    """Temperature of the coil."""
    measured_temperature_k: Annotated[float, Meta(ge=200.0, le=450.0)] | None = None
    """Temperature that is reported; if left out, that of the coil."""
    noise_sd_s: Annotated[float, Meta(ge=0.0, le=1e-3)] = 0.0
    """Standard deviation of white noise on the pulse, before the timer counts it."""

    @property
    def phase_ns(self) -> int:
        """Start of the first pulse [ns]."""
        period = seconds_to_ns(self.period_s)
        if self.phase_s is None:
            return -seconds_to_ns(0.005) % period
        return seconds_to_ns(self.phase_s) % period


class SensorFault(FaultWindow, frozen=True, kw_only=True):
    """A failure of the circuit, for pulses that start at start_s or later and before end_s.

    stuck: the duration stays at the last reported one, or at pulse_s. garbage: durations are
    uniform in 0..garbage_s. wrong: durations are offset_s longer. off: nothing is reported. slow:
    only every `every`-th pulse is reported. delayed: each report gives the duration of `late`
    pulses before (of the fault's first pulse as long as there is none). intermittent: each report
    is missing with `probability`.
    """

    kind: Literal["stuck", "garbage", "wrong", "off", "slow", "delayed", "intermittent"]
    pulse_s: Annotated[float, Meta(ge=0.0, le=0.004)] | None = None
    """Duration reported by a stuck sensor; if left out, the last one."""
    garbage_s: Annotated[float, Meta(gt=0.0, le=0.004)] = 0.002
    """Longest duration of garbage."""
    offset_s: Annotated[float, Meta(ge=-0.004, le=0.004)] = 5e-5
    """Error of a wrong sensor."""
    every: Annotated[int, Meta(ge=2, le=1000)] = 4
    """Which pulses a slow sensor reports."""
    late: Annotated[int, Meta(ge=1, le=1000)] = 5
    """By how many pulses a delayed sensor is late."""
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    """Probability that a report is missing."""

    def wrong(self, pulse_s: float) -> float:
        """Return the duration of a wrong sensor [s]."""
        return pulse_s + self.offset_s

    def garbage(self, generator: Generator) -> float:
        """Draw a duration [s]."""
        return float(generator.uniform(0.0, self.garbage_s))


class Reading(NamedTuple):
    """One report: pulse duration [s], coil temperature [K], number of the pulse modulo 256."""

    pulse_s: float
    temperature_k: float
    sample_index: int


class PositionCircuit:
    """Pulses at fixed instants; the stay changes their duration. Raises InputError for too short a capture or period."""

    def __init__(
        self,
        config: SensorConfig,
        sensor: InductiveSensor,
        reach_m: float,
        faults: tuple[SensorFault, ...] = (),
        seed: int = 0,
        thermometer: Thermometer | None = None,
    ) -> None:
        """`reach_m` is the farthest position [m] on either side that a pulse must measure."""
        longest_s = max(
            sensor.pulse_s(side * reach_m, config.coil_temperature_k) for side in (-1, 1)
        )
        for name in ("capture_s", "period_s"):
            if getattr(config, name) < longest_s:
                raise InputError(
                    f"sensor.{name}: {getattr(config, name)}; expected at least the longest pulse, "
                    f"{longest_s:.6g} s at {config.coil_temperature_k:g} K"
                )
        self.sensor = sensor
        self._coil_k = config.coil_temperature_k
        measured_k = config.measured_temperature_k
        self._reported_k = config.coil_temperature_k if measured_k is None else measured_k
        self._thermometer = Thermometer((), seed) if thermometer is None else thermometer
        self._noise_sd_s = config.noise_sd_s
        self._noise = named_generator(seed, "position sensor", "noise")
        self._faults = [
            ActiveFault(fault, named_generator(seed, "position sensor", i), sensor.counted_s)
            for i, fault in enumerate(faults)
        ]
        self.period_ns = seconds_to_ns(config.period_s)
        self._report_after_ns = seconds_to_ns(config.capture_s) + seconds_to_ns(config.delay_s)
        self._start_ns = config.phase_ns  # of the next pulse to be measured
        self.next_report_ns = config.phase_ns + self._report_after_ns
        self._count = 0
        self._waiting: deque[Reading | None] = deque()
        self._last_pulse_s: float | None = None

    def measurement_instants_ns(self, until_ns: int) -> list[int]:
        """Instants [ns] up to `until_ns` whose positions `measure` has not been given yet."""
        first = self._start_ns + self.sensor.measurement_offset_ns
        return list(range(first, until_ns + 1, self.period_ns))

    def measure(self, position_m: float) -> None:
        """Take the position at the next measurement instant."""
        start_ns, self._start_ns = self._start_ns, self._start_ns + self.period_ns
        index, self._count = self._count & 0xFF, self._count + 1
        noise_s = float(self._noise.normal(0.0, self._noise_sd_s)) if self._noise_sd_s else 0.0
        pulse: float | None = self.sensor.pulse_s(position_m, self._coil_k, noise_s)
        for active in self._faults:
            if pulse is not None:
                fixed = active.fault.pulse_s
                pulse = active.apply(
                    start_ns, pulse, self._last_pulse_s if fixed is None else fixed
                )
        if pulse is None:
            self._waiting.append(None)
            return
        self._last_pulse_s = pulse
        reported_k = self._thermometer.reading_k(start_ns, self._reported_k)
        self._waiting.append(Reading(pulse, reported_k, index))

    def report(self) -> Reading | None:
        """Report due at `next_report_ns`, None when a fault swallows it; moves on to the next."""
        self.next_report_ns += self.period_ns
        return self._waiting.popleft()
