"""A chamber with one 3/2 valve: flows, leaks, process exponents and pressure (thesis 3.11, 3.23).

A cylinder's air has a temperature of its own, by balances of mass and energy; that of the thesis's actuator has the
supply's, and its exponents stand for the heat.
"""

from __future__ import annotations

from math import exp, pi, sqrt

from plant.kernel.compiled import inlined
from plant.kernel.layout import Slot
from plant.kernel.views import unlikely
from plant.parts.flow import charge, discharge, iso_6358, orifice
from plant.parts.term import added, not_negative


@inlined
def valve_flow_in(pressure, supply, kelvin, p, c):
    """Return the charge flow at u = 1 by the flow model [K kg/s]; kelvin: of the chamber, for what flows back."""
    factor = p.k_in
    if unlikely(p.adder != 0.0):
        share = added(Slot.CHARGE, 0.0, 0.0, 0.0, 0.0, pressure / supply, p)
        factor *= not_negative(1.0 + share)
    if p.flow_model == 0.0:
        return factor * charge(pressure, supply, c)
    if p.flow_model == 2.0:
        return factor * iso_6358(supply, pressure, p.cda_in, p.valve_b, p.t_gas, kelvin, p.r_air)
    return factor * orifice(supply, pressure, p.cda_in, p.t_gas, p.gamma, p.r_air)


@inlined
def valve_flow_out(pressure, kelvin, p, c):
    """Return the discharge flow at u = 0 by the selected flow model [K kg/s]."""
    factor = p.k_out
    if unlikely(p.adder != 0.0):
        share = added(Slot.DISCHARGE, 0.0, 0.0, 0.0, 0.0, pressure / p.p_atm, p)
        factor *= not_negative(1.0 + share)
    if p.flow_model == 0.0:
        return factor * discharge(pressure, p.p_atm, c)
    if p.flow_model == 2.0:
        return factor * iso_6358(pressure, p.p_atm, p.cda_out, p.valve_b, kelvin, p.t_gas, p.r_air)
    return factor * orifice(pressure, p.p_atm, p.cda_out, p.t_gas, p.gamma, p.r_air)


@inlined
def leak(pressure, other, cda, kelvin, p):
    """Return the flow through a gap C_d A: an orifice; for a cylinder by ISO 6358 with b = 0.5 [K kg/s]."""
    if p.flow_model == 2.0:
        return iso_6358(pressure, other, cda, 0.5, kelvin, kelvin, p.r_air)
    return orifice(pressure, other, cda, kelvin, p.gamma, p.r_air)


@inlined
def piston_leak(pressure, other, kelvin, p):
    """Return the flow past a piston from a chamber to its neighbour [K kg/s]; kelvin: temperature of that air."""
    if p.leak_piston == 0.0:
        return 0.0
    return leak(pressure, other, p.leak_piston, kelvin, p)


@inlined
def all_leaks(past_pistons, t, x, pressure, kelvin, u, slot, p):
    """Return the flow into a chamber that passes no valve, `past_pistons` included [K kg/s]; slot: of its terms."""
    if p.leak_atm != 0.0 and u != 0.0:
        past_pistons -= u * leak(pressure, p.p_atm, p.leak_atm, kelvin, p)
    if unlikely(p.adder != 0.0):
        past_pistons += added(slot, t, x, 0.0, u, pressure, p)
        past_pistons -= added(Slot.LEAK, t, x, 0.0, u, pressure, p)
    return past_pistons


@inlined
def exponents(speed, p):
    """Return alpha_m1, alpha_1, alpha_m2, alpha_2 at a speed: by |v|, or v0 (1 - exp(-|v| / v0))."""
    v0 = p.alpha_v0
    effective = speed if v0 == 0.0 else v0 * (1.0 - exp(-speed / v0))
    am1 = p.alpha_m1 + p.alpha_speed_m1 * effective
    a1 = p.alpha_1 + p.alpha_speed * effective
    am2 = p.alpha_m2 + p.alpha_speed_m2 * effective
    a2 = p.alpha_2 + p.alpha_speed_2 * effective
    if unlikely(p.adder != 0.0):
        shift = added(Slot.EXPONENT, 0.0, 0.0, speed, 0.0, 0.0, p)
        a1 += shift
        a2 += shift
    return am1, a1, am2, a2


