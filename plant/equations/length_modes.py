"""Modes that continue the length stroke's motion: who is joined, who rests, who moves.

The one-dimensional contact problem of three bodies by pool-adjacent-violators (`join`, `part`), friction set-valued.
"""

from __future__ import annotations

from plant.equations import length_contacts as contacts
from plant.equations.length_stroke import (
    TOUCH_M,
    across,
    gap,
    net_forces,
    opening,
    piston_of,
    sense,
    touching,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, COMPRESSIBLE, FREE, NUT
from plant.parts.forces import piston_sliding, piston_static, stay_sliding, stay_static

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
        contacts.piston_holds(1.0, k, y),
        contacts.piston_holds(-1.0, k, y),
    )


@inlined
def joined_acceleration(y, m, p, force, c1, c2):
    """Acceleration of the stay with the pistons joined to it [m/s^2], by their contacts c1 and c2."""
    high, low = contacts.stay_limits(y, m, p)
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
            stop_plus = stop_plus or contacts.piston_holds(1.0, k, y)
            stop_minus = stop_minus or contacts.piston_holds(-1.0, k, y)
    return group_acceleration(
        y.v_s, drive, cap_plus, cap_minus, run_plus, run_minus, mass, stop_plus, stop_minus
    )


@inlined
def closing(y, k, p, joined, touch, relative):
    """Return True if piston k touches the stay and would close the contact; relative: accelerations."""
    push = p.m_p * contacts.sign_ahead(k, touch) * relative
    return joined == FREE and touch != FREE and push < contacts.bond(touch, y, p)


