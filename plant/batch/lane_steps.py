"""Eight lanes side by side: one Runge-Kutta step of all of them as vector instructions.

All numbers of a lane stand `WIDTH` apart in one flat array; the equations are those of the scalar
kernel.  With constant distances inside one array the compiler proves that nothing overlaps, which
it needs to turn eight lanes into one instruction.

Covered: mapped flow without leaks, line, damper, synchronizer, barriers or non-parametric terms
(`FREE_OF`); everything else belongs to the scalar kernel.

Checked by: tests/unit/plant/batch/test_batch.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

from math import sqrt

from plant.equations.fixed_piston import fixed_guards, fixed_rates
from plant.equations.length_contacts import guards
from plant.equations.length_stroke import rates
from plant.integrator.events import fixed_may_hide, may_hide
from plant.integrator.steppers import (
    local_error,
    stage_1,
    stage_2,
    stage_3,
    stage_4,
    stage_5,
    stage_6,
)
from plant.kernel import layout as L
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FLOW_COEFFICIENTS, MAX_STATES, MODES, PARAMETERS
from plant.kernel.views import ABSENT, copy_row, lane, rows

WIDTH = 8

# Parameters and modes that must be 0 in a lane; what depends on them is not compiled.
FREE_OF = (
    L.FLOW_MODEL,
    L.STRIBECK_V,
    L.BUMP_FORCE,
    L.SEAL_MU,
    L.MESH_FORCE,
    L.PULL_FORCE,
    L.SYNC_IMPULSE,
    L.DETENT_FORCE,
    L.LEAK_PISTON,
    L.LEAK_ATM,
    L.ALPHA_SPEED,
    L.TERM_EQUATION,
)
MODES_FREE_OF = (L.M_DAMPER, L.M_LINE, L.M_OIL_REST, L.M_BLOCKED)
ABSENT["lane parameters"] = sum(1 << i for i in FREE_OF)
ABSENT["plain parameters"] = ABSENT["lane parameters"] | 1 << L.ALPHA_V0
ABSENT["lane modes"] = sum(1 << i for i in MODES_FREE_OF)

# Blocks of the flat array, in rows of WIDTH.
Y = 0
STAGE = Y + MAX_STATES
RATE = STAGE + MAX_STATES
RATE_0 = RATE + MAX_STATES
SPARE = RATE_0 + MAX_STATES
K = SPARE + MAX_STATES
DENSE = K + 7 * MAX_STATES
MODE = DENSE + 5 * MAX_STATES
VALVE = MODE + MODES
VALVE_RATE = VALVE + 3
WORK = VALVE_RATE + 3
TIME = WORK + 6
STEP = TIME + 1
WANTED = STEP + 1  # step that the error control would take
NEXT = WANTED + 1  # time of the next switch, or of the end
END = NEXT + 1
NORM = END + 1  # square of the error norm
FACTOR = NORM + 1
ROOT = FACTOR + 1  # sixteenth root of the norm
BEFORE = ROOT + 1  # the same of the last step taken, at least LEAST_ROOT
LOWEST = BEFORE + 1  # guard at the end of the step
HIDES = LOWEST + 1  # 1: a body may have turned or met another within the step
C = HIDES + 1
P = C + FLOW_COEFFICIENTS
STEPS = P + PARAMETERS  # step sizes again, once for every state
SCALE = STEPS + MAX_STATES
TAKE = SCALE + MAX_STATES  # ACCEPTED again, once for every state
ACCEPTED = TAKE + MAX_STATES  # 1: the state at the end of the last step is to be taken
ROWS = ACCEPTED + 1
LANE_STATES = MAX_STATES * WIDTH

lane_fixed_rates = inlined(fixed_rates.py_func)  # type: ignore[attr-defined]
lane_length_rates = inlined(rates.py_func)  # type: ignore[attr-defined]
lane_fixed_guards = inlined(fixed_guards.py_func)  # type: ignore[attr-defined]
lane_length_guards = inlined(guards.py_func)  # type: ignore[attr-defined]


@inlined
def fixed_rates_of_lane(f, j, fraction, parameters):
    """Rates of lane j of fixed-piston strokes."""
    lane_fixed_rates(
        f[TIME * WIDTH + j] + fraction * f[STEP * WIDTH + j],
        lane(f, STAGE, j, WIDTH, ""),
        lane(f, RATE, j, WIDTH, ""),
        lane(f, MODE, j, WIDTH, "lane modes"),
        lane(f, VALVE, j, WIDTH, ""),
        lane(f, VALVE_RATE, j, WIDTH, ""),
        parameters,
        lane(f, C, j, WIDTH, ""),
        False,
    )


@inlined
def length_rates_of_lane(f, j, fraction, parameters):
    """Rates of lane j of length strokes."""
    lane_length_rates(
        f[TIME * WIDTH + j] + fraction * f[STEP * WIDTH + j],
        lane(f, STAGE, j, WIDTH, ""),
        lane(f, RATE, j, WIDTH, ""),
        lane(f, MODE, j, WIDTH, "lane modes"),
        lane(f, VALVE, j, WIDTH, ""),
        lane(f, VALVE_RATE, j, WIDTH, ""),
        parameters,
        lane(f, C, j, WIDTH, ""),
        lane(f, WORK, j, WIDTH, ""),
        False,
    )


@called
def rates_of_lanes(f, fixed, curved, fraction, width):
    """Rates of all lanes at their stage states, `fraction` of their step on: STAGE -> RATE.

    curved: a lane's exponents may follow its speed along a curve; else there is no exp, which would
    be called for one lane after the other.
    """
    if fixed and curved:
        for j in range(width):
            fixed_rates_of_lane(f, j, fraction, lane(f, P, j, WIDTH, "lane parameters"))
    elif fixed:
        for j in range(width):
            fixed_rates_of_lane(f, j, fraction, lane(f, P, j, WIDTH, "plain parameters"))
    elif curved:
        for j in range(width):
            length_rates_of_lane(f, j, fraction, lane(f, P, j, WIDTH, "lane parameters"))
    else:
        for j in range(width):
            length_rates_of_lane(f, j, fraction, lane(f, P, j, WIDTH, "plain parameters"))


@called
def guards_of_lanes(f, fixed, width):
    """Of all lanes: lowest guard at the end of the step -> LOWEST, something hidden in it -> HIDES."""
    if fixed:
        for j in range(width):
            f[LOWEST * WIDTH + j] = lane_fixed_guards(
                f[TIME * WIDTH + j] + f[STEP * WIDTH + j],
                lane(f, STAGE, j, WIDTH, ""),
                lane(f, MODE, j, WIDTH, "lane modes"),
                lane(f, P, j, WIDTH, "lane parameters"),
                lane(f, WORK, j, WIDTH, "discarded"),
            )
            hides = fixed_may_hide(
                lane(f, RATE_0, j, WIDTH, ""),
                lane(f, RATE, j, WIDTH, ""),
                lane(f, MODE, j, WIDTH, "lane modes"),
            )
            f[HIDES * WIDTH + j] = 1.0 if hides else 0.0
    else:
        for j in range(width):
            f[LOWEST * WIDTH + j] = lane_length_guards(
                f[TIME * WIDTH + j] + f[STEP * WIDTH + j],
                lane(f, STAGE, j, WIDTH, ""),
                lane(f, MODE, j, WIDTH, "lane modes"),
                lane(f, P, j, WIDTH, "lane parameters"),
                lane(f, WORK, j, WIDTH, ""),
                lane(f, WORK, j, WIDTH, "discarded"),
            )
            hides = may_hide(
                lane(f, Y, j, WIDTH, ""),
                lane(f, STAGE, j, WIDTH, ""),
                lane(f, RATE_0, j, WIDTH, ""),
                lane(f, RATE, j, WIDTH, ""),
                lane(f, MODE, j, WIDTH, "lane modes"),
                lane(f, P, j, WIDTH, "lane parameters"),
            )
            f[HIDES * WIDTH + j] = 1.0 if hides else 0.0


@inlined
def increments(f, source, stage, count):
    """Step times rates of all lanes -> row `stage` of K."""
    k = f[(K + stage * MAX_STATES) * WIDTH :]
    rate = f[source * WIDTH :]
    steps = f[STEPS * WIDTH :]
    for e in range(count):
        k[e] = steps[e] * rate[e]


@called
def step_of_lanes(f, fixed, curved, n, tolerance, width):
    """One Dormand-Prince step of every lane, each with its own step size.

    First, lanes whose last step was ACCEPTED take its end as their state.  Then
    Y, RATE_0, TIME, STEP -> STAGE (new state), RATE (rates there), K (increments), LOWEST (guard
    there), HIDES, NORM (of the error), ROOT and FACTOR, by which the error lets the step grow; SCALE holds
    the states' typical sizes.
    `width` must be WIDTH; as a variable it keeps the compiler from unrolling the lanes.
    """
    count = n * WIDTH
    y = f[Y * WIDTH :]
    out = f[STAGE * WIDTH :]
    error = f[SPARE * WIDTH :]
    k = rows(f[K * WIDTH :], LANE_STATES)
    for i in range(n):
        copy_row(f, STEP * WIDTH, (STEPS + i) * WIDTH, WIDTH)
        copy_row(f, ACCEPTED * WIDTH, (TAKE + i) * WIDTH, WIDTH)
    take = f[TAKE * WIDTH :]
    first = f[RATE_0 * WIDTH :]
    last = f[RATE * WIDTH :]
    for e in range(count):
        old = y[e]
        new = out[e]
        y[e] = new if take[e] != 0.0 else old
    for e in range(count):
        old = first[e]
        new = last[e]
        first[e] = new if take[e] != 0.0 else old
    increments(f, RATE_0, 0, count)
    stage_1(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.2, width)
    increments(f, RATE, 1, count)
    stage_2(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.3, width)
    increments(f, RATE, 2, count)
    stage_3(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 0.8, width)
    increments(f, RATE, 3, count)
    stage_4(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 8.0 / 9.0, width)
    increments(f, RATE, 4, count)
    stage_5(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 1.0, width)
    increments(f, RATE, 5, count)
    stage_6(1.0, y, k, out, count)
    rates_of_lanes(f, fixed, curved, 1.0, width)
    increments(f, RATE, 6, count)
    guards_of_lanes(f, fixed, width)
    local_error(1.0, k, error, count)
    share = 1.0 / n
    scale = f[SCALE * WIDTH :]
    for e in range(count):
        ratio = error[e] / (tolerance * (scale[e] + max(abs(y[e]), abs(out[e]))))
        error[e] = ratio * ratio
    for j in range(WIDTH):
        f[NORM * WIDTH + j] = 0.0
    for i in range(n):
        for j in range(WIDTH):
            f[NORM * WIDTH + j] += error[i * WIDTH + j]
    for j in range(width):
        # a proportional-integral controller by square roots alone: norm^(-1/8), times the last
        # norm's power 1/16 (see `grown`), which keeps the steps from swinging
        norm = f[NORM * WIDTH + j] * share
        eighth = sqrt(sqrt(sqrt(sqrt(norm))))
        f[NORM * WIDTH + j] = norm
        f[ROOT * WIDTH + j] = sqrt(eighth)
        f[FACTOR * WIDTH + j] = 0.95 / max(eighth, 0.1)
