"""Chambers that fill or empty while nothing moves: their pressures over time, tabulated once per flow map.

With the volume at rest, mapped flow and no leaks, every chamber follows one of two curves, the same for all volumes and
supplies: with r = P/P_s (charging) or P/P_atm (discharging) and d tau = |phi'(1)| alpha_m R k dt / V,
dr/d tau = +-phi(r)/|phi'(1)|.  Between the nodes: cubic Hermite, error below 1e-9.  Beyond the table the flow is
constant (below y_min) or the deviation decays as exp(-tau).
"""

from __future__ import annotations

from functools import lru_cache
from math import exp

import numpy as np
from numpy.typing import NDArray

from plant.equations.fixed_piston import fixed_volumes
from plant.equations.length_stroke import length_volumes
from plant.kernel.compiled import called, inlined, kernel
from plant.kernel.layout import fixed_state, flow_map, length_state, parameters, pressures
from plant.kernel.records import Record, Value, block
from plant.kernel.views import named, view
from plant.parts.flow import charge, discharge

CELLS_FAR, CELLS_NEAR = 256, 1536
Floats = NDArray[np.float64]


class Curve(Record):
    """One curve: head, then the cells of its two regions, each a cubic's coefficients."""

    start: Value  # ratio and slope dr/d tau at the start
    slope: Value
    split: Value  # ratio at which the near region begins
    end: Value  # ratio at the end of the table
    step_far: Value  # length of a cell in tau
    step_near: Value
    cells_far: Value  # cells per unit of tau
    cells_near: Value
    rate: Value
    spare: Value = block(3)
    far: Value = block(CELLS_FAR, 4)
    near: Value = block(CELLS_NEAR, 4)


CURVE, TABLE = Curve.size, 2 * Curve.size
curve_of = named(Curve)
# Ratio P/P_atm at which the discharge curve starts, and how far the near regions reach.
Z_TOP, NEAR_REACH = 16.0, 20.0


@inlined
def curve_for(charging, table):
    """Return the charge or the discharge curve of a table."""
    return curve_of(table[0:] if charging else table[CURVE:])


@inlined
def slope_of(r, charging, c):
    """dr/d tau of the charge or the discharge curve, times its head's rate."""
    return charge(r, 1.0, c) if charging else -discharge(r, 1.0, c)


@called
def fill_cells(start, step, cells, charging, c, rate, out):
    """Cells r = c0 + w (c1 + w (c2 + w c3)) of a region -> out, by Runge-Kutta; its end, 0 if the flow stops or turns."""
    r = start
    substeps = 8
    h = step / substeps
    sign = 1.0 if charging else -1.0
    left = 0.0
    left_slope = 0.0
    for node in range(cells + 1):
        slope = slope_of(r, charging, c) / rate
        if not (slope * sign > 0.0 and sign * (1.0 - r) > 0.0):
            return 0.0
        if node > 0:
            cubic = out[node - 1]
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
        for _ in range(substeps):
            k1 = slope_of(r, charging, c) / rate
            k2 = slope_of(r + 0.5 * h * k1, charging, c) / rate
            k3 = slope_of(r + 0.5 * h * k2, charging, c) / rate
            k4 = slope_of(r + h * k3, charging, c) / rate
            r += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return r


@called
def fill_curve(charging, c, curve):
    """One curve -> curve; False if the map is not a flow that ends at equal pressures."""
    start = c.y_min if charging else Z_TOP
    split = c.y_split if charging else c.z_split
    rate = abs(c.charge_slope if charging else c.discharge_slope)
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
    curve.start = start
    curve.split = split
    curve.step_far = length / CELLS_FAR
    curve.step_near = NEAR_REACH / CELLS_NEAR
    curve.cells_far = CELLS_FAR / length
    curve.cells_near = CELLS_NEAR / NEAR_REACH
    curve.rate = rate
    curve.slope = slope_of(start, charging, c) / rate
    far = fill_cells(start, length / CELLS_FAR, CELLS_FAR, charging, c, rate, curve.far)
    near = fill_cells(split, NEAR_REACH / CELLS_NEAR, CELLS_NEAR, charging, c, rate, curve.near)
    curve.end = near
    # the far region ends at the border itself, up to integration error
    return abs(far - split) < 1e-9 and near > 0.0


@kernel
def tabulate(c, table):
    """Both curves of a flow map c [FlowMap.size] -> table [TABLE]; False if it has no such curves."""
    coefficients = flow_map(c)
    out = view(table, 0)
    return fill_curve(True, coefficients, curve_of(out)) and fill_curve(
        False, coefficients, curve_of(out[CURVE:])
    )


NO_CURVES = np.zeros(1)


@lru_cache(maxsize=64)
def _filling_curves(flow: bytes) -> NDArray[np.float64]:
    table = np.zeros(TABLE)
    return table if tabulate(np.frombuffer(flow).copy(), table) else NO_CURVES


