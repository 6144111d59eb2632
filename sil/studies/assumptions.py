"""The inferred numbers of the parameter file: which change together, and which decide no headline.

A test sets those of `NOT_VARIED` to other values and finds every headline as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from plant.parameters import Number, ParameterSet

Change = dict[str, Number]


def _times(*paths: str) -> Callable[[ParameterSet, float], Change]:
    """Return a factor on all values of some parameters."""

    def change(parameters: ParameterSet, factor: float) -> Change:
        changes: Change = {}
        for path in paths:
            values = tuple(factor * value for value in parameters.values(path))
            changes[path] = values if isinstance(parameters[path].value, tuple) else values[0]
        return changes

    return change


def _with_neutral(*paths: str) -> Callable[[ParameterSet, float], Change]:
    """Return a factor on lengths or areas that leaves the dead volume of chamber N as it is."""
    scaled, swept_by = _times(*paths), ("A_p", "x_free_total", "stroke")

    def change(parameters: ParameterSet, factor: float) -> Change:
        new = scaled(parameters, factor)
        (area, free, stroke), (new_area, new_free, new_stroke) = (
            [parameters.override(each).value(f"length.{name}") for name in swept_by]
            for each in ({}, new)
        )
        swept = new_area * (new_free + new_stroke) - area * (free + stroke)
        return new | {"length.V_N0": parameters.value("length.V_N0") + swept}

    return change


def _stay_share(parameters: ParameterSet, factor: float) -> Change:
    """Scale the stay's share of the friction; the piston has the rest of the thesis's total."""
    changes: Change = {}
    for name in ("F_sf", "F_rf", "beta"):
        stay, piston = (parameters.value(f"friction_length.{name}_{body}") for body in "sp")
        changes[f"friction_length.{name}_s"] = factor * stay
        changes[f"friction_length.{name}_p"] = stay + piston - factor * stay
    return changes


def _stretched(coefficients: tuple[float, ...], factor: float) -> tuple[float, ...]:
    """Return the coefficients of c(1 + factor (x - 1)), ascending."""
    inner = np.polynomial.Polynomial([1.0 - factor, factor])
    return tuple(np.polynomial.Polynomial(coefficients)(inner).coef.tolist())


def _charge_shape(parameters: ParameterSet, factor: float) -> Change:
    """Give a pressure drop the charge flow that a drop greater by the factor has in the map."""
    values, value = parameters.values, parameters.value
    changes: Change = {
        path: _stretched(values(path), factor) for path in ("flow_charge.c_high", "flow_charge.c_low")
    }  # fmt: skip
    for path in ("flow_charge.y_min", "flow_charge.y_split"):
        changes[path] = max(1.0 - (1.0 - value(path)) / factor, 0.0)
    return changes


def _discharge_shape(parameters: ParameterSet, factor: float) -> Change:
    """Let the discharge flow be proportional to the pressure from a lower one on, by the factor."""
    changes: Change = {}
    for path in ("flow_discharge.c_low", "flow_discharge.c_high"):
        changes[path] = tuple(c / factor for c in _stretched(parameters.values(path), factor))
    for path in ("flow_discharge.z_split", "flow_discharge.z_max"):
        changes[path] = 1.0 + (parameters.value(path) - 1.0) / factor
    return changes


FACTORS: Mapping[str, Callable[[ParameterSet, float], Change]] = {
    "friction": _times(
        *(f"friction_length.{name}_{body}" for name in ("F_sf", "F_rf", "beta") for body in "sp")
    ),
    "stay_friction": _stay_share,
    "end_volumes": _times("length.V_B0", "length.V_F0"),
    "piston_area": _with_neutral("length.A_p"),
    "travel": _with_neutral("length.stroke", "length.x_free_total"),
    "free_travel": _with_neutral("length.x_free_total"),
    "charge_flow": _times("flow_charge.c_high", "flow_charge.c_low"),
    "charge_shape": _charge_shape,
    "discharge_flow": _times("flow_discharge.c_low", "flow_discharge.c_high"),
    "discharge_shape": _discharge_shape,
}
"""What a factor does to the parameters: its name, and the values that it gives."""

NOT_VARIED = {
    "of the fixed-piston rig, on which no headline rests": (
        *(f"fixed.{name}" for name in ("m_s", "m_p", "r_piston", "r_stay", "A_s", "A1", "A2")),
        *("fixed.V10", "fixed.V20", "spring_test.k", "spring_test.x0", "supply.P_s_low"),
    ),
    "of an alternative that no headline uses: theoretical flow, closing by duty, free air in the oil": (
        *("orifice.A_valve", "orifice.C_d_in", "orifice.C_d_out", "gas.T"),
        *("valve.fall_tau", "valve.fall_base", "damper.air_fraction"),
    ),
    "of instruments or of a campaign's scatter, which do not act on a shift": (
        *("potentiometer.noise_sd", "gauge.noise_sd_air", "gauge.noise_sd_oil", "gauge.adc_bits"),
        *("repeatability.unit_volume_sd", "repeatability.unit_pot_offset_sd"),
        "repeatability.unit_gauge_offset_sd",
    ),
    "of the way out of gear, which no headline takes": (
        *("synchronizer.F_pull_typ", "synchronizer.w_pull"),
    ),
    "for the force of an impact, not for its speed": ("stops.soft_k", "stops.soft_c"),
    "follows from others": ("damper.x_r",),
}
"""Inferred numbers that are not varied, by the reason."""
