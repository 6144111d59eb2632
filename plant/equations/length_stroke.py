"""Right-hand side of the length stroke: stay, two sliding pistons, three chambers (3.53-3.68).

Chambers in a row B | piston 1 | N | piston 2 | F.  x_s is positive towards backward; x_1 and x_2
count inward from each piston's outer stop.  Forces below are in the direction of x_s.
"""

from __future__ import annotations

from math import exp, pi, sin

from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, FREE, NUT, LengthState, Over, Slot
from plant.kernel.record_views import quadratures_of
from plant.parts.chamber import pressure_rate
from plant.parts.damper import (
    borders,
    bulk_modulus,
    discharge_coefficient,
    holes_area,
    large_area,
    outflow,
    steady_difference,
)
from plant.parts.flow import charge, discharge, orifice
from plant.parts.friction import sliding
from plant.parts.synchronizer import barrier

STATES = LengthState.size
# Bodies nearer than this touch.
TOUCH_M = 1e-9


@inlined
def term_value(p, variable):
    """Non-parametric term: nodes joined by straight lines, constant outside [unit of its equation]."""
    count = int(p.term_count)
    place = (variable - p.term_low) / p.term_step
    if place <= 0.0:
        return p.term_nodes[0]
    if place >= count - 1:
        return p.term_nodes[count - 1]
    k = int(place)
    w = place - k
    return (1.0 - w) * p.term_nodes[k] + w * p.term_nodes[k + 1]


@inlined
def valve_flow_in(pressure, supply, p, c):
    """Charge flow at u = 1 by the selected flow model, with the unit's factor [K kg/s].

    A non-parametric term of equation 6 changes it by a share that depends on P / P_s.
    """
    factor = p.k_in
    if p.term_slot == Slot.CHARGE:
        factor *= max(0.0, 1.0 + term_value(p, pressure / supply))
    if p.flow_model == 0.0:
        return factor * charge(pressure, supply, c)
    return factor * orifice(supply, pressure, p.cda_in, p.t_gas, p.gamma, p.r_air)


@inlined
def valve_flow_out(pressure, p, c):
    """Discharge flow at u = 0 by the selected flow model, with the unit's factor [K kg/s].

    A non-parametric term of equation 7 changes it by a share that depends on P / P_atm.
    """
    factor = p.k_out
    if p.term_slot == Slot.DISCHARGE:
        factor *= max(0.0, 1.0 + term_value(p, pressure / p.p_atm))
    if p.flow_model == 0.0:
        return factor * discharge(pressure, p.p_atm, c)
    return factor * orifice(pressure, p.p_atm, p.cda_out, p.t_gas, p.gamma, p.r_air)


@inlined
def leak_flow(upstream, downstream, cda, p):
    """Flow T m_dot of a leak from upstream to downstream [K kg/s]; none without an area."""
    if cda == 0.0:
        return 0.0
    return orifice(upstream, downstream, cda, p.t_gas, p.gamma, p.r_air)


@inlined
def exponent_speed(speed, p):
    """Speed that the process exponents follow [m/s]: |v|, or v0 (1 - exp(-|v| / v0))."""
    v0 = p.alpha_v0
    return speed if v0 == 0.0 else v0 * (1.0 - exp(-speed / v0))


@inlined
def direction_factor(direction, p):
    """Friction asymmetry: 1 + a towards +, 1 - a towards -."""
    return 1.0 + p.asymmetry * direction


@inlined
def extra_drag(x, direction, p):
    """Position-bound resistance on the stay [N]: gearbox barrier, bump, linkage, damper mount."""
    extra = p.f_linkage + p.damper_drag
    if p.mesh_force != 0.0 or p.pull_force != 0.0:
        extra += barrier(
            x,
            direction,
            p.stroke,
            p.mesh_force,
            p.x_mesh,
            p.w_mesh,
            p.pull_force,
            p.w_pull,
        )
    if p.bump_force != 0.0:
        d = (x - p.bump_x) / p.bump_width
        extra += p.bump_force * exp(-0.5 * d * d)
    return extra


@inlined
def term_drag(x, speed, p):
    """The non-parametric resistance of position (variable 1) or speed (2) [N]."""
    return term_value(p, x if p.term_variable == Over.POSITION else speed)


@inlined
def stay_sliding(x, v, direction, p):
    """Sliding friction of the stay in its direction of motion [N], >= 0."""
    level = sliding(direction * v, p.f_static_s, p.f_run_s, p.beta_s, p.stribeck_v)
    level = level * direction_factor(direction, p) + extra_drag(x, direction, p)
    if p.term_slot == Slot.RESISTANCE:
        level = max(0.0, level + term_drag(x, abs(v), p))
    return level


