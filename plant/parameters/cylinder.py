"""A user's own cylinder, by the [cylinder] section of a model file: the fixed-piston actuator with other dimensions."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi, sqrt

from plant.errors import InputError

UNITS = {
    "cylinder.acting": "-",
    "cylinder.bore": "m",
    "cylinder.rod": "m",
    "cylinder.stroke": "m",
    "cylinder.dead_volume_1": "m^3",
    "cylinder.dead_volume_2": "m^3",
    "cylinder.mass": "kg",
    "cylinder.breakaway": "N",
    "cylinder.coulomb": "N",
    "cylinder.viscous": "N s/m",
    "cylinder.spring_rate": "N/m",
    "cylinder.spring_preload": "N",
    "cylinder.valve_c_in": "m^3/(s Pa)",
    "cylinder.valve_c_out": "m^3/(s Pa)",
    "cylinder.valve_cda_in": "m^2",
    "cylinder.valve_cda_out": "m^2",
    "cylinder.valve_b": "-",
    "cylinder.wall_heat": "W/(m^2 K)",
    "cylinder.wall_density": "-",
    "cylinder.wall_ends": "-",
    "cylinder.kappa": "-",
    "cylinder.gauge_lag": "s",
    "cylinder.tube_length": "m",
    "cylinder.tube_diameter": "m",
    "cylinder.valve_frequency": "Hz",
    "cylinder.valve_damping": "-",
    "cylinder.valve_dead_zone": "-",
}
"""Every value of the section, all required but those of `PROPORTIONAL` and `USUAL`.

