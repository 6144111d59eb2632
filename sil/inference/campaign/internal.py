"""The control unit's position as observed: one value a publication, and what it says about when.

Where the record is within the sensor's period is not known beforehand; it follows from the
instants of publication under the assumed latency and clock.
Checked by: tests/unit/sil/inference/campaign/test_internal.py
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from plant.effects.setup import Setup
from sil.campaign.campaign import Floats

INTERNAL_SD_M = 3e-5
"""Expected scatter of one published position: timer tick and a recorder's step of 0.1 ms."""


@dataclass(frozen=True)
class InternalSamples:
    """Published positions [m], when they appeared on the recorder's clock [s], mid of the step.

    sd_m: expected scatter; a slow recorder's step in time counts by how fast the position changes.
    """

    published_s: Floats
    values_m: Floats
    sd_m: Floats


def internal_samples(time_s: Floats, values: Floats) -> InternalSamples | None:
    """Return the publications in values [n] in m at time_s [n], by their steps.

    None if it hardly moves, or is recorded in steps of more than half their period (5 ms).
    """
    if float(time_s[1] - time_s[0]) > 0.005:
        return None
    edges = np.flatnonzero(np.abs(np.diff(values)) > 1e-9) + 1
    if len(edges) < 4:
        return None
    step_s = float(time_s[1] - time_s[0])
    slope_m_s = np.abs(np.gradient(values[edges], time_s[edges]))
    # beyond the usual recorder's step of 0.1 ms, which the expected scatter holds
    late_s = (max(0.0, step_s**2 - 1e-4**2) / 12.0) ** 0.5
    sd_m = np.hypot(INTERNAL_SD_M, slope_m_s * late_s)
    return InternalSamples(time_s[edges] - 0.5 * step_s, values[edges], sd_m)


def internal_prediction(
    internal: InternalSamples,
    time_s: Floats,
    position_m: Floats,
    setup: Setup,
    rounded: bool = True,
) -> Floats:
    """Return the published positions of a stroke under a setup, at the publications observed [m].

    position_m: the true one at time_s; rounded: pulses at rest are counted in timer ticks, as they
    are (at rest the rounding is the same error every time); without, the result is smooth.
    """
    chain = setup.chain
    period = chain.period_s
    unit_s = internal.published_s * (1.0 - setup.clock_drift) - setup.clock_offset_s
    about_s = unit_s - chain.latency_s - 0.5 * chain.sensor.t_mid_s
    pulse_s = chain.sensor.duration_s(
        np.interp(about_s, time_s, position_m), chain.coil_temperature_k
    )
    begun = unit_s - chain.latency_s - pulse_s
    turn = 2.0 * np.pi / period
    phase = float(np.angle(np.mean(np.exp(1j * turn * begun)))) / turn % period
    pulses = np.rint((begun - phase) / period).astype(int)
    first = min(int(np.floor(-phase / period)) - 1, int(pulses[0]))
    count = int(pulses[-1]) - first + 1
    ticks = phase + period * (first + np.arange(count))
    true_m = np.interp(ticks + 0.5 * chain.sensor.t_mid_s, time_s, position_m)
    warm = chain.sensor.duration_s(true_m, chain.coil_temperature_k)
    if rounded:
        # less than 0.1 um from pulse to pulse
        resting = np.abs(np.diff(true_m, prepend=true_m[0])) < 1e-7
        warm = np.where(resting, chain.sensor.ticks(warm) * chain.sensor.tick_s, warm)
    observed = chain.calibration.position_m(warm, chain.measured_temperature_k)
    response = _impulse_response(chain.filter_order, chain.cutoff_hz, period, count)
    values = observed[0] + np.convolve(observed - observed[0], response)[:count]
    return setup.reported_m(values[np.minimum(np.maximum(pulses - first, 0), count - 1)])


@lru_cache(maxsize=64)
def _impulse_response(order: int, cutoff_hz: float, period_s: float, count: int) -> Floats:
    """Response of a chain's filter to one unit value, `count` periods long."""
    if not order:
        response = np.zeros(count)
        response[0] = 1.0
        return response
    from plant.devices.sensors import butterworth_sections, filter_from_rest

    sections = butterworth_sections(order, cutoff_hz, 1.0 / period_s)
    impulse = np.zeros(count + 1)
    impulse[1] = 1.0
    return np.asarray(filter_from_rest(sections, impulse)[1:])
