"""Right-hand side of the length stroke: stay, two sliding pistons, three chambers (3.53-3.68).

Chambers in a row B | piston 1 | N | piston 2 | F.  x_s is positive towards backward; x_1 and x_2
count inward from each piston's outer stop.  Forces below are in the direction of x_s.
"""

from __future__ import annotations

from math import exp, pi, sin

from plant.kernel.compiled import called, inlined
from plant.kernel.layout import (
    A_LARGE,
    A_OIL,
    A_SMALL,
    AIR_FRACTION,
    ALPHA_1,
    ALPHA_2,
    ALPHA_M1,
    ALPHA_M2,
    ALPHA_SPEED,
    ALPHA_SPEED_2,
    ALPHA_SPEED_M1,
    ALPHA_SPEED_M2,
    ALPHA_V0,
    AREA_P,
    AREA_S,
    ASYMMETRY,
    BETA_P,
    BETA_S,
    BUMP_FORCE,
    BUMP_WIDTH,
    BUMP_X,
    CD_FLOOR,
    CD_SLOPE,
    CDA_IN,
    CDA_OUT,
    COLLAR,
    DAMPER_DRAG,
    DETENT_FORCE,
    DETENT_WIDTH,
    F_EXTERNAL,
    F_LINKAGE,
    F_RUN_P,
    F_RUN_S,
    F_STATIC_P,
    F_STATIC_S,
    FLOW_MODEL,
    FREE,
    GAMMA,
    K_IN,
    K_OUT,
    KAPPA,
    LEAK_ATM,
    LEAK_PISTON,
    LENGTH_STATES,
    LINE_CDA,
    LINE_VOLUME,
    LLINE,
    LOIL,
    M_BLOCKED,
    M_CAPPED,
    M_DAMPER,
    M_JOINED1,
    M_JOINED2,
    M_LIFTED,
    M_LINE,
    M_OIL_REST,
    M_OPEN,
    M_P,
    M_PISTON1,
    M_PISTON2,
    M_S,
    M_SIDE,
    M_STAY,
    MESH_FORCE,
    NUT,
    P_ATM,
    P_SUPPLY,
    PB,
    PF,
    PN,
    PULL_FORCE,
    Q_ATMOSPHERE,
    Q_DAMPER,
    Q_EXTERNAL,
    Q_FRICTION,
    Q_GAS,
    Q_HEAT,
    Q_MASS_IN,
    Q_MASS_OUT,
    Q_WORK,
    R_AIR,
    R_HOLE,
    RHO_OIL,
    SEAL_MU,
    SPENT,
    SPRING_K,
    SPRING_X0,
    STRIBECK_V,
    STROKE,
    T_GAS,
    TERM_0,
    TERM_COUNT,
    TERM_EQUATION,
    TERM_LOW,
    TERM_STEP,
    TERM_VARIABLE,
    V1,
    V2,
    V_OIL,
    VOL_B,
    VOL_F,
    VOL_N,
    VS,
    W_MESH,
    W_PULL,
    X1,
    X2,
    X_FREE,
    X_HOLE,
    X_MESH,
    XS,
)
from plant.parts.chamber import pressure_rate
from plant.parts.damper import (
    borders,
    bulk_modulus,
    discharge_coefficient,
    holes_area,
    large_area,
    outflow,
    steady_difference,
)
from plant.parts.flow import charge, discharge, orifice
from plant.parts.friction import sliding
from plant.parts.synchronizer import barrier

# Bodies nearer than this touch.
TOUCH_M = 1e-9


@inlined
def term_value(p, variable):
    """Non-parametric term: nodes joined by straight lines, constant outside [unit of its equation]."""
    count = int(p[TERM_COUNT])
    place = (variable - p[TERM_LOW]) / p[TERM_STEP]
    if place <= 0.0:
        return p[TERM_0]
    if place >= count - 1:
        return p[TERM_0 + count - 1]
    k = int(place)
    w = place - k
    return (1.0 - w) * p[TERM_0 + k] + w * p[TERM_0 + k + 1]


@inlined
def valve_flow_in(pressure, supply, p, c):
    """Charge flow at u = 1 by the selected flow model, with the unit's factor [K kg/s].

    A non-parametric term of equation 6 changes it by a share that depends on P / P_s.
    """
    factor = p[K_IN]
    if p[TERM_EQUATION] == 6.0:
        factor *= max(0.0, 1.0 + term_value(p, pressure / supply))
    if p[FLOW_MODEL] == 0.0:
        return factor * charge(pressure, supply, c)
    return factor * orifice(supply, pressure, p[CDA_IN], p[T_GAS], p[GAMMA], p[R_AIR])


