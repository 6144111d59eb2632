"""The hybrid integrator: continuous steps, events located on the dense output, resets.

One kernel for every use: a stroke in one call, or pieces under lockstep.  Valve switchings are
known instants and split the steps; everything else (sticking, slipping, contacts, stops, the
synchronizer, the damper's modes) is a guard, located to rounding on the step's interpolant, after
which the modes are chosen anew.  Nothing is smoothed.

Checked by: tests/physics/
"""

from __future__ import annotations

from plant.equations.length_contacts import FIRST_CORNER, GUARDS, note_side
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
from plant.integrator.filling import STILL, chamber_of, chamber_samples
from plant.integrator.rest import rest_jump
from plant.integrator.steppers import (
    derivative,
    explicit_dense,
    explicit_step,
    interpolate,
    jacobian,
    stiff_dense,
    stiff_step,
)
from plant.kernel.compiled import called, inlined, kernel
from plant.kernel.layout import CHAMBERS, FIRST_PRESSURE, FIXED, EventRow, GridRow, Slot
from plant.kernel.record_views import (
    counts_of,
    event_row,
    flow_map,
    grid_row,
    impact_of,
    length_state,
    modes,
    parameters,
)
from plant.kernel.views import rows, view

EVENT_COLUMNS = EventRow.size

# Why `advance` stopped.
DONE, TOO_MANY_EVENTS, STEP_TOO_SMALL, NOT_FINITE = 0, 1, 2, 3
OFF_GRID = 10  # something happened that the stroke of the grid did not meet

# A grid of steps, written by one stroke and followed by others: where each step was to end, whether
# that was the next switch, and the guard that ended it before (-1: none).
GRID_COLUMNS = GridRow.size
OWN_STEPS, WRITE_GRID, FOLLOW_GRID = range(3)

LONGEST_STEP_S = 5e-3
LONGEST_REST_STEP_S = 1e-2
SWITCH_STEP_S = 1e-3
FIRST_STEP_S = 2e-5
STEP_AFTER_REST_S = 4e-4
# Shape of the scratch array.
WORKSPACE_ROWS, ROW = 80, 64


@called
def rests_are_plain(p, m):
    """True if chambers at rest follow the flow map alone and all guards are linear in pressures."""
    return (
        p.flow_model == 0.0
        and p.leak_piston == 0.0
        and p.leak_atm == 0.0
        and p.seal_mu == 0.0
        and p.term_slot == Slot.NONE
        and m.line == 0
    )


@called
def sample_rest(t, until, begin, samples, n_sample, out, width, fixed, rest, curves, y, n):
    """Samples of a rest from t on; y holds all that does not move.  Returns the next sample's number."""
    end = begin
    while end < n_sample and samples[end] <= until:
        end += 1
    place = FIRST_PRESSURE[0] if fixed else FIRST_PRESSURE[1]
    count = CHAMBERS[0] if fixed else CHAMBERS[1]
    for k in range(n):
        row = chamber_of(rest, max(k - place, 0))
        if k < place or k >= place + count or row.kind == STILL:
            value = y[k]
            for i in range(begin, end):
                out[i * width + k] = value
        else:
            chamber_samples(row, curves, t, samples, begin, end, out[k:], width)
    return end


@inlined
def write_event(t, index, impact, y, row):
    """Store an event."""
    row.time = t
    row.guard = index
    row.lost = impact.lost
    row.speed = impact.speed
    row.at_block = impact.at_block
    row.x = y[0]
    row.v = y[1]


@called
def note_event(t, index, y, impact, events, counts, limit):
    """Record an event; False if there are too many.  A corner is none, but counts towards the limit."""
    count = counts.events
    if index >= FIRST_CORNER:
        counts.corners += 1
        return count + counts.corners < limit
    if count >= events.shape[0] or count + counts.corners >= limit:
        return False
    write_event(t, index, impact, y, event_row(view(events, count * EVENT_COLUMNS)))
    counts.events += 1
    return True


@kernel
def start(y, m, p, workspace):
    """Choose the modes of an initial state."""
    choose_modes(0.0, view(y, 0), modes(m), parameters(p), view(workspace, 0))


