"""Events of the hybrid integrator: guards of the present modes, their location, what follows them."""

from __future__ import annotations

from math import sqrt

from plant.equations.fixed_piston import fixed_guards, fixed_impacts, fixed_settle
from plant.equations.length_contacts import guards as length_guards
from plant.equations.length_modes import impacts, settle
from plant.integrator.steppers import interpolate
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FIXED, FREE, GUARDS, Guard, fixed_state, impact_of, length_state


@called
def all_guards(t, y, o, g):
    """Guards of the stroke's system at (t, y) -> g; returns the lowest, negative if an event is due."""
    if o.m.system == FIXED:
        return fixed_guards(t, fixed_state(y), o.m, o.p, g)
    return length_guards(t, length_state(y), o.m, o.p, g)


@called
def choose_modes(t, o):
    """Choose the modes that continue the motion from here (sticking, joined, moving)."""
    if o.m.system == FIXED:
        fixed_settle(t, fixed_state(o.y), o.m, o.p)
    else:
        settle(t, length_state(o.y), o.m, o.p)


@called
def at_rest(m):
    """Return True if neither the stay nor a piston moves or is about to."""
    return m.stay == 0 and m.piston_1 == 0 and m.piston_2 == 0


@called
def smallest(g):
    """Smallest guard and its index."""
    index = 0
    for k in range(1, GUARDS):
        if g[k] < g[index]:
            index = k
    return index


@inlined
def lowest_fraction(v0, v1, s0, s1):
    """Where in 0..1 the cubic from v0 to v1 with slopes s0, s1 (per step) comes below zero, 1 if nowhere."""
    if not (s0 < 0.0 and s1 > 0.0):
        return 1.0
    d = v1 - v0
    b = 3.0 * d - 2.0 * s0 - s1
    a = s0 + s1 - 2.0 * d
    fraction = -s0 / (b + sqrt(max(b * b - 3.0 * a * s0, 0.0)))
    if not 0.0 < fraction < 1.0:
        return 1.0
    lowest = v0 + fraction * (s0 + fraction * (b + fraction * a))
    return fraction if lowest < 0.0 else 1.0


@inlined
def turn_fraction(d, h, v, v1, a, a1):
    """`lowest_fraction` of the velocity of a body that moves in direction d, 1 for one at rest."""
    if d == 0:
        return 1.0
    return lowest_fraction(d * v, d * v1, h * d * a, h * d * a1)


@called
def hidden_turn(h, y1, rate0, rate1, o):
    """Fraction of a step at which a body has turned, and turned back before its end, or 1."""
    m = o.m
    # also of the fixed piston: its velocity has the index of the stay's, and no piston moves
    y = length_state(o.y)
    y1 = length_state(y1)
    rate0 = length_state(rate0)
    rate1 = length_state(rate1)
    stay = turn_fraction(m.stay, h, y.v_s, y1.v_s, rate0.v_s, rate1.v_s)
    one = 1.0
    if m.joined_1 == FREE:
        one = turn_fraction(m.piston_1, h, y.v_1, y1.v_1, rate0.v_1, rate1.v_1)
    two = 1.0
    if m.joined_2 == FREE:
        two = turn_fraction(-m.piston_2, h, y.v_2, y1.v_2, rate0.v_2, rate1.v_2)
    return min(stay, one, two)


@inlined
def meeting_fraction(h, gap, gap1, opening, opening1, p):
    """`lowest_fraction` of the distance of stay and piston from the contact they are nearer to."""
    low = 0.0 if gap < 0.5 * p.x_free else p.x_free
    sign = 1.0 if low == 0.0 else -1.0
    return lowest_fraction(
        sign * (gap - low), sign * (gap1 - low), h * sign * opening, h * sign * opening1
    )


