"""Guards of the length stroke: stops, contacts, sticking, the synchronizer's block, the damper's corners.

Three bodies on one line.  A contact has a body behind and one ahead: moving in + the body behind
pushes the one ahead.  Collar 1: piston 1 behind, stay ahead; nut 1: stay behind, piston 1 ahead;
nut 2: piston 2 behind, stay ahead; collar 2: stay behind, piston 2 ahead.
"""

from __future__ import annotations

from plant.equations.length_stroke import (
    TOUCH_M,
    accelerations,
    damper_borders,
    net_forces,
    piston_static,
    stay_static,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import (
    COLLAR,
    FREE,
    LOIL,
    M_BLOCKED,
    M_CAPPED,
    M_DAMPER,
    M_INSIDE,
    M_JOINED1,
    M_JOINED2,
    M_LIFTED,
    M_OIL_REST,
    M_OPEN,
    M_P,
    M_PISTON1,
    M_PISTON2,
    M_SIDE,
    M_STAY,
    NUT,
    P_ATM,
    PB,
    PF,
    PN,
    SPENT,
    STOP_OFFSET,
    STROKE,
    SYNC_IMPULSE,
    V1,
    V2,
    VS,
    X1,
    X2,
    X_BLOCK,
    X_FREE,
    XS,
)

EPS_M = 1e-13
EPS_M_S = 1e-11
EPS_N = 1e-7
EPS_PA = 1e-7
EPS_M2 = 1e-18
EPS_CD = 1e-12
FAR = 1.0e30

GUARDS = 23
(
    G_STAY_SPEED,
    G_SPEED1,
    G_SPEED2,
    G_STAY_HIGH,
    G_STAY_LOW,
    G_OUTER1,
    G_OUTER2,
    G_NUT1,
    G_COLLAR1,
    G_NUT2,
    G_COLLAR2,
    G_CONTACT1,
    G_CONTACT2,
    G_HOLD_STAY,
    G_HOLD1,
    G_HOLD2,
    G_SYNC,
    G_OIL_EMPTY,
    G_OIL_FILL,
    G_NEUTRAL,
    G_CAPPED,
    G_OPEN,
    G_LIFTED,
) = range(GUARDS)
FIRST_CORNER = G_CAPPED  # from here on: corners of a law, at which nothing happens but a new step


@inlined
def end_stop(p):
    """Farthest stay position [m]: its own stop, or the collar of the piston that cannot give way."""
    return min(p[STROKE] + p[STOP_OFFSET], p[X_FREE])


@inlined
def stay_limits(y, m, p):
    """Highest and lowest stay position now: the end stops, or the synchronizer while unspent."""
    high = end_stop(p)
    if m[M_BLOCKED] != 0 or (m[M_INSIDE] != 0 and y[SPENT] < p[SYNC_IMPULSE]):
        high = p[X_BLOCK]
    return high, -high


@inlined
def note_side(y, m, p):
    """Remember on which side of the blocking position the stay stands (a step must not jump it)."""
    m[M_INSIDE] = 1 if abs(y[XS]) <= p[X_BLOCK] + TOUCH_M else 0


@inlined
def sign_ahead(which, contact):
    """+1 if piston `which` is the body ahead in its contact with the stay, -1 if behind."""
    if which == 1:
        return 1 if contact == NUT else -1
    return 1 if contact == COLLAR else -1


@inlined
def piston_holds(direction, which, y):
    """True if a piston cannot move in `direction` (of x_s): it stands on its outer stop."""
    if which == 1:
        return direction < 0 and y[X1] <= TOUCH_M
    return direction > 0 and y[X2] <= TOUCH_M


@inlined
def stay_margin(d, y, m, p, force, static1, static2):
    """Margin before the stay, at rest, moves in direction d (1, -1) with what it takes along [N].

    static1, static2: static friction of the pistons that way.
    """
    high, low = stay_limits(y, m, p)
    c1 = m[M_JOINED1]
    c2 = m[M_JOINED2]
    hold = FAR
    own = stay_static(y[XS], d, p)
    stopped = (d > 0 and y[XS] >= high - TOUCH_M) or (d < 0 and y[XS] <= low + TOUCH_M)
    # the stay with everything joined to it, or only touching it at rest and in the way
    blocked = stopped
    total = d * force[0]
    cap = own
    gap = y[X1] - y[XS]
    ahead = gap <= TOUCH_M if d > 0 else gap >= p[X_FREE] - TOUCH_M
    if c1 != FREE or (not blocked and ahead and m[M_PISTON1] == 0):
        blocked = blocked or piston_holds(d, 1, y)
        total += d * force[1]
        cap += static1
    gap = y[X2] + y[XS]
    ahead = gap <= TOUCH_M if d < 0 else gap >= p[X_FREE] - TOUCH_M
    if c2 != FREE or (not blocked and ahead and m[M_PISTON2] == 0):
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
            hold = min(hold, cap - away)
    if c2 != FREE and d == -sign_ahead(2, c2):
        away = d * force[0]
        cap = own
        blocked = stopped
        if c1 != FREE:
            away += d * force[1]
            cap += static1
            blocked = blocked or piston_holds(d, 1, y)
        if not blocked:
            hold = min(hold, cap - away)
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
    c1 = m[M_JOINED1]
    c2 = m[M_JOINED2]
    plus1 = piston_static(1.0, y[PB] - y[PN], p)
    minus1 = piston_static(-1.0, y[PB] - y[PN], p)
    plus2 = piston_static(1.0, y[PF] - y[PN], p)
    minus2 = piston_static(-1.0, y[PF] - y[PN], p)
    hold = FAR
    hold1 = FAR
    hold2 = FAR
    if m[M_STAY] == 0:
        hold = min(
            stay_margin(1, y, m, p, force, plus1, plus2),
            stay_margin(-1, y, m, p, force, minus1, minus2),
        )
    if m[M_PISTON1] == 0:
        hold1 = min(
            piston_margin(1, 1, c1, y, plus1, force[1]),
            piston_margin(-1, 1, c1, y, minus1, force[1]),
        )
    if m[M_PISTON2] == 0:
        hold2 = min(
            piston_margin(1, 2, c2, y, plus2, force[2]),
            piston_margin(-1, 2, c2, y, minus2, force[2]),
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
    low = put(g, G_CAPPED, (capped if m[M_CAPPED] != 0 else -capped) + EPS_M2, low)
    low = put(g, G_OPEN, (opened if m[M_OPEN] != 0 else -opened) + EPS_M, low)
    return put(g, G_LIFTED, (lifted if m[M_LIFTED] != 0 else -lifted) + EPS_CD, low)


@inlined
def note_corners(distance, speed, m, p):
    """Remember on which sides of the damper's corners the stay stands."""
    capped, opened, lifted = damper_borders(distance, speed, p)
    m[M_CAPPED] = 1 if capped > 0.0 else 0
    m[M_OPEN] = 1 if opened > 0.0 else 0
    m[M_LIFTED] = 1 if lifted > 0.0 else 0


@called
def guards(t, y, m, p, work, g):
    """Guards of the present modes -> g[0:GUARDS]; each is positive until its event.  Returns the lowest.

    Shifted by a rounding-sized amount so that a guard just fired does not fire again.
    """
    low = FAR
    for k in range(GUARDS):
        g[k] = low
    force = work[0:3]
    acc = work[3:6]
    net_forces(y, m, p, t, force)
    d = m[M_STAY]
    d1 = m[M_PISTON1]
    d2 = m[M_PISTON2]
    c1 = m[M_JOINED1]
    c2 = m[M_JOINED2]
    w1 = y[V1]
    w2 = -y[V2]
    if d != 0:
        low = put(g, G_STAY_SPEED, d * y[VS] + EPS_M_S, low)
        highest, lowest = stay_limits(y, m, p)
        if d > 0:
            low = put(g, G_STAY_HIGH, highest - y[XS] + EPS_M, low)
        else:
            low = put(g, G_STAY_LOW, y[XS] - lowest + EPS_M, low)
    if d1 != 0:
        if c1 == FREE:
            low = put(g, G_SPEED1, d1 * w1 + EPS_M_S, low)
        if d1 < 0:
            low = put(g, G_OUTER1, y[X1] + EPS_M, low)
    if d2 != 0:
        if c2 == FREE:
            low = put(g, G_SPEED2, d2 * w2 + EPS_M_S, low)
        if d2 > 0:
            low = put(g, G_OUTER2, y[X2] + EPS_M, low)
    if c1 == FREE and (d1 != 0 or d != 0):
        gap = y[X1] - y[XS]
        if gap < 0.5 * p[X_FREE]:
            low = put(g, G_NUT1, gap + EPS_M, low)
        else:
            low = put(g, G_COLLAR1, p[X_FREE] - gap + EPS_M, low)
    if c2 == FREE and (d2 != 0 or d != 0):
        gap = y[X2] + y[XS]
        if gap < 0.5 * p[X_FREE]:
            low = put(g, G_NUT2, gap + EPS_M, low)
        else:
            low = put(g, G_COLLAR2, p[X_FREE] - gap + EPS_M, low)
    if d != 0 and (c1 != FREE or c2 != FREE):
        accelerations(m, p, force, acc)
        if c1 != FREE:
            low = put(g, G_CONTACT1, sign_ahead(1, c1) * (p[M_P] * acc[0] - force[1]) + EPS_N, low)
        if c2 != FREE:
            low = put(g, G_CONTACT2, sign_ahead(2, c2) * (p[M_P] * acc[0] - force[2]) + EPS_N, low)
    if d == 0 or d1 == 0 or d2 == 0:
        hold, hold1, hold2 = rest_margins(y, m, p, force)
        low = put(g, G_HOLD_STAY, hold, low)
        low = put(g, G_HOLD1, hold1, low)
        low = put(g, G_HOLD2, hold2, low)
    if m[M_BLOCKED] != 0:
        low = put(g, G_SYNC, p[SYNC_IMPULSE] - y[SPENT], low)
    if m[M_DAMPER] != 0:
        side = float(m[M_SIDE])
        if d * side < 0:
            # crossing neutral: the damper acts on the other side from there
            low = put(g, G_NEUTRAL, side * y[XS] + EPS_M, low)
        if d != 0:
            low = damper_corners(side * y[XS], side * y[VS], m, p, g, low)
        if m[M_DAMPER] == 2:
            if m[M_OIL_REST] == 0:
                low = put(g, G_OIL_EMPTY, y[LOIL] - p[P_ATM] + EPS_PA, low)
            elif d != 0:
                low = put(g, G_OIL_FILL, EPS_M_S - side * y[VS], low)
    return low