@inlined
def openings(u, p):
    """Return the open shares of inlet and outlet: u and 1 - u; from a closed centre 2 u - 1 or 1 - 2 u."""
    opened = u
    vented = 1.0 - u
    if unlikely(p.closed_centre != 0.0):
        opened = max(0.0, 2.0 * u - 1.0)
        vented = max(0.0, 1.0 - 2.0 * u)
    return opened, vented


@inlined
def chamber(pressure, kelvin, u, leak, volume, volume_rate, supply, alphas, p, c):
    """Return dP/dt = (R (am1 u f_in - am2 (1-u) f_out + leak) - alpha P dV/dt) / V   [Pa/s].

    Also f_in and f_out [K kg/s], R times the sum of flows [W], and alpha = u a1 + (1-u) a2. `u`: actual valve
    position, 1 supply, 0 atmosphere; `kelvin`: of its air. Source: thesis 3.23, 3.57-3.60. Checked by:
    tests/physics/test_chamber.py
    """
    am1, a1, am2, a2 = alphas
    opened, vented = openings(u, p)
    flow_in = valve_flow_in(pressure, supply, kelvin, p, c) if opened > 0.0 else 0.0
    flow_out = valve_flow_out(pressure, kelvin, p, c) if vented > 0.0 else 0.0
    gas = p.r_air * (am1 * opened * flow_in - am2 * vented * flow_out + leak)
    alpha = u * a1 + (1.0 - u) * a2
    rate = (gas - alpha * pressure * volume_rate) / volume
    return rate, flow_in, flow_out, gas, alpha


@inlined
def temperature(pressure, volume, mass, p):
    """Return the temperature of a cylinder's chamber, P V / (m R) [K]."""
    return pressure * volume / (mass * p.r_air)


@inlined
def energy_source(leak, volume, mass, kelvin, p):
    """Return what leaks and walls do to the energy of a cylinder's chamber, over R [K kg/s].

    kappa leak + (kappa - 1) h A (T_wall - T) / R, h by the power `wall_density` of the density over that of ISO 6358's
    reference air, 1.185 kg/m^3; walls at the supply's temperature, their area that of a cylinder of the bore and the
    chamber's volume, its ends times `wall_ends`.
    """
    area = 2.0 * p.wall_ends * p.area_p + 2.0 * volume * sqrt(pi / p.area_p)
    transfer = p.wall_heat * (mass / (volume * 1.185)) ** p.wall_density
    heat_w = transfer * area * (p.t_gas - kelvin)
    return p.air_kappa * leak + (p.air_kappa - 1.0) * heat_w / p.r_air


@inlined
def mass_rate(flows, leak, u, kelvin, p):
    """Return dm/dt of a cylinder's chamber [kg/s]: each flow of `chamber` over the temperature it comes with.

    leak: T m_dot into the chamber beside its valve, from outside with the supply's temperature.
    """
    opened, vented = openings(u, p)
    inward = opened * flows[1] / (p.t_gas if flows[1] > 0.0 else kelvin)
    outward = vented * flows[2] / (kelvin if flows[2] > 0.0 else p.t_gas)
    return inward - outward + leak / (p.t_gas if leak > 0.0 else kelvin)


@inlined
def store_chamber(q, j, flows, pressure, kelvin, u, volume_rate, p):
    """Store the rates of chamber j's quadratures, from what `chamber` returned."""
    _, flow_in, flow_out, gas, alpha = flows
    q.gas[j] = gas
    q.heat[j] = (1.0 - alpha) * pressure * volume_rate
    q.work[j] = pressure * volume_rate
    opened, vented = openings(u, p)
    q.mass_in[j] = opened * flow_in / p.t_gas
    q.mass_out[j] = vented * flow_out / kelvin


@inlined
def line_feed(pressure, p):
    """Return the flow into the supply line through its restriction [K kg/s]."""
    return orifice(p.p_supply, pressure, p.line_cda, p.t_gas, p.gamma, p.r_air)
