"""Between which values a parameter means something, widely: signs and magnitudes that no actuator has are refused."""

from __future__ import annotations

from math import inf

BY_UNIT = {
    "J/(kg K)": (1.0, 1e6),
    "K": (1.0, 1e5),
    "Pa": (0.0, 1e12),
    "Pa (absolute)": (1.0, 1e12),
    "Hz": (1e-6, 1e12),
    "N": (0.0, 1e12),
    "N s": (0.0, 1e12),
    "N s/m": (0.0, 1e12),
    "N/m": (0.0, 1e12),
    "kg": (1e-9, 1e12),
    "kg/m^3": (1e-3, 1e6),
    "m": (0.0, 1e3),
    "m^2": (0.0, 1e6),
    "m^3": (0.0, 1e6),
    "s": (0.0, 1e6),
    "s/m": (-1e6, 1e6),
    "1/K": (-1.0, 1.0),
    "K kg/(s Pa)": (-1e12, 1e12),
    "-": (0.0, 1e6),
}

BY_PATH = {
    "gas.gamma": (1.0 + 1e-6, 10.0),
    "gas.critical_ratio": (1e-6, 1.0),
    **dict.fromkeys(("valve.D_rise", "valve.D_fall"), (0.0, 10.0)),
    **dict.fromkeys(("valve.fall_base", "valve.fall_tau"), (0.0, 10.0)),
    "flow_charge.y_min": (0.0, 1.0),
    "flow_charge.y_split": (0.0, 1.0),
    "flow_discharge.z_split": (1.0, 1e6),
    "flow_discharge.z_max": (1.0, 1e6),
    **dict.fromkeys((f"alpha.alpha_{name}" for name in ("m1", "1", "m2", "2")), (0.01, 10.0)),
    "stops.restitution": (0.0, 1.0),
    "damper.air_fraction": (0.0, 1.0),
    "spring_test.x0": (-1e3, 1e3),
    "gauge.adc_bits": (1.0, 64.0),
    "cylinder.valve_b": (0.0, 0.9),
    "cylinder.wall_heat": (0.0, 1e6),
    "cylinder.wall_density": (0.0, 2.0),
    "cylinder.wall_ends": (0.0, 10.0),
    "cylinder.kappa": (1.0, 1.7),
    "cylinder.gauge_lag": (0.0, 0.1),
    "position_sensor.t_mid": (0.0, 10.0),
    "position_sensor.slope": (-1e3, 1e3),
}
"""Where a parameter's unit says too little."""


def bounds(path: str, unit: str) -> tuple[float, float]:
    """Return the least and largest value of the parameter at `section.key`; infinite where nothing is known."""
    return BY_PATH.get(path) or BY_UNIT.get(unit, (-inf, inf))


def outside(path: str, unit: str, values: tuple[float, ...]) -> str:
    """Return what is wrong with a parameter's values and what was expected; "" if nothing is."""
    low, high = bounds(path, unit)
    for value in values:
        if not low <= value <= high:
            return f"{value:g}; expected {low:g} to {high:g} {'' if unit == '-' else unit}".rstrip()
    return ""
