"""Eight lanes side by side: one Runge-Kutta step of all of them as vector instructions.

All numbers of a lane are `WIDTH` apart in one flat array, so that the compiler can prove that nothing overlaps.
Covered: mapped flow without leaks, line, damper, detent, friction of seals or added terms (`FREE_OF`); all else
belongs to the scalar kernel.
"""

from __future__ import annotations

from math import sqrt

from plant.equations.fixed_piston import fixed_guards, fixed_rates
from plant.equations.length_contacts import guards
from plant.equations.length_stroke import rates
from plant.integrator import steppers
from plant.kernel import layout
from plant.kernel.compiled import called, inlined, plain
from plant.kernel.records import Record, Value, block, interleaved
from plant.kernel.views import discarding, lane, named

WIDTH = 8

# Parameters and modes that must be 0 in a lane; what depends on them is not compiled.
FREE_OF = (
    "flow_model",
    "closed_centre",
    "stribeck_v",
    "bump_force",
    "seal_mu",
    "detent_force",
    "leak_piston",
    "leak_atm",
    "alpha_speed",
    "adder",
)
MODES_FREE_OF = ("damper", "line", "masses", "oil_rest")
lane_parameters = named(layout.Parameters, FREE_OF)
plain_parameters = named(layout.Parameters, (*FREE_OF, "alpha_v0"))
lane_modes = named(layout.Modes, MODES_FREE_OF)


class Lane(Record):
    """One of WIDTH interleaved strokes in the flat array."""

    y: Value = block(layout.MAX_STATES)
    stage: Value = block(layout.MAX_STATES)  # state of a stage, at the end the new state
    rate: Value = block(layout.MAX_STATES)  # its rates
    rate_0: Value = block(layout.MAX_STATES)  # rates at the step's start
    spare: Value = block(layout.MAX_STATES)
    k: Value = block(7, layout.MAX_STATES)  # step times rates
    dense: Value = block(5, layout.MAX_STATES)
    modes: Value = block(layout.Modes.size)
    u0: Value = block(3)  # valve positions u0 + du t
    du: Value = block(3)
    time: Value
    step: Value
    wanted: Value  # step that the error control would take
    next: Value  # time of the next switch, or of the end
    end: Value
    norm: Value  # square of the error norm
    factor: Value
    root: Value  # sixteenth root of the norm
    before: Value  # the same of the last step taken, bounded below
    lowest: Value  # guard at the end of the step
    flow: Value = block(layout.FlowMap.size)
    parameters: Value = block(
        layout.Parameters.fields["added_count"].start
    )  # no term is added here
    steps: Value = block(layout.MAX_STATES)  # step sizes again, once for every state
    scale: Value = block(layout.MAX_STATES)
    take: Value = block(layout.MAX_STATES)  # `accepted` again, once for every state
    accepted: Value  # 1: the state at the end of the last step is to be taken


Lanes = interleaved(Lane, WIDTH)
all_lanes = named(Lanes)
lane_record = named(Lane)


@inlined
def lane_of(f, j):
    """Lane j of the flat array."""
    return lane_record(lane(f, j, WIDTH))


def rates_over_lanes(rates_of_system, state, parameters):
    """Return the function that computes the rates of all lanes from a system's equations."""
    rates_of = inlined(plain(rates_of_system))

    @called
    def over_lanes(f, fraction, width):
        for j in range(width):
            one = lane_of(f, j)
            rates_of(
                one.time + fraction * one.step,
                state(one.stage),
                state(one.rate),
                lane_modes(one.modes),
                one.u0,
                one.du,
                parameters(one.parameters),
                layout.flow_map(one.flow),
                False,
            )

    return over_lanes


def guards_over_lanes(guards_of_system, state):
    """Return the function that computes the lowest guard of all lanes at the end of their steps."""
    guards_of = inlined(plain(guards_of_system))

    @called
    def over_lanes(f, width):
        for j in range(width):
            one = lane_of(f, j)
            m = lane_modes(one.modes)
            p = lane_parameters(one.parameters)
            end = state(one.stage)
            one.lowest = guards_of(one.time + one.step, end, m, p, discarding(lane(f, j, WIDTH)))

    return over_lanes


