"""A chamber with one 3/2 valve: flows, leaks, process exponents and pressure (thesis 3.11, 3.23).

Every chamber of both actuators, moving or at rest, computed in steps or in closed form.
"""

from __future__ import annotations

from math import exp

from plant.kernel.compiled import inlined
from plant.kernel.layout import Slot
from plant.kernel.views import unlikely
from plant.parts.flow import charge, discharge, orifice
from plant.parts.term import added, not_negative


@inlined
def valve_flow_in(pressure, supply, p, c):
    """Return the charge flow at u = 1 by the selected flow model, with the factor of this unit [K kg/s]."""
    factor = p.k_in
    if unlikely(p.adder != 0.0):
        share = added(Slot.CHARGE, 0.0, 0.0, 0.0, 0.0, pressure / supply, p)
        factor *= not_negative(1.0 + share)
    if p.flow_model == 0.0:
        return factor * charge(pressure, supply, c)
    return factor * orifice(supply, pressure, p.cda_in, p.t_gas, p.gamma, p.r_air)


@inlined
def valve_flow_out(pressure, p, c):
    """Return the discharge flow at u = 0 by the selected flow model [K kg/s]."""
    factor = p.k_out
    if unlikely(p.adder != 0.0):
        share = added(Slot.DISCHARGE, 0.0, 0.0, 0.0, 0.0, pressure / p.p_atm, p)
        factor *= not_negative(1.0 + share)
    if p.flow_model == 0.0:
        return factor * discharge(pressure, p.p_atm, c)
    return factor * orifice(pressure, p.p_atm, p.cda_out, p.t_gas, p.gamma, p.r_air)


@inlined
def piston_leak(pressure, other, p):
    """Return the flow past a piston from a chamber to its neighbour [K kg/s]."""
    if p.leak_piston == 0.0:
        return 0.0
    return orifice(pressure, other, p.leak_piston, p.t_gas, p.gamma, p.r_air)


@inlined
def all_leaks(leak, t, x, pressure, u, slot, p):
    """Return the flow into a chamber that passes no valve [K kg/s].

    leak: that past the pistons; slot: of the terms that add to it.
    """
    if p.leak_atm != 0.0:
        leak -= u * orifice(pressure, p.p_atm, p.leak_atm, p.t_gas, p.gamma, p.r_air)
    if unlikely(p.adder != 0.0):
        leak += added(slot, t, x, 0.0, u, pressure, p)
        leak -= added(Slot.LEAK, t, x, 0.0, u, pressure, p)
    return leak


@inlined
def exponents(speed, p):
    """Return the process exponents alpha_m1, alpha_1, alpha_m2, alpha_2 at a speed of the piston.

    They follow |v|, or v0 (1 - exp(-|v| / v0)).
    """
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
def pressure_rate(pressure, gas, alpha, volume, volume_rate):
    """Return dP/dt = (gas - alpha P dV/dt) / V   [Pa/s]; gas: R times the sum of flows [W]."""
    return (gas - alpha * pressure * volume_rate) / volume


@inlined
def openings(u, p):
    """Return the shares of inlet and outlet that are open at a valve's position.

    u and 1 - u; from a closed centre 2 u - 1 or 1 - 2 u.
    """
    opened = u
    vented = 1.0 - u
    if unlikely(p.closed_centre != 0.0):
        opened = max(0.0, 2.0 * u - 1.0)
        vented = max(0.0, 1.0 - 2.0 * u)
    return opened, vented


@inlined
def chamber(pressure, u, leak, volume, volume_rate, supply, alphas, p, c):
    """Return dP/dt = (R (am1 u f_in - am2 (1-u) f_out + leak) - alpha P dV/dt) / V   [Pa/s].

    Also f_in and f_out [K kg/s], R times the sum of flows [W], and alpha = u a1 + (1-u) a2.
    `u` is the actual valve position, 1 = supply, 0 = atmosphere; the exponents follow it.
    Source: thesis 3.23, 3.57-3.60.  Checked by: tests/physics/test_chamber.py
    """
    am1, a1, am2, a2 = alphas
    opened, vented = openings(u, p)
    flow_in = valve_flow_in(pressure, supply, p, c) if opened > 0.0 else 0.0
    flow_out = valve_flow_out(pressure, p, c) if vented > 0.0 else 0.0
    gas = p.r_air * (am1 * opened * flow_in - am2 * vented * flow_out + leak)
    alpha = u * a1 + (1.0 - u) * a2
    rate = pressure_rate(pressure, gas, alpha, volume, volume_rate)
    return rate, flow_in, flow_out, gas, alpha


@inlined
def store_chamber(q, j, flows, pressure, u, volume_rate, p):
    """Store the rates of chamber j's quadratures, from what `chamber` returned."""
    _, flow_in, flow_out, gas, alpha = flows
    q.gas[j] = gas
    q.heat[j] = (1.0 - alpha) * pressure * volume_rate
    q.work[j] = pressure * volume_rate
    opened, vented = openings(u, p)
    q.mass_in[j] = opened * flow_in / p.t_gas
    q.mass_out[j] = vented * flow_out / p.t_gas


@inlined
def line_feed(pressure, p):
    """Return the flow into the supply line through its restriction [K kg/s]."""
    return orifice(p.p_supply, pressure, p.line_cda, p.t_gas, p.gamma, p.r_air)