@inlined
def stay_static(x, direction, p):
    """Breakaway friction of the stay towards a direction [N]."""
    level = max(p.f_static_s, p.f_run_s) * direction_factor(direction, p)
    level += extra_drag(x, direction, p)
    if p.term_slot == Slot.RESISTANCE:
        level = max(0.0, level + term_drag(x, 0.0, p))
    return level


@inlined
def seal_drag(difference_pa, p):
    """Friction of a piston seal grown by the pressure difference across it [N]."""
    return p.seal_mu * abs(difference_pa) * p.area_p


@inlined
def piston_sliding(v, direction, difference_pa, p):
    """Sliding friction of one piston [N]; v and direction are those of x_s."""
    level = sliding(direction * v, p.f_static_p, p.f_run_p, p.beta_p, p.stribeck_v)
    return level * direction_factor(direction, p) + seal_drag(difference_pa, p)


@inlined
def piston_static(direction, difference_pa, p):
    """Breakaway friction of one piston [N]."""
    level = max(p.f_static_p, p.f_run_p) * direction_factor(direction, p)
    return level + seal_drag(difference_pa, p)


@inlined
def conservative_force(x, p):
    """Spring, constant force and detent on the stay, in the direction of x [N]."""
    force = p.f_external - p.spring_k * (x - p.spring_x0)
    if p.detent_force != 0.0:
        stroke = p.stroke
        for k in range(-1, 2):
            d = (x - k * stroke) / p.detent_width
            if abs(d) < 1.0:
                force -= p.detent_force * sin(pi * d)
    return force


@inlined
def damper_outlet(distance, speed, p):
    """Outlet area times discharge coefficient of the oil damper [m^2] at a distance and speed."""
    large = large_area(distance, p.a_large, p.r_hole, p.x_hole)
    c_d = discharge_coefficient(large, p.a_large, speed, p.cd_floor, p.cd_slope)
    return (p.a_small + large) * c_d


@inlined
def damper_outlet_beside(distance, speed, m, p):
    """The same on the sides of the law's corners where the modes stand, goes on smoothly beyond them."""
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
    if m.damper == 1:
        outlet = damper_outlet_beside(distance, speed, m, p)
        return steady_difference(speed, p.a_oil, outlet, 1.0, p.rho_oil)
    return oil_pa - p.p_atm


@inlined
def damper_borders(distance, speed, p):
    """`plant.parts.damper.borders` of this stroke's damper."""
    return borders(distance, speed, p.a_large, p.r_hole, p.x_hole, p.cd_floor, p.cd_slope)


@inlined
def oil_rate(distance, speed, oil_pa, m, p):
    """dP_oil2/dt of the compressible damper [Pa/s] (3.31)."""
    kappa = bulk_modulus(oil_pa, p.kappa, p.air_fraction, p.p_atm)
    outlet = damper_outlet_beside(distance, speed, m, p)
    out = outflow(oil_pa - p.p_atm, outlet, 1.0, p.rho_oil)
    return kappa / (p.v_oil - p.a_oil * distance) * (p.a_oil * speed - out)


@inlined
def stay_force(y, m, p, t):
    """Net driving force on the stay without friction and contacts [N]."""
    x = y.x_s
    force = (y.p_b - y.p_f) * p.area_s + conservative_force(x, p)
    if m.damper != 0:
        side = float(m.side)
        force -= side * p.a_oil * damper_difference(side * x, side * y.v_s, y.p_oil, m, p)
    if p.term_slot == Slot.FORCE:
        force += term_force(y, p, t)
    return force


@inlined
def term_force(y, p, t):
    """The non-parametric force: of time, position, or (as a resistance) of speed [N]."""
    kind = p.term_variable
    if kind == Over.TIME:
        return term_value(p, t)
    if kind == Over.POSITION:
        return term_value(p, y.x_s)
    speed = y.v_s
    value = term_value(p, abs(speed))
    return -value if speed > 0.0 else (value if speed < 0.0 else 0.0)


@called
def net_forces(y, m, p, t):
    """Driving forces minus sliding friction of stay, piston 1, piston 2 [N].

    A body at rest gets its driving force alone.
    """
    d = m.stay
    stay = stay_force(y, m, p, t)
    if d != 0:
        stay -= d * stay_sliding(y.x_s, y.v_s, d, p)
    dp1 = y.p_b - y.p_n
    one = dp1 * p.area_p
    d1 = m.piston_1
    if d1 != 0:
        one -= d1 * piston_sliding(y.v_1, d1, dp1, p)
    dp2 = y.p_f - y.p_n
    two = -dp2 * p.area_p
    d2 = m.piston_2
    if d2 != 0:
        two -= d2 * piston_sliding(-y.v_2, d2, dp2, p)
    return stay, one, two


