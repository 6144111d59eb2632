"""What the instruments make of a true stroke, by the chain's description: recorder, gauges, position (scipy's filter)."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi

from tests.reference.parts import Values

Floats = np.ndarray


def potentiometer(true_m: Floats, offset_m: float, v: Values, rng: np.random.Generator) -> Floats:
    """Steps of the winding, contact noise before them."""
    step = v["potentiometer.resolution"]
    shaken = true_m + offset_m + v["potentiometer.noise_sd"] * rng.standard_normal(len(true_m))
    return np.round(shaken / step) * step


def gauge(
    true_pa: Floats, offset_pa: float, oil: bool, v: Values, rng: np.random.Generator
) -> Floats:
    """Offset, white noise, converter."""
    kind = "oil" if oil else "air"
    count = v[f"gauge.range_{kind}"] / 2 ** v["gauge.adc_bits"]
    shaken = true_pa + offset_pa + v[f"gauge.noise_sd_{kind}"] * rng.standard_normal(len(true_pa))
    return np.clip(np.round(shaken / count), 0, 2 ** v["gauge.adc_bits"] - 1) * count


def control_unit(
    time_s: Floats,
    true_m: Floats,
    phase_s: float,
    v: Values,
    *,
    warmer_k: float = 0.0,
    gain: float = 0.0,
    later_s: float = 0.0,
    clock_offset_s: float = 0.0,
    clock_drift: float = 0.0,
) -> Floats:
    """Reported position at the recorder's instants: pulse, timer, filter, hold."""
    period, mid = v["position_sensor.period"], v["position_sensor.t_mid"]
    slope, tick = v["position_sensor.slope"], v["position_sensor.timer_resolution"]
    warmth = 1.0 + v["position_sensor.temp_coeff"] * warmer_k
    # the unit's own time runs late; pulses start at multiples of its period
    starts = phase_s + period * np.arange(-12, int(time_s[-1] / period) + 2)
    seen = np.interp(starts + 0.5 * mid, time_s, true_m)
    pulse = np.round((mid + slope * seen) * warmth / tick) * tick
    cold = (pulse - mid) / slope
    sections = butter(
        int(v["position_sensor.butter_order"]),
        v["position_sensor.butter_fc"],
        fs=1.0 / period,
        output="sos",
    )
    smooth, _ = sosfilt(sections, cold, zi=sosfilt_zi(sections) * cold[0])
    published = starts + v["position_sensor.latency"] + later_s + pulse
    on_recorder = (published + clock_offset_s) / (1.0 - clock_drift)
    index = np.searchsorted(on_recorder, time_s, side="right") - 1
    return (1.0 + gain) * smooth[np.maximum(index, 0)]