@inlined
def valve_flow_out(pressure, p, c):
    """Discharge flow at u = 0 by the selected flow model, with the unit's factor [K kg/s].

    A non-parametric term of equation 7 changes it by a share that depends on P / P_atm.
    """
    factor = p[K_OUT]
    if p[TERM_EQUATION] == 7.0:
        factor *= max(0.0, 1.0 + term_value(p, pressure / p[P_ATM]))
    if p[FLOW_MODEL] == 0.0:
        return factor * discharge(pressure, p[P_ATM], c)
    return factor * orifice(pressure, p[P_ATM], p[CDA_OUT], p[T_GAS], p[GAMMA], p[R_AIR])


@inlined
def leak_flow(upstream, downstream, cda, p):
    """Flow T m_dot of a leak from upstream to downstream [K kg/s]; none without an area."""
    if cda == 0.0:
        return 0.0
    return orifice(upstream, downstream, cda, p[T_GAS], p[GAMMA], p[R_AIR])


@inlined
def exponent_speed(speed, p):
    """Speed that the process exponents follow [m/s]: |v|, or v0 (1 - exp(-|v| / v0))."""
    v0 = p[ALPHA_V0]
    return speed if v0 == 0.0 else v0 * (1.0 - exp(-speed / v0))


@inlined
def direction_factor(direction, p):
    """Friction asymmetry: 1 + a towards +, 1 - a towards -."""
    return 1.0 + p[ASYMMETRY] * direction


@inlined
def extra_drag(x, direction, p):
    """Position-bound resistance on the stay [N]: gearbox barrier, bump, linkage, damper mount."""
    extra = p[F_LINKAGE] + p[DAMPER_DRAG]
    if p[MESH_FORCE] != 0.0 or p[PULL_FORCE] != 0.0:
        extra += barrier(
            x,
            direction,
            p[STROKE],
            p[MESH_FORCE],
            p[X_MESH],
            p[W_MESH],
            p[PULL_FORCE],
            p[W_PULL],
        )
    if p[BUMP_FORCE] != 0.0:
        d = (x - p[BUMP_X]) / p[BUMP_WIDTH]
        extra += p[BUMP_FORCE] * exp(-0.5 * d * d)
    return extra


@inlined
def term_drag(x, speed, p):
    """The non-parametric resistance of position (variable 1) or speed (2) [N]."""
    return term_value(p, x if p[TERM_VARIABLE] == 1.0 else speed)


@inlined
def stay_sliding(x, v, direction, p):
    """Sliding friction of the stay in its direction of motion [N], >= 0."""
    level = sliding(direction * v, p[F_STATIC_S], p[F_RUN_S], p[BETA_S], p[STRIBECK_V])
    level = level * direction_factor(direction, p) + extra_drag(x, direction, p)
    if p[TERM_EQUATION] == 5.0:
        level = max(0.0, level + term_drag(x, abs(v), p))
    return level


@inlined
def stay_static(x, direction, p):
    """Breakaway friction of the stay towards a direction [N]."""
    level = max(p[F_STATIC_S], p[F_RUN_S]) * direction_factor(direction, p)
    level += extra_drag(x, direction, p)
    if p[TERM_EQUATION] == 5.0:
        level = max(0.0, level + term_drag(x, 0.0, p))
    return level


@inlined
def seal_drag(difference_pa, p):
    """Friction of a piston seal grown by the pressure difference across it [N]."""
    return p[SEAL_MU] * abs(difference_pa) * p[AREA_P]


@inlined
def piston_sliding(v, direction, difference_pa, p):
    """Sliding friction of one piston [N]; v and direction are those of x_s."""
    level = sliding(direction * v, p[F_STATIC_P], p[F_RUN_P], p[BETA_P], p[STRIBECK_V])
    return level * direction_factor(direction, p) + seal_drag(difference_pa, p)


@inlined
def piston_static(direction, difference_pa, p):
    """Breakaway friction of one piston [N]."""
    level = max(p[F_STATIC_P], p[F_RUN_P]) * direction_factor(direction, p)
    return level + seal_drag(difference_pa, p)


@inlined
def conservative_force(x, p):
    """Spring, constant force and detent on the stay, in the direction of x [N]."""
    force = p[F_EXTERNAL] - p[SPRING_K] * (x - p[SPRING_X0])
    if p[DETENT_FORCE] != 0.0:
        stroke = p[STROKE]
        for k in range(-1, 2):
            d = (x - k * stroke) / p[DETENT_WIDTH]
            if abs(d) < 1.0:
                force -= p[DETENT_FORCE] * sin(pi * d)
    return force


