"""The fixed-piston actuator: right-hand side, guards and resets (thesis 3.46-3.52 with errata).

V1 = V10 + A1 x, V2 = V20 - A2 x, 0 <= x <= stroke; the parts are those of the length stroke.
"""

from __future__ import annotations

from plant.equations.length_contacts import (
    EPS_M,
    EPS_M_S,
    EPS_N,
    EPS_PA,
    FAR,
    G_HOLD_STAY,
    G_OIL_EMPTY,
    G_OIL_FILL,
    G_STAY_HIGH,
    G_STAY_LOW,
    G_STAY_SPEED,
    GUARDS,
    TOUCH_M,
    damper_corners,
    note_corners,
    put,
)
from plant.equations.length_impacts import direction_of, group_acceleration, rebound
from plant.equations.length_stroke import (
    conservative_force,
    damper_difference,
    exponent_speed,
    leak_flow,
    oil_rate,
    stay_sliding,
    stay_static,
    term_value,
    valve_flow_in,
    valve_flow_out,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FixedState, Over, Slot
from plant.kernel.record_views import quadratures_of
from plant.parts.chamber import pressure_rate
from plant.parts.flow import orifice

STATES = FixedState.size


@inlined
def fixed_drive(y, m, p, t):
    """Driving force on the piston without friction [N]: P1 A1 - P2 A2 - P_atm A_s + loads."""
    force = y.p_1 * p.area_p - y.p_2 * p.area_p2 - p.p_atm * p.area_s
    force += conservative_force(y.x, p)
    if m.damper != 0:
        force -= p.a_oil * damper_difference(y.x, y.v, y.p_oil, m, p)
    if p.term_slot == Slot.FORCE:
        force += fixed_term(y, p, t)
    return force


@inlined
def fixed_term(y, p, t):
    """The non-parametric force: of time, position, or (as a resistance) of speed [N]."""
    kind = p.term_variable
    if kind == Over.TIME:
        return term_value(p, t)
    if kind == Over.POSITION:
        return term_value(p, y.x)
    value = term_value(p, abs(y.v))
    return -value if y.v > 0.0 else (value if y.v < 0.0 else 0.0)


@inlined
def seal(y, p):
    """Seal friction from the pressure difference across the piston [N]."""
    return p.seal_mu * abs(y.p_1 - y.p_2) * p.area_p


@inlined
def fixed_volumes(y, p):
    """Volumes of chambers 1 and 2 [m^3]: V10 + A1 x, V20 - A2 x."""
    return p.vol_b + p.area_p * y.x, p.vol_n - p.area_p2 * y.x


@called
def fixed_rates(t, y, dy, m, u0, du, p, c, quadratures):
    """Time derivatives of the fixed piston -> dy; with `quadratures`, those behind the states."""
    v = y.v
    d = m.stay
    a = 0.0
    if d != 0:
        friction = stay_sliding(y.x, v, d, p) + seal(y, p)
        a = (fixed_drive(y, m, p, t) - d * friction) / p.m_s
    dy.x = v
    dy.v = a
    u1 = u0[0] + du[0] * t
    u2 = u0[1] + du[1] * t
    supply = y.p_line if m.line != 0 else p.p_supply
    in1 = valve_flow_in(y.p_1, supply, p, c) if u1 > 0.0 else 0.0
    in2 = valve_flow_in(y.p_2, supply, p, c) if u2 > 0.0 else 0.0
    out1 = valve_flow_out(y.p_1, p, c) if u1 < 1.0 else 0.0
    out2 = valve_flow_out(y.p_2, p, c) if u2 < 1.0 else 0.0
    leak1 = 0.0
    leak2 = 0.0
    if p.leak_piston != 0.0:
        across = leak_flow(y.p_1, y.p_2, p.leak_piston, p)
        leak1 -= across
        leak2 += across
    if p.leak_atm != 0.0:
        leak1 -= u1 * leak_flow(y.p_1, p.p_atm, p.leak_atm, p)
        leak2 -= u2 * leak_flow(y.p_2, p.p_atm, p.leak_atm, p)
    if p.term_slot == Slot.LEAK:
        leak1 -= term_value(p, y.p_1)
        leak2 -= term_value(p, y.p_2)
    elif Slot.FLOW_1 <= p.term_slot <= Slot.FLOW_3:
        kind = p.term_variable
        first = p.term_slot == Slot.FLOW_1
        own = y.p_1 if first else y.p_2
        flow = term_value(p, t if kind == Over.TIME else (y.x if kind == Over.POSITION else own))
        if first:
            leak1 += flow
        else:
            leak2 += flow
    r = p.r_air
    effective = exponent_speed(abs(v), p)
    am1 = p.alpha_m1 + p.alpha_speed_m1 * effective
    am2 = p.alpha_m2 + p.alpha_speed_m2 * effective
    a1 = p.alpha_1 + p.alpha_speed * effective
    a2 = p.alpha_2 + p.alpha_speed_2 * effective
    if p.term_slot == Slot.EXPONENT:
        shift = term_value(p, abs(v))
        a1 += shift
        a2 += shift
    vol1, vol2 = fixed_volumes(y, p)
    rate1 = p.area_p * v
    rate2 = -p.area_p2 * v
    dy.p_1 = pressure_rate(y.p_1, u1, in1, out1, leak1, vol1, rate1, r, am1, a1, am2, a2)
    dy.p_2 = pressure_rate(y.p_2, u2, in2, out2, leak2, vol2, rate2, r, am1, a1, am2, a2)
    if m.damper == 2 and m.oil_rest == 0:
        dy.p_oil = oil_rate(y.x, v, y.p_oil, m, p)
    else:
        dy.p_oil = 0.0
    if m.line != 0:
        feed = orifice(p.p_supply, y.p_line, p.line_cda, p.t_gas, p.gamma, r)
        dy.p_line = r / p.line_volume * (feed - u1 * in1 - u2 * in2)
    else:
        dy.p_line = 0.0
    if quadratures:
        q = quadratures_of(dy[STATES:])
        q.gas[0] = r * (am1 * u1 * in1 - am2 * (1.0 - u1) * out1 + leak1)
        q.gas[1] = r * (am1 * u2 * in2 - am2 * (1.0 - u2) * out2 + leak2)
        q.gas[2] = 0.0
        q.heat[0] = (1.0 - (u1 * a1 + (1.0 - u1) * a2)) * y.p_1 * rate1
        q.heat[1] = (1.0 - (u2 * a1 + (1.0 - u2) * a2)) * y.p_2 * rate2
        q.heat[2] = 0.0
        q.work[0] = y.p_1 * rate1
        q.work[1] = y.p_2 * rate2
        q.work[2] = 0.0
        q.mass_in[0] = u1 * in1 / p.t_gas
        q.mass_in[1] = u2 * in2 / p.t_gas
        q.mass_in[2] = 0.0
        q.mass_out[0] = (1.0 - u1) * out1 / p.t_gas
        q.mass_out[1] = (1.0 - u2) * out2 / p.t_gas
        q.mass_out[2] = 0.0
        q.friction = (stay_sliding(y.x, v, d, p) + seal(y, p)) * d * v if d != 0 else 0.0
        q.damper = 0.0
        if m.damper != 0:
            q.damper = v * p.a_oil * damper_difference(y.x, v, y.p_oil, m, p)
        q.external = conservative_force(y.x, p) * v
        if p.term_slot == Slot.FORCE:
            q.external += fixed_term(y, p, t) * v
        q.atmosphere = -p.p_atm * p.area_s * v


@called
def fixed_guards(t, y, m, p, g):
    """Guards of the present modes -> g[0:GUARDS]; each is positive until its event.  Returns the lowest."""
    low = FAR
    for k in range(GUARDS):
        g[k] = low
    high = p.stroke + p.stop_offset
    d = m.stay
    if d != 0:
        low = put(g, G_STAY_SPEED, d * y.v + EPS_M_S, low)
        if d > 0:
            low = put(g, G_STAY_HIGH, high - y.x + EPS_M, low)
        else:
            low = put(g, G_STAY_LOW, y.x + EPS_M, low)
    else:
        drive = fixed_drive(y, m, p, t)
        hold = FAR
        if y.x < high - TOUCH_M:
            hold = stay_static(y.x, 1.0, p) + seal(y, p) - drive
        if y.x > TOUCH_M:
            hold = min(hold, stay_static(y.x, -1.0, p) + seal(y, p) + drive)
        low = put(g, G_HOLD_STAY, hold + EPS_N, low)
    if m.damper != 0 and d != 0:
        low = damper_corners(y.x, y.v, m, p, g, low)
    if m.damper == 2:
        if m.oil_rest != 0:
            if d != 0:
                low = put(g, G_OIL_FILL, EPS_M_S - y.v, low)
        else:
            low = put(g, G_OIL_EMPTY, y.p_oil - p.p_atm + EPS_PA, low)
    return low


@called
def fixed_impacts(y, m, p, impact):
    """Resolve an end stop; impact.lost energy lost [J], impact.speed impact speed [m/s]."""
    impact.lost = 0.0
    impact.speed = 0.0
    impact.at_block = 0.0
    high = p.stroke + p.stop_offset
    hit = False
    if y.x >= high - TOUCH_M and y.v > 0.0:
        y.x = high
        hit = True
    elif y.x <= TOUCH_M and y.v < 0.0:
        y.x = 0.0
        hit = True
    if hit:
        after = rebound(y.v, p)
        impact.lost = 0.5 * p.m_s * (y.v * y.v - after * after)
        impact.speed = abs(y.v)
        y.v = after


@called
def fixed_settle(t, y, m, p):
    """Choose the mode that continues the motion: at rest, or moving, and the damper's."""
    m.stay = 0
    if m.damper != 0:
        note_corners(y.x, y.v, m, p)
    drive = fixed_drive(y, m, p, t)
    drag = seal(y, p)
    high = p.stroke + p.stop_offset
    a = group_acceleration(
        y.v,
        drive,
        stay_static(y.x, 1.0, p) + drag,
        stay_static(y.x, -1.0, p) + drag,
        stay_sliding(y.x, y.v, 1.0, p) + drag,
        stay_sliding(y.x, y.v, -1.0, p) + drag,
        p.m_s,
        y.x >= high - TOUCH_M,
        y.x <= TOUCH_M,
    )
    m.stay = direction_of(y.v, a)
    if m.damper == 2:
        m.oil_rest = 0
        if y.p_oil <= p.p_atm + EPS_PA:
            y.p_oil = p.p_atm
            m.oil_rest = 0 if m.stay > 0 else 1
