"""Resets of the length stroke: impacts, and the modes that continue the motion (see `length_contacts`)."""

from __future__ import annotations

from plant.equations.length_contacts import (
    EPS_PA,
    bond,
    end_stop,
    note_corners,
    note_side,
    sign_ahead,
    stay_limits,
)
from plant.equations.length_stroke import TOUCH_M, net_forces, touching
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, COMPRESSIBLE, FREE, NUT
from plant.parts.friction import (
    piston_sliding,
    piston_static,
    stay_sliding,
    stay_static,
)

# A rebound slower than this is a stop: the end of a Zeno sequence.
REST_M_S = 1e-4
# Equal velocities of touching bodies, up to rounding.
SAME_M_S = 1e-10
# Touching bodies that part slower than this, and would meet again, stay together: the end of a
# Zeno sequence of contacts.
SLOW_M_S = 1e-5


@inlined
def meets(contact, relative, slow):
    """Return True if touching bodies change their velocities: they close, or part too slowly to count.

    relative: rate at which their gap grows [m/s]; slow: see `slow_partings`.
    """
    if contact == FREE or abs(relative) <= SAME_M_S:
        return False
    return (relative if contact == NUT else -relative) < slow


@inlined
def join_velocity(y, p, which, slow):
    """Inelastic contact of the stay and one piston; returns the kinetic energy lost [J].

    Conserves momentum.  The other piston takes part if it touches and does not part (faster than
    `slow` [m/s]).
    """
    vs = y.v_s
    w1 = y.v_1
    w2 = -y.v_2
    before = p.m_s * vs * vs + p.m_p * (w1 * w1 + w2 * w2)
    if which == 1:
        v = (p.m_s * vs + p.m_p * w1) / (p.m_s + p.m_p)
        contact = touching(y.x_2 + y.x_s, p)
        both = contact != FREE and sign_ahead(2, contact) * (w2 - v) < slow
    else:
        v = (p.m_s * vs + p.m_p * w2) / (p.m_s + p.m_p)
        contact = touching(y.x_1 - y.x_s, p)
        both = contact != FREE and sign_ahead(1, contact) * (w1 - v) < slow
    if both:
        v = (p.m_s * vs + p.m_p * (w1 + w2)) / (p.m_s + 2.0 * p.m_p)
    if both or which == 1:
        y.v_1 = v
    if both or which == 2:
        y.v_2 = -v
    y.v_s = v
    after = p.m_s * v * v + p.m_p * (y.v_1 * y.v_1 + y.v_2 * y.v_2)
    return 0.5 * (before - after)


@inlined
def rebound(v, p):
    """Velocity after a stop: -e v, or 0 when slower than a rebound that counts."""
    after = -p.restitution * v
    return after if abs(after) > REST_M_S else 0.0


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
def lone_piston(v, drive, pressure, stop_plus, stop_minus, p):
    """Acceleration of a piston that touches nothing but its outer stop [m/s^2], as x_s counts."""
    return group_acceleration(
        v,
        drive,
        piston_static(1.0, pressure, p),
        piston_static(-1.0, pressure, p),
        piston_sliding(v, 1.0, pressure, p),
        piston_sliding(v, -1.0, pressure, p),
        p.m_p,
        stop_plus,
        stop_minus,
    )


@called
def slow_partings(t, y, m, p):
    """Speeds below which pistons 1 and 2 do not count as parting from the stay [m/s].

    SLOW_M_S where the accelerations, each body alone, would close the contact again; else 0.
    """
    m.stay = 0
    m.piston_1 = 0
    m.piston_2 = 0
    force = net_forces(y, m, p, t)
    high, low = stay_limits(y, m, p)
    a = group_acceleration(
        y.v_s,
        force[0],
        stay_static(y.x_s, 1.0, p),
        stay_static(y.x_s, -1.0, p),
        stay_sliding(y.x_s, y.v_s, 1.0, p),
        stay_sliding(y.x_s, y.v_s, -1.0, p),
        p.m_s,
        y.x_s >= high - TOUCH_M,
        y.x_s <= low + TOUCH_M,
    )
    a1 = lone_piston(y.v_1, force[1], y.p_b - y.p_n, False, y.x_1 <= TOUCH_M, p)
    a2 = lone_piston(-y.v_2, force[2], y.p_f - y.p_n, y.x_2 <= TOUCH_M, False, p)
    c1 = touching(y.x_1 - y.x_s, p)
    c2 = touching(y.x_2 + y.x_s, p)
    slow1 = SLOW_M_S if c1 != FREE and sign_ahead(1, c1) * (a1 - a) < 0.0 else 0.0
    slow2 = SLOW_M_S if c2 != FREE and sign_ahead(2, c2) * (a2 - a) < 0.0 else 0.0
    return slow1, slow2