@inlined
def damper_outlet(distance, speed, p):
    """Outlet area times discharge coefficient of the oil damper [m^2] at a distance and speed."""
    large = large_area(distance, p[A_LARGE], p[R_HOLE], p[X_HOLE])
    c_d = discharge_coefficient(large, p[A_LARGE], speed, p[CD_FLOOR], p[CD_SLOPE])
    return (p[A_SMALL] + large) * c_d


@inlined
def damper_outlet_beside(distance, speed, m, p):
    """The same on the sides of the law's corners where the modes stand, goes on smoothly beyond them."""
    r = p[R_HOLE]
    c = min(max(distance - p[X_HOLE], 0.0), 2.0 * r) - r
    large = p[A_LARGE]
    if m[M_CAPPED] == 0:
        large = holes_area(c, r) if m[M_OPEN] != 0 else 0.0
    c_d = large / p[A_LARGE] + p[CD_SLOPE] * speed if m[M_LIFTED] != 0 else p[CD_FLOOR]
    return (p[A_SMALL] + large) * c_d


@inlined
def damper_difference(distance, speed, oil_pa, m, p):
    """Pressure difference of the oil damper [Pa] by the model in force."""
    if m[M_DAMPER] == 1:
        outlet = damper_outlet_beside(distance, speed, m, p)
        return steady_difference(speed, p[A_OIL], outlet, 1.0, p[RHO_OIL])
    return oil_pa - p[P_ATM]


@inlined
def damper_borders(distance, speed, p):
    """`plant.parts.damper.borders` of this stroke's damper."""
    return borders(distance, speed, p[A_LARGE], p[R_HOLE], p[X_HOLE], p[CD_FLOOR], p[CD_SLOPE])


@inlined
def oil_rate(distance, speed, oil_pa, m, p):
    """dP_oil2/dt of the compressible damper [Pa/s] (3.31)."""
    kappa = bulk_modulus(oil_pa, p[KAPPA], p[AIR_FRACTION], p[P_ATM])
    outlet = damper_outlet_beside(distance, speed, m, p)
    out = outflow(oil_pa - p[P_ATM], outlet, 1.0, p[RHO_OIL])
    return kappa / (p[V_OIL] - p[A_OIL] * distance) * (p[A_OIL] * speed - out)


@inlined
def stay_force(y, m, p, t):
    """Net driving force on the stay without friction and contacts [N]."""
    x = y[XS]
    force = (y[PB] - y[PF]) * p[AREA_S] + conservative_force(x, p)
    if m[M_DAMPER] != 0:
        side = float(m[M_SIDE])
        force -= side * p[A_OIL] * damper_difference(side * x, side * y[VS], y[LOIL], m, p)
    if p[TERM_EQUATION] == 1.0:
        force += term_force(y, p, t)
    return force


@inlined
def term_force(y, p, t):
    """The non-parametric force: of time, position, or (as a resistance) of speed [N]."""
    kind = p[TERM_VARIABLE]
    if kind == 0.0:
        return term_value(p, t)
    if kind == 1.0:
        return term_value(p, y[XS])
    speed = y[VS]
    value = term_value(p, abs(speed))
    return -value if speed > 0.0 else (value if speed < 0.0 else 0.0)


@called
def net_forces(y, m, p, t, out):
    """Driving forces minus sliding friction of stay, piston 1, piston 2 -> out[0:3] [N].

    A body at rest gets its driving force alone.
    """
    d = m[M_STAY]
    stay = stay_force(y, m, p, t)
    if d != 0:
        stay -= d * stay_sliding(y[XS], y[VS], d, p)
    dp1 = y[PB] - y[PN]
    one = dp1 * p[AREA_P]
    d1 = m[M_PISTON1]
    if d1 != 0:
        one -= d1 * piston_sliding(y[V1], d1, dp1, p)
    dp2 = y[PF] - y[PN]
    two = -dp2 * p[AREA_P]
    d2 = m[M_PISTON2]
    if d2 != 0:
        two -= d2 * piston_sliding(-y[V2], d2, dp2, p)
    out[0] = stay
    out[1] = one
    out[2] = two


@inlined
def accelerations(m, p, force, out):
    """Accelerations in the direction of x_s of stay, piston 1, piston 2 -> out[0:3] [m/s^2]."""
    joined1 = m[M_JOINED1] != 0
    joined2 = m[M_JOINED2] != 0
    mass = p[M_S]
    total = force[0]
    if joined1:
        mass += p[M_P]
        total += force[1]
    if joined2:
        mass += p[M_P]
        total += force[2]
    a = total / mass if m[M_STAY] != 0 else 0.0
    per_mass = 1.0 / p[M_P]
    out[0] = a
    if joined1:
        out[1] = a
    else:
        out[1] = force[1] * per_mass if m[M_PISTON1] != 0 else 0.0
    if joined2:
        out[2] = a
    else:
        out[2] = force[2] * per_mass if m[M_PISTON2] != 0 else 0.0