def filling_curves(c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the filling curves [TABLE] of a flow map [FlowMap.size], cached; NO_CURVES if it, or several, have none."""
    return NO_CURVES if c.ndim == 2 and len(c) > 1 else _filling_curves(c.tobytes())


@inlined
def cubic(cells, position):
    """Ratio at a position on the curve, counted in cells."""
    cell = int(position)
    w = position - cell
    q = cells[cell]
    return q[0] + w * (q[1] + w * (q[2] + w * q[3]))


@called
def curve_value(curve, tau):
    """Pressure ratio at tau; tau = 0 at the head of the table."""
    if tau < 0.0:
        return curve.start + tau * curve.slope
    position = tau * curve.cells_far
    if position < CELLS_FAR:
        return cubic(curve.far, position)
    tau -= curve.step_far * CELLS_FAR
    position = tau * curve.cells_near
    if position < CELLS_NEAR:
        return cubic(curve.near, max(position, 0.0))
    return 1.0 + (curve.end - 1.0) * faded(tau - NEAR_REACH)


@inlined
def faded(x):
    """exp(-x) for x >= 0 to 2e-3, by its reciprocal's series: what is left behind the table is 2e-9."""
    return 1.0 / (
        1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x / 720)))))
    )


@called
def curve_tau(curve, r):
    """Return tau at ratio r, from the start (any lower for charging) to the table's end: inverse of curve_value."""
    start = curve.start
    split = curve.split
    sign = 1.0 if split > start else -1.0
    if sign * (r - start) < 0.0:
        return (r - start) / curve.slope
    far = sign * (split - r) > 0.0
    cells = curve.far if far else curve.near
    step = curve.step_far if far else curve.step_near
    low = 0
    size = CELLS_FAR if far else CELLS_NEAR
    while size > 1:
        half = size // 2
        low = low + half if sign * (r - cells[low + half, 0]) >= 0.0 else low
        size -= half
    q = cells[low]
    w = (r - q[0]) / (q[1] + q[2] + q[3])
    for _ in range(3):
        w -= (q[0] + w * (q[1] + w * (q[2] + w * q[3])) - r) / (
            q[1] + w * (2.0 * q[2] + w * 3.0 * q[3])
        )
    return (low + w) * step + (0.0 if far else curve.step_far * CELLS_FAR)


# A grid of steps is written by one stroke and followed by others.
OWN_STEPS, WRITE_GRID, FOLLOW_GRID = range(3)

# How a chamber at rest goes on: constant, on a curve, or a deviation decaying to its reference.
STILL, ON_CHARGE, ON_DISCHARGE, DECAY = range(4)


class ChamberCurve(Record):
    """How one chamber at rest goes on."""

    kind: Value
    tau: Value  # position on the curve, or the deviation that decays
    rate: Value  # d tau / dt
    reference: Value


class Stored(Record):
    """What the grid's stroke stores of one chamber at one sample."""

    kind: Value
    position: Value
    value: Value
    slope: Value


CHAMBER_COLUMNS, STORED_COLUMNS = ChamberCurve.size, Stored.size
STORED_ROW = 3 * STORED_COLUMNS
stored_of = named(Stored)
chamber_row = named(ChamberCurve)


@inlined
def chamber_of(w, j):
    """How chamber j goes on, from the rows of all."""
    return chamber_row(w[CHAMBER_COLUMNS * j :])


@called
def chamber_curve(pressure, u, volume, p, table, out):
    """How one chamber at rest goes on -> out; True if it is known."""
    charging = u == 1.0
    curve = curve_for(charging, table)
    reference = p.p_supply if charging else p.p_atm
    factor = p.alpha_m1 * p.k_in if charging else p.alpha_m2 * p.k_out
    ratio = pressure / reference
    deviation = ratio - 1.0 if charging else 1.0 - ratio
    out.reference = reference
    out.rate = curve.rate * factor * p.r_air / volume
    out.tau = 0.0
    if u != 1.0 and u != 0.0:
        return False
    if abs(deviation) < 1e-14:
        out.kind = STILL
        out.reference = pressure
    elif deviation > 0.0 or abs(deviation) <= abs(1.0 - curve.end):
        out.kind = DECAY
        out.tau = ratio - 1.0
    elif charging or ratio <= Z_TOP:
        out.kind = ON_CHARGE if charging else ON_DISCHARGE
        out.tau = curve_tau(curve, ratio)
    else:
        return False
    return True


@inlined
def chamber_pressure(dt, row, table):
    """Pressure of a chamber a time dt after its row was written."""
    kind = row.kind
    if kind == STILL:
        return row.reference
    if kind == DECAY:
        return row.reference * (1.0 + row.tau * exp(-row.rate * dt))
    curve = curve_for(kind == ON_CHARGE, table)
    return row.reference * curve_value(curve, row.tau + row.rate * dt)


