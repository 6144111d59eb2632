"""Chambers that fill or empty while nothing moves: time and pressure in closed form.

With the volume at rest, mapped flow and no leaks, every chamber follows one of two curves, the same
for all volumes and supplies: with r = P/P_s (charging) or P/P_atm (discharging) and
d tau = |phi'(1)| alpha_m R k dt / V,   dr/d tau = +-phi(r)/|phi'(1)|.
Each curve is tabulated once per flow map, from the flow functions themselves; then a pressure is
a look-up at any later time.  Between the nodes: cubic Hermite, error below 1e-9.  Beyond the
table the flow is constant (below y_min) or the deviation decays as exp(-tau).

Checked by: tests/unit/plant/integrator/test_filling.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

from functools import lru_cache
from math import exp

import numpy as np

from plant.equations.fixed_piston import fixed_volumes
from plant.equations.length_stroke import length_volumes
from plant.kernel.compiled import called, inlined, kernel
from plant.kernel.layout import (
    ALPHA_M1,
    ALPHA_M2,
    C_SLOPE,
    C_Y_MIN,
    C_Y_SPLIT,
    D_SLOPE,
    D_Z_SPLIT,
    FP1,
    K_IN,
    K_OUT,
    P_ATM,
    P_SUPPLY,
    PB,
    R_AIR,
)
from plant.kernel.views import rows, view
from plant.parts.flow import charge, discharge

# One curve: head, then cells of its two regions, each with its own length: a cubic's coefficients.
CELLS_FAR, CELLS_NEAR = 256, 1536
(
    HEAD_START,
    HEAD_SPLIT,
    HEAD_END,
    HEAD_STEP_FAR,
    HEAD_STEP_NEAR,
    HEAD_CELLS_FAR,  # cells per unit of tau
    HEAD_CELLS_NEAR,
    HEAD_RATE,
    HEAD_SLOPE,  # dr/d tau at the start
) = range(9)
HEAD = 12
CUBIC = 4
FAR = HEAD
NEAR = FAR + CUBIC * CELLS_FAR
CURVE = NEAR + CUBIC * CELLS_NEAR
CHARGE, DISCHARGE = 0, CURVE
TABLE = 2 * CURVE
# Ratio P/P_atm at which the discharge curve starts, and how far the near regions reach.
Z_TOP = 16.0
NEAR_REACH = 20.0
SUBSTEPS = 8
# Places on a curve nearer than this share its tangent: an error of 1e-4 of their distance.
NEXT_TO = 1e-4
KNOWN_COLUMNS = 4

# How a chamber at rest goes on: constant, on a curve, or a deviation decaying to its reference.
STILL, ON_CHARGE, ON_DISCHARGE, DECAY, UNKNOWN = range(5)
W_KIND, W_TAU, W_RATE, W_REFERENCE = range(4)
CHAMBER_ROW = 4


@inlined
def slope_of(r, charging, c):
    """dr/d tau of the charge or the discharge curve, times its head's rate."""
    return charge(r, 1.0, c) if charging else -discharge(r, 1.0, c)


@called
def fill_cells(start, step, cells, charging, c, rate, out):
    """Cells of one region -> out, by classical Runge-Kutta; its end, 0 if the flow stops or turns.

    Cubic Hermite: r = c0 + w (c1 + w (c2 + w c3)) at the fraction w of a cell.
    """
    r = start
    h = step / SUBSTEPS
    sign = 1.0 if charging else -1.0
    left = 0.0
    left_slope = 0.0
    for node in range(cells + 1):
        slope = slope_of(r, charging, c) / rate
        if not (slope * sign > 0.0 and sign * (1.0 - r) > 0.0):
            return 0.0
        if node > 0:
            cubic = out[CUBIC * (node - 1) :]
            d = r - left
            s0 = step * left_slope
            s1 = step * slope
            cubic[0] = left
            cubic[1] = s0
            cubic[2] = 3.0 * d - 2.0 * s0 - s1
            cubic[3] = s0 + s1 - 2.0 * d
        left = r
        left_slope = slope
        if node == cells:
            break
        for _ in range(SUBSTEPS):
            k1 = slope_of(r, charging, c) / rate
            k2 = slope_of(r + 0.5 * h * k1, charging, c) / rate
            k3 = slope_of(r + 0.5 * h * k2, charging, c) / rate
            k4 = slope_of(r + h * k3, charging, c) / rate
            r += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return r