@inlined
def touching(gap, p):
    """Contact of stay and piston at this gap: NUT, COLLAR or FREE."""
    if gap <= TOUCH_M:
        return NUT
    return COLLAR if gap >= p[X_FREE] - TOUCH_M else FREE


@inlined
def blocked_force(y, m, p, force):
    """Driving force of the stay and of the pistons at rest on it against the synchronizer [N].

    Positive outward; without friction, as the static friction's share is not determined.
    """
    total = force[0]
    if m[M_PISTON1] == 0:
        contact = touching(y[X1] - y[XS], p)
        if (contact == NUT and force[1] < 0.0) or (contact == COLLAR and force[1] > 0.0):
            total += force[1]
    if m[M_PISTON2] == 0:
        contact = touching(y[X2] + y[XS], p)
        if (contact == NUT and force[2] > 0.0) or (contact == COLLAR and force[2] < 0.0):
            total += force[2]
    return total * m[M_BLOCKED]


@inlined
def length_volumes(y, p):
    """Volumes of chambers B, N and F [m^3]."""
    area = p[AREA_P]
    area_s = p[AREA_S]
    return (
        p[VOL_B] + area * y[X1] + area_s * y[XS],
        p[VOL_N] - area * (y[X1] + y[X2]),
        p[VOL_F] + area * y[X2] - area_s * y[XS],
    )


