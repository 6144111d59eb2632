"""One lane between two vector steps, with the event loop's own functions: accept, events, rests, samples."""

from __future__ import annotations

import numpy as np

from plant.batch.lane_steps import WIDTH, lane_modes, lane_parameters
from plant.equations.length_contacts import note_side
from plant.integrator import events as event
from plant.integrator import loop
from plant.integrator.filling import FOLLOW_GRID
from plant.integrator.loop import Motion
from plant.integrator.rest import pass_rest
from plant.integrator.steppers import dense_element, derivative, explicit_dense
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import LENGTH, Modes, Parameters, flow_map, impact_of, length_state
from plant.kernel.records import Record, Value
from plant.kernel.views import lane, named


class Memory(Record):
    """Counters of a lane (int64)."""

    stroke: Value  # number of the stroke in the lane, IDLE if none
    next_switch: Value
    next_sample: Value
    events: Value
    steps: Value


class Result(Record):
    """What became of one stroke of a batch."""

    status: Value  # DONE or why it stopped
    events: Value
    steps: Value
    arrival: Value  # first impact of the stay on a stop: time, speed, energy; nan if none
    speed: Value
    energy: Value


memory_record = named(Memory)
result_of = named(Result)

IDLE = -1
# What a lane takes of a stroke: no term is added there.
COPIED, MODES = Parameters.fields["added_count"].start, Modes.size


@inlined
def memory_of(memory, j):
    """Return the counters of lane j."""
    return memory_record(lane(memory, j, WIDTH))


@inlined
def motion_of(one, scratch):
    """Return the views of the stroke in a lane."""
    return Motion(
        one.y, lane_modes(one.modes), one.u0, one.du,
        lane_parameters(one.parameters), flow_map(one.flow), scratch,
    )  # fmt: skip


@inlined
def store_arrival(t, impact, result):
    """Store an impact of the stay on a stop as the arrival if it is the first."""
    if impact.speed > 0.0 and impact.at_block == 0.0 and not result.arrival >= 0.0:
        result.arrival = t
        result.speed = impact.speed
        result.energy = impact.lost


@called
def handle_event(index, one, k, o, task, result):
    """Reset at an event and store it, the first impact on a stop as the arrival."""
    event.after_event(one.time, index, o)
    impact = impact_of(o.scratch.impact)
    loop.store_event(one.time, index, impact, o.y, k.events, task)
    store_arrival(one.time, impact, result)
    k.events += 1


@called
def prepare(one, k, o, task, result, n):
    """Bring a lane to its next step, over switches, events and rests: STEPPING, DONE at the end, or why it stops."""
    while True:
        loop.apply_switches(one, k, o, task)
        if one.time >= one.end:
            return loop.DONE
        if k.events > loop.MAX_EVENTS:
            return loop.TOO_MANY_EVENTS
        if event.all_guards(one.time, o.y, o, o.scratch.guards) < 0.0:
            handle_event(event.smallest(o.scratch.guards), one, k, o, task, result)
            continue
        status = loop.STEPPING
        if task.tabulated and loop.valves_stand(o) and event.at_rest(o.m) and o.m.blocked == 0:
            status, index = pass_rest(one, k, o, one.stage, one.spare, task, n)
            if index >= 0:
                handle_event(index, one, k, o, task, result)
                one.wanted = loop.STEP_AFTER_REST_S
        if status == loop.STEPPING:
            if o.m.system == LENGTH:
                note_side(length_state(o.y), o.m, o.p)
            derivative(one.time, o.y, one.rate_0, o, False)
            return loop.choose_step(one, k, task)
        if status != loop.AGAIN:
            return status


@inlined
def grown(one, h, norm, factor):
    """Step that the error control wants after one that was taken; a small error lets it grow freely."""
    root = one.root
    factor *= one.before if norm > 0.01 else 1.0 / max(root, 0.1)
    one.before = max(root, 0.5623413251903491)  # root of a norm of 1e-4
    return h * min(factor, 5.0)


@called
def reject(one, k, follow):
    """Repeat a step with a smaller one; STEPPING, or the reason to stop."""
    finite_norm = one.norm <= 1.0e300
    h = one.step * (min(max(one.factor, 0.2), 0.9) if finite_norm else 0.1)
    one.step = h
    one.wanted = h
    if h < 1e-14 or follow:
        return loop.STEP_TOO_SMALL if finite_norm else loop.NOT_FINITE
    return loop.STEPPING


@called
def find_event(one, k, o, task, until, n):
    """Find the first event of the step, as `first_event` does; stage: the state there, dense: the interpolant."""
    h = one.step
    y1 = one.stage
    theta = 1.0
    fired = False
    if loop.expects_event(task, k.steps - 1):
        fired = one.lowest < 0.0
        if not fired:
            theta = event.hidden_turn(h, y1, one.rate_0, one.rate, o)
            theta = min(theta, event.hidden_meeting(h, y1, o))
    dense = one.dense
    if fired or theta < 1.0:
        explicit_dense(1.0, o.y, y1, one.k, dense, n)
    elif k.next_sample < task.n_sample and task.samples[k.next_sample] <= until:
        for i in range(task.n_columns):
            dense_element(1.0, o.y, y1, one.k, dense, task.columns[i])
    if fired:
        event.all_guards(one.time + h, y1, o, o.scratch.guards)
    return loop.first_event(one, theta, fired, y1, one.spare, o, task, n)


@called
def judge(one, k, o, task, result, n):
    """Accept or reject the step that a lane has just taken; one that follows a grid rejects nothing.

    Returns STEPPING, DONE when something has happened (event, switch, end) and the lane must be prepared, or why it
    stops.
    """
    h = one.step
    one.accepted = 0.0
    follow = task.use == FOLLOW_GRID
    if not one.norm <= (1.0e300 if follow else 1.0):
        return reject(one, k, follow)
    k.steps += 1
    last = h == one.next - one.time
    until = one.next if last else one.time + h
    wanted = one.wanted
    longer = grown(one, h, one.norm, one.factor)
    one.wanted = min(max(wanted, longer) if h < wanted else longer, loop.LONGEST_STEP_S)
    theta, index = find_event(one, k, o, task, until, n)
    if index == -2:
        return loop.OFF_GRID
    if index >= 0:
        until = one.time + theta * h
    loop.sample_step(one, k, one.dense, until, theta, task)
    if not loop.follow_or_write(one, task, k.steps - 1, last, float(index)):
        return loop.OFF_GRID
    one.time = until
    if index < 0 and not last:
        one.accepted = 1.0
        if o.m.system == LENGTH:
            note_side(length_state(one.stage), o.m, o.p)
        return loop.choose_step(one, k, task)
    for e in range(n):
        o.y[e] = one.stage[e]
    if index >= 0:
        handle_event(index, one, k, o, task, result)
        one.wanted = min(one.wanted, max(loop.STEP_AFTER_EVENT_S, 0.3 * h))
        one.before = 1.0
    return loop.DONE


@called
def begin(one, k, o, result):
    """Begin the stroke that was put into a lane."""
    one.accepted = 0.0
    one.wanted = loop.STEP_AFTER_REST_S
    one.before = 1.0
    k.next_switch = 0
    k.next_sample = 0
    k.events = 0
    k.steps = 0
    result.arrival = np.nan
    result.speed = np.nan
    result.energy = np.nan
    event.choose_modes(0.0, o)
