"""Impacts of the length stroke: stops and closing contacts at one instant; momentum is conserved but by stops."""

from __future__ import annotations

from plant.equations.length_contacts import at_outer_stop, end_stop, sign_ahead, stay_limits
from plant.equations.length_modes import SAME_M_S, joined_acceleration, lone_piston
from plant.equations.length_stroke import (
    TOUCH_M,
    gap,
    net_forces,
    opening,
    piston_of,
    sense,
    touching,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FREE, NUT

# Touching bodies that part slower than this, and would meet again, stay together: the end of a
# Zeno sequence of contacts.
SLOW_M_S = 1e-5


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
    if contact != FREE and sign_ahead(1 - k, contact) * (other - v) < slow:
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
    """Speed below which piston k does not count as parting, by its acceleration relative to the stay."""
    contact = touching(y, k, p)
    return SLOW_M_S if contact != FREE and sign_ahead(k, contact) * relative < 0.0 else 0.0


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
    high, low = stay_limits(y, m, p)
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
    at_block = abs(obstacle) == 1.0 and abs(y.x_s) < end_stop(p) - TOUCH_M
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
    high, low = stay_limits(y, m, p)
    relative = opening(y, k)
    closes = meets(touching(y, k, p), relative, slow)
    if closes:
        push = sense(k) * relative
        stopped = (
            (y.x_s >= high - TOUCH_M and push > 0.0)
            or (y.x_s <= low + TOUCH_M and push < 0.0)
            or (relative < 0.0 and gap(y, 1 - k) <= TOUCH_M and at_outer_stop(y, 1 - k))
            or abs(relative) < slow
        ) and y.v_s == 0.0
        if stopped:
            piston = piston_of(y, k)
            impact.lost += 0.5 * p.m_p * piston.v * piston.v
            piston.v = 0.0
        else:
            impact.lost += join_velocity(y, p, k, slow_other)
    return closes
