"""Events of the hybrid integrator: guards of the present modes, their location, what follows them.

Checked by: tests/physics/
"""

from __future__ import annotations

from math import sqrt

from plant.equations.fixed_piston import fixed_guards, fixed_impacts, fixed_settle
from plant.equations.length_contacts import (
    G_OIL_EMPTY,
    G_SPEED1,
    G_SPEED2,
    G_STAY_SPEED,
    G_SYNC,
    GUARDS,
)
from plant.equations.length_contacts import guards as length_guards
from plant.equations.length_impacts import impacts, settle
from plant.integrator.steppers import interpolate
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import (
    FIXED,
    FOIL,
    FREE,
    FV,
    LOIL,
    M_JOINED1,
    M_JOINED2,
    M_PISTON1,
    M_PISTON2,
    M_STAY,
    M_SYSTEM,
    P_ATM,
    SPENT,
    SYNC_IMPULSE,
    V1,
    V2,
    VS,
    X1,
    X2,
    X_FREE,
    XS,
)

# A velocity below this after an event is rounding, and ends a Zeno sequence of stops.
ZERO_M_S = 1e-10
# An event is located when it is no farther than this.
NEXT_S = 1e-15


@called
def all_guards(t, y, m, p, work, g):
    """Guards of the stroke's system -> g; returns the lowest, negative if an event is due."""
    if m[M_SYSTEM] == FIXED:
        return fixed_guards(t, y, m, p, g)
    return length_guards(t, y, m, p, work, g)


@called
def choose_modes(t, y, m, p, work):
    """Modes that continue the motion from here (sticking, joined, moving)."""
    if m[M_SYSTEM] == FIXED:
        fixed_settle(t, y, m, p)
    else:
        settle(t, y, m, p, work)


@called
def at_rest(m):
    """True if neither the stay nor a piston moves or is about to."""
    return m[M_STAY] == 0 and m[M_PISTON1] == 0 and m[M_PISTON2] == 0


@called
def smallest(g):
    """Smallest guard and its index."""
    index = 0
    for k in range(1, GUARDS):
        if g[k] < g[index]:
            index = k
    return index


@inlined
def dips(s0, s1):
    """True if a quantity with these slopes at both ends may be lower in between: see `lowest_place`."""
    return s0 < 0.0 and s1 > 0.0


@inlined
def lowest_place(v0, v1, s0, s1):
    """Where in 0..1 a quantity that ends as it began comes below zero, 1 if nowhere.

    Asked of the cubic through both ends with the slopes s0, s1 there (per step).
    """
    if not dips(s0, s1):
        return 1.0
    d = v1 - v0
    b = 3.0 * d - 2.0 * s0 - s1
    a = s0 + s1 - 2.0 * d
    place = -s0 / (b + sqrt(max(b * b - 3.0 * a * s0, 0.0)))
    if not 0.0 < place < 1.0:
        return 1.0
    lowest = v0 + place * (s0 + place * (b + place * a))
    return place if lowest < 0.0 else 1.0


@inlined
def may_hide(y, y1, rate0, rate1, m, p):
    """True if `hidden_turn` or `hidden_meeting` may find something in a step of the length stroke."""
    d = m[M_STAY]
    found = d != 0 and dips(d * rate0[VS], d * rate1[VS])
    if m[M_JOINED1] == FREE:
        d = m[M_PISTON1]
        found = found or (d != 0 and dips(d * rate0[V1], d * rate1[V1]))
        sign = 1.0 if y[X1] - y[XS] < 0.5 * p[X_FREE] else -1.0
        found = found or dips(sign * (y[V1] - y[VS]), sign * (y1[V1] - y1[VS]))
    if m[M_JOINED2] == FREE:
        d = -m[M_PISTON2]
        found = found or (d != 0 and dips(d * rate0[V2], d * rate1[V2]))
        sign = 1.0 if y[X2] + y[XS] < 0.5 * p[X_FREE] else -1.0
        found = found or dips(sign * (y[V2] + y[VS]), sign * (y1[V2] + y1[VS]))
    return found


@inlined
def fixed_may_hide(rate0, rate1, m):
    """True if `hidden_turn` may find something in a step of the fixed piston."""
    d = m[M_STAY]
    return d != 0 and dips(d * rate0[FV], d * rate1[FV])


@called
def hidden_turn(h, y, y1, rate0, rate1, m):
    """Fraction of a step at which a body has turned although both ends move the same way, or 1.

    A body that would rest for a moment turns twice within a long step; the guards at its ends do
    not see it.
    """
    d = m[M_STAY]
    if m[M_SYSTEM] == FIXED:
        if d == 0:
            return 1.0
        return lowest_place(d * y[FV], d * y1[FV], h * d * rate0[FV], h * d * rate1[FV])
    stay = 1.0
    if d != 0:
        stay = lowest_place(d * y[VS], d * y1[VS], h * d * rate0[VS], h * d * rate1[VS])
    one = 1.0
    d = m[M_PISTON1]
    if d != 0 and m[M_JOINED1] == FREE:
        one = lowest_place(d * y[V1], d * y1[V1], h * d * rate0[V1], h * d * rate1[V1])
    two = 1.0
    d = -m[M_PISTON2]
    if d != 0 and m[M_JOINED2] == FREE:
        two = lowest_place(d * y[V2], d * y1[V2], h * d * rate0[V2], h * d * rate1[V2])
    return min(stay, one, two)