acting: 1 single (the rod's side is open to the air, spring return), 2 double; bore, rod: diameters;
dead volumes: of chamber 1 (behind the piston) and 2 (on the rod's side) at the retracted end, without
tubes; spring: pushes back with preload + rate x; valve_c: sonic conductance C of the valve's inlet
and outlet, or valve_cda: the same as C_d A; valve_b: its critical pressure ratio (ISO 6358); wall_heat:
heat transfer coefficient of the walls at a density of 1.185 kg/m^3, wall_density the power of the density with which it
grows (0.5 to 0.8 for forced convection), wall_ends the area of a chamber's ends over that of two flat ones (0 and a
wall_density of 1: a constant time constant); kappa: ratio of the air's specific heats; gauge_lag: time constant of the lines to the gauges; tube: from the valve to each
chamber, length 0 for none; valve_frequency, damping (0: first order) and dead_zone: of a proportional valve's spool (`plant.devices.spool`), without them the valves are on/off.
"""

PROPORTIONAL = ("cylinder.valve_frequency", "cylinder.valve_damping", "cylinder.valve_dead_zone")
USUAL = {
    "cylinder.valve_b": 0.5,
    "cylinder.wall_heat": 40.0,
    "cylinder.wall_density": 0.0,
    "cylinder.wall_ends": 1.0,
    "cylinder.kappa": 1.4,
    "cylinder.gauge_lag": 0.0,
}
"""Values that a data sheet may leave out. Few valves lie outside b = 0.2 to 0.5, and few cylinders outside
h = 10 to 120 W/(m^2 K) (Carneiro and de Almeida 2006)."""
CHOKED = 0.6847314563772704
"""Flow function of a choked orifice, sqrt(g (2 / (g + 1))^((g + 1) / (g - 1))) of g = 1.4."""


def tube_area(length_m: float, diameter_m: float) -> float:
    """Return the C_d A of a tube, A / sqrt(f L / D + 1.5) [m^2]; without a length none limits.

    f = 0.02: smooth tube, turbulent (Moody chart, Re about 3e4); 1.5: loss factors of entry and exit (0.5 and 1).
    """
    if length_m == 0.0:
        return float("inf")
    area = 0.25 * pi * diameter_m**2
    return area / sqrt(0.02 * length_m / diameter_m + 1.5)


def area_of(conductance: float) -> float:
    """Return the C_d A of a sonic conductance C [m^2]: the choked orifice that passes as much air.

    sqrt(R T_0) and the density, 1.185 kg/m^3, are those of ISO 6358's reference air.
    """
    return conductance * 1.185 * sqrt(287.05 * 293.15) / CHOKED


def in_series(one: float, two: float) -> float:
    """Return the C_d A of two restrictions one behind the other [m^2]."""
    return 1.0 / sqrt(1.0 / one**2 + 1.0 / two**2)


def derived(values: Mapping[str, float], name: str) -> dict[str, float]:
    """Return what follows from a [cylinder] section, by path. Raises InputError if it is incomplete or impossible."""
    stated = [path for path in UNITS if path in values]
    optional = {*USUAL, *("cylinder.valve_cda_in", "cylinder.valve_cda_out")}
    if not set(stated) & set(PROPORTIONAL):
        optional |= set(PROPORTIONAL)
    given = {path.replace("valve_cda_", "valve_c_") for path in stated}
    expected = [path for path in UNITS if path not in optional]
    for path in expected:
        if path not in given:
            raise InputError(f"{name}: no {path}; expected all of {', '.join(expected)}")
    v = {path.removeprefix("cylinder."): value for path, value in (USUAL | dict(values)).items()}
    for end in ("in", "out"):
        if f"valve_c_{end}" in v and f"valve_cda_{end}" in v:
            both = f"cylinder.valve_c_{end} and valve_cda_{end}"
            raise InputError(f"{name}: {both}: the same in two units; expected one of them")
        if f"valve_c_{end}" in v:
            v[f"valve_cda_{end}"] = area_of(v[f"valve_c_{end}"])
    positive = ("bore", "stroke", "dead_volume_1", "valve_cda_in", "valve_cda_out")
    for key in (*positive, *(("tube_diameter",) if v["tube_length"] > 0.0 else ())):
        if not v[key] > 0.0:
            raise InputError(f"{name}: cylinder.{key}: {v[key]:g}; expected more than 0")
    if v["acting"] not in (1.0, 2.0):
        raise InputError(f"{name}: cylinder.acting: {v['acting']:g}; expected 1 or 2")
    if not v.get("valve_dead_zone", 0.0) < 1.0:
        raise InputError(
            f"{name}: cylinder.valve_dead_zone: {v['valve_dead_zone']:g}; expected less than 1"
        )
    if not v["rod"] < v["bore"]:
        raise InputError(
            f"{name}: cylinder.rod: {v['rod']:g}; expected less than bore, {v['bore']:g}"
        )
    bore, rod = 0.25 * pi * v["bore"] ** 2, 0.25 * pi * v["rod"] ** 2
    single = v["acting"] == 1.0
    tube_m3 = 0.25 * pi * v["tube_diameter"] ** 2 * v["tube_length"]
    tube = tube_area(v["tube_length"], v["tube_diameter"])
    charge, discharge = in_series(v["valve_cda_in"], tube), in_series(v["valve_cda_out"], tube)
    return {
        **{path: v[path.removeprefix("cylinder.")] for path in USUAL},
        "fixed.stroke": v["stroke"],
        "fixed.r_piston": 0.5 * v["bore"],
        "fixed.r_stay": 0.5 * v["rod"],
        "fixed.A1": bore,
        "fixed.A2": 0.0 if single else bore - rod,
        "fixed.A_s": bore if single else rod,
        "fixed.V10": v["dead_volume_1"] + tube_m3,
        "fixed.V20": v["dead_volume_2"] + tube_m3 + (bore - rod) * v["stroke"],
        "fixed.m_s": v["mass"],
        "fixed.m_p": 1e-9,
        "friction_fixed.F_sf": v["breakaway"],
        "friction_fixed.F_rf": v["coulomb"],
        "friction_fixed.beta": v["viscous"],
        "orifice.A_valve": charge,
        "orifice.C_d_in": 1.0,
        "orifice.C_d_out": discharge / charge,
    }
