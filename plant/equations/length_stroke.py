"""Right-hand side of the length stroke: stay, two sliding pistons, three chambers (3.53-3.68).

Chambers in a row B | piston 1 | N | piston 2 | F.  x_s is positive towards backward; x_1 and x_2
count inward from each piston's outer stop.  Forces below are in the direction of x_s.

======================  ==========  =====================================================
thesis, piston 1 free   joined      here
======================  ==========  =====================================================
3.53, 3.54 positions    3.62        `rates`
3.55 piston, 3.56 stay  3.63        `net_forces`, `accelerations`
3.57 P_B, 3.58 P_N      3.64, 3.65  `length_volumes`, `rates`, `plant.parts.chamber.chamber`
3.59, 3.60 flows        3.66, 3.67  `plant.parts.chamber.chamber`
3.61 friction           3.68        `plant.parts.forces`; at rest: `length_contacts`
======================  ==========  =====================================================
"""

from __future__ import annotations

from plant.kernel import layout
from plant.kernel.compiled import called, inlined
from plant.parts.chamber import all_leaks, chamber, exponents, line_feed, piston_leak, store_chamber
from plant.parts.damper import oil_rate
from plant.parts.forces import loaded, piston_sliding, stay_sliding, store_loads

LENGTH_STATES = layout.LengthState.size
# Where the pistons' states and modes begin.
PISTONS, STATUS, JOINED = layout.LengthState.x_1, layout.Modes.piston_1, layout.Modes.joined_1
# Bodies nearer than this touch.
TOUCH_M = 1e-9


@inlined
def piston_of(y, k):
    """State of piston k: 0 between B and N, 1 between N and F."""
    return layout.piston_state(y[PISTONS + 2 * k :])


@inlined
def sense(k):
    """+1 if piston k counts its position in the direction of x_s, -1 if against it."""
    return 1.0 - 2.0 * k


@inlined
def gap(y, k):
    """Distance of piston k from the nut of the stay [m]."""
    return piston_of(y, k).x - sense(k) * y.x_s


@inlined
def opening(y, k):
    """Rate at which the gap of piston k grows [m/s]."""
    return piston_of(y, k).v - sense(k) * y.v_s


@inlined
def across(y, k):
    """Pressure difference across piston k, positive towards N [Pa]."""
    return (y.p_b if k == 0 else y.p_f) - y.p_n


@inlined
def piston_force(y, m, k, p):
    """Driving force minus sliding friction of piston k [N]."""
    pressure = across(y, k)
    force = sense(k) * pressure * p.area_p
    d = m[STATUS + k]
    if d != 0:
        force -= d * piston_sliding(sense(k) * piston_of(y, k).v, d, pressure, p)
    return force


@called
def net_forces(y, m, p, t):
    """Driving forces of stay, piston 1, piston 2, less the sliding friction of those that move [N]."""
    d = m.stay
    stay = loaded((y.p_b - y.p_f) * p.area_s, t, y.x_s, y.v_s, float(m.side), y.p_oil, m, p)
    if d != 0:
        stay -= d * stay_sliding(y.x_s, y.v_s, d, p)
    return stay, piston_force(y, m, 0, p), piston_force(y, m, 1, p)


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
def touching(y, k, p):
    """Contact of stay and piston k where they are: NUT, COLLAR or FREE."""
    if gap(y, k) <= TOUCH_M:
        return layout.NUT
    return layout.COLLAR if gap(y, k) >= p.x_free - TOUCH_M else layout.FREE


