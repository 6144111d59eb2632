"""Guards of the length stroke: stops, contacts, sticking, the synchronizer's block, the damper's corners.

Three bodies on one line.  A contact has a body behind and one ahead: moving in + the body behind
pushes the one ahead.  Collar 1: piston 1 behind, stay ahead; nut 1: stay behind, piston 1 ahead;
nut 2: piston 2 behind, stay ahead; collar 2: stay behind, piston 2 ahead.
"""

from __future__ import annotations

from plant.equations.length_stroke import (
    JOINED,
    STATUS,
    TOUCH_M,
    accelerations,
    across,
    gap,
    net_forces,
    piston_of,
    sense,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, COMPRESSIBLE, FREE, GUARDS, NUT, Guard
from plant.parts.damper import damper_borders
from plant.parts.forces import piston_static, stay_static

EPS_M = 1e-13
EPS_M_S = 1e-11
EPS_N = 1e-7
EPS_PA = 1e-7
UNREACHED = 1.0e30


@inlined
def end_stop(p):
    """Farthest stay position [m]: its stay_cap stop, or the collar of the piston that cannot give way."""
    return min(p.stroke + p.stop_offset, p.x_free)


@inlined
def stay_limits(y, m, p):
    """Highest and lowest stay position now: the end stops, or the synchronizer while unspent."""
    high = end_stop(p)
    if m.blocked != 0 or (m.inside != 0 and y.impulse < p.sync_impulse):
        high = p.x_block
    return high, -high


@inlined
def note_side(y, m, p):
    """Remember on which side of the blocking position the stay is (a step must not jump it)."""
    m.inside = 1 if abs(y.x_s) <= p.x_block + TOUCH_M else 0


@inlined
def sign_ahead(k, contact):
    """+1 if piston k is the body ahead in its contact with the stay, -1 if behind."""
    return 1 if (contact == NUT) == (k == 0) else -1


@inlined
def at_outer_stop(y, k):
    """Return True if piston k is on its outer stop."""
    return piston_of(y, k).x <= TOUCH_M


@inlined
def piston_holds(direction, k, y):
    """Return True if piston k cannot move in `direction` (of x_s): it is on its outer stop."""
    return sense(k) * direction < 0.0 and at_outer_stop(y, k)


@inlined
def bond(contact, y, p):
    """Pull that this contact bears here [N]; none where the piston must part: of a nut in neutral, of a collar at an end."""
    away = abs(y.x_s)
    parts = (contact == NUT and away <= TOUCH_M) or (
        contact == COLLAR and away >= end_stop(p) - TOUCH_M
    )
    return 0.0 if parts or contact == FREE else p.bond


@inlined
def in_the_way(d, k, y, m, p):
    """Return True if piston k rests where the stay touches it on its way in direction d (1, -1)."""
    touches = gap(y, k) <= TOUCH_M if sense(k) * d > 0.0 else gap(y, k) >= p.x_free - TOUCH_M
    return touches and m[STATUS + k] == 0


@inlined
def leaving_margin(d, k, y, m, p, force, caps):
    """Margin before the stay leaves its contact with piston k [N]; caps: static friction of stay and pistons that way."""
    contact = m[JOINED + k]
    if contact == FREE or d != -sign_ahead(k, contact):
        return UNREACHED
    away = d * force[0]
    cap = caps[0]
    if m[JOINED + 1 - k] != FREE:
        if piston_holds(d, 1 - k, y):
            return UNREACHED
        away += d * (force[2] if k == 0 else force[1])
        cap += caps[2] if k == 0 else caps[1]
    return cap - away + bond(contact, y, p)


@inlined
def stay_margin(d, y, m, p, force, static1, static2):
    """Margin before the stay at rest moves in direction d with what it takes along [N]; static1, static2: of pistons."""
    high, low = stay_limits(y, m, p)
    stay_cap = stay_static(y.x_s, d, p)
    if (d > 0 and y.x_s >= high - TOUCH_M) or (d < 0 and y.x_s <= low + TOUCH_M):
        return UNREACHED
    # the stay with everything joined to it, or only touching it at rest and in the way
    blocked = False
    total = d * force[0]
    cap = stay_cap
    if m.joined_1 != FREE or in_the_way(d, 0, y, m, p):
        blocked = piston_holds(d, 0, y)
        total += d * force[1]
        cap += static1
    if m.joined_2 != FREE or (not blocked and in_the_way(d, 1, y, m, p)):
        blocked = blocked or piston_holds(d, 1, y)
        total += d * force[2]
        cap += static2
    hold = UNREACHED if blocked else cap - total
    caps = (stay_cap, static1, static2)
    one = leaving_margin(d, 0, y, m, p, force, caps)
    return min(hold, one, leaving_margin(d, 1, y, m, p, force, caps))


@inlined
def piston_margin(d, k, contact, y, static, force):
    """Margin before piston k, at rest, moves in direction d (1, -1) [N]."""
    if (contact != FREE and d != sign_ahead(k, contact)) or piston_holds(d, k, y):
        return UNREACHED
    return static - d * force


@inlined
def rest_margins(y, m, p, force):
    """Margins before stay, piston 1, piston 2 leave their rest [N]: friction less driving force."""
    plus1 = piston_static(1.0, across(y, 0), p)
    minus1 = piston_static(-1.0, across(y, 0), p)
    plus2 = piston_static(1.0, across(y, 1), p)
    minus2 = piston_static(-1.0, across(y, 1), p)
    hold = UNREACHED
    if m.stay == 0:
        hold = min(
            stay_margin(1, y, m, p, force, plus1, plus2),
            stay_margin(-1, y, m, p, force, minus1, minus2),
        )
    one = piston_rest(y, m, p, 0, plus1, minus1, force[1])
    return hold + EPS_N, one + EPS_N, piston_rest(y, m, p, 1, plus2, minus2, force[2]) + EPS_N


@inlined
def piston_rest(y, m, p, k, plus, minus, force):
    """Margin before piston k leaves its rest [N]; plus, minus: its static friction both ways."""
    if m[STATUS + k] != 0:
        return UNREACHED
    contact = m[JOINED + k]
    pull = bond(contact, y, p)
    return min(
        piston_margin(1, k, contact, y, plus + pull, force),
        piston_margin(-1, k, contact, y, minus + pull, force),
    )


@inlined
def put(g, k, value, low):
    """Write guard k; returns the lowest so far."""
    g[k] = value
    return min(low, value)


@inlined
def damper_guards(distance, speed, oil_pa, m, p, g, low):
    """Guards of the corners of the damper's law, and of its oil; returns the lowest guard so far."""
    if m.stay != 0:
        capped, opened, lifted = damper_borders(distance, speed, p)
        low = put(g, Guard.CAPPED, (capped if m.capped != 0 else -capped) + 1e-18, low)
        low = put(g, Guard.OPENED, (opened if m.opened != 0 else -opened) + EPS_M, low)
        low = put(g, Guard.LIFTED, (lifted if m.lifted != 0 else -lifted) + 1e-12, low)
    if m.damper == COMPRESSIBLE:
        if m.oil_rest == 0:
            low = put(g, Guard.OIL_EMPTY, oil_pa - p.p_atm + EPS_PA, low)
        elif m.stay != 0:
            low = put(g, Guard.OIL_FILL, EPS_M_S - speed, low)
    return low


@inlined
def note_corners(distance, speed, m, p):
    """Remember on which sides of the damper's corners the stay is."""
    capped, opened, lifted = damper_borders(distance, speed, p)
    m.capped = 1 if capped > 0.0 else 0
    m.opened = 1 if opened > 0.0 else 0
    m.lifted = 1 if lifted > 0.0 else 0


@inlined
def guard_piston(y, m, p, k, g, low):
    """Guards of piston k: turning, its outer stop, the contact it is nearer to; returns the lowest."""
    d = m[STATUS + k]
    piston = piston_of(y, k)
    free = m[JOINED + k] == FREE
    if d != 0:
        if free:
            low = put(g, Guard.PISTON_1_TURN + k, d * (sense(k) * piston.v) + EPS_M_S, low)
        if sense(k) * d < 0.0:
            low = put(g, Guard.PISTON_1_STOP + k, piston.x + EPS_M, low)
    if free and (d != 0 or m.stay != 0):
        if gap(y, k) < 0.5 * p.x_free:
            low = put(g, Guard.NUT_1_CONTACT + 2 * k, gap(y, k) + EPS_M, low)
        else:
            low = put(g, Guard.COLLAR_1_CONTACT + 2 * k, p.x_free - gap(y, k) + EPS_M, low)
    return low


@inlined
def guard_contact(y, m, p, k, need, force, g, low):
    """Guard of the contact of stay and piston k, which needs a force [N] to move along; returns the lowest so far."""
    contact = m[JOINED + k]
    if contact != FREE:
        push = sign_ahead(k, contact) * (need - force) + bond(contact, y, p)
        low = put(g, Guard.PISTON_1_SEPARATION + k, push + EPS_N, low)
    return low


@called
def guards(t, y, m, p, g):
    """Guards of the present modes -> g[0:GUARDS], positive until the event, rounding apart. Returns the lowest."""
    low = UNREACHED
    for k in range(GUARDS):
        g[k] = low
    force = net_forces(y, m, p, t)
    d = m.stay
    if d != 0:
        low = put(g, Guard.TURN, d * y.v_s + EPS_M_S, low)
        highest, lowest = stay_limits(y, m, p)
        if d > 0:
            low = put(g, Guard.STOP_HIGH, highest - y.x_s + EPS_M, low)
        else:
            low = put(g, Guard.STOP_LOW, y.x_s - lowest + EPS_M, low)
    low = guard_piston(y, m, p, 0, g, low)
    low = guard_piston(y, m, p, 1, g, low)
    if m.stay != 0 and (m.joined_1 != FREE or m.joined_2 != FREE):
        need = p.m_p * accelerations(m, p, force)[0]
        low = guard_contact(y, m, p, 0, need, force[1], g, low)
        low = guard_contact(y, m, p, 1, need, force[2], g, low)
    if m.stay == 0 or m.piston_1 == 0 or m.piston_2 == 0:
        hold, hold1, hold2 = rest_margins(y, m, p, force)
        low = put(g, Guard.BREAKAWAY, hold, low)
        low = put(g, Guard.PISTON_1_BREAKAWAY, hold1, low)
        low = put(g, Guard.PISTON_2_BREAKAWAY, hold2, low)
    if m.blocked != 0:
        low = put(g, Guard.UNBLOCK, p.sync_impulse - y.impulse, low)
    if m.damper != 0:
        side = float(m.side)
        if d * side < 0:  # crossing neutral: the damper acts on the other side from there
            low = put(g, Guard.DAMPER_SIDE, side * y.x_s + EPS_M, low)
        low = damper_guards(side * y.x_s, side * y.v_s, y.p_oil, m, p, g, low)
    return low
