"""Modes that continue the length stroke's motion: who is joined, who rests, who moves.

The one-dimensional contact problem of three bodies by pool-adjacent-violators (`join`, `part`), friction set-valued.
"""

from __future__ import annotations

from plant.equations.length_contacts import (
    EPS_PA,
    bond,
    note_corners,
    note_side,
    piston_holds,
    sign_ahead,
    stay_limits,
)
from plant.equations.length_stroke import (
    TOUCH_M,
    across,
    net_forces,
    opening,
    piston_of,
    sense,
    touching,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, COMPRESSIBLE, FREE
from plant.parts.friction import piston_sliding, piston_static, stay_sliding, stay_static

# Equal velocities of touching bodies, up to rounding.
SAME_M_S = 1e-10


@inlined
def direction_of(v, a):
    """+1, -1 or 0: the way a body moves, or starts to move."""
    if v > 0.0:
        return 1
    if v < 0.0:
        return -1
    if a > 0.0:
        return 1
    if a < 0.0:
        return -1
    return 0


@inlined
def group_acceleration(
    v, drive, cap_plus, cap_minus, run_plus, run_minus, mass, stop_plus, stop_minus
):
    """Acceleration of one group of joined bodies: set-valued friction at rest, stops one-sided."""
    if v > 0.0:
        return (drive - run_plus) / mass
    if v < 0.0:
        return (drive + run_minus) / mass
    if drive > cap_plus and not stop_plus:
        return (drive - run_plus) / mass
    if drive < -cap_minus and not stop_minus:
        return (drive + run_minus) / mass
    return 0.0


@inlined
def lone_piston(y, k, force, p):
    """Acceleration of piston k if it touches nothing but its outer stop [m/s^2], as x_s counts."""
    v = sense(k) * piston_of(y, k).v
    pressure = across(y, k)
    return group_acceleration(
        v,
        force,
        piston_static(1.0, pressure, p),
        piston_static(-1.0, pressure, p),
        piston_sliding(v, 1.0, pressure, p),
        piston_sliding(v, -1.0, pressure, p),
        p.m_p,
        piston_holds(1.0, k, y),
        piston_holds(-1.0, k, y),
    )


@inlined
def joined_acceleration(y, m, p, force, c1, c2):
    """Acceleration of the stay with the pistons joined to it [m/s^2], by their contacts c1 and c2."""
    high, low = stay_limits(y, m, p)
    drive = force[0]
    mass = p.m_s
    cap_plus = stay_static(y.x_s, 1.0, p)
    cap_minus = stay_static(y.x_s, -1.0, p)
    stop_plus = y.x_s >= high - TOUCH_M
    stop_minus = y.x_s <= low + TOUCH_M
    run_plus = stay_sliding(y.x_s, y.v_s, 1.0, p)
    run_minus = stay_sliding(y.x_s, y.v_s, -1.0, p)
    for k in range(2):
        if (c1 if k == 0 else c2) != FREE:
            pressure = across(y, k)
            drive += force[1] if k == 0 else force[2]
            mass += p.m_p
            cap_plus += piston_static(1.0, pressure, p)
            cap_minus += piston_static(-1.0, pressure, p)
            run_plus += piston_sliding(y.v_s, 1.0, pressure, p)
            run_minus += piston_sliding(y.v_s, -1.0, pressure, p)
            stop_plus = stop_plus or piston_holds(1.0, k, y)
            stop_minus = stop_minus or piston_holds(-1.0, k, y)
    return group_acceleration(
        y.v_s, drive, cap_plus, cap_minus, run_plus, run_minus, mass, stop_plus, stop_minus
    )


@inlined
def closing(y, k, p, joined, touch, relative):
    """Return True if piston k touches the stay and would close the contact; relative: accelerations."""
    push = p.m_p * sign_ahead(k, touch) * relative
    return joined == FREE and touch != FREE and push < bond(touch, y, p)


@inlined
def join(y, m, p, force):
    """Contacts of pistons 1 and 2 that close, and the accelerations of stay, piston 1 and 2.

    From apart: touching bodies whose accelerations (or pushes at rest) would close the contact are joined, until none does.
    """
    touch1 = touching(y, 0, p) if abs(opening(y, 0)) <= SAME_M_S else FREE
    touch2 = touching(y, 1, p) if abs(opening(y, 1)) <= SAME_M_S else FREE
    c1 = FREE
    c2 = FREE
    a = 0.0
    a1 = 0.0
    a2 = 0.0
    for _ in range(3):
        a = joined_acceleration(y, m, p, force, c1, c2)
        a1 = a if c1 != FREE else lone_piston(y, 0, force[1], p)
        a2 = a if c2 != FREE else lone_piston(y, 1, force[2], p)
        if closing(y, 0, p, c1, touch1, a1 - a):
            c1 = touch1
        elif closing(y, 1, p, c2, touch2, a2 - a):
            c2 = touch2
        else:
            break
    return c1, c2, a, a1, a2


@inlined
def part(y, p, force, joined):
    """Part the contacts of `join` that would have to pull (harder than their `bond`): a piston faster than the group leaves it."""
    c1, c2, a, a1, a2 = joined
    d = direction_of(y.v_s, a)
    for _ in range(2):
        if d == 0 or (c1 == FREE and c2 == FREE):
            break
        alone1 = (force[1] - d * piston_sliding(y.v_s, d, across(y, 0), p)) / p.m_p
        alone2 = (force[2] - d * piston_sliding(y.v_s, d, across(y, 1), p)) / p.m_p
        if c1 != FREE and p.m_p * sign_ahead(0, c1) * (alone1 - a) > bond(c1, y, p):
            a1 = alone1
            c1 = FREE
        elif c2 != FREE and p.m_p * sign_ahead(1, c2) * (alone2 - a) > bond(c2, y, p):
            a2 = alone2
            c2 = FREE
        else:
            break
        mass = p.m_s
        a = force[0] - d * stay_sliding(y.x_s, y.v_s, d, p)
        if c1 != FREE:
            mass += p.m_p
            a += p.m_p * alone1
        if c2 != FREE:
            mass += p.m_p
            a += p.m_p * alone2
        a /= mass
        if y.v_s == 0.0 and d * a < 0.0:
            a = 0.0
    return c1, c2, a, a1, a2


@inlined
def seat_piston(y, p, k, contact):
    """Give a joined piston the velocity of the stay and its position on it; none overlaps the stay."""
    piston = piston_of(y, k)
    nut = sense(k) * y.x_s
    if contact != FREE:
        piston.x = nut + (p.x_free if contact == COLLAR else 0.0)
        piston.v = sense(k) * y.v_s
    # the stay was put on its stop: a piston that is just leaving it must not overlap it
    piston.x = min(max(piston.x, nut), nut + p.x_free)


@inlined
def settle_oil(y, outward, m, p):
    """Choose whether the damper's oil rests; outward: 1 if the stay goes to it, 0 or -1 if not."""
    m.oil_rest = 0
    if y.p_oil <= p.p_atm + EPS_PA:
        y.p_oil = p.p_atm
        m.oil_rest = 0 if outward > 0 else 1


@inlined
def settle_damper(y, m, p):
    """Choose the damper's side, at neutral the one to which the stay goes, and whether its oil rests."""
    before = m.side
    if abs(y.x_s) > TOUCH_M:
        m.side = 1 if y.x_s > 0.0 else -1
    elif m.stay != 0:
        m.side = m.stay
    elif before == 0:
        m.side = 1
    side = float(m.side)
    note_corners(side * y.x_s, side * y.v_s, m, p)
    if m.damper == COMPRESSIBLE:
        if before != 0 and m.side != before:
            y.p_oil = p.p_atm
        settle_oil(y, m.stay * m.side, m, p)


@called
def settle(t, y, m, p):
    """Choose the modes that continue the motion; touching bodies that break away together all slide."""
    note_side(y, m, p)
    if m.damper != 0:
        side = float(m.side)
        note_corners(side * y.x_s, side * y.v_s, m, p)
    m.blocked = 0
    m.stay = 0
    m.piston_1 = 0
    m.piston_2 = 0
    force = net_forces(y, m, p, t)
    c1, c2, a, a1, a2 = part(y, p, force, join(y, m, p, force))
    m.joined_1 = c1
    m.joined_2 = c2
    m.stay = direction_of(y.v_s, a)
    m.piston_1 = m.stay if c1 != FREE else direction_of(y.v_1, a1)
    m.piston_2 = m.stay if c2 != FREE else direction_of(-y.v_2, a2)
    seat_piston(y, p, 0, c1)
    seat_piston(y, p, 1, c2)
    if m.stay == 0 and y.impulse < p.sync_impulse:
        if abs(y.x_s - p.x_block) <= TOUCH_M:
            m.blocked = 1
        elif abs(y.x_s + p.x_block) <= TOUCH_M:
            m.blocked = -1
    if m.damper != 0:
        settle_damper(y, m, p)