@called
def impacts(t, y, m, p, impact):
    """Resolve all closing contacts and stops at this instant -> impact.

    Leaves the bodies' modes of motion to `settle`.
    """
    slow1, slow2 = slow_partings(t, y, m, p)
    impact.lost = 0.0
    impact.speed = 0.0
    impact.at_block = 0.0
    for _ in range(12):
        again = stop_pistons(y, p, impact)
        again = stop_stay(y, m, p, impact) or again
        again = meet_pistons(y, m, p, slow1, slow2, impact) or again
        if not again:
            break


@inlined
def stop_pistons(y, p, impact):
    """Stop pistons on their outer stops; True if one has met its stop."""
    hit = False
    if y.x_1 <= TOUCH_M and y.v_1 < 0.0:
        y.x_1 = 0.0
        after = rebound(y.v_1, p)
        impact.lost += 0.5 * p.m_p * (y.v_1 * y.v_1 - after * after)
        y.v_1 = after
        hit = True
    if y.x_2 <= TOUCH_M and y.v_2 < 0.0:
        y.x_2 = 0.0
        after = rebound(y.v_2, p)
        impact.lost += 0.5 * p.m_p * (y.v_2 * y.v_2 - after * after)
        y.v_2 = after
        hit = True
    return hit


@inlined
def stop_stay(y, m, p, impact):
    """Stop the stay at an end, at the synchronizer or in neutral; True if it has met one of them."""
    high, low = stay_limits(y, m, p)
    held = 0.0
    if y.x_s >= high - TOUCH_M and y.v_s > 0.0:
        held = 1.0
        y.x_s = high
    elif y.x_s <= low + TOUCH_M and y.v_s < 0.0:
        held = -1.0
        y.x_s = low
    # neutral: a piston at rest on its outer stop is as fixed as the housing
    elif y.v_s < 0.0 and y.x_2 + y.x_s <= TOUCH_M and y.x_2 <= TOUCH_M and y.v_2 <= 0.0:
        held = -2.0
        y.x_s = 0.0
        y.x_2 = 0.0
    elif y.v_s > 0.0 and y.x_1 - y.x_s <= TOUCH_M and y.x_1 <= TOUCH_M and y.v_1 <= 0.0:
        held = 2.0
        y.x_s = 0.0
        y.x_1 = 0.0
    if held == 0.0:
        return False
    at_block = abs(held) == 1.0 and abs(y.x_s) < end_stop(p) - TOUCH_M
    after = 0.0 if at_block else rebound(y.v_s, p)
    impact.lost += 0.5 * p.m_s * (y.v_s * y.v_s - after * after)
    if abs(y.v_s) > impact.speed:
        impact.speed = abs(y.v_s)
        impact.at_block = 1.0 if at_block else 0.0
    y.v_s = after
    return True


@inlined
def meet_pistons(y, m, p, slow1, slow2, impact):
    """Resolve closing contacts of stay and pistons; True if there was one."""
    high, low = stay_limits(y, m, p)
    met = False
    relative = y.v_1 - y.v_s
    if meets(touching(y.x_1 - y.x_s, p), relative, slow1):
        stopped = (
            (y.x_s >= high - TOUCH_M and relative > 0.0)
            or (y.x_s <= low + TOUCH_M and relative < 0.0)
            or (relative < 0.0 and y.x_2 + y.x_s <= TOUCH_M and y.x_2 <= TOUCH_M)
            or abs(relative) < slow1
        ) and y.v_s == 0.0
        if stopped:
            impact.lost += 0.5 * p.m_p * y.v_1 * y.v_1
            y.v_1 = 0.0
        else:
            impact.lost += join_velocity(y, p, 1, slow2)
        met = True
    relative = y.v_s + y.v_2
    if meets(touching(y.x_2 + y.x_s, p), relative, slow2):
        stopped = (
            (y.x_s <= low + TOUCH_M and relative > 0.0)
            or (y.x_s >= high - TOUCH_M and relative < 0.0)
            or (relative < 0.0 and y.x_1 - y.x_s <= TOUCH_M and y.x_1 <= TOUCH_M)
            or abs(relative) < slow2
        ) and y.v_s == 0.0
        if stopped:
            impact.lost += 0.5 * p.m_p * y.v_2 * y.v_2
            y.v_2 = 0.0
        else:
            impact.lost += join_velocity(y, p, 2, slow1)
        met = True
    return met


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
def settle_damper(y, m, p):
    """Choose the side on which the damper acts, and whether its oil rests.

    At neutral: the side to which the stay goes; one that stays there keeps its side.  The oil of the
    side it comes to stands at the atmosphere.
    """
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
        m.oil_rest = 0
        if y.p_oil <= p.p_atm + EPS_PA:
            y.p_oil = p.p_atm
            m.oil_rest = 0 if m.stay * m.side > 0 else 1