@kernel
def vent(since_s, packed, table, states):
    """Pressures of chambers that have been open to the atmosphere for since_s [n, 3], full before -> states [n, states]."""
    out = np.zeros(CHAMBER_COLUMNS)
    row = chamber_of(view(out, 0), 0)
    for stroke in range(len(since_s)):
        p = parameters(view(packed[stroke], 0))
        y = view(states[stroke], 0)
        volumes = length_volumes(length_state(y), p)
        pressure = pressures(False, y)
        for j in range(3):
            was_full = since_s[stroke, j] < np.inf
            if was_full and chamber_curve(p.p_supply, 0.0, volumes[j], p, view(table, 0), row):
                pressure[j] = chamber_pressure(since_s[stroke, j], row, view(table, 0))


def vented(since_s: Floats, packed: Floats, flow: Floats, states: Floats) -> Floats:
    """Return states [n, states] of length strokes at rest with what is left in chambers that were full.

    since_s [n, 3]: time for which each has been open to the atmosphere, in s; infinite: it is empty. Leaks, which only
    help, are left out. packed [n, PARAMETERS], flow [FLOW_COEFFICIENTS]; all of a flow without filling curves are taken as empty.
    """
    table = filling_curves(flow)
    states = states.copy()
    if table is not NO_CURVES:
        vent(since_s, packed, table, states)
    return states


@called
def chamber_samples(row, table, t, samples, begin, end, out, stride):
    """Pressures of a chamber at samples from `begin` to `end` -> out[i * stride], as `chamber_pressure`; t: of its row."""
    kind = row.kind
    reference = row.reference
    if kind == DECAY:
        for i in range(begin, end):
            out[i * stride] = chamber_pressure(max(samples[i] - t, 0.0), row, table)
        return
    curve = curve_for(kind == ON_CHARGE, table)
    start = row.tau
    rate = row.rate
    i = begin
    while i < end and start + rate * max(samples[i] - t, 0.0) < 0.0:
        tau = start + rate * max(samples[i] - t, 0.0)
        out[i * stride] = reference * curve_value(curve, tau)
        i += 1
    cells = curve.far
    density = curve.cells_far
    while i < end:
        position = (start + rate * max(samples[i] - t, 0.0)) * density
        if not position < CELLS_FAR:
            break
        out[i * stride] = reference * cubic(cells, position)
        i += 1
    far = curve.step_far * CELLS_FAR
    cells = curve.near
    density = curve.cells_near
    while i < end:
        tau = start + rate * max(samples[i] - t, 0.0) - far
        position = tau * density
        if not position < CELLS_NEAR:
            break
        out[i * stride] = reference * cubic(cells, max(position, 0.0))
        i += 1
    while i < end:
        tau = start + rate * max(samples[i] - t, 0.0) - far
        out[i * stride] = reference * (1.0 + (curve.end - 1.0) * faded(tau - NEAR_REACH))
        i += 1


@called
def neighbour_samples(row, t, c, rows, begin, end, out, task):
    """Pressures of a chamber at samples from `begin` to `end` -> out, next to what the grid's stroke stored.

    It stores kind, position, value and slope in rows[i * STORED_ROW :]; the others go along that slope.
    """
    kind = row.kind
    decays = kind == DECAY
    charging = kind == ON_CHARGE
    curve = curve_for(charging, task.table)
    reference = row.reference
    start = 0.0 if decays else row.tau
    scale = reference * row.tau if decays else reference
    offset = reference if decays else 0.0
    first = task.use == WRITE_GRID
    for i in range(begin, end):
        position = start + row.rate * max(task.samples[i] - t, 0.0)
        stored = stored_of(rows[i * STORED_ROW :])
        apart = position - stored.position
        # so near, the tangent is wrong by 1e-4 of the distance
        if not first and stored.kind == kind and abs(apart) < 1e-4:
            value = stored.value + apart * stored.slope
        else:
            value = exp(-position) if decays else curve_value(curve, position)
        if first:
            slope = -value if decays else slope_of(value, charging, c) / curve.rate
            stored.kind = kind
            stored.position = position
            stored.value = value
            stored.slope = slope
        out[i * task.n_columns] = offset + scale * value


@called
def chamber_curves(fixed, y, u0, p, table, w):
    """How every chamber goes on -> w; True if all are known."""
    pressure = pressures(fixed, y)
    volumes = (
        (*fixed_volumes(fixed_state(y), p), 0.0) if fixed else length_volumes(length_state(y), p)
    )
    for j in range(2 if fixed else 3):
        if not chamber_curve(pressure[j], u0[j], volumes[j], p, table, chamber_of(w, j)):
            return False
    return True
