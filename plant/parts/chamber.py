"""Pressure of a chamber with one 3/2 valve (thesis 3.11, 3.23)."""

from __future__ import annotations

from plant.kernel.compiled import inlined


@inlined
def pressure_rate(p, u, flow_in, flow_out, leak, volume, volume_rate, r_air, am1, a1, am2, a2):
    """dP/dt = (R (am1 u f_in - am2 (1-u) f_out + leak) - alpha P dV/dt) / V   [Pa/s].

    `u` is the actual valve position, 1 = supply, 0 = atmosphere; the exponents follow it.
    `leak` is a flow T m_dot into the chamber that passes no valve.
    Source: thesis 3.23, 3.57-3.60.  Checked by: tests/physics/test_chamber.py
    """
    gas = am1 * u * flow_in - am2 * (1.0 - u) * flow_out + leak
    alpha = u * a1 + (1.0 - u) * a2
    return (r_air * gas - alpha * p * volume_rate) / volume
