"""The hybrid integrator: one kernel for a stroke in one call, or pieces under lockstep.

Valve switchings are known instants and split the steps; all else is a guard, located to rounding on the step's
interpolant, after which the modes are chosen anew. Nothing is smoothed.
"""

from __future__ import annotations

from plant.equations.length_contacts import note_side
from plant.integrator import events as event
from plant.integrator import loop, steppers
from plant.integrator.filling import FOLLOW_GRID
from plant.integrator.loop import Motion, control_of, run_of, scratch_of
from plant.integrator.rest import pass_rest
from plant.kernel import layout
from plant.kernel.compiled import called, inlined, kernel
from plant.kernel.views import view


@called
def rests_are_plain(p, m):
    """Return True if chambers at rest follow the flow map alone and all guards are linear in pressures."""
    return (
        p.flow_model == 0.0
        and p.leak_piston == 0.0
        and p.leak_atm == 0.0
        and p.seal_mu == 0.0
        and p.adder == 0.0
        and m.line == 0
    )


@called
def handle_event(index, r, k, o, task):
    """Reset at an event and store it; AGAIN, or TOO_MANY_EVENTS, towards which corners of a law count as well."""
    event.after_event(r.time, index, o)
    k.fresh = 1
    if index >= layout.Guard.CAPPED:
        k.corners += 1
        return loop.AGAIN if k.events + k.corners < k.most_events else loop.TOO_MANY_EVENTS
    if k.events >= task.room or k.events + k.corners >= k.most_events:
        return loop.TOO_MANY_EVENTS
    loop.store_event(r.time, index, layout.impact_of(o.scratch.impact), o.y, k.events, task)
    k.events += 1
    return loop.AGAIN


@called
def begin_piece(r, k, o, task, leaping):
    """Begin after a change: act on guards already passed, pass a rest in one step; STEPPING, AGAIN or why it stops."""
    steppers.derivative(r.time, o.y, r.k[6], o, k.quadratures > 0)
    if event.all_guards(r.time, o.y, o, o.scratch.guards) < 0.0:
        # a jump of input or parameters has already passed a guard
        return handle_event(event.smallest(o.scratch.guards), r, k, o, task)
    k.fresh = 0
    k.has_jacobian = 0
    m = o.m
    if not (leaping and loop.valves_stand(o) and event.at_rest(m) and m.blocked == 0):
        return loop.STEPPING
    if m.damper == layout.COMPRESSIBLE and m.oil_rest == 0:
        return loop.STEPPING
    status, index = pass_rest(r, k, o, r.y1, r.stage, task, k.states)
    if status == loop.AGAIN:
        r.wanted = loop.STEP_AFTER_REST_S
        k.fresh = 1
    return handle_event(index, r, k, o, task) if index >= 0 else status


@inlined
def fills(o):
    """Return True if chambers with masses of their own, or behind a short line, rest: as full as the supply they are stiff."""
    m = o.m
    # such a line settles within milliseconds
    short = m.line != 0 and o.p.line_cda > 0.2 * o.p.line_volume
    return (m.masses != 0 or short) and event.at_rest(m)


@inlined
def is_stiff(o):
    """Return True if steps of an explicit method would be short for stability alone."""
    return o.m.damper == layout.COMPRESSIBLE or fills(o)


@called
def try_step(r, k, o):
    """One step of the method that the modes ask for; error norm and its root's power."""
    n = k.states
    n_all = n + k.quadratures
    if is_stiff(o):
        if k.has_jacobian == 0:
            # positions and speeds
            resting = layout.FIRST_PRESSURE[int(o.m.system)] if fills(o) else 0
            steppers.differentiate(o, r, n, n_all, k.quadratures > 0, resting)
            k.has_jacobian = 1
        return steppers.stiff_step(o, r, n, n_all, k.quadratures > 0), 0.25
    for i in range(n_all):
        r.k[0, i] = r.k[6, i]
    return steppers.explicit_step(o, r, n, n_all, k.quadratures > 0), 0.2


@called
def reject(r, k, h, explicit):
    """Take a step back, the next one shall be h."""
    r.wanted = h
    if explicit:
        for i in range(k.states + k.quadratures):
            r.k[6, i] = r.k[0, i]


@called
def judge_step(r, k, o, norm, power, follow):
    """Accept a step and choose the size of the next; STEPPING, AGAIN if rejected, or why to stop."""
    explicit = not is_stiff(o)
    h = r.step
    if not norm <= 1.0e300:
        if 0.1 * h < 1e-14 or follow:
            return loop.NOT_FINITE
        reject(r, k, 0.1 * h, explicit)
        return loop.AGAIN
    factor = 5.0 if norm < 1e-12 else min(5.0, max(0.2, 0.9 * norm ** (-power)))
    if norm > 1.0 and not follow:
        shorter = h * min(factor, 0.9)
        if shorter < 1e-14:
            return loop.STEP_TOO_SMALL
        reject(r, k, shorter, explicit)
        return loop.AGAIN
    k.steps += 1
    grown = h * factor
    cut = h == r.next - r.time and h < r.wanted
    r.wanted = max(r.wanted, grown) if cut else grown
    r.wanted = min(r.wanted, 0.01 if event.at_rest(o.m) else loop.LONGEST_STEP_S)
    return loop.STEPPING