@called
def hidden_meeting(h, y, y1, m, p):
    """Fraction of a step at which stay and piston have met although both ends are apart, or 1.

    Two bodies that graze each other close and part again within one step.
    """
    if m[M_SYSTEM] == FIXED:
        return 1.0
    one = 1.0
    if m[M_JOINED1] == FREE:
        gap = y[X1] - y[XS]
        low = 0.0 if gap < 0.5 * p[X_FREE] else p[X_FREE]
        sign = 1.0 if low == 0.0 else -1.0
        one = lowest_place(
            sign * (gap - low),
            sign * (y1[X1] - y1[XS] - low),
            h * sign * (y[V1] - y[VS]),
            h * sign * (y1[V1] - y1[VS]),
        )
    two = 1.0
    if m[M_JOINED2] == FREE:
        gap = y[X2] + y[XS]
        low = 0.0 if gap < 0.5 * p[X_FREE] else p[X_FREE]
        sign = 1.0 if low == 0.0 else -1.0
        two = lowest_place(
            sign * (gap - low),
            sign * (y1[X2] + y1[XS] - low),
            h * sign * (y[V2] + y[VS]),
            h * sign * (y1[V2] + y1[VS]),
        )
    return min(one, two)


@inlined
def root_place(low, high, third, a, b, c):
    """Where a quantity that is a >= 0 at low, b < 0 at high, c at third crosses zero.

    Inverse quadratic interpolation through all three; the secant where that leaves the bracket.
    """
    place = high + (low - high) * b / (b - a)
    if c != a and c != b:
        curved = (
            high
            + (low - high) * b * c / ((a - b) * (a - c))
            + (third - high) * a * b / ((c - a) * (c - b))
        )
        if low < curved < high:
            place = curved
    return place


@called
def locate(t, h, high, dense, y, m, p, work, g, g0, n_all):
    """Fraction of the step at which the first guard crosses zero, and that guard; y: the state there.

    g0: guards at the step's start, all positive; g: at its fraction `high`, one negative; both are
    overwritten.  A bracket whose upper end is replaced by the foreseen crossing of whichever negative
    guard would cross first, with bisection when it stalls, until it is where it is foreseen.
    """
    low = 0.0
    third = high
    before = 1.0
    below = g
    above = g0
    trial = work[6 : 6 + GUARDS]
    older = work[6 + GUARDS : 6 + 2 * GUARDS]
    for k in range(GUARDS):
        older[k] = below[k]
    for iteration in range(80):
        width = high - low
        theta = high
        for k in range(GUARDS):
            if below[k] < 0.0:
                start = max(above[k], 0.0)
                theta = min(theta, root_place(low, high, third, start, below[k], older[k]))
        if (high - theta) * h < NEXT_S or width * h < NEXT_S:
            break
        # just beyond the crossing, so that a good forecast is the last
        theta = max(theta + 0.5 * NEXT_S / h, low + width * min(1e-3, 4.0 * width))
        if iteration % 3 == 2:
            if width > 0.1 * before:
                theta = 0.5 * (low + high)
            before = width
        interpolate(theta, dense, y, n_all)
        spare = older
        if all_guards(t + theta * h, y, m, p, work, trial) < 0.0:
            third = high
            older = below
            high = theta
            below = trial
        else:
            third = low
            older = above
            low = theta
            above = trial
        trial = spare
    interpolate(high, dense, y, n_all)
    return high, smallest(below)


@called
def after_event(t, index, y, m, p, record, work):
    """Reset at an event and choose the modes that follow."""
    if m[M_SYSTEM] == FIXED:
        if index == G_STAY_SPEED:
            y[FV] = 0.0
        if index == G_OIL_EMPTY:
            y[FOIL] = p[P_ATM]
        if abs(y[FV]) < ZERO_M_S:
            y[FV] = 0.0
        fixed_impacts(y, m, p, record)
        fixed_settle(t, y, m, p)
        return
    if index == G_STAY_SPEED:
        if m[3] != 0:
            y[V1] = 0.0
        if m[4] != 0:
            y[V2] = 0.0
        y[VS] = 0.0
    elif index == G_SPEED1:
        y[V1] = 0.0
    elif index == G_SPEED2:
        y[V2] = 0.0
    elif index == G_SYNC:
        y[SPENT] = p[SYNC_IMPULSE]
    elif index == G_OIL_EMPTY:
        y[LOIL] = p[P_ATM]
    for i in (VS, V1, V2):
        if abs(y[i]) < ZERO_M_S:
            y[i] = 0.0
    impacts(t, y, m, p, record, work)
    settle(t, y, m, p, work)
