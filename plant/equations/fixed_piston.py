"""The fixed-piston actuator: right-hand side, guards and resets (thesis 3.46-3.52 with errata).

V1 = V10 + A1 x, V2 = V20 - A2 x, 0 <= x <= stroke; the parts are those of the length stroke.
"""

from __future__ import annotations

from plant.equations.length_contacts import (
    EPS_M,
    EPS_M_S,
    EPS_N,
    EPS_PA,
    FAR,
    G_HOLD_STAY,
    G_OIL_EMPTY,
    G_OIL_FILL,
    G_STAY_HIGH,
    G_STAY_LOW,
    G_STAY_SPEED,
    GUARDS,
    TOUCH_M,
    damper_corners,
    note_corners,
    put,
)
from plant.equations.length_impacts import direction_of, group_acceleration, rebound
from plant.equations.length_stroke import (
    conservative_force,
    damper_difference,
    exponent_speed,
    leak_flow,
    oil_rate,
    stay_sliding,
    stay_static,
    term_value,
    valve_flow_in,
    valve_flow_out,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import (
    A_OIL,
    ALPHA_1,
    ALPHA_2,
    ALPHA_M1,
    ALPHA_M2,
    ALPHA_SPEED,
    ALPHA_SPEED_2,
    ALPHA_SPEED_M1,
    ALPHA_SPEED_M2,
    AREA_P,
    AREA_P2,
    AREA_S,
    FIXED_STATES,
    FLINE,
    FOIL,
    FP1,
    FP2,
    FV,
    FX,
    GAMMA,
    LEAK_ATM,
    LEAK_PISTON,
    LINE_CDA,
    LINE_VOLUME,
    M_DAMPER,
    M_LINE,
    M_OIL_REST,
    M_S,
    M_STAY,
    P_ATM,
    P_SUPPLY,
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
    SEAL_MU,
    STOP_OFFSET,
    STROKE,
    T_GAS,
    TERM_EQUATION,
    TERM_VARIABLE,
    VOL_B,
    VOL_N,
)
from plant.parts.chamber import pressure_rate
from plant.parts.flow import orifice


@inlined
def fixed_drive(y, m, p, t):
    """Driving force on the piston without friction [N]: P1 A1 - P2 A2 - P_atm A_s + loads."""
    force = y[FP1] * p[AREA_P] - y[FP2] * p[AREA_P2] - p[P_ATM] * p[AREA_S]
    force += conservative_force(y[FX], p)
    if m[M_DAMPER] != 0:
        force -= p[A_OIL] * damper_difference(y[FX], y[FV], y[FOIL], m, p)
    if p[TERM_EQUATION] == 1.0:
        force += fixed_term(y, p, t)
    return force


@inlined
def fixed_term(y, p, t):
    """The non-parametric force: of time, position, or (as a resistance) of speed [N]."""
    kind = p[TERM_VARIABLE]
    if kind == 0.0:
        return term_value(p, t)
    if kind == 1.0:
        return term_value(p, y[FX])
    value = term_value(p, abs(y[FV]))
    return -value if y[FV] > 0.0 else (value if y[FV] < 0.0 else 0.0)


@inlined
def seal(y, p):
    """Seal friction from the pressure difference across the piston [N]."""
    return p[SEAL_MU] * abs(y[FP1] - y[FP2]) * p[AREA_P]


@inlined
def fixed_volumes(y, p):
    """Volumes of chambers 1 and 2 [m^3]: V10 + A1 x, V20 - A2 x."""
    return p[VOL_B] + p[AREA_P] * y[FX], p[VOL_N] - p[AREA_P2] * y[FX]


@called
def fixed_rates(t, y, dy, m, u0, du, p, c, quadratures):
    """Time derivatives of the fixed piston -> dy; with `quadratures`, those behind the states."""
    v = y[FV]
    d = m[M_STAY]
    a = 0.0
    if d != 0:
        friction = stay_sliding(y[FX], v, d, p) + seal(y, p)
        a = (fixed_drive(y, m, p, t) - d * friction) / p[M_S]
    dy[FX] = v
    dy[FV] = a
    u1 = u0[0] + du[0] * t
    u2 = u0[1] + du[1] * t
    supply = y[FLINE] if m[M_LINE] != 0 else p[P_SUPPLY]
    in1 = valve_flow_in(y[FP1], supply, p, c) if u1 > 0.0 else 0.0
    in2 = valve_flow_in(y[FP2], supply, p, c) if u2 > 0.0 else 0.0
    out1 = valve_flow_out(y[FP1], p, c) if u1 < 1.0 else 0.0
    out2 = valve_flow_out(y[FP2], p, c) if u2 < 1.0 else 0.0
    leak1 = 0.0
    leak2 = 0.0
    if p[LEAK_PISTON] != 0.0:
        across = leak_flow(y[FP1], y[FP2], p[LEAK_PISTON], p)
        leak1 -= across
        leak2 += across
    if p[LEAK_ATM] != 0.0:
        leak1 -= u1 * leak_flow(y[FP1], p[P_ATM], p[LEAK_ATM], p)
        leak2 -= u2 * leak_flow(y[FP2], p[P_ATM], p[LEAK_ATM], p)
    if p[TERM_EQUATION] == 8.0:
        leak1 -= term_value(p, y[FP1])
        leak2 -= term_value(p, y[FP2])
    elif p[TERM_EQUATION] >= 2.0 and p[TERM_EQUATION] <= 4.0:
        kind = p[TERM_VARIABLE]
        first = p[TERM_EQUATION] == 2.0
        own = y[FP1] if first else y[FP2]
        flow = term_value(p, t if kind == 0.0 else (y[FX] if kind == 1.0 else own))
        if first:
            leak1 += flow
        else:
            leak2 += flow
    r = p[R_AIR]
    effective = exponent_speed(abs(v), p)
    am1 = p[ALPHA_M1] + p[ALPHA_SPEED_M1] * effective
    am2 = p[ALPHA_M2] + p[ALPHA_SPEED_M2] * effective
    a1 = p[ALPHA_1] + p[ALPHA_SPEED] * effective
    a2 = p[ALPHA_2] + p[ALPHA_SPEED_2] * effective
    if p[TERM_EQUATION] == 9.0:
        shift = term_value(p, abs(v))
        a1 += shift
        a2 += shift
    vol1, vol2 = fixed_volumes(y, p)
    rate1 = p[AREA_P] * v
    rate2 = -p[AREA_P2] * v
    dy[FP1] = pressure_rate(y[FP1], u1, in1, out1, leak1, vol1, rate1, r, am1, a1, am2, a2)
    dy[FP2] = pressure_rate(y[FP2], u2, in2, out2, leak2, vol2, rate2, r, am1, a1, am2, a2)
    if m[M_DAMPER] == 2 and m[M_OIL_REST] == 0:
        dy[FOIL] = oil_rate(y[FX], v, y[FOIL], m, p)
    else:
        dy[FOIL] = 0.0
    if m[M_LINE] != 0:
        feed = orifice(p[P_SUPPLY], y[FLINE], p[LINE_CDA], p[T_GAS], p[GAMMA], r)
        dy[FLINE] = r / p[LINE_VOLUME] * (feed - u1 * in1 - u2 * in2)
    else:
        dy[FLINE] = 0.0
    if quadratures:
        q = dy[FIXED_STATES:]
        q[Q_GAS] = r * (am1 * u1 * in1 - am2 * (1.0 - u1) * out1 + leak1)
        q[Q_GAS + 1] = r * (am1 * u2 * in2 - am2 * (1.0 - u2) * out2 + leak2)
        q[Q_GAS + 2] = 0.0
        q[Q_HEAT] = (1.0 - (u1 * a1 + (1.0 - u1) * a2)) * y[FP1] * rate1
        q[Q_HEAT + 1] = (1.0 - (u2 * a1 + (1.0 - u2) * a2)) * y[FP2] * rate2
        q[Q_HEAT + 2] = 0.0
        q[Q_WORK] = y[FP1] * rate1
        q[Q_WORK + 1] = y[FP2] * rate2
        q[Q_WORK + 2] = 0.0
        q[Q_MASS_IN] = u1 * in1 / p[T_GAS]
        q[Q_MASS_IN + 1] = u2 * in2 / p[T_GAS]
        q[Q_MASS_IN + 2] = 0.0
        q[Q_MASS_OUT] = (1.0 - u1) * out1 / p[T_GAS]
        q[Q_MASS_OUT + 1] = (1.0 - u2) * out2 / p[T_GAS]
        q[Q_MASS_OUT + 2] = 0.0
        q[Q_FRICTION] = (stay_sliding(y[FX], v, d, p) + seal(y, p)) * d * v if d != 0 else 0.0
        q[Q_DAMPER] = 0.0
        if m[M_DAMPER] != 0:
            q[Q_DAMPER] = v * p[A_OIL] * damper_difference(y[FX], v, y[FOIL], m, p)
        q[Q_EXTERNAL] = conservative_force(y[FX], p) * v
        if p[TERM_EQUATION] == 1.0:
            q[Q_EXTERNAL] += fixed_term(y, p, t) * v
        q[Q_ATMOSPHERE] = -p[P_ATM] * p[AREA_S] * v


@called
def fixed_guards(t, y, m, p, g):
    """Guards of the present modes -> g[0:GUARDS]; each is positive until its event.  Returns the lowest."""
    low = FAR
    for k in range(GUARDS):
        g[k] = low
    high = p[STROKE] + p[STOP_OFFSET]
    d = m[M_STAY]
    if d != 0:
        low = put(g, G_STAY_SPEED, d * y[FV] + EPS_M_S, low)
        if d > 0:
            low = put(g, G_STAY_HIGH, high - y[FX] + EPS_M, low)
        else:
            low = put(g, G_STAY_LOW, y[FX] + EPS_M, low)
    else:
        drive = fixed_drive(y, m, p, t)
        hold = FAR
        if y[FX] < high - TOUCH_M:
            hold = stay_static(y[FX], 1.0, p) + seal(y, p) - drive
        if y[FX] > TOUCH_M:
            hold = min(hold, stay_static(y[FX], -1.0, p) + seal(y, p) + drive)
        low = put(g, G_HOLD_STAY, hold + EPS_N, low)
    if m[M_DAMPER] != 0 and d != 0:
        low = damper_corners(y[FX], y[FV], m, p, g, low)
    if m[M_DAMPER] == 2:
        if m[M_OIL_REST] != 0:
            if d != 0:
                low = put(g, G_OIL_FILL, EPS_M_S - y[FV], low)
        else:
            low = put(g, G_OIL_EMPTY, y[FOIL] - p[P_ATM] + EPS_PA, low)
    return low


@called
def fixed_impacts(y, m, p, record):
    """Resolve an end stop; record[0] energy lost [J], record[1] impact speed [m/s]."""
    record[0] = 0.0
    record[1] = 0.0
    record[2] = 0.0
    high = p[STROKE] + p[STOP_OFFSET]
    hit = False
    if y[FX] >= high - TOUCH_M and y[FV] > 0.0:
        y[FX] = high
        hit = True
    elif y[FX] <= TOUCH_M and y[FV] < 0.0:
        y[FX] = 0.0
        hit = True
    if hit:
        after = rebound(y[FV], p)
        record[0] = 0.5 * p[M_S] * (y[FV] * y[FV] - after * after)
        record[1] = abs(y[FV])
        y[FV] = after


@called
def fixed_settle(t, y, m, p):
    """Choose the mode that continues the motion: at rest, or moving, and the damper's."""
    m[M_STAY] = 0
    if m[M_DAMPER] != 0:
        note_corners(y[FX], y[FV], m, p)
    drive = fixed_drive(y, m, p, t)
    drag = seal(y, p)
    high = p[STROKE] + p[STOP_OFFSET]
    a = group_acceleration(
        y[FV],
        drive,
        stay_static(y[FX], 1.0, p) + drag,
        stay_static(y[FX], -1.0, p) + drag,
        stay_sliding(y[FX], y[FV], 1.0, p) + drag,
        stay_sliding(y[FX], y[FV], -1.0, p) + drag,
        p[M_S],
        y[FX] >= high - TOUCH_M,
        y[FX] <= TOUCH_M,
    )
    m[M_STAY] = direction_of(y[FV], a)
    if m[M_DAMPER] == 2:
        m[M_OIL_REST] = 0
        if y[FOIL] <= p[P_ATM] + EPS_PA:
            y[FOIL] = p[P_ATM]
            m[M_OIL_REST] = 0 if m[M_STAY] > 0 else 1
