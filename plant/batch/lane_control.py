"""One lane between two vector steps: accept or reject, events, switches, rests, samples.

With the scalar kernel's own functions, on one lane of the flat array.

Checked by: tests/unit/plant/batch/test_batch.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

from plant.batch.lane_steps import (
    ACCEPTED,
    BEFORE,
    DENSE,
    END,
    FACTOR,
    HIDES,
    LOWEST,
    MODE,
    NEXT,
    NORM,
    RATE,
    RATE_0,
    ROOT,
    SPARE,
    STAGE,
    STEP,
    TIME,
    VALVE,
    VALVE_RATE,
    WANTED,
    WIDTH,
    C,
    K,
    P,
    Y,
)
from plant.integrator.events import (
    after_event,
    all_guards,
    at_rest,
    choose_modes,
    hidden_meeting,
    hidden_turn,
    locate,
    smallest,
)
from plant.integrator.filling import (
    CHAMBER_ROW,
    KNOWN_COLUMNS,
    STILL,
    W_KIND,
    chamber_samples,
    neighbour_samples,
)
from plant.integrator.integrate import (
    DONE,
    EVENT_BLOCK,
    EVENT_COLUMNS,
    EVENT_GUARD,
    EVENT_LOST,
    EVENT_SPEED,
    EVENT_TIME,
    EVENT_V,
    EVENT_X,
    FIRST_STEP_S,
    FOLLOW_GRID,
    GRID_COLUMNS,
    GRID_END,
    GRID_GUARD,
    GRID_SWITCH,
    LONGEST_STEP_S,
    NOT_FINITE,
    OFF_GRID,
    OWN_STEPS,
    STEP_AFTER_REST_S,
    STEP_TOO_SMALL,
    TOO_MANY_EVENTS,
    WRITE_GRID,
)
from plant.integrator.rest import rest_jump
from plant.integrator.steppers import (
    dense_element,
    derivative,
    explicit_dense,
    interpolate,
    interpolated,
)
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FP1, MAX_STATES, MODES, PB, TERM_0
from plant.kernel.views import lane, rows

# What a lane remembers beside the flat array.
STROKE, NEXT_SWITCH, NEXT_SAMPLE, EVENTS, TAKEN, REJECTED, JUMPS = range(7)
MEMORY = 7

KNOWN = 3 * KNOWN_COLUMNS  # what the grid's stroke notes of each sample at rest
IDLE = -1

# Columns of a stroke's result.
R_STATUS, R_ARRIVAL, R_SPEED, R_ENERGY, R_EVENTS, R_STEPS, R_REJECTED, R_JUMPS = range(8)
RESULTS = 8

# What a lane does next, beside the reasons to stop.
STEPPING = -1
LIMIT_EVENTS = 4000
LEAST_ROOT = 0.5623413251903491  # of a norm of 1e-4
SMALL_NORM = 0.01  # square of the norm

# Scratch of one lane at a time.
SCRATCH_WORK, SCRATCH_G, SCRATCH_G0, SCRATCH_RECORD, SCRATCH_REST = 0, 64, 128, 192, 224
SCRATCH = 256


@called
def next_step(f, j, memory, grid, steps, use):
    """Choose the step of a lane: what the error control wants, up to the next switch; or the grid's.

    Returns STEPPING, or OFF_GRID.
    """
    if use == FOLLOW_GRID:
        i = memory[TAKEN * WIDTH + j]
        if i >= steps:
            return OFF_GRID
        row = grid[i * GRID_COLUMNS :]
        following = f[NEXT * WIDTH + j]
        end = following if row[GRID_SWITCH] != 0.0 else row[GRID_END]
        f[STEP * WIDTH + j] = end - f[TIME * WIDTH + j]
        inside = f[TIME * WIDTH + j] < end and end <= following
        return STEPPING if inside else OFF_GRID
    left = f[NEXT * WIDTH + j] - f[TIME * WIDTH + j]
    h = f[WANTED * WIDTH + j]
    f[STEP * WIDTH + j] = left if h >= left * (1.0 - 1e-12) else min(h, 0.5 * left)
    return STEPPING


@called
def note_event(f, j, index, memory, record, events, room, result):
    """Record an event of a lane, and the first impact on a stop as the arrival."""
    count = memory[EVENTS * WIDTH + j]
    t = f[TIME * WIDTH + j]
    if count < room:
        row = events[count * EVENT_COLUMNS :]
        row[EVENT_TIME] = t
        row[EVENT_GUARD] = index
        row[EVENT_LOST] = record[0]
        row[EVENT_SPEED] = record[1]
        row[EVENT_BLOCK] = record[2]
        row[EVENT_X] = f[Y * WIDTH + j]
        row[EVENT_V] = f[(Y + 1) * WIDTH + j]
    if record[1] > 0.0 and record[2] == 0.0 and not result[R_ARRIVAL] >= 0.0:
        result[R_ARRIVAL] = t
        result[R_SPEED] = record[1]
        result[R_ENERGY] = record[0]
    memory[EVENTS * WIDTH + j] = count + 1


@called
def apply_switches(f, j, memory, switches, n_switch):
    """Move the valves that are due, and note the time of the next switch or of the end."""
    t = f[TIME * WIDTH + j]
    u = lane(f, VALVE, j, WIDTH, "")
    du = lane(f, VALVE_RATE, j, WIDTH, "")
    i = memory[NEXT_SWITCH * WIDTH + j]
    while i < n_switch and switches[4 * i] <= t:
        chamber = int(switches[4 * i + 1])
        du[chamber] = switches[4 * i + 3]
        u[chamber] = switches[4 * i + 2] - du[chamber] * switches[4 * i]
        i += 1
    memory[NEXT_SWITCH * WIDTH + j] = i
    end = f[END * WIDTH + j]
    f[NEXT * WIDTH + j] = min(switches[4 * i], end) if i < n_switch else end


@called
def finite(y, n):
    """True if every state is a finite number."""
    total = 0.0
    for k in range(n):
        total += 0.0 * y[k]
    return total == 0.0


@called
def sample_rest(
    f, j, fixed, memory, until, samples, n_sample, columns, n_columns, out, table, w, known, use
):
    """Samples of a rest, from its curves; all that is not a pressure stands still."""
    t = f[TIME * WIDTH + j]
    state = lane(f, STAGE, j, WIDTH, "")
    c = lane(f, C, j, WIDTH, "")
    chambers = rows(w, CHAMBER_ROW)
    begin = memory[NEXT_SAMPLE * WIDTH + j]
    end = begin
    while end < n_sample and samples[end] <= until:
        end += 1
    memory[NEXT_SAMPLE * WIDTH + j] = end
    place = FP1 if fixed else PB
    count = 2 if fixed else 3
    for k in range(n_columns):
        chamber = columns[k] - place
        row = chambers[max(chamber, 0)]
        if chamber < 0 or chamber >= count or row[W_KIND] == STILL:
            value = state[columns[k]]
            for i in range(begin, end):
                out[i * n_columns + k] = value
        elif use == OWN_STEPS:
            chamber_samples(row, table, t, samples, begin, end, out[k:], n_columns)
        else:
            neighbour_samples(
                row, table, c, t, samples, begin, end, known[KNOWN_COLUMNS * chamber :], KNOWN,
                use == WRITE_GRID, out[k:], n_columns,
            )  # fmt: skip


@called
def sample_step(f, j, memory, until, theta, samples, n_sample, columns, n_columns, out):
    """Samples of a step, from its interpolant, up to its fraction theta."""
    t = f[TIME * WIDTH + j]
    h = f[STEP * WIDTH + j]
    dense = rows(lane(f, DENSE, j, WIDTH, ""), MAX_STATES)
    i = memory[NEXT_SAMPLE * WIDTH + j]
    while i < n_sample and samples[i] <= until:
        place = min(max((samples[i] - t) / h, 0.0), theta)
        for k in range(n_columns):
            out[i * n_columns + k] = interpolated(place, dense, columns[k])
        i += 1
    memory[NEXT_SAMPLE * WIDTH + j] = i


@called
def prepare(
    f, j, fixed, n, memory, switches, n_switch, samples, n_sample, columns, n_columns, out,
    events, room, result, tabulated, table, scratch, grid, steps, use, known,
):  # fmt: skip
    """Bring a lane to its next step, over switches, events at this instant and rests.

    Returns STEPPING, DONE at the stroke's end, or the reason to stop.
    """
    y = lane(f, Y, j, WIDTH, "")
    y1 = lane(f, STAGE, j, WIDTH, "")
    m = lane(f, MODE, j, WIDTH, "lane modes")
    u = lane(f, VALVE, j, WIDTH, "")
    du = lane(f, VALVE_RATE, j, WIDTH, "")
    p = lane(f, P, j, WIDTH, "lane parameters")
    c = lane(f, C, j, WIDTH, "")
    work = scratch[SCRATCH_WORK:]
    g = scratch[SCRATCH_G:]
    record = scratch[SCRATCH_RECORD:]
    w = scratch[SCRATCH_REST:]
    while True:
        apply_switches(f, j, memory, switches, n_switch)
        t = f[TIME * WIDTH + j]
        if t >= f[END * WIDTH + j]:
            return DONE
        if memory[EVENTS * WIDTH + j] > LIMIT_EVENTS:
            return TOO_MANY_EVENTS
        if all_guards(t, y, m, p, work, g) < 0.0:
            worst = smallest(g)
            after_event(t, worst, y, m, p, record, work)
            note_event(f, j, worst, memory, record, events, room, result)
            continue
        still = du[0] == 0.0 and du[1] == 0.0 and du[2] == 0.0
        if tabulated and still and at_rest(m):
            span = f[NEXT * WIDTH + j] - t
            corner = lane(f, SPARE, j, WIDTH, "")
            dt, index = rest_jump(t, span, fixed, y, y1, corner, m, u, p, table, w, work, g, n)
            if dt > 0.0 or index >= 0:
                memory[JUMPS * WIDTH + j] += 1
                if not finite(y1, n):
                    return NOT_FINITE
                until = f[NEXT * WIDTH + j] if dt == span and index < 0 else t + dt
                for k in range(n):
                    y[k] = y1[k]
                sample_rest(
                    f,
                    j,
                    fixed,
                    memory,
                    until,
                    samples,
                    n_sample,
                    columns,
                    n_columns,
                    out,
                    table,
                    w,
                    known,
                    use,
                )
                f[TIME * WIDTH + j] = until
                if index >= 0:
                    after_event(until, index, y, m, p, record, work)
                    note_event(f, j, index, memory, record, events, room, result)
                    f[WANTED * WIDTH + j] = STEP_AFTER_REST_S
                continue
        derivative(t, y, lane(f, RATE_0, j, WIDTH, ""), m, u, du, p, c, work, False)
        return next_step(f, j, memory, grid, steps, use)


@inlined
def grown(f, j, h, norm, factor):
    """Step that the error control wants after one that was taken; a small error lets it grow freely."""
    root = f[ROOT * WIDTH + j]
    factor *= f[BEFORE * WIDTH + j] if norm > SMALL_NORM else 1.0 / max(root, 0.1)
    f[BEFORE * WIDTH + j] = max(root, LEAST_ROOT)
    return h * min(factor, 5.0)


@called
def judge(
    f, j, n, memory, samples, n_sample, columns, n_columns, out, events, room, result, scratch,
    grid, steps, use,
):  # fmt: skip
    """Accept or reject the step that a lane has just taken.

    Returns STEPPING, DONE when something has happened (event, switch, end) and the lane must be
    prepared anew, or the reason to stop.  A lane that follows a grid rejects nothing.
    """
    h = f[STEP * WIDTH + j]
    f[ACCEPTED * WIDTH + j] = 0.0
    norm = f[NORM * WIDTH + j]
    factor = f[FACTOR * WIDTH + j]
    if not norm <= (1.0e300 if use == FOLLOW_GRID else 1.0):
        memory[REJECTED * WIDTH + j] += 1
        finite = norm <= 1.0e300
        h *= min(max(factor, 0.2), 0.9) if finite else 0.1
        f[STEP * WIDTH + j] = h
        f[WANTED * WIDTH + j] = h
        if h < 1e-14 or use == FOLLOW_GRID:
            return STEP_TOO_SMALL if finite else NOT_FINITE
        return STEPPING
    taken = memory[TAKEN * WIDTH + j]
    memory[TAKEN * WIDTH + j] += 1
    t = f[TIME * WIDTH + j]
    y = lane(f, Y, j, WIDTH, "")
    y1 = lane(f, STAGE, j, WIDTH, "")
    m = lane(f, MODE, j, WIDTH, "lane modes")
    p = lane(f, P, j, WIDTH, "lane parameters")
    work = scratch[SCRATCH_WORK:]
    g = scratch[SCRATCH_G:]
    record = scratch[SCRATCH_RECORD:]
    last = h == f[NEXT * WIDTH + j] - t
    until = f[NEXT * WIDTH + j] if last else t + h
    wanted = f[WANTED * WIDTH + j]
    longer = grown(f, j, h, norm, factor)
    f[WANTED * WIDTH + j] = min(max(wanted, longer) if h < wanted else longer, LONGEST_STEP_S)
    theta = 1.0
    # a lane on a grid meets an event only where the grid's stroke met one
    expected = use != FOLLOW_GRID or grid[min(taken, steps - 1) * GRID_COLUMNS + GRID_GUARD] >= 0.0
    fired = False
    if expected:
        fired = f[LOWEST * WIDTH + j] < 0.0
    if expected and not fired and f[HIDES * WIDTH + j] != 0.0:
        rate0 = lane(f, RATE_0, j, WIDTH, "")
        theta = hidden_turn(h, y, y1, rate0, lane(f, RATE, j, WIDTH, ""), m)
        theta = min(theta, hidden_meeting(h, y, y1, m, p))
    index = 0
    i = memory[NEXT_SAMPLE * WIDTH + j]
    if fired or theta < 1.0 or (i < n_sample and samples[i] <= until):
        k = rows(lane(f, K, j, WIDTH, ""), MAX_STATES)
        dense = rows(lane(f, DENSE, j, WIDTH, ""), MAX_STATES)
        if fired or theta < 1.0:
            explicit_dense(1.0, y, y1, k, dense, n)
        else:
            for i in range(n_columns):
                dense_element(1.0, y, y1, k, dense, columns[i])
        if theta < 1.0:
            state = lane(f, SPARE, j, WIDTH, "")
            interpolate(theta, dense, state, n)
            fired = all_guards(t + theta * h, state, m, p, work, g) < 0.0
            if not fired:
                theta = 1.0
        if fired:
            if theta == 1.0:
                all_guards(t + h, y1, m, p, work, g)
            g0 = scratch[SCRATCH_G0:]
            begun = all_guards(t, y, m, p, work, g0)
            if use == FOLLOW_GRID and begun < 0.0:
                return OFF_GRID
            theta, index = locate(t, h, theta, dense, y1, m, p, work, g, g0, n)
            until = t + theta * h
        sample_step(f, j, memory, until, theta, samples, n_sample, columns, n_columns, out)
    if use != OWN_STEPS:
        row = grid[min(taken, steps - 1) * GRID_COLUMNS :]
        happened = float(index) if fired else -1.0
        if use == FOLLOW_GRID and row[GRID_GUARD] != happened:
            return OFF_GRID
        if use == WRITE_GRID:
            row[GRID_END] = t + h
            row[GRID_SWITCH] = 1.0 if last else 0.0
            row[GRID_GUARD] = happened
    f[TIME * WIDTH + j] = until
    if not (fired or last):
        f[ACCEPTED * WIDTH + j] = 1.0
        return next_step(f, j, memory, grid, steps, use)
    for e in range(n):
        y[e] = y1[e]
    if fired:
        after_event(until, index, y, m, p, record, work)
        note_event(f, j, index, memory, record, events, room, result)
        f[WANTED * WIDTH + j] = min(f[WANTED * WIDTH + j], max(FIRST_STEP_S, 0.3 * h))
        f[BEFORE * WIDTH + j] = 1.0
    return DONE


@called
def begin(f, j, n, memory, packed, y0, m0, u0, duration, work):
    """Put a stroke into a lane, at time 0."""
    for k in range(TERM_0):
        f[(P + k) * WIDTH + j] = packed[k]
    for k in range(MODES):
        f[(MODE + k) * WIDTH + j] = m0[k]
    for k in range(n):
        f[(Y + k) * WIDTH + j] = y0[k]
    for k in range(3):
        f[(VALVE + k) * WIDTH + j] = u0[k]
        f[(VALVE_RATE + k) * WIDTH + j] = 0.0
    f[ACCEPTED * WIDTH + j] = 0.0
    f[TIME * WIDTH + j] = 0.0
    f[END * WIDTH + j] = duration
    f[WANTED * WIDTH + j] = STEP_AFTER_REST_S
    f[BEFORE * WIDTH + j] = 1.0
    for k in range(1, MEMORY):
        memory[k * WIDTH + j] = 0
    y = lane(f, Y, j, WIDTH, "")
    m = lane(f, MODE, j, WIDTH, "lane modes")
    choose_modes(0.0, y, m, lane(f, P, j, WIDTH, "lane parameters"), work)
