"""The fixed-piston actuator: right-hand side, guards and resets (thesis 3.46-3.52 with errata).

V1 = V10 + A1 x, V2 = V20 - A2 x, 0 <= x <= stroke. A user's cylinder has balances of mass and energy in place of the
thesis's exponents. `fixed_rates`: 3.46 (position), 3.47 (forces, with `fixed_drive`, `fixed_friction`), 3.48, 3.49
(P_1, P_2); `plant.parts.chamber.chamber`: 3.50, 3.51 (flows); `plant.parts.forces`: 3.52.
"""

from __future__ import annotations

from plant.equations import length_contacts as contacts
from plant.equations.length_modes import direction_of, group_acceleration, rebound, settle_oil
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COMPRESSIBLE, FIXED, GUARDS, Guard, Slot, quadratures_of
from plant.kernel.packing import CYLINDER_STATES, STATE_COUNTS
from plant.parts import chamber as air
from plant.parts.damper import oil_rate
from plant.parts.forces import loaded, seal_drag, stay_sliding, stay_static, store_loads

FIXED_STATES = STATE_COUNTS[FIXED][2]


@inlined
def fixed_drive(y, m, p, t):
    """Driving force on the piston without friction [N]: P1 A1 - P2 A2 - P_atm A_s + loads."""
    force = y.p_1 * p.area_p - y.p_2 * p.area_p2 - p.p_atm * p.area_s
    return loaded(force, t, y.x, y.v, 1.0, y.p_oil, m, p)


@inlined
def fixed_volumes(y, p):
    """Volumes of chambers 1 and 2 [m^3]: V10 + A1 x, V20 - A2 x."""
    return p.vol_b + p.area_p * y.x, p.vol_n - p.area_p2 * y.x


@inlined
def fixed_friction(y, d, p):
    """Return the sliding friction in the direction of motion d, with the seal's [N]."""
    return stay_sliding(y.x, y.v, d, p) + seal_drag(y.p_1 - y.p_2, p)


@called
def fixed_rates(t, y, dy, m, u0, du, p, c, quadratures):
    """Time derivatives of the fixed piston -> dy; with `quadratures`, those behind the states."""
    v = y.v
    d = m.stay
    a = 0.0
    if d != 0:
        a = (fixed_drive(y, m, p, t) - d * fixed_friction(y, d, p)) / p.m_s
    u_1 = u0[0] + du[0] * t
    u_2 = u0[1] + du[1] * t
    supply = y.p_line if m.line != 0 else p.p_supply
    v_1, v_2 = fixed_volumes(y, p)
    t_1 = air.temperature(y.p_1, v_1, y.m_1, p) if m.masses != 0 else p.t_gas
    t_2 = air.temperature(y.p_2, v_2, y.m_2, p) if m.masses != 0 else p.t_gas
    t_across = t_1 if y.p_1 > y.p_2 else t_2
    across = air.piston_leak(y.p_1, y.p_2, t_across, p)
    leak_1 = air.all_leaks(0.0 - across, t, y.x, y.p_1, t_1, u_1, Slot.FLOW_1, p)
    leak_2 = air.all_leaks(across, t, y.x, y.p_2, t_2, u_2, Slot.FLOW_2, p)
    alphas = air.exponents(abs(v), p)
    outside_1, outside_2 = leak_1 + across, leak_2 - across
    if m.masses != 0:
        leak_1 = air.energy_source(leak_1, v_1, y.m_1, t_1, p)
        leak_2 = air.energy_source(leak_2, v_2, y.m_2, t_2, p)
        alphas = p.air_kappa, p.air_kappa, p.air_kappa, p.air_kappa
    dv_1 = p.area_p * v
    dv_2 = -p.area_p2 * v
    one = air.chamber(y.p_1, t_1, u_1, leak_1, v_1, dv_1, supply, alphas, p, c)
    two = air.chamber(y.p_2, t_2, u_2, leak_2, v_2, dv_2, supply, alphas, p, c)
    if m.masses != 0:
        dy.m_1 = air.mass_rate(one, outside_1, u_1, t_1, p) - across / t_across
        dy.m_2 = air.mass_rate(two, outside_2, u_2, t_2, p) + across / t_across
    dy.x = v
    dy.v = a
    dy.p_1 = one[0]
    dy.p_2 = two[0]
    dy.p_oil = 0.0
    if m.damper == COMPRESSIBLE and m.oil_rest == 0:
        dy.p_oil = oil_rate(y.x, v, y.p_oil, m, p)
    dy.p_line = 0.0
    if m.line != 0:
        left = (
            air.line_feed(y.p_line, p)
            - air.openings(u_1, p)[0] * one[1]
            - air.openings(u_2, p)[0] * two[1]
        )
        dy.p_line = p.r_air / p.line_volume * left
    if quadratures:
        q = quadratures_of(dy[CYLINDER_STATES if m.masses != 0 else FIXED_STATES :])
        for j in range(3):
            q.gas[j] = q.heat[j] = q.work[j] = q.mass_in[j] = q.mass_out[j] = 0.0
        air.store_chamber(q, 0, one, y.p_1, t_1, u_1, dv_1, p)
        air.store_chamber(q, 1, two, y.p_2, t_2, u_2, dv_2, p)
        q.friction = fixed_friction(y, d, p) * d * v if d != 0 else 0.0
        store_loads(q, t, y.x, v, 1.0, y.p_oil, m, p)
        q.atmosphere = -p.p_atm * p.area_s * v


