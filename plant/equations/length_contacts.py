"""Guards of the length stroke: stops, contacts, sticking, the synchronizer's block, the damper's corners.

Three bodies on one line.  A contact has a body behind and one ahead: moving in + the body behind
pushes the one ahead.  Collar 1: piston 1 behind, stay ahead; nut 1: stay behind, piston 1 ahead;
nut 2: piston 2 behind, stay ahead; collar 2: stay behind, piston 2 ahead.
"""

from __future__ import annotations

from plant.equations.length_stroke import TOUCH_M, accelerations, net_forces
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import COLLAR, COMPRESSIBLE, FREE, GUARDS, NUT, Guard
from plant.parts.damper import damper_borders
from plant.parts.friction import piston_static, stay_static

EPS_M = 1e-13
EPS_M_S = 1e-11
EPS_N = 1e-7
EPS_PA = 1e-7
EPS_M2 = 1e-18
EPS_CD = 1e-12
FAR = 1.0e30


@inlined
def end_stop(p):
    """Farthest stay position [m]: its own stop, or the collar of the piston that cannot give way."""
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
    """Remember on which side of the blocking position the stay stands (a step must not jump it)."""
    m.inside = 1 if abs(y.x_s) <= p.x_block + TOUCH_M else 0


@inlined
def sign_ahead(which, contact):
    """+1 if piston `which` is the body ahead in its contact with the stay, -1 if behind."""
    if which == 1:
        return 1 if contact == NUT else -1
    return 1 if contact == COLLAR else -1


@inlined
def piston_holds(direction, which, y):
    """Return True if a piston cannot move in `direction` (of x_s): it stands on its outer stop."""
    if which == 1:
        return direction < 0 and y.x_1 <= TOUCH_M
    return direction > 0 and y.x_2 <= TOUCH_M


@inlined
def bond(contact, y, p):
    """Pull that this contact of stay and piston bears here [N].

    None in the gear in which the piston must part: of a nut in neutral, of a collar at an end.
    """
    away = abs(y.x_s)
    parts = (contact == NUT and away <= TOUCH_M) or (
        contact == COLLAR and away >= end_stop(p) - TOUCH_M
    )
    return 0.0 if parts or contact == FREE else p.bond


@inlined
def stay_margin(d, y, m, p, force, static1, static2):
    """Margin before the stay, at rest, moves in direction d (1, -1) with what it takes along [N].

    static1, static2: static friction of the pistons that way.
    """
    high, low = stay_limits(y, m, p)
    c1 = m.joined_1
    c2 = m.joined_2
    hold = FAR
    own = stay_static(y.x_s, d, p)
    stopped = (d > 0 and y.x_s >= high - TOUCH_M) or (d < 0 and y.x_s <= low + TOUCH_M)
    # the stay with everything joined to it, or only touching it at rest and in the way
    blocked = stopped
    total = d * force[0]
    cap = own
    gap = y.x_1 - y.x_s
    ahead = gap <= TOUCH_M if d > 0 else gap >= p.x_free - TOUCH_M
    if c1 != FREE or (not blocked and ahead and m.piston_1 == 0):
        blocked = blocked or piston_holds(d, 1, y)
        total += d * force[1]
        cap += static1
    gap = y.x_2 + y.x_s
    ahead = gap <= TOUCH_M if d < 0 else gap >= p.x_free - TOUCH_M
    if c2 != FREE or (not blocked and ahead and m.piston_2 == 0):
        blocked = blocked or piston_holds(d, 2, y)
        total += d * force[2]
        cap += static2
    if not blocked:
        hold = cap - total
    # leaving a contact: the stay (with the other piston) away from piston 1, 2
    if c1 != FREE and d == -sign_ahead(1, c1):
        away = d * force[0]
        cap = own
        blocked = stopped
        if c2 != FREE:
            away += d * force[2]
            cap += static2
            blocked = blocked or piston_holds(d, 2, y)
        if not blocked:
            hold = min(hold, cap - away + bond(c1, y, p))
    if c2 != FREE and d == -sign_ahead(2, c2):
        away = d * force[0]
        cap = own
        blocked = stopped
        if c1 != FREE:
            away += d * force[1]
            cap += static1
            blocked = blocked or piston_holds(d, 1, y)
        if not blocked:
            hold = min(hold, cap - away + bond(c2, y, p))
    return hold


@inlined
def piston_margin(d, which, contact, y, static, force):
    """Margin before piston `which`, at rest, moves in direction d (1, -1) [N]."""
    if (contact != FREE and d != sign_ahead(which, contact)) or piston_holds(d, which, y):
        return FAR
    return static - d * force


@inlined
def rest_margins(y, m, p, force):
    """Margins before stay, piston 1, piston 2 leave their rest [N]: friction less driving force."""
    c1 = m.joined_1
    c2 = m.joined_2
    plus1 = piston_static(1.0, y.p_b - y.p_n, p)
    minus1 = piston_static(-1.0, y.p_b - y.p_n, p)
    plus2 = piston_static(1.0, y.p_f - y.p_n, p)
    minus2 = piston_static(-1.0, y.p_f - y.p_n, p)
    pull1 = bond(c1, y, p)
    pull2 = bond(c2, y, p)
    hold = FAR
    hold1 = FAR
    hold2 = FAR
    if m.stay == 0:
        hold = min(
            stay_margin(1, y, m, p, force, plus1, plus2),
            stay_margin(-1, y, m, p, force, minus1, minus2),
        )
    if m.piston_1 == 0:
        hold1 = min(
            piston_margin(1, 1, c1, y, plus1 + pull1, force[1]),
            piston_margin(-1, 1, c1, y, minus1 + pull1, force[1]),
        )
    if m.piston_2 == 0:
        hold2 = min(
            piston_margin(1, 2, c2, y, plus2 + pull2, force[2]),
            piston_margin(-1, 2, c2, y, minus2 + pull2, force[2]),
        )
    return hold + EPS_N, hold1 + EPS_N, hold2 + EPS_N


