"""One lane between two vector steps: accept or reject, events, switches, rests, samples.

With the scalar kernel's own functions, on one lane of the flat array.

Checked by: tests/unit/plant/batch/test_batch.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

from plant.batch.lane_steps import WIDTH, lane_modes, lane_parameters
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
    KNOWN_COLUMNS,
    STILL,
    chamber_of,
    chamber_samples,
    neighbour_samples,
)
from plant.integrator.integrate import (
    DONE,
    EVENT_COLUMNS,
    FIRST_STEP_S,
    FOLLOW_GRID,
    GRID_COLUMNS,
    LONGEST_STEP_S,
    NOT_FINITE,
    OFF_GRID,
    OWN_STEPS,
    STEP_AFTER_REST_S,
    STEP_TOO_SMALL,
    TOO_MANY_EVENTS,
    WRITE_GRID,
    write_event,
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
from plant.kernel.layout import CHAMBERS, FIRST_PRESSURE, Modes, Parameters
from plant.kernel.record_views import event_row, flow_map, grid_row, impact_of
from plant.kernel.records import Record, Value
from plant.kernel.views import lane, named


class Memory(Record):
    """Counters of a lane (int64)."""

    stroke: Value  # number of the stroke in the lane, IDLE if none
    next_switch: Value
    next_sample: Value
    events: Value
    taken: Value
    rejected: Value
    jumps: Value


MEMORY = Memory.size
memory_record = named(Memory)


@inlined
def memory_of(memory, j):
    """Counters of lane j."""
    return memory_record(lane(memory, 0, j, WIDTH, ""))


KNOWN = 3 * KNOWN_COLUMNS  # what the grid's stroke notes of each sample at rest
IDLE = -1
# What a lane takes of a stroke: no term has nodes there.
COPIED, MODES = Parameters.fields["term_nodes"].start, Modes.size


class Result(Record):
    """What became of one stroke of a batch."""

    status: Value  # DONE or why it stopped
    arrival: Value  # first impact of the stay on a stop: time, speed, energy; nan if none
    speed: Value
    energy: Value
    events: Value
    steps: Value
    rejected: Value
    jumps: Value  # rests passed in closed form


RESULTS = Result.size
result_of = named(Result)

# What a lane does next, beside the reasons to stop.
STEPPING = -1
LIMIT_EVENTS = 4000
LEAST_ROOT = 0.5623413251903491  # of a norm of 1e-4
SMALL_NORM = 0.01  # square of the norm

# Scratch of one lane at a time.
SCRATCH_WORK, SCRATCH_G, SCRATCH_G0, SCRATCH_IMPACT, SCRATCH_REST = 0, 64, 128, 192, 224
SCRATCH = 256


@called
def next_step(one, memory, grid, steps, use):
    """Choose the step of a lane: what the error control wants, up to the next switch; or the grid's.

    Returns STEPPING, or OFF_GRID.
    """
    if use == FOLLOW_GRID:
        i = memory.taken
        if i >= steps:
            return OFF_GRID
        row = grid_row(grid[i * GRID_COLUMNS :])
        following = one.next
        end = following if row.switch != 0.0 else row.end
        one.step = end - one.time
        inside = one.time < end and end <= following
        return STEPPING if inside else OFF_GRID
    left = one.next - one.time
    h = one.wanted
    one.step = left if h >= left * (1.0 - 1e-12) else min(h, 0.5 * left)
    return STEPPING


@called
def note_event(one, index, memory, impact, events, room, result):
    """Record an event of a lane, and the first impact on a stop as the arrival."""
    count = memory.events
    t = one.time
    if count < room:
        row = event_row(events[count * EVENT_COLUMNS :])
        write_event(t, index, impact, one.y, row)
    if impact.speed > 0.0 and impact.at_block == 0.0 and not result.arrival >= 0.0:
        result.arrival = t
        result.speed = impact.speed
        result.energy = impact.lost
    memory.events = count + 1


@called
def apply_switches(one, memory, switches, n_switch):
    """Move the valves that are due, and note the time of the next switch or of the end."""
    t = one.time
    u = one.valve
    du = one.valve_rate
    i = memory.next_switch
    while i < n_switch and switches[4 * i] <= t:
        chamber = int(switches[4 * i + 1])
        du[chamber] = switches[4 * i + 3]
        u[chamber] = switches[4 * i + 2] - du[chamber] * switches[4 * i]
        i += 1
    memory.next_switch = i
    end = one.end
    one.next = min(switches[4 * i], end) if i < n_switch else end


@called
def finite(y, n):
    """True if every state is a finite number."""
    total = 0.0
    for k in range(n):
        total += 0.0 * y[k]
    return total == 0.0


@called
def sample_rest(
    one, fixed, memory, until, samples, n_sample, columns, n_columns, out, table, w, known, use
):
    """Samples of a rest, from its curves; all that is not a pressure stands still."""
    t = one.time
    state = one.stage
    c = flow_map(one.flow)
    begin = memory.next_sample
    end = begin
    while end < n_sample and samples[end] <= until:
        end += 1
    memory.next_sample = end
    place = FIRST_PRESSURE[0] if fixed else FIRST_PRESSURE[1]
    count = CHAMBERS[0] if fixed else CHAMBERS[1]
    for k in range(n_columns):
        chamber = columns[k] - place
        row = chamber_of(w, max(chamber, 0))
        if chamber < 0 or chamber >= count or row.kind == STILL:
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
def sample_step(one, memory, until, theta, samples, n_sample, columns, n_columns, out):
    """Samples of a step, from its interpolant, up to its fraction theta."""
    t = one.time
    h = one.step
    dense = one.dense
    i = memory.next_sample
    while i < n_sample and samples[i] <= until:
        place = min(max((samples[i] - t) / h, 0.0), theta)
        for k in range(n_columns):
            out[i * n_columns + k] = interpolated(place, dense, columns[k])
        i += 1
    memory.next_sample = i


@called
def prepare(
    one, fixed, n, memory, switches, n_switch, samples, n_sample, columns, n_columns, out,
    events, room, result, tabulated, table, scratch, grid, steps, use, known,
):  # fmt: skip
    """Bring a lane to its next step, over switches, events at this instant and rests.

    Returns STEPPING, DONE at the stroke's end, or the reason to stop.
    """
    y = one.y
    y1 = one.stage
    m = lane_modes(one.modes)
    u = one.valve
    du = one.valve_rate
    p = lane_parameters(one.parameters)
    c = flow_map(one.flow)
    work = scratch[SCRATCH_WORK:]
    g = scratch[SCRATCH_G:]
    impact = impact_of(scratch[SCRATCH_IMPACT:])
    w = scratch[SCRATCH_REST:]
    while True:
        apply_switches(one, memory, switches, n_switch)
        t = one.time
        if t >= one.end:
            return DONE
        if memory.events > LIMIT_EVENTS:
            return TOO_MANY_EVENTS
        if all_guards(t, y, m, p, work, g) < 0.0:
            worst = smallest(g)
            after_event(t, worst, y, m, p, impact, work)
            note_event(one, worst, memory, impact, events, room, result)
            continue
        still = du[0] == 0.0 and du[1] == 0.0 and du[2] == 0.0
        if tabulated and still and at_rest(m):
            span = one.next - t
            corner = one.spare
            dt, index = rest_jump(t, span, fixed, y, y1, corner, m, u, p, table, w, work, g, n)
            if dt > 0.0 or index >= 0:
                memory.jumps += 1
                if not finite(y1, n):
                    return NOT_FINITE
                until = one.next if dt == span and index < 0 else t + dt
                for k in range(n):
                    y[k] = y1[k]
                sample_rest(
                    one,
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
                one.time = until
                if index >= 0:
                    after_event(until, index, y, m, p, impact, work)
                    note_event(one, index, memory, impact, events, room, result)
                    one.wanted = STEP_AFTER_REST_S
                continue
        derivative(t, y, one.rate_0, m, u, du, p, c, work, False)
        return next_step(one, memory, grid, steps, use)


@inlined
def grown(one, h, norm, factor):
    """Step that the error control wants after one that was taken; a small error lets it grow freely."""
    root = one.root
    factor *= one.before if norm > SMALL_NORM else 1.0 / max(root, 0.1)
    one.before = max(root, LEAST_ROOT)
    return h * min(factor, 5.0)


@called
def judge(
    one, n, memory, samples, n_sample, columns, n_columns, out, events, room, result, scratch,
    grid, steps, use,
):  # fmt: skip
    """Accept or reject the step that a lane has just taken.

    Returns STEPPING, DONE when something has happened (event, switch, end) and the lane must be
    prepared anew, or the reason to stop.  A lane that follows a grid rejects nothing.
    """
    h = one.step
    one.accepted = 0.0
    norm = one.norm
    factor = one.factor
    if not norm <= (1.0e300 if use == FOLLOW_GRID else 1.0):
        memory.rejected += 1
        finite = norm <= 1.0e300
        h *= min(max(factor, 0.2), 0.9) if finite else 0.1
        one.step = h
        one.wanted = h
        if h < 1e-14 or use == FOLLOW_GRID:
            return STEP_TOO_SMALL if finite else NOT_FINITE
        return STEPPING
    taken = memory.taken
    memory.taken += 1
    t = one.time
    y = one.y
    y1 = one.stage
    m = lane_modes(one.modes)
    p = lane_parameters(one.parameters)
    work = scratch[SCRATCH_WORK:]
    g = scratch[SCRATCH_G:]
    impact = impact_of(scratch[SCRATCH_IMPACT:])
    last = h == one.next - t
    until = one.next if last else t + h
    wanted = one.wanted
    longer = grown(one, h, norm, factor)
    one.wanted = min(max(wanted, longer) if h < wanted else longer, LONGEST_STEP_S)
    theta = 1.0
    # a lane on a grid meets an event only where the grid's stroke met one
    expected = (
        use != FOLLOW_GRID or grid_row(grid[min(taken, steps - 1) * GRID_COLUMNS :]).guard >= 0.0
    )
    fired = False
    if expected:
        fired = one.lowest < 0.0
    if expected and not fired and one.hides != 0.0:
        rate0 = one.rate_0
        theta = hidden_turn(h, y, y1, rate0, one.rate, m)
        theta = min(theta, hidden_meeting(h, y, y1, m, p))
    index = 0
    i = memory.next_sample
    if fired or theta < 1.0 or (i < n_sample and samples[i] <= until):
        k = one.k
        dense = one.dense
        if fired or theta < 1.0:
            explicit_dense(1.0, y, y1, k, dense, n)
        else:
            for i in range(n_columns):
                dense_element(1.0, y, y1, k, dense, columns[i])
        if theta < 1.0:
            state = one.spare
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
        sample_step(one, memory, until, theta, samples, n_sample, columns, n_columns, out)
    if use != OWN_STEPS:
        row = grid_row(grid[min(taken, steps - 1) * GRID_COLUMNS :])
        happened = float(index) if fired else -1.0
        if use == FOLLOW_GRID and row.guard != happened:
            return OFF_GRID
        if use == WRITE_GRID:
            row.end = t + h
            row.switch = 1.0 if last else 0.0
            row.guard = happened
    one.time = until
    if not (fired or last):
        one.accepted = 1.0
        return next_step(one, memory, grid, steps, use)
    for e in range(n):
        y[e] = y1[e]
    if fired:
        after_event(until, index, y, m, p, impact, work)
        note_event(one, index, memory, impact, events, room, result)
        one.wanted = min(one.wanted, max(FIRST_STEP_S, 0.3 * h))
        one.before = 1.0
    return DONE


@called
def begin(one, n, memory, packed, y0, m0, u0, duration, work):
    """Put a stroke into a lane, at time 0."""
    for k in range(COPIED):
        one.parameters[k] = packed[k]
    for k in range(MODES):
        one.modes[k] = m0[k]
    for k in range(n):
        one.y[k] = y0[k]
    for k in range(3):
        one.valve[k] = u0[k]
        one.valve_rate[k] = 0.0
    one.accepted = 0.0
    one.time = 0.0
    one.end = duration
    one.wanted = STEP_AFTER_REST_S
    one.before = 1.0
    memory.next_switch = 0
    memory.next_sample = 0
    memory.events = 0
    memory.taken = 0
    memory.rejected = 0
    memory.jumps = 0
    y = one.y
    m = lane_modes(one.modes)
    choose_modes(0.0, y, m, lane_parameters(one.parameters), work)
