"""Oil damper: orifice area, discharge coefficient, incompressible and compressible pressure (thesis 3.26-3.35).

x is the distance from the start (fixed) or from neutral (length). Checked by: tests/physics/test_damper.py
"""

from __future__ import annotations

from math import acos, sqrt

from plant.kernel.compiled import inlined, kernel
from plant.kernel.layout import INCOMPRESSIBLE, parameters


@inlined
def holes_area(c, r_hole):
    """Open area of two bolt holes whose covered edge is c beyond their centre [m^2]."""
    return 2.0 * (r_hole * r_hole * acos(c / r_hole) - c * sqrt(max(r_hole * r_hole - c * c, 0.0)))


@inlined
def large_area(x_m, area_cap, r_hole, x_hole):
    """Open area of the large outlet a_valve,B(x) [m^2]: two bolt holes, capped (3.27)."""
    s = x_m - x_hole
    if s <= 0.0:
        return area_cap
    if s >= 2.0 * r_hole:
        return 0.0
    return min(area_cap, holes_area(s - r_hole, r_hole))


@inlined
def damper_borders(distance, speed, p):
    """Return how far the damper's law is from its corners, positive before each.

    Holes' area at its cap [m^2], holes covered [m], C_D at its floor [-].
    """
    c = min(max(distance - p.x_hole, 0.0), 2.0 * p.r_hole) - p.r_hole
    large = large_area(distance, p.a_large, p.r_hole, p.x_hole)
    return (
        holes_area(c, p.r_hole) - p.a_large,
        p.x_hole + 2.0 * p.r_hole - distance,
        large / p.a_large + p.cd_slope * speed - p.cd_floor,
    )


@inlined
def discharge_coefficient(area_large, area_cap, speed_m_s, floor, slope):
    """C_D(x, v) = max(a_B/a_B0 + 0.65 v, 0.65) (3.35)."""
    return max(area_large / area_cap + slope * speed_m_s, floor)


@inlined
def steady_difference(speed_m_s, a_oil, area, c_d, rho):
    """Incompressible pressure difference (A v / (A_valve C_D))^2 rho/2 [Pa], 0 on the way back (3.34)."""
    if speed_m_s <= 0.0:
        return 0.0
    ratio = a_oil * speed_m_s / (area * c_d)
    return 0.5 * rho * ratio * ratio


@inlined
def outflow(difference_pa, area, c_d, rho):
    """Flow out of chamber two q = C_D A sqrt(2 dP / rho) [m^3/s] (3.28); laminar next to zero."""
    if difference_pa <= 0.0:
        return 0.0
    laminar_pa = 10.0  # the root's infinite slope ends there
    if difference_pa < laminar_pa:
        return c_d * area * sqrt(2.0 * laminar_pa / rho) * difference_pa / laminar_pa
    return c_d * area * sqrt(2.0 * difference_pa / rho)


@inlined
def bulk_modulus(pressure_pa, kappa, air_fraction, atmosphere_pa):
    """Effective bulk modulus 1/(1/kappa + air P_atm / P^2) [Pa]: oil with free air."""
    return 1.0 / (1.0 / kappa + air_fraction * atmosphere_pa / (pressure_pa * pressure_pa))


@inlined
def damper_outlet(distance, speed, p):
    """Outlet area times discharge coefficient of the oil damper [m^2] at a distance and speed."""
    large = large_area(distance, p.a_large, p.r_hole, p.x_hole)
    c_d = discharge_coefficient(large, p.a_large, speed, p.cd_floor, p.cd_slope)
    return (p.a_small + large) * c_d


@inlined
def mode_outlet(distance, speed, m, p):
    """Return the same on the sides of the law's corners that the modes state, smooth beyond them."""
    r = p.r_hole
    c = min(max(distance - p.x_hole, 0.0), 2.0 * r) - r
    large = p.a_large
    if m.capped == 0:
        large = holes_area(c, r) if m.opened != 0 else 0.0
    c_d = large / p.a_large + p.cd_slope * speed if m.lifted != 0 else p.cd_floor
    return (p.a_small + large) * c_d


@inlined
def damper_difference(distance, speed, oil_pa, m, p):
    """Pressure difference of the oil damper [Pa] by the model in force."""
    if m.damper == INCOMPRESSIBLE:
        outlet = mode_outlet(distance, speed, m, p)
        return steady_difference(speed, p.a_oil, outlet, 1.0, p.rho_oil)
    return oil_pa - p.p_atm


@inlined
def oil_rate(distance, speed, oil_pa, m, p):
    """dP_oil2/dt of the compressible damper [Pa/s] (3.31)."""
    kappa = bulk_modulus(oil_pa, p.kappa, p.air_fraction, p.p_atm)
    outlet = mode_outlet(distance, speed, m, p)
    out = outflow(oil_pa - p.p_atm, outlet, 1.0, p.rho_oil)
    return kappa / (p.v_oil - p.a_oil * distance) * (p.a_oil * speed - out)


@kernel
def steady_oil_pressure(position, velocity, p, out):
    """Absolute pressure of the incompressible damper's chamber two [Pa] along position [m], velocity [m/s] -> out (3.34)."""
    p = parameters(p)
    for i in range(len(position)):
        side = 1.0 if position[i] > 0.0 or (position[i] == 0.0 and velocity[i] >= 0.0) else -1.0
        speed = side * velocity[i]
        outlet = damper_outlet(abs(position[i]), speed, p)
        out[i] = p.p_atm + steady_difference(speed, p.a_oil, outlet, 1.0, p.rho_oil)