@inlined
def joined_acceleration(y, p, force, c1, c2, high, low):
    """Acceleration of the stay with the pistons joined to it [m/s^2].

    c1, c2: contacts of pistons 1 and 2; high, low: limits of the stay.
    """
    pressure1 = y.p_b - y.p_n
    pressure2 = y.p_f - y.p_n
    drive = force[0]
    mass = p.m_s
    cap_plus = stay_static(y.x_s, 1.0, p)
    cap_minus = stay_static(y.x_s, -1.0, p)
    stop_plus = y.x_s >= high - TOUCH_M
    stop_minus = y.x_s <= low + TOUCH_M
    run_plus = stay_sliding(y.x_s, y.v_s, 1.0, p)
    run_minus = stay_sliding(y.x_s, y.v_s, -1.0, p)
    if c1 != FREE:
        drive += force[1]
        mass += p.m_p
        cap_plus += piston_static(1.0, pressure1, p)
        cap_minus += piston_static(-1.0, pressure1, p)
        run_plus += piston_sliding(y.v_s, 1.0, pressure1, p)
        run_minus += piston_sliding(y.v_s, -1.0, pressure1, p)
        stop_minus = stop_minus or y.x_1 <= TOUCH_M
    if c2 != FREE:
        drive += force[2]
        mass += p.m_p
        cap_plus += piston_static(1.0, pressure2, p)
        cap_minus += piston_static(-1.0, pressure2, p)
        run_plus += piston_sliding(y.v_s, 1.0, pressure2, p)
        run_minus += piston_sliding(y.v_s, -1.0, pressure2, p)
        stop_plus = stop_plus or y.x_2 <= TOUCH_M
    return group_acceleration(
        y.v_s, drive, cap_plus, cap_minus, run_plus, run_minus, mass, stop_plus, stop_minus
    )


@inlined
def join(y, m, p, force):
    """Contacts that close, and accelerations: contact of piston 1 and 2, then of stay, piston 1, 2.

    Bodies start apart; touching bodies whose accelerations (or pushes at rest) would close the
    contact are joined, until none closes.
    """
    high, low = stay_limits(y, m, p)
    same1 = abs(y.v_1 - y.v_s) <= SAME_M_S
    same2 = abs(y.v_2 + y.v_s) <= SAME_M_S
    touch1 = touching(y.x_1 - y.x_s, p) if same1 else FREE
    touch2 = touching(y.x_2 + y.x_s, p) if same2 else FREE
    c1 = FREE
    c2 = FREE
    a = 0.0
    a1 = 0.0
    a2 = 0.0
    for _ in range(3):
        a = joined_acceleration(y, p, force, c1, c2, high, low)
        a1 = lone_piston(y.v_1, force[1], y.p_b - y.p_n, False, y.x_1 <= TOUCH_M, p)
        if c1 != FREE:
            a1 = a
        a2 = lone_piston(-y.v_2, force[2], y.p_f - y.p_n, y.x_2 <= TOUCH_M, False, p)
        if c2 != FREE:
            a2 = a
        if (
            c1 == FREE
            and touch1 != FREE
            and p.m_p * sign_ahead(1, touch1) * (a1 - a) < bond(touch1, y, p)
        ):
            c1 = touch1
        elif (
            c2 == FREE
            and touch2 != FREE
            and p.m_p * sign_ahead(2, touch2) * (a2 - a) < bond(touch2, y, p)
        ):
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
        alone1 = (force[1] - d * piston_sliding(y.v_s, d, y.p_b - y.p_n, p)) / p.m_p
        alone2 = (force[2] - d * piston_sliding(y.v_s, d, y.p_f - y.p_n, p)) / p.m_p
        if c1 != FREE and p.m_p * sign_ahead(1, c1) * (alone1 - a) > bond(c1, y, p):
            a1 = alone1
            c1 = FREE
        elif c2 != FREE and p.m_p * sign_ahead(2, c2) * (alone2 - a) > bond(c2, y, p):
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


@called
def settle(t, y, m, p):
    """Choose the modes that continue the motion from here: who is joined, who rests, who moves.

    The one-dimensional contact problem, solved as pool-adjacent-violators does (`join`, `part`).
    Friction at rest is set-valued; touching bodies that break away together are all sliding from
    there on.
    """
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
    place_pistons(y, p, c1, c2)
    if m.stay == 0 and y.impulse < p.sync_impulse:
        if abs(y.x_s - p.x_block) <= TOUCH_M:
            m.blocked = 1
        elif abs(y.x_s + p.x_block) <= TOUCH_M:
            m.blocked = -1
    if m.damper != 0:
        settle_damper(y, m, p)


@inlined
def place_pistons(y, p, c1, c2):
    """Give joined pistons the place and the velocity of the stay, and none a place inside it."""
    if c1 != FREE:
        y.x_1 = y.x_s + (p.x_free if c1 == COLLAR else 0.0)
        y.v_1 = y.v_s
    if c2 != FREE:
        y.x_2 = (p.x_free if c2 == COLLAR else 0.0) - y.x_s
        y.v_2 = -y.v_s
    # the stay was put on its stop: a piston that is just leaving it must not stand inside it
    y.x_1 = min(max(y.x_1, y.x_s), y.x_s + p.x_free)
    y.x_2 = min(max(y.x_2, -y.x_s), p.x_free - y.x_s)
