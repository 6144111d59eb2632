"""A rest as one step: from now to the next switch, or until something breaks away."""

from __future__ import annotations

from plant.integrator.events import all_guards, smallest
from plant.integrator.filling import STILL, chamber_curves, chamber_of, chamber_pressure
from plant.integrator.loop import AGAIN, NOT_FINITE, STEPPING, sample_rest
from plant.kernel.compiled import called
from plant.kernel.layout import FIXED, pressures


@called
def pressures_after(dt, fixed, w, table, y):
    """Pressures of the chambers a time dt on -> y; those that stand still are left alone."""
    pressure = pressures(fixed, y)
    for j in range(2 if fixed else 3):
        if chamber_of(w, j).kind != STILL:
            pressure[j] = chamber_pressure(dt, chamber_of(w, j), table)


@called
def lowest_corner(t, fixed, y1, corner, o):
    """Lowest guard over all mixtures of the pressures of y and y1: at rest guards are minima of linear functions."""
    w = o.scratch.rest
    count = 2 if fixed else 3
    before = pressures(fixed, o.y)
    after = pressures(fixed, y1)
    mixed = pressures(fixed, corner)
    moving = 0
    for j in range(count):
        if chamber_of(w, j).kind != STILL:
            moving |= 1 << j
    lowest = 1.0e30
    for mixture in range(1, moving):
        if mixture & ~moving == 0:
            for j in range(count):
                mixed[j] = after[j] if mixture >> j & 1 else before[j]
            lowest = min(lowest, all_guards(t, corner, o, o.scratch.guards))
    return lowest


@called
def rest_jump(t, span, y1, corner, o, table, n):
    """Rest from t on, at most for `span` -> time passed, and the guard that ended it or -1; all positive before.

    y1: the state then, scratch.guards its guards, scratch.rest the chambers' curves. Time 0 without a guard: no closed
    form.
    """
    g = o.scratch.guards
    w = o.scratch.rest
    fixed = o.m.system == FIXED
    if not chamber_curves(fixed, o.y, o.u0, o.p, table, w):
        return 0.0, -1
    for i in range(n):
        y1[i] = o.y[i]
        corner[i] = o.y[i]
    for _ in range(40):
        pressures_after(span, fixed, w, table, y1)
        last = all_guards(t, y1, o, g)
        dt = span
        if last < 0.0:
            first = all_guards(t, o.y, o, g)
            dt = crossing(t, span, first, last, y1, o, table)
        # within 2 ms no proof that it is the first: the scalar kernel looks no more often
        if dt <= 2e-3 or lowest_corner(t, fixed, y1, corner, o) >= 0.0:
            if last >= 0.0:
                return dt, -1
            all_guards(t, y1, o, g)
            return dt, smallest(g)
        span = 0.5 * dt
    return 0.0, -1


@called
def pass_rest(s, k, o, end, corner, task, n):
    """Pass a rest of n states in one step: AGAIN, NOT_FINITE, or STEPPING without a closed form; and its guard or -1."""
    left = s.next - s.time
    dt, index = rest_jump(s.time, left, end, corner, o, task.table, n)
    if not (dt > 0.0 or index >= 0):
        return STEPPING, -1
    until = s.next if dt == left and index < 0 else s.time + dt
    for i in range(n):
        o.y[i] = end[i]
        if not abs(o.y[i]) < 1e300:
            return NOT_FINITE, -1
    sample_rest(s, k, o, end, until, task)
    s.time = until
    return AGAIN, index


@called
def crossing(t, span, low_value, high_value, y1, o, table):
    """Time within `span` at which the lowest guard has just become negative; y1 is the state there.

    Regula falsi (Illinois), to 1e-6 N below zero within a thousandth, which derivatives need.
    """
    g = o.scratch.guards
    w = o.scratch.rest
    fixed = o.m.system == FIXED
    margin = 1e-6  # N; in 1e-14 s a breakaway moves by far less than that
    low = 0.0
    high = span
    low_value = max(low_value, 0.0) + margin
    high_value += margin
    side = 0
    for iteration in range(100):
        if high_value > -1e-3 * margin or high - low < 1e-14:
            break
        dt = low + (high - low) * low_value / (low_value - high_value)
        if iteration % 4 == 3:
            dt = 0.5 * (low + high)
        if not low < dt < high:
            break
        pressures_after(dt, fixed, w, table, y1)
        value = all_guards(t, y1, o, g) + margin
        if value < 0.0:
            high = dt
            high_value = value
            if side < 0:
                low_value *= 0.5
            side = -1
        else:
            low = dt
            low_value = value
            if side > 0:
                high_value *= 0.5
            side = 1
    pressures_after(high, fixed, w, table, y1)
    return high
