"""What can be hidden in a campaign: changes of the judge's actuator by name and size, unknown to the diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from math import exp, log

import numpy as np

Rng = np.random.Generator
Change = dict[str, float]

# id: class, what it changes, smallest easy size, largest easy size, smallest medium size; a small one
# is SMALL of the smallest medium size, which leaves it inside what units and strokes differ by.
# The stop can wear by less than the pistons' free travel exceeds the stroke (0.15 mm).
SIZES: dict[str, tuple[str, str, float, float, float]] = {
    "dynamic_friction": ("friction", "running-1", 0.8, 2.5, 0.4),
    "static_friction": ("friction", "static-1", 0.8, 2.0, 0.4),
    "stribeck": ("friction", "stribeck_m_s", 0.1, 0.5, 0.04),
    "friction_asymmetry": ("friction", "one_way", 0.25, 0.5, 0.12),
    "friction_bump": ("friction", "bump_n", 60.0, 200.0, 30.0),
    "seal_pressure_friction": ("friction", "seal", 0.03, 0.1, 0.015),
    "piston_leak": ("leak", "piston_leak_m2", 4e-7, 1.5e-6, 1.5e-7),
    "leak_to_atmosphere": ("leak", "leak_out_m2", 4e-7, 1.5e-6, 1.5e-7),
    "supply_low": ("supply", "supply-", 0.05, 0.2, 0.025),
    "hose_droop": ("supply", "line", 4e-6, 8e-6, 1.2e-5),
    "valve_open_delay": ("valve timing", "open_later_s", 0.003, 0.01, 0.0015),
    "valve_delay_pressure": ("valve timing", "open_later_s_pa", 8e-9, 2e-8, 4e-9),
    "valve_slow_close": ("valve timing", "close_later_s", 0.008, 0.025, 0.004),
    "valve_creep": ("valve timing", "creep_s", 0.004, 0.012, 0.002),
    "exhaust_clog": ("flow restriction", "outlet-", 0.15, 0.5, 0.07),
    "inlet_clog": ("flow restriction", "inlet-", 0.15, 0.5, 0.07),
    "dead_volume_charge": ("volume", "driving_volume_m3", 6e-6, 3e-5, 3e-6),
    "dead_volume_passive": ("volume", "compressed_volume_m3", 1e-5, 5e-5, 5e-6),
    "residual_pressure": ("initial state", "left_pa", 3e4, 2e5, 1.5e4),
    "alpha_speed": ("thermodynamics", "heat_share", 0.3, 1.0, 0.15),
    "oil_aeration": ("damper", "oil_air", 0.01, 0.05, 0.004),
    "damper_clog": ("damper", "small_outlet-", 0.15, 0.5, 0.07),
    "damper_misalignment": ("damper", "damper_drag_n", 30.0, 150.0, 15.0),
    "free_play": ("mechanics", "free_travel_m", 6e-4, 2e-3, 3e-4),
    "stop_wear": ("mechanics", "stop_m", 8e-5, 1.4e-4, 4e-5),
    "added_mass": ("mechanics", "mass_kg", 0.3, 2.0, 0.15),
    "external_force": ("mechanics", "force_n", 20.0, 80.0, 10.0),
    "detent": ("mechanics", "detent_n", 50.0, 200.0, 25.0),
    "end_stop_bounce": ("mechanics", "restitution", 0.25, 0.6, 0.12),
    "sensor_temperature": ("internal sensor", "warmer_k", 10.0, 40.0, 5.0),
    "sensor_gain": ("internal sensor", "gain", 0.04, 0.1, 0.02),
    "sensor_delay": ("internal sensor", "later_s", 0.003, 0.01, 0.0015),
    "clock_skew": ("clock", "clock", 0.006, 0.02, 0.003),
    "gauge_line_lag": ("gauge", "gauge_lag_s", 0.001, 0.005, 0.0005),
}

FOREIGN: dict[str, tuple[str, str, float, float, float]] = {
    "friction of rest": ("friction", "rest_share", 0.25, 0.6, 0.12),
    "drag of speed squared": ("friction", "drag_n_s2_m2", 60.0, 200.0, 30.0),
    "wave of force": ("mechanics", "wave_n", 40.0, 120.0, 20.0),
    "centring spring": ("mechanics", "centring_n_m", 6000.0, 15000.0, 3000.0),
    "inlet by pressure": ("flow restriction", "inlet_late", 0.2, 0.5, 0.1),
    "outlet by pressure": ("flow restriction", "outlet_high", 0.2, 0.5, 0.1),
    "relief": ("leak", "relief_k_kg_s_pa", 1e-6, 4e-6, 5e-7),
    "warming friction": ("friction", "warming", 0.6, 1.2, 0.4),
    "sticky plunger": ("valve timing", "sticky_s", 0.002, 0.006, 0.001),
    "one late valve": ("valve timing", "late_s", 0.003, 0.010, 0.0015),
    "emptying tank": ("supply", "emptying", 0.08, 0.25, 0.04),
    "bent sensor": ("internal sensor", "bent_m", 4e-4, 1e-3, 2e-4),
    "gauge gain": ("gauge", "gauge_share", 0.03, 0.08, 0.015),
}
"""Effects that the vocabulary lacks, with the class that a reader would file them under."""

SMALL = 0.02
DAMPER = ("oil_aeration", "damper_clog", "damper_misalignment")
SENSOR = ("sensor_temperature", "sensor_gain", "sensor_delay", "clock_skew")


def size(row: tuple[str, str, float, float, float], level: str | float, rng: Rng) -> float:
    """A size of that level, spread evenly in its logarithm; a number: 0 medium, 1 the largest."""
    easy, most, medium = row[2:]
    if not isinstance(level, str):
        return float(medium * (most / medium) ** level)
    if level == "small":
        return SMALL * medium
    low, high = (easy, most) if level == "easy" else (min(medium, easy), max(medium, easy))
    return exp(rng.uniform(log(low), log(high)))


def draw(name: str, level: str | float, rng: Rng) -> Change:
    """The changes that hide this effect, of a size of this level ("easy", "medium", "small")."""
    row = SIZES.get(name) or FOREIGN[name]
    key, amount = row[1], size(row, level, rng)
    if key.endswith("-1"):
        return {key[:-2]: 1.0 + amount}
    if key.endswith("-"):
        return {"supply": -amount} if name == "supply_low" else {key[:-1]: 1.0 - amount}
    either = rng.choice((-1.0, 1.0))
    special: dict[str, Callable[[], Change]] = {
        "friction_asymmetry": lambda: {key: either * amount},
        "friction_bump": lambda: {
            key: amount,
            "bump_at_m": either * rng.uniform(0.003, 0.010),
            "bump_width_m": rng.uniform(0.0008, 0.002),
        },
        "hose_droop": lambda: (
            {"line_cda_m2": amount, "line_m3": exp(rng.uniform(-11.5, -10.0))}
            if level != "small"
            else {"line_cda_m2": 1e-3, "line_m3": 1e-3}
        ),
        "valve_delay_pressure": lambda: {key: -amount},
        "alpha_speed": lambda: {key: amount, "heat_m_s": rng.uniform(0.1, 1.0)},
        "free_play": lambda: {key: either * amount},
        "external_force": lambda: {key: either * amount},
        "detent": lambda: {key: amount, "detent_m": rng.uniform(0.001, 0.003)},
        "sensor_temperature": lambda: {key: either * amount},
        "sensor_gain": lambda: {key: either * amount},
        "clock_skew": lambda: {
            "clock_offset_s": amount,
            "clock_drift": amount * rng.uniform(-0.5, 0.5),
        },
        "wave of force": lambda: {key: amount, "wave_m": rng.uniform(0.004, 0.008)},
        "relief": lambda: {key: amount, "relief_pa": rng.uniform(3e5, 5e5)},
        "one late valve": lambda: {key: amount, "late_valve": float(rng.integers(3))},
        "bent sensor": lambda: {key: either * amount, "bent_over_m": rng.uniform(0.006, 0.02)},
        "gauge gain": lambda: {key: either * amount},
    }
    return special.get(name, lambda: {key: amount})()