@inlined
def put(g, k, value, low):
    """Write guard k; returns the lowest so far."""
    g[k] = value
    return min(low, value)


@inlined
def damper_corners(distance, speed, m, p, g, low):
    """Guards of the corners of the damper's law; returns the lowest guard so far."""
    capped, opened, lifted = damper_borders(distance, speed, p)
    low = put(g, Guard.CAPPED, (capped if m.capped != 0 else -capped) + EPS_M2, low)
    low = put(g, Guard.OPEN, (opened if m.opened != 0 else -opened) + EPS_M, low)
    return put(g, Guard.LIFTED, (lifted if m.lifted != 0 else -lifted) + EPS_CD, low)


@inlined
def note_corners(distance, speed, m, p):
    """Remember on which sides of the damper's corners the stay stands."""
    capped, opened, lifted = damper_borders(distance, speed, p)
    m.capped = 1 if capped > 0.0 else 0
    m.opened = 1 if opened > 0.0 else 0
    m.lifted = 1 if lifted > 0.0 else 0


@inlined
def guard_speeds(y, m, p, g, low):
    """Guards of bodies in motion: turning, and reaching their stops; returns the lowest so far."""
    d = m.stay
    if d != 0:
        low = put(g, Guard.STAY_SPEED, d * y.v_s + EPS_M_S, low)
        highest, lowest = stay_limits(y, m, p)
        if d > 0:
            low = put(g, Guard.STAY_HIGH, highest - y.x_s + EPS_M, low)
        else:
            low = put(g, Guard.STAY_LOW, y.x_s - lowest + EPS_M, low)
    d1 = m.piston_1
    if d1 != 0:
        if m.joined_1 == FREE:
            low = put(g, Guard.SPEED_1, d1 * y.v_1 + EPS_M_S, low)
        if d1 < 0:
            low = put(g, Guard.OUTER_1, y.x_1 + EPS_M, low)
    d2 = m.piston_2
    if d2 != 0:
        if m.joined_2 == FREE:
            low = put(g, Guard.SPEED_2, d2 * -y.v_2 + EPS_M_S, low)
        if d2 > 0:
            low = put(g, Guard.OUTER_2, y.x_2 + EPS_M, low)
    return low


@inlined
def guard_gap(gap, nut, collar, p, g, low):
    """Guard of the contact that a free piston is nearer to; returns the lowest so far."""
    if gap < 0.5 * p.x_free:
        return put(g, nut, gap + EPS_M, low)
    return put(g, collar, p.x_free - gap + EPS_M, low)


@inlined
def guard_contacts(y, m, p, force, g, low):
    """Guards of contacts of stay and pistons, that close or open; returns the lowest so far."""
    moves = m.stay != 0
    if m.joined_1 == FREE and (m.piston_1 != 0 or moves):
        low = guard_gap(y.x_1 - y.x_s, Guard.NUT_1, Guard.COLLAR_1, p, g, low)
    if m.joined_2 == FREE and (m.piston_2 != 0 or moves):
        low = guard_gap(y.x_2 + y.x_s, Guard.NUT_2, Guard.COLLAR_2, p, g, low)
    if moves and (m.joined_1 != FREE or m.joined_2 != FREE):
        need = p.m_p * accelerations(m, p, force)[0]
        if m.joined_1 != FREE:
            push = sign_ahead(1, m.joined_1) * (need - force[1]) + bond(m.joined_1, y, p)
            low = put(g, Guard.CONTACT_1, push + EPS_N, low)
        if m.joined_2 != FREE:
            push = sign_ahead(2, m.joined_2) * (need - force[2]) + bond(m.joined_2, y, p)
            low = put(g, Guard.CONTACT_2, push + EPS_N, low)
    return low


@inlined
def guard_damper(y, m, p, g, low):
    """Guards of the oil damper: its side, its law's corners, its oil; returns the lowest so far."""
    d = m.stay
    side = float(m.side)
    if d * side < 0:
        # crossing neutral: the damper acts on the other side from there
        low = put(g, Guard.NEUTRAL, side * y.x_s + EPS_M, low)
    if d != 0:
        low = damper_corners(side * y.x_s, side * y.v_s, m, p, g, low)
    if m.damper == COMPRESSIBLE:
        if m.oil_rest == 0:
            low = put(g, Guard.OIL_EMPTY, y.p_oil - p.p_atm + EPS_PA, low)
        elif d != 0:
            low = put(g, Guard.OIL_FILL, EPS_M_S - side * y.v_s, low)
    return low


@called
def guards(t, y, m, p, g):
    """Guards of the present modes -> g[0:GUARDS]; each is positive until its event.  Returns the lowest.

    Shifted by a rounding-sized amount so that a guard just fired does not fire again.
    """
    low = FAR
    for k in range(GUARDS):
        g[k] = low
    force = net_forces(y, m, p, t)
    low = guard_speeds(y, m, p, g, low)
    low = guard_contacts(y, m, p, force, g, low)
    if m.stay == 0 or m.piston_1 == 0 or m.piston_2 == 0:
        hold, hold1, hold2 = rest_margins(y, m, p, force)
        low = put(g, Guard.HOLD_STAY, hold, low)
        low = put(g, Guard.HOLD_1, hold1, low)
        low = put(g, Guard.HOLD_2, hold2, low)
    if m.blocked != 0:
        low = put(g, Guard.SYNC, p.sync_impulse - y.impulse, low)
    if m.damper != 0:
        low = guard_damper(y, m, p, g, low)
    return low