fixed_lanes = rates_over_lanes(fixed_rates, layout.fixed_state, plain_parameters)
length_lanes = rates_over_lanes(rates, layout.length_state, plain_parameters)
curved_fixed_lanes = rates_over_lanes(fixed_rates, layout.fixed_state, lane_parameters)
curved_length_lanes = rates_over_lanes(rates, layout.length_state, lane_parameters)
fixed_lane_guards = guards_over_lanes(fixed_guards, layout.fixed_state)
length_lane_guards = guards_over_lanes(guards, layout.length_state)


@called
def rates_of_lanes(f, fixed, curved, fraction, width):
    """Rates of all lanes, `fraction` of their step on: stage -> rate; only exponents that are `curved` need an exp."""
    if fixed and curved:
        curved_fixed_lanes(f, fraction, width)
    elif fixed:
        fixed_lanes(f, fraction, width)
    elif curved:
        curved_length_lanes(f, fraction, width)
    else:
        length_lanes(f, fraction, width)


@inlined
def increments(steps, rate, k, count):
    """Step times rates of all lanes -> k."""
    for e in range(count):
        k[e] = steps[e] * rate[e]


@called
def step_of_lanes(f, fixed, curved, n, tolerance, width):
    """One Dormand-Prince step of every lane, each with its own size, after the `accepted` ends have become states.

    y, rate_0, time, step -> stage (new state), rate (there), k (increments), lowest (guard there), norm (of the
    error), root and factor, by which the error lets the step grow. `width`: WIDTH, as a variable, so that the lanes
    are not unrolled.
    """
    count = n * WIDTH
    a = all_lanes(f)
    y = a.y
    out = a.stage
    error = a.spare
    k = a.k
    steps = a.steps
    take = a.take
    first = a.rate_0
    last = a.rate
    for i in range(n):
        for j in range(WIDTH):
            steps[i * WIDTH + j] = a.step[j]
            take[i * WIDTH + j] = a.accepted[j]
    for e in range(count):
        old = y[e]
        new = out[e]
        y[e] = new if take[e] != 0.0 else old
    for e in range(count):
        old = first[e]
        new = last[e]
        first[e] = new if take[e] != 0.0 else old
    increments(steps, first, k[0], count)
    steppers.stage_1(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.2, width)
    increments(steps, last, k[1], count)
    steppers.stage_2(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.3, width)
    increments(steps, last, k[2], count)
    steppers.stage_3(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.8, width)
    increments(steps, last, k[3], count)
    steppers.stage_4(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 8.0 / 9.0, width)
    increments(steps, last, k[4], count)
    steppers.stage_5(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 1.0, width)
    increments(steps, last, k[5], count)
    steppers.stage_6(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 1.0, width)
    increments(steps, last, k[6], count)
    if fixed:
        fixed_lane_guards(f, width)
    else:
        length_lane_guards(f, width)
    steppers.local_error(1.0, k, error, count)
    share = 1.0 / n
    scale = a.scale
    norm = a.norm
    for e in range(count):
        ratio = error[e] / (tolerance * (scale[e] + max(abs(y[e]), abs(out[e]))))
        error[e] = ratio * ratio
    for j in range(WIDTH):
        norm[j] = 0.0
    for i in range(n):
        for j in range(WIDTH):
            norm[j] += error[i * WIDTH + j]
    for j in range(width):
        # a proportional-integral controller by square roots alone: norm^(-1/8), times the last
        # norm's power 1/16 (see `grown`), which keeps the steps from swinging
        one = lane_of(f, j)
        one.norm *= share
        eighth = sqrt(sqrt(sqrt(sqrt(one.norm))))
        one.root = sqrt(eighth)
        one.factor = 0.95 / max(eighth, 0.1)