@called
def find_event(r, k, o, task):
    """Find the first event within the step just taken, as `first_event` does; dense: its interpolant."""
    h = r.step
    end = r.time + h
    n_all = k.states + k.quadratures
    explicit = not is_stiff(o)
    fired = False
    theta = 1.0
    if loop.expects_event(task, k.steps - 1):
        fired = event.all_guards(end, r.y1, o, o.scratch.guards) < 0.0
        if not fired:
            theta = event.hidden_meeting(h, r.y1, o)
            if explicit:
                theta = min(theta, event.hidden_turn(h, r.y1, r.k[0], r.k[6], o))
    sampled = k.next_sample < task.n_sample and task.samples[k.next_sample] <= end
    if fired or theta < 1.0 or sampled:
        if explicit:
            steppers.explicit_dense(h, o.y, r.y1, r.k, r.dense, n_all)
        else:
            steppers.stiff_dense(o.y, r.y1, r.k, r.dense, n_all)
    return loop.first_event(r, theta, fired, r.y1, r.stage, o, task, n_all)


@called
def finish_step(r, k, o, task):
    """Sample the step just accepted, up to the first event in it, and act on that; STEPPING, AGAIN or why it stops."""
    h = r.step
    last = h == r.next - r.time
    theta, index = find_event(r, k, o, task)
    if index == -2 or not loop.follow_or_write(r, task, k.steps - 1, last, float(index)):
        return loop.OFF_GRID
    until = r.next if last and index < 0 else r.time + theta * h
    loop.sample_step(r, k, r.dense, until, theta, task)
    for i in range(k.states + k.quadratures):
        o.y[i] = r.y1[i]
    r.time = until
    if index >= 0:
        status = handle_event(index, r, k, o, task)
        r.wanted = min(r.wanted, max(loop.STEP_AFTER_EVENT_S, 0.3 * h))
        return status
    if is_stiff(o):
        steppers.derivative(r.time, o.y, r.k[6], o, k.quadratures > 0)
    k.has_jacobian = 0
    return loop.STEPPING


@called
def next_event(r, k, o, task, leaping):
    """One turn of the event loop: a switch, an event, a rest or a step; STEPPING, AGAIN, DONE or why it stops."""
    if loop.apply_switches(r, k, o, task):
        k.fresh = 1
        r.wanted = min(r.wanted, 1e-3)
    if r.time >= r.end:
        return loop.DONE
    if k.fresh != 0:
        status = begin_piece(r, k, o, task, leaping)
        if status != loop.STEPPING:
            return status
    if o.m.system != layout.FIXED:
        note_side(layout.length_state(o.y), o.m, o.p)
    status = loop.choose_step(r, k, task)
    if status != loop.STEPPING:
        return status
    norm, power = try_step(r, k, o)
    status = judge_step(r, k, o, norm, power, task.use == FOLLOW_GRID)
    if status != loop.STEPPING:
        return status
    return finish_step(r, k, o, task)


@kernel
def advance(run, control, p, c, switches, samples, out, events, curves, grid):
    """Integrate from time 0 to run.end [s]; returns DONE or the reason to stop.

    run, control: float64 [Run.size], int64 [Control.size], updated in place; p, c: [Parameters.size], [FlowMap.size];
    switches: [k, 4], rows (time s, chamber, position, slope 1/s), ascending; samples: [s], instants at which the state
    is wanted -> out [s, n]; events: [e, EventRow.size], filled in order; curves: filling curves of c [TABLE], to pass
    rests in closed form (without quadratures only), shorter if there are none; grid: [steps, GridRow.size], to write
    or to follow (control.use).
    """
    r = run_of(run)
    k = control_of(control)
    p = layout.parameters(p)
    o = Motion(r.y, layout.modes(k.modes), r.u0, r.du, p, layout.flow_map(c), scratch_of(r.scratch))
    n_sample = samples.shape[0]
    n_columns = out.shape[1]
    columns = k.columns
    for i in range(n_columns):
        columns[i] = i
    task = loop.Task(
        view(switches, 0), switches.shape[0], view(samples, 0), n_sample, columns, n_columns,
        view(out, 0), view(events, 0), events.shape[0], view(curves, 0), curves.shape[0] > 1,
        view(grid, 0), k.grid_steps, k.use, view(curves, 0), False,
    )  # fmt: skip
    leaping = task.tabulated and k.quadratures == 0 and rests_are_plain(p, o.m)
    if k.starting != 0:
        event.choose_modes(0.0, o)
    r.time = 0.0
    k.next_switch = 0
    k.next_sample = 0
    k.most_events = k.events + k.corners + loop.MAX_EVENTS
    k.fresh = 1
    status = loop.STEPPING
    while status < 0:
        status = next_event(r, k, o, task, leaping)
    if status != loop.DONE:
        return status
    for i in range(k.next_sample, n_sample):
        for j in range(n_columns):
            task.out[i * n_columns + j] = r.y[j]
    for j in range(3):
        r.u0[j] = r.u0[j] + r.du[j] * r.end
    r.wanted = max(r.wanted, 1e-9)
    return loop.DONE