@kernel
def advance(
    duration,
    y,
    m,
    u0,
    du,
    p,
    c,
    scale,
    n,
    quad,
    tolerance,
    step,
    switches,
    samples,
    out,
    events,
    counts,
    workspace,
    tabulated,
    table,
    grid,
    steps,
    use,
    starting,
):
    """Integrate from time 0 to `duration` [s]; returns DONE or the reason to stop.

    Parameters
    ----------
    y : float64 [n + quadratures], state, updated in place
    m : int64 [MODES], modes, updated in place
    u0, du : float64 [3], valve positions u0 + du t, updated in place to the end of the interval
    p, c : parameters and flow-map coefficients
    scale : float64 [n], typical size of each state, for the error control
    quad : 0, or number of quadratures behind the states
    step : float64 [1], size of the next step, carried over from call to call
    switches : float64 [k, 4] rows (time, chamber, position, slope), times ascending
    samples : float64 [s], times at which the state is wanted, ascending -> out [s, n]
    events : float64 [e, EVENT_COLUMNS], filled in order
    counts : int64 [Counts.size]: events, steps, rejected steps, samples written, corners of a law; added to
    workspace : float64 [WORKSPACE_ROWS, ROW] scratch
    tabulated : True if `table` holds the filling curves of c: rests are then passed in closed form
        where there is one (without quadratures only)
    grid, steps, use : float64 [steps, GRID_COLUMNS], OWN_STEPS to leave it alone, WRITE_GRID to note
        the steps, FOLLOW_GRID to take those steps whatever the error
    starting : True if m holds no modes of motion yet (as `start`)
    """
    y = view(y, 0)
    pivot = view(m, 16)
    m = modes(m)
    u0 = view(u0, 0)
    du = view(du, 0)
    p = parameters(p)
    c = flow_map(c)
    scale = view(scale, 0)
    n_all = n + quad
    with_quad = quad > 0
    work = view(workspace, 0 * ROW)
    g = view(workspace, 1 * ROW)
    g0 = view(workspace, 2 * ROW)
    stage = view(workspace, 3 * ROW)
    err = view(workspace, 4 * ROW)
    y1 = view(workspace, 5 * ROW)
    impact = impact_of(view(workspace, 6 * ROW))
    counts = counts_of(counts)
    column = view(workspace, 7 * ROW)
    ft = view(workspace, 8 * ROW)
    k = rows(view(workspace, 9 * ROW), ROW)
    dense = rows(view(workspace, 16 * ROW), ROW)
    jac = rows(view(workspace, 21 * ROW), ROW)
    lu = rows(view(workspace, 61 * ROW), ROW)
    if starting:
        choose_modes(0.0, y, m, p, work)
    t = 0.0
    i_switch = 0
    i_sample = 0
    n_switch = switches.shape[0]
    n_sample = samples.shape[0]
    samples = view(samples, 0)
    width = out.shape[1]
    out = view(out, 0)
    fixed = m.system == FIXED
    curves = view(table, 0)
    rest = view(workspace, 79 * ROW)
    leaping = tabulated and not with_quad and rests_are_plain(p, m)
    stiff = m.damper == 2
    h = step[0]
    fresh = True
    have_jacobian = False
    limit_events = counts.events + counts.corners + 4000
    i_step = -1
    row = grid_row(grid)
    expected = True
    while True:
        while i_switch < n_switch and switches[i_switch, 0] <= t:
            chamber = int(switches[i_switch, 1])
            du[chamber] = switches[i_switch, 3]
            u0[chamber] = switches[i_switch, 2] - du[chamber] * switches[i_switch, 0]
            i_switch += 1
            fresh = True
            h = min(h, SWITCH_STEP_S)
        if t >= duration:
            break
        t_next = duration
        if i_switch < n_switch and switches[i_switch, 0] < duration:
            t_next = switches[i_switch, 0]
        left = t_next - t
        if fresh:
            derivative(t, y, k[6], m, u0, du, p, c, work, with_quad)
            if all_guards(t, y, m, p, work, g0) < 0.0:
                worst = smallest(g0)
                # a jump of input or parameters has already passed a guard: act on it now
                after_event(t, worst, y, m, p, impact, work)
                if not note_event(t, worst, y, impact, events, counts, limit_events):
                    return TOO_MANY_EVENTS
                continue
            fresh = False
            have_jacobian = False
            still = du[0] == 0.0 and du[1] == 0.0 and du[2] == 0.0
            if (
                leaping
                and still
                and at_rest(m)
                and m.blocked == 0
                and (not stiff or m.oil_rest != 0)
            ):
                dt, index = rest_jump(
                    t, left, fixed, y, y1, stage, m, u0, p, curves, rest, work, g, n
                )
                if dt > 0.0 or index >= 0:
                    t_end = t_next if dt == left and index < 0 else t + dt
                    for i in range(n):
                        y[i] = y1[i]
                        if not abs(y[i]) < 1e300:
                            return NOT_FINITE
                    i_sample = sample_rest(
                        t,
                        t_end,
                        i_sample,
                        samples,
                        n_sample,
                        out,
                        width,
                        fixed,
                        rest,
                        curves,
                        y1,
                        n,
                    )
                    t = t_end
                    if index >= 0:
                        after_event(t, index, y, m, p, impact, work)
                        if not note_event(t, index, y, impact, events, counts, limit_events):
                            return TOO_MANY_EVENTS
                    h = STEP_AFTER_REST_S
                    fresh = True
                    continue
        if m.system != FIXED:
            note_side(length_state(y), m, p)
        if use == FOLLOW_GRID:
            i_step += 1
            if i_step >= steps:
                return OFF_GRID
            row = grid_row(view(grid, i_step * GRID_COLUMNS))
            end = t_next if row.switch != 0.0 else row.end
            if not t < end <= t_next:
                return OFF_GRID
            last = end == t_next
            trial = end - t
            expected = row.guard >= 0.0
        else:
            last = h >= left * (1.0 - 1e-12)
            trial = left if last else min(h, 0.5 * left)
        if stiff:
            if not have_jacobian:
                jacobian(
                    t,
                    y,
                    k[6],
                    jac,
                    m,
                    u0,
                    du,
                    p,
                    c,
                    work,
                    stage,
                    scale,
                    n,
                    n_all,
                    with_quad,
                    column,
                )
                ramp = du[0] != 0.0 or du[1] != 0.0 or du[2] != 0.0
                for i in range(n_all):
                    ft[i] = 0.0
                if ramp:
                    delta = 1e-9
                    derivative(t + delta, y, column, m, u0, du, p, c, work, with_quad)
                    for i in range(n_all):
                        ft[i] = (column[i] - k[6, i]) / delta
                have_jacobian = True
            norm = stiff_step(
                t,
                trial,
                y,
                y1,
                k,
                m,
                u0,
                du,
                p,
                c,
                work,
                stage,
                err,
                scale,
                n,
                n_all,
                with_quad,
                tolerance,
                jac,
                lu,
                pivot,
                ft,
            )
            power = 0.25
        else:
            for i in range(n_all):
                k[0, i] = k[6, i]
            norm = explicit_step(
                t,
                trial,
                y,
                y1,
                k,
                m,
                u0,
                du,
                p,
                c,
                work,
                stage,
                err,
                scale,
                n,
                n_all,
                with_quad,
                tolerance,
            )
            power = 0.2
        if not norm <= 1.0e300:
            h = 0.1 * trial
            if h < 1e-14 or use == FOLLOW_GRID:
                return NOT_FINITE
            if not stiff:
                for i in range(n_all):
                    k[6, i] = k[0, i]
            counts.rejected += 1
            continue
        factor = 5.0 if norm < 1e-12 else min(5.0, max(0.2, 0.9 * norm ** (-power)))
        if norm > 1.0 and use != FOLLOW_GRID:
            h = trial * min(factor, 0.9)
            if h < 1e-14:
                return STEP_TOO_SMALL
            if not stiff:
                for i in range(n_all):
                    k[6, i] = k[0, i]
            counts.rejected += 1
            continue
        counts.steps += 1
        grown = trial * factor
        h = max(h, grown) if last and trial < h else grown
        h = min(h, LONGEST_REST_STEP_S if at_rest(m) else LONGEST_STEP_S)
        fired = False
        theta = 1.0
        index = -1
        if expected:
            fired = all_guards(t + trial, y1, m, p, work, g) < 0.0
            if not fired:
                theta = hidden_meeting(trial, y, y1, m, p)
                if not stiff:
                    theta = min(theta, hidden_turn(trial, y, y1, k[0], k[6], m))
        sampled = i_sample < n_sample and samples[i_sample] <= t + trial
        if fired or theta < 1.0 or sampled:
            if stiff:
                stiff_dense(y, y1, k, dense, n_all)
            else:
                explicit_dense(trial, y, y1, k, dense, n_all)
        if theta < 1.0:
            interpolate(theta, dense, stage, n_all)
            fired = all_guards(t + theta * trial, stage, m, p, work, g) < 0.0
            if not fired:
                theta = 1.0
                all_guards(t + trial, y1, m, p, work, g)
        if use == FOLLOW_GRID and fired and all_guards(t, y, m, p, work, g0) < 0.0:
            return OFF_GRID
        if fired:
            theta, index = locate(t, trial, theta, dense, y1, m, p, work, g, g0, n_all)
        if use == WRITE_GRID:
            i_step += 1
            row = grid_row(view(grid, min(i_step, steps - 1) * GRID_COLUMNS))
            row.end = t + trial
            row.switch = 1.0 if last else 0.0
            row.guard = index
        elif use == FOLLOW_GRID and row.guard != index:
            return OFF_GRID
        t_end = t + theta * trial
        if last and not fired:
            t_end = t_next
        while i_sample < n_sample and samples[i_sample] <= t_end:
            place = min(max((samples[i_sample] - t) / trial, 0.0), theta)
            interpolate(place, dense, out[i_sample * width :], n)
            i_sample += 1
        for i in range(n_all):
            y[i] = y1[i]
        t = t_end
        if fired:
            after_event(t, index, y, m, p, impact, work)
            if not note_event(t, index, y, impact, events, counts, limit_events):
                return TOO_MANY_EVENTS
            fresh = True
            h = min(h, max(FIRST_STEP_S, 0.3 * trial))
        else:
            if stiff:
                derivative(t, y, k[6], m, u0, du, p, c, work, with_quad)
            have_jacobian = False
            for i in range(GUARDS):
                g0[i] = g[i]
    while i_sample < n_sample:
        for i in range(n):
            out[i_sample * width + i] = y[i]
        i_sample += 1
    for j in range(3):
        u0[j] = u0[j] + du[j] * duration
    step[0] = max(h, 1e-9)
    counts.samples += i_sample
    return DONE