@called
def hidden_meeting(h, y1, o):
    """Fraction of a step at which stay and piston have met, and parted again before its end, or 1."""
    m = o.m
    p = o.p
    if m.system == FIXED:
        return 1.0
    y = length_state(o.y)
    y1 = length_state(y1)
    one = 1.0
    if m.joined_1 == FREE:
        one = meeting_fraction(h, y.x_1 - y.x_s, y1.x_1 - y1.x_s, y.v_1 - y.v_s, y1.v_1 - y1.v_s, p)
    two = 1.0
    if m.joined_2 == FREE:
        two = meeting_fraction(h, y.x_2 + y.x_s, y1.x_2 + y1.x_s, y.v_2 + y.v_s, y1.v_2 + y1.v_s, p)
    return min(one, two)


@inlined
def root_fraction(low, high, third, a, b, c):
    """Where a quantity, a >= 0 at low, b < 0 at high, c at third, crosses zero: inverse quadratic, or the secant."""
    fraction = high + (low - high) * b / (b - a)
    if c != a and c != b:
        curved = (
            high
            + (low - high) * b * c / ((a - b) * (a - c))
            + (third - high) * a * b / ((c - a) * (c - b))
        )
        if low < curved < high:
            fraction = curved
    return fraction


@called
def locate(t, h, high, dense, y, o, n_all):
    """Fraction of the step at which the first guard crosses zero, and that guard; y: the state there.

    scratch.before: guards at the step's start, all positive, scratch.guards: at its fraction `high`, one negative;
    both are overwritten. The bracket's upper end becomes the crossing that is foreseen first, with bisection when it
    stalls.
    """
    located_s = 1e-15  # no farther off it counts as located
    low = 0.0
    third = high
    before = 1.0
    below = o.scratch.guards
    above = o.scratch.before
    trial = o.scratch.trial
    older = o.scratch.older
    for k in range(GUARDS):
        older[k] = below[k]
    for iteration in range(80):
        width = high - low
        theta = high
        for k in range(GUARDS):
            if below[k] < 0.0:
                start = max(above[k], 0.0)
                theta = min(theta, root_fraction(low, high, third, start, below[k], older[k]))
        if (high - theta) * h < located_s or width * h < located_s:
            break
        # just beyond the crossing, so that a good forecast is the last
        theta = max(theta + 0.5 * located_s / h, low + width * min(1e-3, 4.0 * width))
        if iteration % 3 == 2:
            if width > 0.1 * before:
                theta = 0.5 * (low + high)
            before = width
        interpolate(theta, dense, y, n_all)
        spare = older
        if all_guards(t + theta * h, y, o, trial) < 0.0:
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


@inlined
def settled_speed(v):
    """Return a velocity after an event: 0 where it is rounding, which ends a Zeno sequence of stops."""
    return 0.0 if abs(v) < 1e-10 else v


@called
def after_event(t, index, o):
    """Reset at an event and choose the modes that follow."""
    impact = impact_of(o.scratch.impact)
    if o.m.system == FIXED:
        fixed_reset(t, index, fixed_state(o.y), o.m, o.p, impact)
    else:
        length_reset(t, index, length_state(o.y), o.m, o.p, impact)


@called
def fixed_reset(t, index, y, m, p, impact):
    """`after_event` of the fixed piston."""
    if index == Guard.TURN:
        y.v = 0.0
    if index == Guard.OIL_EMPTY:
        y.p_oil = p.p_atm
    y.v = settled_speed(y.v)
    fixed_impacts(y, m, p, impact)
    fixed_settle(t, y, m, p)


@called
def length_reset(t, index, y, m, p, impact):
    """`after_event` of the length stroke."""
    if index == Guard.TURN:
        if m.joined_1 != FREE:
            y.v_1 = 0.0
        if m.joined_2 != FREE:
            y.v_2 = 0.0
        y.v_s = 0.0
    elif index == Guard.PISTON_1_TURN:
        y.v_1 = 0.0
    elif index == Guard.PISTON_2_TURN:
        y.v_2 = 0.0
    elif index == Guard.UNBLOCK:
        y.impulse = p.sync_impulse
    elif index == Guard.OIL_EMPTY:
        y.p_oil = p.p_atm
    y.v_s = settled_speed(y.v_s)
    y.v_1 = settled_speed(y.v_1)
    y.v_2 = settled_speed(y.v_2)
    impacts(t, y, m, p, impact)
    settle(t, y, m, p)