@inlined
def accelerations(m, p, force):
    """Accelerations in the direction of x_s of stay, piston 1, piston 2 [m/s^2]."""
    joined_1 = m.joined_1 != 0
    joined_2 = m.joined_2 != 0
    mass = p.m_s
    total = force[0]
    if joined_1:
        mass += p.m_p
        total += force[1]
    if joined_2:
        mass += p.m_p
        total += force[2]
    a = total / mass if m.stay != 0 else 0.0
    per_mass = 1.0 / p.m_p
    one = force[1] * per_mass if m.piston_1 != 0 else 0.0
    two = force[2] * per_mass if m.piston_2 != 0 else 0.0
    return a, a if joined_1 else one, a if joined_2 else two


@inlined
def touching(gap, p):
    """Contact of stay and piston at this gap: NUT, COLLAR or FREE."""
    if gap <= TOUCH_M:
        return NUT
    return COLLAR if gap >= p.x_free - TOUCH_M else FREE


@inlined
def blocked_force(y, m, p, force):
    """Driving force of the stay and of the pistons at rest on it against the synchronizer [N].

    Positive outward; without friction, as the static friction's share is not determined.
    """
    total = force[0]
    if m.piston_1 == 0:
        contact = touching(y.x_1 - y.x_s, p)
        if (contact == NUT and force[1] < 0.0) or (contact == COLLAR and force[1] > 0.0):
            total += force[1]
    if m.piston_2 == 0:
        contact = touching(y.x_2 + y.x_s, p)
        if (contact == NUT and force[2] > 0.0) or (contact == COLLAR and force[2] < 0.0):
            total += force[2]
    return total * m.blocked


@inlined
def length_volumes(y, p):
    """Volumes of chambers B, N and F [m^3]."""
    area = p.area_p
    area_s = p.area_s
    return (
        p.vol_b + area * y.x_1 + area_s * y.x_s,
        p.vol_n - area * (y.x_1 + y.x_2),
        p.vol_f + area * y.x_2 - area_s * y.x_s,
    )