@called
def rates(t, y, dy, m, u0, du, p, c, work, quadratures):
    """Time derivatives of the length stroke -> dy; with `quadratures`, those behind the states."""
    force = work[0:3]
    acc = work[3:6]
    net_forces(y, m, p, t, force)
    accelerations(m, p, force, acc)
    vs = y[VS]
    v1 = y[V1]
    v2 = y[V2]
    dy[XS] = vs
    dy[VS] = acc[0]
    dy[X1] = v1
    dy[V1] = acc[1]
    dy[X2] = v2
    dy[V2] = -acc[2]
    area = p[AREA_P]
    area_s = p[AREA_S]
    vol_b, vol_n, vol_f = length_volumes(y, p)
    rate_b = area * v1 + area_s * vs
    rate_n = -area * (v1 + v2)
    rate_f = area * v2 - area_s * vs
    ub = u0[0] + du[0] * t
    un = u0[1] + du[1] * t
    uf = u0[2] + du[2] * t
    supply = y[LLINE] if m[M_LINE] != 0 else p[P_SUPPLY]
    in_b = valve_flow_in(y[PB], supply, p, c) if ub > 0.0 else 0.0
    in_n = valve_flow_in(y[PN], supply, p, c) if un > 0.0 else 0.0
    in_f = valve_flow_in(y[PF], supply, p, c) if uf > 0.0 else 0.0
    out_b = valve_flow_out(y[PB], p, c) if ub < 1.0 else 0.0
    out_n = valve_flow_out(y[PN], p, c) if un < 1.0 else 0.0
    out_f = valve_flow_out(y[PF], p, c) if uf < 1.0 else 0.0
    leak_b = 0.0
    leak_n = 0.0
    leak_f = 0.0
    if p[LEAK_PISTON] != 0.0:
        one = leak_flow(y[PB], y[PN], p[LEAK_PISTON], p)
        two = leak_flow(y[PF], y[PN], p[LEAK_PISTON], p)
        leak_b -= one
        leak_f -= two
        leak_n += one + two
    if p[LEAK_ATM] != 0.0:
        leak_b -= ub * leak_flow(y[PB], p[P_ATM], p[LEAK_ATM], p)
        leak_n -= un * leak_flow(y[PN], p[P_ATM], p[LEAK_ATM], p)
        leak_f -= uf * leak_flow(y[PF], p[P_ATM], p[LEAK_ATM], p)
    if p[TERM_EQUATION] == 8.0:
        leak_b -= term_value(p, y[PB])
        leak_n -= term_value(p, y[PN])
        leak_f -= term_value(p, y[PF])
    elif p[TERM_EQUATION] >= 2.0 and p[TERM_EQUATION] <= 4.0:
        kind = p[TERM_VARIABLE]
        which = int(p[TERM_EQUATION]) - 2
        own = y[PB] if which == 0 else (y[PN] if which == 1 else y[PF])
        flow = term_value(p, t if kind == 0.0 else (y[XS] if kind == 1.0 else own))
        if which == 0:
            leak_b += flow
        elif which == 1:
            leak_n += flow
        else:
            leak_f += flow
    r = p[R_AIR]
    am1 = p[ALPHA_M1]
    am2 = p[ALPHA_M2]
    a1 = p[ALPHA_1]
    a2 = p[ALPHA_2]
    speed = max(abs(vs), abs(v1), abs(v2))
    effective = exponent_speed(speed, p)
    am1 += p[ALPHA_SPEED_M1] * effective
    a1 += p[ALPHA_SPEED] * effective
    am2 += p[ALPHA_SPEED_M2] * effective
    a2 += p[ALPHA_SPEED_2] * effective
    if p[TERM_EQUATION] == 9.0:
        shift = term_value(p, speed)
        a1 += shift
        a2 += shift
    dy[PB] = pressure_rate(y[PB], ub, in_b, out_b, leak_b, vol_b, rate_b, r, am1, a1, am2, a2)
    dy[PN] = pressure_rate(y[PN], un, in_n, out_n, leak_n, vol_n, rate_n, r, am1, a1, am2, a2)
    dy[PF] = pressure_rate(y[PF], uf, in_f, out_f, leak_f, vol_f, rate_f, r, am1, a1, am2, a2)
    dy[SPENT] = max(0.0, blocked_force(y, m, p, force)) if m[M_BLOCKED] != 0 else 0.0
    if m[M_DAMPER] == 2 and m[M_OIL_REST] == 0:
        side = float(m[M_SIDE])
        dy[LOIL] = oil_rate(side * y[XS], side * vs, y[LOIL], m, p)
    else:
        dy[LOIL] = 0.0
    if m[M_LINE] != 0:
        drawn = ub * in_b + un * in_n + uf * in_f
        feed = orifice(p[P_SUPPLY], y[LLINE], p[LINE_CDA], p[T_GAS], p[GAMMA], r)
        dy[LLINE] = r / p[LINE_VOLUME] * (feed - drawn)
    else:
        dy[LLINE] = 0.0
    if quadratures:
        q = dy[LENGTH_STATES:]
        q[Q_GAS] = r * (am1 * ub * in_b - am2 * (1.0 - ub) * out_b + leak_b)
        q[Q_GAS + 1] = r * (am1 * un * in_n - am2 * (1.0 - un) * out_n + leak_n)
        q[Q_GAS + 2] = r * (am1 * uf * in_f - am2 * (1.0 - uf) * out_f + leak_f)
        q[Q_WORK] = y[PB] * rate_b
        q[Q_WORK + 1] = y[PN] * rate_n
        q[Q_WORK + 2] = y[PF] * rate_f
        q[Q_HEAT] = (1.0 - (ub * a1 + (1.0 - ub) * a2)) * y[PB] * rate_b
        q[Q_HEAT + 1] = (1.0 - (un * a1 + (1.0 - un) * a2)) * y[PN] * rate_n
        q[Q_HEAT + 2] = (1.0 - (uf * a1 + (1.0 - uf) * a2)) * y[PF] * rate_f
        temperature = p[T_GAS]
        q[Q_MASS_IN] = ub * in_b / temperature
        q[Q_MASS_IN + 1] = un * in_n / temperature
        q[Q_MASS_IN + 2] = uf * in_f / temperature
        q[Q_MASS_OUT] = (1.0 - ub) * out_b / temperature
        q[Q_MASS_OUT + 1] = (1.0 - un) * out_n / temperature
        q[Q_MASS_OUT + 2] = (1.0 - uf) * out_f / temperature
        d = m[M_STAY]
        loss = stay_sliding(y[XS], vs, d, p) * d * vs if d != 0 else 0.0
        d = m[M_PISTON1]
        if d != 0:
            loss += piston_sliding(v1, d, y[PB] - y[PN], p) * d * v1
        d = m[M_PISTON2]
        if d != 0:
            loss -= piston_sliding(-v2, d, y[PF] - y[PN], p) * d * v2
        q[Q_FRICTION] = loss
        if m[M_DAMPER] != 0:
            side = float(m[M_SIDE])
            q[Q_DAMPER] = (
                side * vs * p[A_OIL] * damper_difference(side * y[XS], side * vs, y[LOIL], m, p)
            )
        else:
            q[Q_DAMPER] = 0.0
        q[Q_EXTERNAL] = conservative_force(y[XS], p) * vs
        if p[TERM_EQUATION] == 1.0:
            q[Q_EXTERNAL] += term_force(y, p, t) * vs
        q[Q_ATMOSPHERE] = 0.0
