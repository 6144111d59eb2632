"""Errors of the instruments: internal sensor, clock, pressure lines."""

from __future__ import annotations

from dataclasses import replace

from plant.effects.effect import EffectParameter, Variant, effect
from plant.effects.setup import Setup


@effect(
    "sensor_temperature",
    "internal sensor",
    "sensor",
    "coil warmer than the compensation assumes",
    EffectParameter("difference_k", "K", 0.0, -150.0, 150.0, 20.0),
    scope="instrument",
    needs=("internal position",),
    look_alikes=("sensor_gain",),
    sentence="The sensor's coil is {} warmer than assumed",
)
def temperature(setup: Setup, values: dict[str, float]) -> None:
    """Warm the coil beyond the temperature compensated for."""
    chain = setup.chain
    warmer = chain.measured_temperature_k + values["difference_k"]
    setup.chain = replace(chain, coil_temperature_k=warmer)


@effect(
    "sensor_gain",
    "internal sensor",
    "sensor",
    "gain error of the internal sensor",
    EffectParameter("gain", "-", 0.0, -0.5, 0.5, 0.05),
    scope="instrument",
    needs=("internal position",),
    sentence="The position sensor's gain is off by {}",
)
def gain(setup: Setup, values: dict[str, float]) -> None:
    """Multiply the reported position by 1 + gain."""
    setup.internal_gain *= 1.0 + values["gain"]


@effect(
    "sensor_delay",
    "internal sensor",
    "sensor",
    "internal position published later",
    EffectParameter("delay_s", "s", 0.0, -0.02, 0.1, 0.005, 1),
    scope="instrument",
    needs=("internal position",),
    look_alikes=("clock_skew",),
    sentence="The position is published {} late",
)
def delay(setup: Setup, values: dict[str, float]) -> None:
    """Publish the reported position later."""
    setup.chain = replace(setup.chain, latency_s=setup.chain.latency_s + values["delay_s"])


@effect(
    "clock_skew",
    "clock",
    "clock",
    "control unit's time base offset and drifting against the recorder",
    EffectParameter("offset_s", "s", 0.0, -0.1, 0.1, 0.005),
    EffectParameter("drift", "-", 0.0, -0.1, 0.1, 0.005, optional=True),
    scope="instrument",
    needs=("internal position",),
    # an offset alone is as simple as a delay of the sensor, which looks the same
    variants=(
        Variant(
            starts=((0.003, 0.0), (-0.003, 0.0), (0.0, 0.005), (0.01, 0.0), (0.003, 0.01)),
            prior=0.5,
        ),
        Variant("offset alone", {"drift": 0.0}, prior=0.5),
    ),
    sized_by="any",  # a clock may drift without being off at the start
    sentence="The control unit's clock is off by {}",
)
def skew(setup: Setup, values: dict[str, float]) -> None:
    """Let the control unit's time run late against the recorder: offset + drift t."""
    setup.clock_offset_s += values["offset_s"]
    setup.clock_drift += values["drift"]


@effect(
    "gauge_line_lag",
    "gauge",
    "gauge",
    "pressure lines lag",
    EffectParameter("lag_s", "s", 0.0, 0.0, 0.1, 0.002, 1),
    scope="instrument",
    look_alikes=("valve_creep",),
    sentence="Pressure lines lag by {}",
)
def line_lag(setup: Setup, values: dict[str, float]) -> None:
    """Pressure lines: first-order lag before the gauges."""
    setup.gauge_lag_s += values["lag_s"]