@called
def fill_curve(charging, c, curve):
    """One curve -> curve[0:CURVE]; False if the map is not a flow that ends at equal pressures."""
    start = c[C_Y_MIN] if charging else Z_TOP
    split = c[C_Y_SPLIT] if charging else c[D_Z_SPLIT]
    rate = abs(c[C_SLOPE] if charging else c[D_SLOPE])
    if not (rate > 0.0 and (start < split < 1.0 if charging else start > split > 1.0)):
        return False
    # length of the far region: Simpson's rule on d tau = rate dr / phi
    panels = 2048
    width = (split - start) / panels
    total = 0.0
    for k in range(panels):
        left = start + k * width
        # the last node belongs to the far region's polynomial
        right = min(left + width, split) if charging else max(left + width, split)
        right -= 1e-12 * width
        total += (
            width
            / 6.0
            * (
                1.0 / slope_of(left, charging, c)
                + 4.0 / slope_of(left + 0.5 * width, charging, c)
                + 1.0 / slope_of(right, charging, c)
            )
        )
    length = total * rate
    if not 0.0 < length < 1e3:
        return False
    curve[HEAD_START] = start
    curve[HEAD_SPLIT] = split
    curve[HEAD_STEP_FAR] = length / CELLS_FAR
    curve[HEAD_STEP_NEAR] = NEAR_REACH / CELLS_NEAR
    curve[HEAD_CELLS_FAR] = CELLS_FAR / length
    curve[HEAD_CELLS_NEAR] = CELLS_NEAR / NEAR_REACH
    curve[HEAD_RATE] = rate
    curve[HEAD_SLOPE] = slope_of(start, charging, c) / rate
    far = fill_cells(start, length / CELLS_FAR, CELLS_FAR, charging, c, rate, curve[FAR:])
    near = fill_cells(split, NEAR_REACH / CELLS_NEAR, CELLS_NEAR, charging, c, rate, curve[NEAR:])
    curve[HEAD_END] = near
    # the far region ends at the border itself, up to integration error
    return abs(far - split) < 1e-9 and near > 0.0


@kernel
def tabulate(c, table):
    """Both curves of a flow map -> table [TABLE]; False if it has no such curves.

    c : float64 [FLOW_COEFFICIENTS]
    """
    coefficients = view(c, 0)
    out = view(table, 0)
    return fill_curve(True, coefficients, out[CHARGE:]) and fill_curve(
        False, coefficients, out[DISCHARGE:]
    )


NO_CURVES = np.zeros(1)


@lru_cache(maxsize=64)
def _filling_curves(flow: bytes) -> tuple:
    table = np.zeros(TABLE)
    known = bool(tabulate(np.frombuffer(flow).copy(), table))
    return known, table if known else NO_CURVES


def filling_curves(c) -> tuple:
    """Whether a flow map has filling curves, and their table; tabulated once per map."""
    return _filling_curves(c.tobytes())


@inlined
def cubic(cells, place):
    """Ratio at a place, counted in cells."""
    cell = int(place)
    w = place - cell
    q = cells[CUBIC * cell :]
    return q[0] + w * (q[1] + w * (q[2] + w * q[3]))


@called
def curve_value(curve, tau):
    """Pressure ratio at tau; tau = 0 at the head of the table."""
    if tau < 0.0:
        return curve[HEAD_START] + tau * curve[HEAD_SLOPE]
    place = tau * curve[HEAD_CELLS_FAR]
    if place < CELLS_FAR:
        return cubic(curve[FAR:], place)
    tau -= curve[HEAD_STEP_FAR] * CELLS_FAR
    place = tau * curve[HEAD_CELLS_NEAR]
    if place < CELLS_NEAR:
        return cubic(curve[NEAR:], max(place, 0.0))
    return 1.0 + (curve[HEAD_END] - 1.0) * faded(tau - NEAR_REACH)


