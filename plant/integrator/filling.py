"""Chambers that fill or empty while nothing moves: their pressures by `filling_curves`."""

from __future__ import annotations

from math import exp

from plant.equations.fixed_piston import fixed_volumes
from plant.equations.length_stroke import length_volumes
from plant.integrator.filling_curves import (
    CELLS_FAR,
    CELLS_NEAR,
    NEAR_REACH,
    Z_TOP,
    cubic,
    curve_for,
    curve_tau,
    curve_value,
    faded,
    slope_of,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import fixed_state, length_state, pressures
from plant.kernel.records import Record, Value
from plant.kernel.views import named

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