@called
def rates(t, y, dy, m, u0, du, p, c, quadratures):
    """Time derivatives of the length stroke -> dy; with `quadratures`, those behind the states."""
    force = net_forces(y, m, p, t)
    acc = accelerations(m, p, force)
    vs = y.v_s
    v1 = y.v_1
    v2 = y.v_2
    dy.x_s = vs
    dy.v_s = acc[0]
    dy.x_1 = v1
    dy.v_1 = acc[1]
    dy.x_2 = v2
    dy.v_2 = -acc[2]
    area = p.area_p
    area_s = p.area_s
    vol_b, vol_n, vol_f = length_volumes(y, p)
    rate_b = area * v1 + area_s * vs
    rate_n = -area * (v1 + v2)
    rate_f = area * v2 - area_s * vs
    ub = u0[0] + du[0] * t
    un = u0[1] + du[1] * t
    uf = u0[2] + du[2] * t
    supply = y.p_line if m.line != 0 else p.p_supply
    in_b = valve_flow_in(y.p_b, supply, p, c) if ub > 0.0 else 0.0
    in_n = valve_flow_in(y.p_n, supply, p, c) if un > 0.0 else 0.0
    in_f = valve_flow_in(y.p_f, supply, p, c) if uf > 0.0 else 0.0
    out_b = valve_flow_out(y.p_b, p, c) if ub < 1.0 else 0.0
    out_n = valve_flow_out(y.p_n, p, c) if un < 1.0 else 0.0
    out_f = valve_flow_out(y.p_f, p, c) if uf < 1.0 else 0.0
    leak_b = 0.0
    leak_n = 0.0
    leak_f = 0.0
    if p.leak_piston != 0.0:
        one = leak_flow(y.p_b, y.p_n, p.leak_piston, p)
        two = leak_flow(y.p_f, y.p_n, p.leak_piston, p)
        leak_b -= one
        leak_f -= two
        leak_n += one + two
    if p.leak_atm != 0.0:
        leak_b -= ub * leak_flow(y.p_b, p.p_atm, p.leak_atm, p)
        leak_n -= un * leak_flow(y.p_n, p.p_atm, p.leak_atm, p)
        leak_f -= uf * leak_flow(y.p_f, p.p_atm, p.leak_atm, p)
    if p.term_slot == Slot.LEAK:
        leak_b -= term_value(p, y.p_b)
        leak_n -= term_value(p, y.p_n)
        leak_f -= term_value(p, y.p_f)
    elif Slot.FLOW_1 <= p.term_slot <= Slot.FLOW_3:
        kind = p.term_variable
        which = int(p.term_slot) - Slot.FLOW_1
        own = y.p_b if which == 0 else (y.p_n if which == 1 else y.p_f)
        flow = term_value(p, t if kind == Over.TIME else (y.x_s if kind == Over.POSITION else own))
        if which == 0:
            leak_b += flow
        elif which == 1:
            leak_n += flow
        else:
            leak_f += flow
    r = p.r_air
    am1 = p.alpha_m1
    am2 = p.alpha_m2
    a1 = p.alpha_1
    a2 = p.alpha_2
    speed = max(abs(vs), abs(v1), abs(v2))
    effective = exponent_speed(speed, p)
    am1 += p.alpha_speed_m1 * effective
    a1 += p.alpha_speed * effective
    am2 += p.alpha_speed_m2 * effective
    a2 += p.alpha_speed_2 * effective
    if p.term_slot == Slot.EXPONENT:
        shift = term_value(p, speed)
        a1 += shift
        a2 += shift
    dy.p_b = pressure_rate(y.p_b, ub, in_b, out_b, leak_b, vol_b, rate_b, r, am1, a1, am2, a2)
    dy.p_n = pressure_rate(y.p_n, un, in_n, out_n, leak_n, vol_n, rate_n, r, am1, a1, am2, a2)
    dy.p_f = pressure_rate(y.p_f, uf, in_f, out_f, leak_f, vol_f, rate_f, r, am1, a1, am2, a2)
    dy.impulse = max(0.0, blocked_force(y, m, p, force)) if m.blocked != 0 else 0.0
    if m.damper == 2 and m.oil_rest == 0:
        side = float(m.side)
        dy.p_oil = oil_rate(side * y.x_s, side * vs, y.p_oil, m, p)
    else:
        dy.p_oil = 0.0
    if m.line != 0:
        drawn = ub * in_b + un * in_n + uf * in_f
        feed = orifice(p.p_supply, y.p_line, p.line_cda, p.t_gas, p.gamma, r)
        dy.p_line = r / p.line_volume * (feed - drawn)
    else:
        dy.p_line = 0.0
    if quadratures:
        q = quadratures_of(dy[STATES:])
        q.gas[0] = r * (am1 * ub * in_b - am2 * (1.0 - ub) * out_b + leak_b)
        q.gas[1] = r * (am1 * un * in_n - am2 * (1.0 - un) * out_n + leak_n)
        q.gas[2] = r * (am1 * uf * in_f - am2 * (1.0 - uf) * out_f + leak_f)
        q.work[0] = y.p_b * rate_b
        q.work[1] = y.p_n * rate_n
        q.work[2] = y.p_f * rate_f
        q.heat[0] = (1.0 - (ub * a1 + (1.0 - ub) * a2)) * y.p_b * rate_b
        q.heat[1] = (1.0 - (un * a1 + (1.0 - un) * a2)) * y.p_n * rate_n
        q.heat[2] = (1.0 - (uf * a1 + (1.0 - uf) * a2)) * y.p_f * rate_f
        temperature = p.t_gas
        q.mass_in[0] = ub * in_b / temperature
        q.mass_in[1] = un * in_n / temperature
        q.mass_in[2] = uf * in_f / temperature
        q.mass_out[0] = (1.0 - ub) * out_b / temperature
        q.mass_out[1] = (1.0 - un) * out_n / temperature
        q.mass_out[2] = (1.0 - uf) * out_f / temperature
        d = m.stay
        loss = stay_sliding(y.x_s, vs, d, p) * d * vs if d != 0 else 0.0
        d = m.piston_1
        if d != 0:
            loss += piston_sliding(v1, d, y.p_b - y.p_n, p) * d * v1
        d = m.piston_2
        if d != 0:
            loss -= piston_sliding(-v2, d, y.p_f - y.p_n, p) * d * v2
        q.friction = loss
        if m.damper != 0:
            side = float(m.side)
            q.damper = (
                side * vs * p.a_oil * damper_difference(side * y.x_s, side * vs, y.p_oil, m, p)
            )
        else:
            q.damper = 0.0
        q.external = conservative_force(y.x_s, p) * vs
        if p.term_slot == Slot.FORCE:
            q.external += term_force(y, p, t) * vs
        q.atmosphere = 0.0