@inlined
def faded(x):
    """exp(-x) for x >= 0 to 2e-3, by its reciprocal's series: what is left behind the table is 2e-9."""
    return 1.0 / (
        1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x / 720)))))
    )


@called
def curve_place(curve, r):
    """tau at which the curve passes the ratio r: the inverse of curve_value.

    r must lie between the start of the curve (any lower for charging) and the end of its table.
    """
    start = curve[HEAD_START]
    split = curve[HEAD_SPLIT]
    sign = 1.0 if split > start else -1.0
    if sign * (r - start) < 0.0:
        return (r - start) / curve[HEAD_SLOPE]
    far = sign * (split - r) > 0.0
    cells = curve[FAR:] if far else curve[NEAR:]
    step = curve[HEAD_STEP_FAR] if far else curve[HEAD_STEP_NEAR]
    low = 0
    size = CELLS_FAR if far else CELLS_NEAR
    while size > 1:
        half = size // 2
        low = low + half if sign * (r - cells[CUBIC * (low + half)]) >= 0.0 else low
        size -= half
    q = cells[CUBIC * low :]
    w = (r - q[0]) / (q[1] + q[2] + q[3])
    for _ in range(3):
        w -= (q[0] + w * (q[1] + w * (q[2] + w * q[3])) - r) / (
            q[1] + w * (2.0 * q[2] + w * 3.0 * q[3])
        )
    return (low + w) * step + (0.0 if far else curve[HEAD_STEP_FAR] * CELLS_FAR)


@called
def chamber_curve(pressure, u, volume, p, table, out):
    """How one chamber at rest goes on -> out[0:CHAMBER_ROW]."""
    charging = u == 1.0
    curve = table[CHARGE:] if charging else table[DISCHARGE:]
    reference = p[P_SUPPLY] if charging else p[P_ATM]
    factor = p[ALPHA_M1] * p[K_IN] if charging else p[ALPHA_M2] * p[K_OUT]
    ratio = pressure / reference
    deviation = ratio - 1.0 if charging else 1.0 - ratio
    out[W_REFERENCE] = reference
    out[W_RATE] = curve[HEAD_RATE] * factor * p[R_AIR] / volume
    out[W_KIND] = UNKNOWN
    out[W_TAU] = 0.0
    if u != 1.0 and u != 0.0:
        return
    if abs(deviation) < 1e-14:
        out[W_KIND] = STILL
        out[W_REFERENCE] = pressure
    elif deviation > 0.0 or abs(deviation) <= abs(1.0 - curve[HEAD_END]):
        out[W_KIND] = DECAY
        out[W_TAU] = ratio - 1.0
    elif charging or ratio <= Z_TOP:
        out[W_KIND] = ON_CHARGE if charging else ON_DISCHARGE
        out[W_TAU] = curve_place(curve, ratio)


@inlined
def chamber_pressure(dt, row, table):
    """Pressure of a chamber a time dt after its row was written."""
    kind = row[W_KIND]
    if kind == STILL:
        return row[W_REFERENCE]
    if kind == DECAY:
        return row[W_REFERENCE] * (1.0 + row[W_TAU] * exp(-row[W_RATE] * dt))
    curve = table[CHARGE:] if kind == ON_CHARGE else table[DISCHARGE:]
    return row[W_REFERENCE] * curve_value(curve, row[W_TAU] + row[W_RATE] * dt)