@inlined
def join(y, m, p, force):
    """Contacts of pistons 1 and 2 that close, and the accelerations of stay, piston 1 and 2.

    From apart: touching bodies whose accelerations (or pushes at rest) would close the contact are joined, until none
    does.
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
        if c1 != FREE and p.m_p * contacts.sign_ahead(0, c1) * (alone1 - a) > contacts.bond(
            c1, y, p
        ):
            a1 = alone1
            c1 = FREE
        elif c2 != FREE and p.m_p * contacts.sign_ahead(1, c2) * (alone2 - a) > contacts.bond(
            c2, y, p
        ):
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
    if y.p_oil <= p.p_atm + contacts.EPS_PA:
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
    contacts.note_corners(side * y.x_s, side * y.v_s, m, p)
    if m.damper == COMPRESSIBLE:
        if before != 0 and m.side != before:
            y.p_oil = p.p_atm
        settle_oil(y, m.stay * m.side, m, p)


@called
def settle(t, y, m, p):
    """Choose the modes that continue the motion; touching bodies that break away together all slide."""
    contacts.note_side(y, m, p)
    if m.damper != 0:
        side = float(m.side)
        contacts.note_corners(side * y.x_s, side * y.v_s, m, p)
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


@inlined
def meets(contact, relative, slow):
    """Return True if touching bodies close, or part more slowly than `slow`; relative: rate at which they part [m/s]."""
    if contact == FREE or abs(relative) <= SAME_M_S:
        return False
    return (relative if contact == NUT else -relative) < slow


@inlined
def join_velocity(y, p, k, slow):
    """Join stay and piston k, inelastically; returns the kinetic energy lost [J].

    The other piston takes part if it touches and does not part (faster than `slow` [m/s]).
    """
    vs = y.v_s
    one = sense(k) * piston_of(y, k).v
    other = sense(1 - k) * piston_of(y, 1 - k).v
    before = p.m_s * vs * vs + p.m_p * (one * one + other * other)
    v = (p.m_s * vs + p.m_p * one) / (p.m_s + p.m_p)
    contact = touching(y, 1 - k, p)
    if contact != FREE and contacts.sign_ahead(1 - k, contact) * (other - v) < slow:
        v = (p.m_s * vs + p.m_p * (one + other)) / (p.m_s + 2.0 * p.m_p)
        piston_of(y, 1 - k).v = sense(1 - k) * v
    piston_of(y, k).v = sense(k) * v
    y.v_s = v
    after = p.m_s * v * v + p.m_p * (y.v_1 * y.v_1 + y.v_2 * y.v_2)
    return 0.5 * (before - after)


@inlined
def rebound(v, p):
    """Velocity after a stop: -e v, or 0 when slower than a rebound that counts."""
    after = -p.restitution * v
    # a slower rebound is a stop: the end of a Zeno sequence
    return after if abs(after) > 1e-4 else 0.0


@inlined
def slow_parting(y, k, relative, p):
    """Speed below which piston k does not count as parting, by its acceleration relative to the stay.

    Touching bodies that part slower, and would meet again, stay together: the end of a Zeno sequence of contacts.
    """
    contact = touching(y, k, p)
    return 1e-5 if contact != FREE and contacts.sign_ahead(k, contact) * relative < 0.0 else 0.0


@called
def slow_partings(t, y, m, p):
    """Speeds below which pistons 1, 2 do not count as parting [m/s]: not 0 where the contact would close again."""
    m.stay = 0
    m.piston_1 = 0
    m.piston_2 = 0
    force = net_forces(y, m, p, t)
    a = joined_acceleration(y, m, p, force, FREE, FREE)
    slow1 = slow_parting(y, 0, lone_piston(y, 0, force[1], p) - a, p)
    return slow1, slow_parting(y, 1, lone_piston(y, 1, force[2], p) - a, p)


@called
def impacts(t, y, m, p, impact):
    """Resolve all closing contacts and stops at this instant -> impact; `settle` chooses the modes of motion."""
    slow1, slow2 = slow_partings(t, y, m, p)
    impact.lost = 0.0
    impact.speed = 0.0
    impact.at_block = 0.0
    for _ in range(12):
        again = stop_piston(y, 0, p, impact)
        again = stop_piston(y, 1, p, impact) or again
        again = stop_stay(y, m, p, impact) or again
        again = meet_piston(y, m, p, 0, slow1, slow2, impact) or again
        again = meet_piston(y, m, p, 1, slow2, slow1, impact) or again
        if not again:
            break


@inlined
def stop_piston(y, k, p, impact):
    """Stop piston k on its outer stop; True if it has met it."""
    piston = piston_of(y, k)
    hit = piston.x <= TOUCH_M and piston.v < 0.0
    if hit:
        piston.x = 0.0
        after = rebound(piston.v, p)
        impact.lost += 0.5 * p.m_p * (piston.v * piston.v - after * after)
        piston.v = after
    return hit


@inlined
def stop_stay(y, m, p, impact):
    """Stop the stay at an end, at the synchronizer or in neutral; True if it has met one of them."""
    high, low = contacts.stay_limits(y, m, p)
    obstacle = 0.0
    if y.x_s >= high - TOUCH_M and y.v_s > 0.0:
        obstacle = 1.0
        y.x_s = high
    elif y.x_s <= low + TOUCH_M and y.v_s < 0.0:
        obstacle = -1.0
        y.x_s = low
    # neutral: a piston at rest on its outer stop is as fixed as the housing
    elif y.v_s < 0.0 and gap(y, 1) <= TOUCH_M and y.x_2 <= TOUCH_M and y.v_2 <= 0.0:
        obstacle = -2.0
        y.x_s = 0.0
        y.x_2 = 0.0
    elif y.v_s > 0.0 and gap(y, 0) <= TOUCH_M and y.x_1 <= TOUCH_M and y.v_1 <= 0.0:
        obstacle = 2.0
        y.x_s = 0.0
        y.x_1 = 0.0
    if obstacle == 0.0:
        return False
    at_block = abs(obstacle) == 1.0 and abs(y.x_s) < contacts.end_stop(p) - TOUCH_M
    after = 0.0 if at_block else rebound(y.v_s, p)
    impact.lost += 0.5 * p.m_s * (y.v_s * y.v_s - after * after)
    if abs(y.v_s) > impact.speed:
        impact.speed = abs(y.v_s)
        impact.at_block = 1.0 if at_block else 0.0
    y.v_s = after
    return True


@inlined
def meet_piston(y, m, p, k, slow, slow_other, impact):
    """Resolve a closing contact of stay and piston k; True if it closes."""
    high, low = contacts.stay_limits(y, m, p)
    relative = opening(y, k)
    closes = meets(touching(y, k, p), relative, slow)
    if closes:
        push = sense(k) * relative
        stopped = (
            (y.x_s >= high - TOUCH_M and push > 0.0)
            or (y.x_s <= low + TOUCH_M and push < 0.0)
            or (relative < 0.0 and gap(y, 1 - k) <= TOUCH_M and contacts.at_outer_stop(y, 1 - k))
            or abs(relative) < slow
        ) and y.v_s == 0.0
        if stopped:
            piston = piston_of(y, k)
            impact.lost += 0.5 * p.m_p * piston.v * piston.v
            piston.v = 0.0
        else:
            impact.lost += join_velocity(y, p, k, slow_other)
    return closes
