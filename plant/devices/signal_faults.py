"""Faults of the slow sensors: the coil's thermometer and the two shaft speeds."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, Literal, TypeVar

import msgspec
from msgspec import Meta
from numpy.random import Generator

from plant.devices.driveline import ToothedWheel
from plant.devices.sensors import named_generator
from plant.devices.valve import seconds_to_ns

Speeds = tuple[float, float]
Report = TypeVar("Report")


class FaultWindow(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A fault that acts from start_s on and before end_s (left out: for good)."""

    start_s: Annotated[float, Meta(ge=0.0, le=86400.0)] = 0.0
    """Time from which the fault acts."""
    end_s: Annotated[float, Meta(ge=0.0, le=86400.0)] | None = None
    """Time at which the fault ends; if left out, never."""

    def holds(self, now_ns: int) -> bool:
        """Whether the fault acts at an instant [ns]."""
        if now_ns < seconds_to_ns(self.start_s):
            return False
        return self.end_s is None or now_ns < seconds_to_ns(self.end_s)


class TemperatureFault(FaultWindow, frozen=True, kw_only=True):
    """A failure of the thermometer in the position sensor's coil.

    off: broken line, the cold end of the range. stuck: reads value_k. wrong: reads offset_k too
    much. garbage: uniform in 200..450 K. intermittent: the line is broken with `probability`.
    """

    kind: Literal["off", "stuck", "wrong", "garbage", "intermittent"]
    value_k: Annotated[float, Meta(ge=200.0, le=450.0)] = 353.15
    """Temperature that a stuck thermometer reads."""
    offset_k: Annotated[float, Meta(ge=-250.0, le=250.0)] = 30.0
    """Error of a wrong thermometer."""
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    """Probability that the line is broken."""

    def wrong(self, temperature_k: float) -> float:
        """Return what a wrong thermometer reads [K]."""
        return self.offset_k + temperature_k

    def garbage(self, generator: Generator) -> float:
        """Draw a temperature [K]."""
        return float(generator.uniform(200.0, 450.0))


class SpeedFault(FaultWindow, frozen=True, kw_only=True):
    """A failure of the shaft speed measurement.

    off: no speeds are sent. stuck: they stay as they were. wrong: the input speed reads
    offset_rad_s too much. garbage: uniform in 0..garbage_rad_s, each for itself. slow: only every
    `every`-th pair is sent. delayed: the speeds of `late` reports before. intermittent: a report
    is missing with `probability`.
    """

    kind: Literal["off", "stuck", "wrong", "garbage", "slow", "delayed", "intermittent"]
    offset_rad_s: Annotated[float, Meta(ge=-400.0, le=400.0)] = 20.0
    """Error of a wrong input speed."""
    garbage_rad_s: Annotated[float, Meta(gt=0.0, le=400.0)] = 200.0
    """Highest speed of garbage."""
    every: Annotated[int, Meta(ge=2, le=1000)] = 4
    """Which pairs are sent when slow."""
    late: Annotated[int, Meta(ge=1, le=1000)] = 10
    """By how many reports delayed speeds are late."""
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    """Probability that a report is missing."""

    def wrong(self, speeds: Speeds) -> Speeds:
        """Return the speeds [rad/s] of a wrong input sensor."""
        return speeds[0] + self.offset_rad_s, speeds[1]

    def garbage(self, generator: Generator) -> Speeds:
        """Draw two speeds [rad/s]."""
        drawn = generator.uniform(0.0, self.garbage_rad_s, 2)
        return float(drawn[0]), float(drawn[1])


class ActiveFault(Generic[Report]):
    """A fault of reports with its memory; `counted`: what the circuit makes of a wrong value."""

    def __init__(
        self, fault: Any, generator: Generator, counted: Callable[[Report], Report] = lambda x: x
    ) -> None:
        self.fault = fault
        self._generator = generator
        self._counted = counted
        self._stuck: Report | None = None
        self._count = 0
        self._past: deque[Report] = deque(maxlen=getattr(fault, "late", 0) + 1)

    def apply(self, now_ns: int, report: Report, stuck: Report | None = None) -> Report | None:
        """Return what is sent in place of a report, None for nothing; `stuck`: what a stuck one sends, None for the report."""
        fault = self.fault
        if not fault.holds(now_ns):
            return report
        match fault.kind:
            case "stuck":
                if self._stuck is None:
                    self._stuck = report if stuck is None else stuck
                return self._stuck
            case "wrong":
                return self._counted(fault.wrong(report))
            case "garbage":
                return self._counted(fault.garbage(self._generator))
            case "slow":
                number, self._count = self._count, self._count + 1
                return report if number % fault.every == 0 else None
            case "delayed":
                self._past.append(report)
                return self._past[0]
            case "intermittent":
                return None if self._generator.random() < fault.probability else report
        return None  # off


class Thermometer:
    """The reported coil temperature behind its faults."""

    def __init__(self, faults: Sequence[TemperatureFault], seed: int) -> None:
        self._faults = [
            ActiveFault[float](fault, named_generator(seed, "thermometer", i))
            for i, fault in enumerate(faults)
        ]

    def reading_k(self, start_ns: int, temperature_k: float) -> float:
        """Temperature [K] reported with the pulse begun at `start_ns`, within 200..450 K."""
        for active in self._faults:
            reading = active.apply(start_ns, temperature_k, active.fault.value_k)
            temperature_k = 200.0 if reading is None else reading  # a broken line reads cold
        return min(max(temperature_k, 200.0), 450.0)


class SpeedSensors:
    """The reported shaft speeds: measured, then behind their faults."""

    def __init__(
        self, faults: Sequence[SpeedFault], seed: int, wheels: Sequence[ToothedWheel] = ()
    ) -> None:
        """`wheels`: of input and output shaft; if left out, the speeds are exact."""
        self._wheels = wheels
        self._faults = [
            ActiveFault[Speeds](fault, named_generator(seed, "shaft speeds", i))
            for i, fault in enumerate(faults)
        ]

    def report(
        self, now_ns: int, input_rad_s: float, output_rad_s: float, ratio: float = 1.0
    ) -> Speeds | None:
        """Return the speeds [rad/s] to send, None for nothing; `ratio`: input shaft's own speed by the referred one."""
        speeds: Speeds | None = (input_rad_s, output_rad_s)
        if self._wheels:
            of_input, of_output = self._wheels
            measured_rad_s = of_input.measure(now_ns, input_rad_s * ratio)
            speeds = measured_rad_s / ratio, of_output.measure(now_ns, output_rad_s)
        for active in self._faults:
            if speeds is not None:
                speeds = active.apply(now_ns, speeds)
        if speeds is None or not self._faults:
            return speeds
        return _in_range(speeds[0]), _in_range(speeds[1])


def _in_range(speed_rad_s: float) -> float:
    """Return what the measurement reports of a speed [rad/s]: it saturates at 1000 on either side."""
    return min(max(speed_rad_s, -1000.0), 1000.0)