@called
def fixed_guards(t, y, m, p, g):
    """Guards of the present modes -> g[0:GUARDS]; each is positive until its event.  Returns the lowest."""
    low = contacts.UNREACHED
    for k in range(GUARDS):
        g[k] = low
    high = p.stroke + p.stop_offset
    d = m.stay
    if d != 0:
        low = contacts.put(g, Guard.TURN, d * y.v + contacts.EPS_M_S, low)
        if d > 0:
            low = contacts.put(g, Guard.STOP_HIGH, high - y.x + contacts.EPS_M, low)
        else:
            low = contacts.put(g, Guard.STOP_LOW, y.x + contacts.EPS_M, low)
    else:
        drive = fixed_drive(y, m, p, t)
        hold = contacts.UNREACHED
        if y.x < high - contacts.TOUCH_M:
            hold = stay_static(y.x, 1.0, p) + seal_drag(y.p_1 - y.p_2, p) - drive
        if y.x > contacts.TOUCH_M:
            hold = min(hold, stay_static(y.x, -1.0, p) + seal_drag(y.p_1 - y.p_2, p) + drive)
        low = contacts.put(g, Guard.BREAKAWAY, hold + contacts.EPS_N, low)
    if m.damper != 0:
        low = contacts.damper_guards(y.x, y.v, y.p_oil, m, p, g, low)
    return low


@called
def fixed_impacts(y, m, p, impact):
    """Resolve an end stop; impact.lost energy lost [J], impact.speed impact speed [m/s]."""
    impact.lost = 0.0
    impact.speed = 0.0
    impact.at_block = 0.0
    high = p.stroke + p.stop_offset
    hit = False
    if y.x >= high - contacts.TOUCH_M and y.v > 0.0:
        y.x = high
        hit = True
    elif y.x <= contacts.TOUCH_M and y.v < 0.0:
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
        contacts.note_corners(y.x, y.v, m, p)
    drive = fixed_drive(y, m, p, t)
    drag = seal_drag(y.p_1 - y.p_2, p)
    high = p.stroke + p.stop_offset
    a = group_acceleration(
        y.v,
        drive,
        stay_static(y.x, 1.0, p) + drag,
        stay_static(y.x, -1.0, p) + drag,
        stay_sliding(y.x, y.v, 1.0, p) + drag,
        stay_sliding(y.x, y.v, -1.0, p) + drag,
        p.m_s,
        y.x >= high - contacts.TOUCH_M,
        y.x <= contacts.TOUCH_M,
    )
    m.stay = direction_of(y.v, a)
    if m.damper == COMPRESSIBLE:
        settle_oil(y, m.stay, m, p)