@called
def chamber_samples(row, table, t, samples, begin, end, out, stride):
    """Pressures of a chamber at the samples from `begin` to `end` -> out[i * stride].

    t: when its row was written.  The same numbers as `chamber_pressure`, region by region.
    """
    kind = row[W_KIND]
    reference = row[W_REFERENCE]
    if kind in (STILL, DECAY):
        for i in range(begin, end):
            out[i * stride] = chamber_pressure(max(samples[i] - t, 0.0), row, table)
        return
    curve = table[CHARGE:] if kind == ON_CHARGE else table[DISCHARGE:]
    start = row[W_TAU]
    rate = row[W_RATE]
    i = begin
    while i < end and start + rate * max(samples[i] - t, 0.0) < 0.0:
        tau = start + rate * max(samples[i] - t, 0.0)
        out[i * stride] = reference * curve_value(curve, tau)
        i += 1
    cells = curve[FAR:]
    density = curve[HEAD_CELLS_FAR]
    while i < end:
        place = (start + rate * max(samples[i] - t, 0.0)) * density
        if not place < CELLS_FAR:
            break
        out[i * stride] = reference * cubic(cells, place)
        i += 1
    far = curve[HEAD_STEP_FAR] * CELLS_FAR
    cells = curve[NEAR:]
    density = curve[HEAD_CELLS_NEAR]
    while i < end:
        tau = start + rate * max(samples[i] - t, 0.0) - far
        place = tau * density
        if not place < CELLS_NEAR:
            break
        out[i * stride] = reference * cubic(cells, max(place, 0.0))
        i += 1
    while i < end:
        tau = start + rate * max(samples[i] - t, 0.0) - far
        out[i * stride] = reference * (1.0 + (curve[HEAD_END] - 1.0) * faded(tau - NEAR_REACH))
        i += 1


@called
def neighbour_samples(row, table, c, t, samples, begin, end, known, width, first, out, stride):
    """Pressures of a chamber at the samples from `begin` to `end` -> out[i * stride], from notes.

    The `first` of several like strokes evaluates its curve and notes kind, place, value and slope in
    known[i * width : i * width + 4]; the others, next to it, go along that slope.
    """
    kind = row[W_KIND]
    decays = kind == DECAY
    charging = kind == ON_CHARGE
    curve = table[CHARGE:] if charging else table[DISCHARGE:]
    reference = row[W_REFERENCE]
    start = 0.0 if decays else row[W_TAU]
    rate = row[W_RATE]
    scale = reference * row[W_TAU] if decays else reference
    offset = reference if decays else 0.0
    for i in range(begin, end):
        place = start + rate * max(samples[i] - t, 0.0)
        noted = known[i * width :]
        apart = place - noted[1]
        if not first and noted[0] == kind and abs(apart) < NEXT_TO:
            value = noted[2] + apart * noted[3]
        else:
            value = exp(-place) if decays else curve_value(curve, place)
        if first:
            slope = -value if decays else slope_of(value, charging, c) / curve[HEAD_RATE]
            noted[0] = kind
            noted[1] = place
            noted[2] = value
            noted[3] = slope
        out[i * stride] = offset + scale * value


@called
def chamber_curves(fixed, y, u0, p, table, w):
    """How every chamber goes on -> w; True if all are known."""
    chambers = rows(w, CHAMBER_ROW)
    if fixed:
        volumes = fixed_volumes(y, p)
        chamber_curve(y[FP1], u0[0], volumes[0], p, table, chambers[0])
        chamber_curve(y[FP1 + 1], u0[1], volumes[1], p, table, chambers[1])
        return chambers[0, W_KIND] != UNKNOWN and chambers[1, W_KIND] != UNKNOWN
    volumes = length_volumes(y, p)
    chamber_curve(y[PB], u0[0], volumes[0], p, table, chambers[0])
    chamber_curve(y[PB + 1], u0[1], volumes[1], p, table, chambers[1])
    chamber_curve(y[PB + 2], u0[2], volumes[2], p, table, chambers[2])
    return (
        chambers[0, W_KIND] != UNKNOWN
        and chambers[1, W_KIND] != UNKNOWN
        and chambers[2, W_KIND] != UNKNOWN
    )