@inlined
def pushing(y, m, k, force, p):
    """Force of piston k [N] if it rests on the stay and pushes, or is bonded to it; else 0."""
    contact = touching(y, k, p)
    push = sense(k) * force
    pushes = (contact == layout.NUT and push < 0.0) or (contact == layout.COLLAR and push > 0.0)
    bonded = p.bond > 0.0 and contact != layout.FREE
    return force if m[STATUS + k] == 0 and (pushes or bonded) else 0.0


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
    v_s = y.v_s
    v_1 = y.v_1
    v_2 = y.v_2
    force = net_forces(y, m, p, t)
    a_s, a_1, a_2 = accelerations(m, p, force)
    vol_b, vol_n, vol_f = length_volumes(y, p)
    rate_b = p.area_p * v_1 + p.area_s * v_s
    rate_n = -p.area_p * (v_1 + v_2)
    rate_f = p.area_p * v_2 - p.area_s * v_s
    u_b = u0[0] + du[0] * t
    u_n = u0[1] + du[1] * t
    u_f = u0[2] + du[2] * t
    supply = y.p_line if m.line != 0 else p.p_supply
    past_1 = piston_leak(y.p_b, y.p_n, p.t_gas, p)
    past_2 = piston_leak(y.p_f, y.p_n, p.t_gas, p)
    leak_b = all_leaks(0.0 - past_1, t, y.x_s, y.p_b, p.t_gas, u_b, layout.Slot.FLOW_1, p)
    leak_n = all_leaks(past_1 + past_2, t, y.x_s, y.p_n, p.t_gas, u_n, layout.Slot.FLOW_2, p)
    leak_f = all_leaks(0.0 - past_2, t, y.x_s, y.p_f, p.t_gas, u_f, layout.Slot.FLOW_3, p)
    alphas = exponents(max(abs(v_s), abs(v_1), abs(v_2)), p)
    in_b = chamber(y.p_b, p.t_gas, u_b, leak_b, vol_b, rate_b, supply, alphas, p, c)
    in_n = chamber(y.p_n, p.t_gas, u_n, leak_n, vol_n, rate_n, supply, alphas, p, c)
    in_f = chamber(y.p_f, p.t_gas, u_f, leak_f, vol_f, rate_f, supply, alphas, p, c)
    dy.x_s = v_s
    dy.v_s = a_s
    dy.x_1 = v_1
    dy.v_1 = a_1
    dy.x_2 = v_2
    dy.v_2 = -a_2
    dy.p_b = in_b[0]
    dy.p_n = in_n[0]
    dy.p_f = in_f[0]
    dy.impulse = 0.0
    if m.blocked != 0:  # friction is left out: at rest its share is not determined
        push = force[0] + pushing(y, m, 0, force[1], p) + pushing(y, m, 1, force[2], p)
        dy.impulse = max(0.0, push * m.blocked)
    side = float(m.side)
    dy.p_oil = 0.0
    if m.damper == layout.COMPRESSIBLE and m.oil_rest == 0:
        dy.p_oil = oil_rate(side * y.x_s, side * v_s, y.p_oil, m, p)
    dy.p_line = 0.0
    if m.line != 0:
        drawn = u_b * in_b[1] + u_n * in_n[1] + u_f * in_f[1]
        dy.p_line = p.r_air / p.line_volume * (line_feed(y.p_line, p) - drawn)
    if quadratures:
        q = layout.quadratures_of(dy[LENGTH_STATES:])
        store_chamber(q, 0, in_b, y.p_b, p.t_gas, u_b, rate_b, p)
        store_chamber(q, 1, in_n, y.p_n, p.t_gas, u_n, rate_n, p)
        store_chamber(q, 2, in_f, y.p_f, p.t_gas, u_f, rate_f, p)
        d = m.stay
        loss = stay_sliding(y.x_s, v_s, d, p) * d * v_s if d != 0 else 0.0
        q.friction = loss + piston_loss(y, m, 0, p) + piston_loss(y, m, 1, p)
        store_loads(q, t, y.x_s, v_s, side, y.p_oil, m, p)
        q.atmosphere = 0.0


@inlined
def piston_loss(y, m, k, p):
    """Power that the friction of piston k turns to heat [W]."""
    d = m[STATUS + k]
    v = sense(k) * piston_of(y, k).v
    return piston_sliding(v, d, across(y, k), p) * d * v if d != 0 else 0.0
