"""Resets of the length stroke: impacts, and the modes that continue the motion (see `length_contacts`)."""

from __future__ import annotations

from plant.equations.length_contacts import (
    EPS_PA,
    end_stop,
    note_corners,
    note_side,
    sign_ahead,
    stay_limits,
)
from plant.equations.length_stroke import (
    TOUCH_M,
    net_forces,
    piston_sliding,
    piston_static,
    stay_sliding,
    stay_static,
    touching,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import (
    COLLAR,
    FREE,
    LOIL,
    M_BLOCKED,
    M_DAMPER,
    M_JOINED1,
    M_JOINED2,
    M_OIL_REST,
    M_P,
    M_PISTON1,
    M_PISTON2,
    M_S,
    M_SIDE,
    M_STAY,
    NUT,
    P_ATM,
    PB,
    PF,
    PN,
    RESTITUTION,
    SPENT,
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

# A rebound slower than this is a stop: the end of a Zeno sequence.
REST_M_S = 1e-4
# Equal velocities of touching bodies, up to rounding.
SAME_M_S = 1e-10
# Touching bodies that part slower than this, and would meet again, stay together: the end of a
# Zeno sequence of contacts.
SLOW_M_S = 1e-5


@inlined
def meets(contact, relative, slow):
    """True if touching bodies change their velocities: they close, or part too slowly to count.

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
    vs = y[VS]
    w1 = y[V1]
    w2 = -y[V2]
    before = p[M_S] * vs * vs + p[M_P] * (w1 * w1 + w2 * w2)
    if which == 1:
        v = (p[M_S] * vs + p[M_P] * w1) / (p[M_S] + p[M_P])
        contact = touching(y[X2] + y[XS], p)
        both = contact != FREE and sign_ahead(2, contact) * (w2 - v) < slow
    else:
        v = (p[M_S] * vs + p[M_P] * w2) / (p[M_S] + p[M_P])
        contact = touching(y[X1] - y[XS], p)
        both = contact != FREE and sign_ahead(1, contact) * (w1 - v) < slow
    if both:
        v = (p[M_S] * vs + p[M_P] * (w1 + w2)) / (p[M_S] + 2.0 * p[M_P])
    if both or which == 1:
        y[V1] = v
    if both or which == 2:
        y[V2] = -v
    y[VS] = v
    after = p[M_S] * v * v + p[M_P] * (y[V1] * y[V1] + y[V2] * y[V2])
    return 0.5 * (before - after)


@inlined
def rebound(v, p):
    """Velocity after a stop: -e v, or 0 when slower than a rebound that counts."""
    after = -p[RESTITUTION] * v
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
        p[M_P],
        stop_plus,
        stop_minus,
    )


@called
def slow_partings(t, y, m, p, work):
    """Speeds below which pistons 1 and 2 do not count as parting from the stay [m/s].

    SLOW_M_S where the accelerations, each body alone, would close the contact again; else 0.
    """
    m[M_STAY] = 0
    m[M_PISTON1] = 0
    m[M_PISTON2] = 0
    force = work[0:3]
    net_forces(y, m, p, t, force)
    high, low = stay_limits(y, m, p)
    a = group_acceleration(
        y[VS],
        force[0],
        stay_static(y[XS], 1.0, p),
        stay_static(y[XS], -1.0, p),
        stay_sliding(y[XS], y[VS], 1.0, p),
        stay_sliding(y[XS], y[VS], -1.0, p),
        p[M_S],
        y[XS] >= high - TOUCH_M,
        y[XS] <= low + TOUCH_M,
    )
    a1 = lone_piston(y[V1], force[1], y[PB] - y[PN], False, y[X1] <= TOUCH_M, p)
    a2 = lone_piston(-y[V2], force[2], y[PF] - y[PN], y[X2] <= TOUCH_M, False, p)
    c1 = touching(y[X1] - y[XS], p)
    c2 = touching(y[X2] + y[XS], p)
    slow1 = SLOW_M_S if c1 != FREE and sign_ahead(1, c1) * (a1 - a) < 0.0 else 0.0
    slow2 = SLOW_M_S if c2 != FREE and sign_ahead(2, c2) * (a2 - a) < 0.0 else 0.0
    return slow1, slow2


@called
def impacts(t, y, m, p, record, work):
    """Resolve all closing contacts and stops at this instant; record[0] energy lost [J],
    record[1] speed of the stay into an end stop, record[2] 1 if it was the synchronizer.

    Leaves the bodies' modes of motion to `settle`.
    """
    slow1, slow2 = slow_partings(t, y, m, p, work)
    record[0] = 0.0
    record[1] = 0.0
    record[2] = 0.0
    for _ in range(12):
        high, low = stay_limits(y, m, p)
        again = False
        held = 0.0
        # pistons on their outer stops
        if y[X1] <= TOUCH_M and y[V1] < 0.0:
            y[X1] = 0.0
            after = rebound(y[V1], p)
            record[0] += 0.5 * p[M_P] * (y[V1] * y[V1] - after * after)
            y[V1] = after
            again = True
        if y[X2] <= TOUCH_M and y[V2] < 0.0:
            y[X2] = 0.0
            after = rebound(y[V2], p)
            record[0] += 0.5 * p[M_P] * (y[V2] * y[V2] - after * after)
            y[V2] = after
            again = True
        # the stay on its stops
        if y[XS] >= high - TOUCH_M and y[VS] > 0.0:
            held = 1.0
            y[XS] = high
        elif y[XS] <= low + TOUCH_M and y[VS] < 0.0:
            held = -1.0
            y[XS] = low
        # neutral: a piston at rest on its outer stop is as fixed as the housing
        elif y[VS] < 0.0 and y[X2] + y[XS] <= TOUCH_M and y[X2] <= TOUCH_M and y[V2] <= 0.0:
            held = -2.0
            y[XS] = 0.0
            y[X2] = 0.0
        elif y[VS] > 0.0 and y[X1] - y[XS] <= TOUCH_M and y[X1] <= TOUCH_M and y[V1] <= 0.0:
            held = 2.0
            y[XS] = 0.0
            y[X1] = 0.0
        if held != 0.0:
            at_block = abs(held) == 1.0 and abs(y[XS]) < end_stop(p) - TOUCH_M
            after = 0.0 if at_block else rebound(y[VS], p)
            record[0] += 0.5 * p[M_S] * (y[VS] * y[VS] - after * after)
            if abs(y[VS]) > record[1]:
                record[1] = abs(y[VS])
                record[2] = 1.0 if at_block else 0.0
            y[VS] = after
            again = True
        # contacts of stay and pistons
        relative = y[V1] - y[VS]
        if meets(touching(y[X1] - y[XS], p), relative, slow1):
            stopped = (
                (y[XS] >= high - TOUCH_M and relative > 0.0)
                or (y[XS] <= low + TOUCH_M and relative < 0.0)
                or (relative < 0.0 and y[X2] + y[XS] <= TOUCH_M and y[X2] <= TOUCH_M)
                or abs(relative) < slow1
            ) and y[VS] == 0.0
            if stopped:
                record[0] += 0.5 * p[M_P] * y[V1] * y[V1]
                y[V1] = 0.0
            else:
                record[0] += join_velocity(y, p, 1, slow2)
            again = True
        relative = y[VS] + y[V2]
        if meets(touching(y[X2] + y[XS], p), relative, slow2):
            stopped = (
                (y[XS] <= low + TOUCH_M and relative > 0.0)
                or (y[XS] >= high - TOUCH_M and relative < 0.0)
                or (relative < 0.0 and y[X1] - y[XS] <= TOUCH_M and y[X1] <= TOUCH_M)
                or abs(relative) < slow2
            ) and y[VS] == 0.0
            if stopped:
                record[0] += 0.5 * p[M_P] * y[V2] * y[V2]
                y[V2] = 0.0
            else:
                record[0] += join_velocity(y, p, 2, slow1)
            again = True
        if not again:
            break


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
    before = m[M_SIDE]
    if abs(y[XS]) > TOUCH_M:
        m[M_SIDE] = 1 if y[XS] > 0.0 else -1
    elif m[M_STAY] != 0:
        m[M_SIDE] = m[M_STAY]
    elif before == 0:
        m[M_SIDE] = 1
    side = float(m[M_SIDE])
    note_corners(side * y[XS], side * y[VS], m, p)
    if m[M_DAMPER] == 2:
        if before != 0 and m[M_SIDE] != before:
            y[LOIL] = p[P_ATM]
        m[M_OIL_REST] = 0
        if y[LOIL] <= p[P_ATM] + EPS_PA:
            y[LOIL] = p[P_ATM]
            m[M_OIL_REST] = 0 if m[M_STAY] * m[M_SIDE] > 0 else 1


@called
def settle(t, y, m, p, work):
    """Choose the modes that continue the motion from here: who is joined, who rests, who moves.

    Bodies start apart; touching bodies whose accelerations (or pushes at rest) would close the
    contact are joined, until none closes; then those that would pull are parted (the
    one-dimensional contact problem, solved as pool-adjacent-violators does).  Friction at rest is
    set-valued; touching bodies that break away together are all sliding from there on.
    """
    force = work[0:3]
    note_side(y, m, p)
    if m[M_DAMPER] != 0:
        side = float(m[M_SIDE])
        note_corners(side * y[XS], side * y[VS], m, p)
    m[M_BLOCKED] = 0
    m[M_STAY] = 0
    m[M_PISTON1] = 0
    m[M_PISTON2] = 0
    net_forces(y, m, p, t, force)
    drive_s = force[0]
    drive1 = force[1]
    drive2 = force[2]
    high, low = stay_limits(y, m, p)
    gap1 = y[X1] - y[XS]
    gap2 = y[X2] + y[XS]
    same1 = abs(y[V1] - y[VS]) <= SAME_M_S
    same2 = abs(y[V2] + y[VS]) <= SAME_M_S
    touch1 = touching(gap1, p) if same1 else FREE
    touch2 = touching(gap2, p) if same2 else FREE
    c1 = FREE
    c2 = FREE
    pressure1 = y[PB] - y[PN]
    pressure2 = y[PF] - y[PN]
    a = 0.0
    a1 = 0.0
    a2 = 0.0
    for _ in range(3):
        drive = drive_s
        mass = p[M_S]
        cap_plus = stay_static(y[XS], 1.0, p)
        cap_minus = stay_static(y[XS], -1.0, p)
        stop_plus = y[XS] >= high - TOUCH_M
        stop_minus = y[XS] <= low + TOUCH_M
        run_plus = stay_sliding(y[XS], y[VS], 1.0, p)
        run_minus = stay_sliding(y[XS], y[VS], -1.0, p)
        if c1 != FREE:
            drive += drive1
            mass += p[M_P]
            cap_plus += piston_static(1.0, pressure1, p)
            cap_minus += piston_static(-1.0, pressure1, p)
            run_plus += piston_sliding(y[VS], 1.0, pressure1, p)
            run_minus += piston_sliding(y[VS], -1.0, pressure1, p)
            stop_minus = stop_minus or y[X1] <= TOUCH_M
        if c2 != FREE:
            drive += drive2
            mass += p[M_P]
            cap_plus += piston_static(1.0, pressure2, p)
            cap_minus += piston_static(-1.0, pressure2, p)
            run_plus += piston_sliding(y[VS], 1.0, pressure2, p)
            run_minus += piston_sliding(y[VS], -1.0, pressure2, p)
            stop_plus = stop_plus or y[X2] <= TOUCH_M
        a = group_acceleration(
            y[VS], drive, cap_plus, cap_minus, run_plus, run_minus, mass, stop_plus, stop_minus
        )
        a1 = lone_piston(y[V1], drive1, pressure1, False, y[X1] <= TOUCH_M, p)
        if c1 != FREE:
            a1 = a
        a2 = lone_piston(-y[V2], drive2, pressure2, y[X2] <= TOUCH_M, False, p)
        if c2 != FREE:
            a2 = a
        joined = False
        if c1 == FREE and touch1 != FREE and sign_ahead(1, touch1) * (a1 - a) < 0.0:
            c1 = touch1
            joined = True
        elif c2 == FREE and touch2 != FREE and sign_ahead(2, touch2) * (a2 - a) < 0.0:
            c2 = touch2
            joined = True
        if not joined:
            break
    # a contact that would have to pull is none: a piston that slides faster than the group leaves it
    d = direction_of(y[VS], a)
    for _ in range(2):
        if d == 0 or (c1 == FREE and c2 == FREE):
            break
        alone1 = (drive1 - d * piston_sliding(y[VS], d, pressure1, p)) / p[M_P]
        alone2 = (drive2 - d * piston_sliding(y[VS], d, pressure2, p)) / p[M_P]
        if c1 != FREE and sign_ahead(1, c1) * (alone1 - a) > 0.0:
            a1 = alone1
            c1 = FREE
        elif c2 != FREE and sign_ahead(2, c2) * (alone2 - a) > 0.0:
            a2 = alone2
            c2 = FREE
        else:
            break
        mass = p[M_S]
        a = drive_s - d * stay_sliding(y[XS], y[VS], d, p)
        if c1 != FREE:
            mass += p[M_P]
            a += p[M_P] * alone1
        if c2 != FREE:
            mass += p[M_P]
            a += p[M_P] * alone2
        a /= mass
        if y[VS] == 0.0 and d * a < 0.0:
            a = 0.0
    m[M_JOINED1] = c1
    m[M_JOINED2] = c2
    m[M_STAY] = direction_of(y[VS], a)
    m[M_PISTON1] = m[M_STAY] if c1 != FREE else direction_of(y[V1], a1)
    m[M_PISTON2] = m[M_STAY] if c2 != FREE else direction_of(-y[V2], a2)
    if c1 != FREE:
        y[X1] = y[XS] + (p[X_FREE] if c1 == COLLAR else 0.0)
        y[V1] = y[VS]
    if c2 != FREE:
        y[X2] = (p[X_FREE] if c2 == COLLAR else 0.0) - y[XS]
        y[V2] = -y[VS]
    # the stay was put on its stop: a piston that is just leaving it must not stand inside it
    y[X1] = min(max(y[X1], y[XS]), y[XS] + p[X_FREE])
    y[X2] = min(max(y[X2], -y[XS]), p[X_FREE] - y[XS])
    if m[M_STAY] == 0 and y[SPENT] < p[SYNC_IMPULSE]:
        if abs(y[XS] - p[X_BLOCK]) <= TOUCH_M:
            m[M_BLOCKED] = 1
        elif abs(y[XS] + p[X_BLOCK]) <= TOUCH_M:
            m[M_BLOCKED] = -1
    if m[M_DAMPER] != 0:
        settle_damper(y, m, p)
