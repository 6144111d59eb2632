"""One step of an explicit and of an L-stable Runge-Kutta method, with dense output.

`explicit_step`: Dormand-Prince 5(4), order-4 dense output. `stiff_step`: Rodas4, order 4(3), for the compressible oil
damper, its Jacobian by forward differences. Sources: Dormand and Prince 1980; Hairer, Norsett, Wanner, Solving ODEs I
(II.5, II.6); Hairer, Wanner, Solving ODEs II (IV.7, IV.10). Checked by: tests/physics/test_steppers.py
"""

from __future__ import annotations

import numpy as np

from plant.equations.fixed_piston import fixed_rates
from plant.equations.length_stroke import rates
from plant.kernel.compiled import called, inlined
from plant.kernel.layout import FIXED, fixed_state, length_state

# Coefficients of Rodas4; rows: stages (of TO_DENSE: of the interpolant), columns: stages before.
STAGE_TIMES, BY_TIME = (
    np.array([0.0, 0.386, 0.21, 0.63, 1.0, 1.0]),
    np.array([0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0]),
)
TO_STATE, TO_RATE, TO_DENSE = np.zeros((6, 5)), np.zeros((6, 5)), np.zeros((2, 5))
TO_STATE[2, :2] = 0.9466785280815826, 0.2557011698983284
TO_STATE[3, :3] = 3.314825187068521, 2.896124015972201, 0.9986419139977817
TO_STATE[4, :4] = 1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950
TO_STATE[5] = *TO_STATE[4, :4], 1.0
TO_RATE[2, :2] = -2.430093356833875, -0.2063599157091915
TO_RATE[3, :3] = -0.1073529058151375, -9.594562251023355, -20.47028614809616
TO_RATE[4, :4] = 7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160
TO_RATE[5, :3] = 8.083246795921522, -7.981132988064893, -31.52159432874371
TO_RATE[5, 3:] = 16.31930543123136, -6.058818238834054
TO_DENSE[0, :3] = 10.12623508344586, -7.487995877610167, -34.80091861555747
TO_DENSE[0, 3:] = -7.992771707568823, 1.025137723295662
TO_DENSE[1, :3] = -0.6762803392806898, 6.087714651680015, 16.43084320892478
TO_DENSE[1, 3:] = 24.76722511418386, -6.594389125716872


@called
def derivative(t, y, dy, o, quadratures):
    """Right-hand side of the stroke's system -> dy."""
    if o.m.system == FIXED:
        fixed_rates(t, fixed_state(y), fixed_state(dy), o.m, o.u0, o.du, o.p, o.c, quadratures)
    else:
        rates(t, length_state(y), length_state(dy), o.m, o.u0, o.du, o.p, o.c, quadratures)


@called
def error_norm(y, r, n):
    """Root mean square of the local error over tolerance (scale + |y|)."""
    y1 = r.y1
    error = r.error
    scale = r.scale
    tolerance = r.tolerance
    total = 0.0
    for i in range(n):
        weight = tolerance * (scale[i] + max(abs(y[i]), abs(y1[i])))
        total += (error[i] / weight) ** 2
    return (total / n) ** 0.5


@inlined
def stage_1(h, y, k, out, count):
    """State of the first inner stage: y + h/5 k0."""
    for i in range(count):
        out[i] = y[i] + h * 0.2 * k[0, i]


@inlined
def stage_2(h, y, k, out, count):
    """State of the second inner stage."""
    for i in range(count):
        out[i] = y[i] + h * (3.0 / 40.0 * k[0, i] + 9.0 / 40.0 * k[1, i])


@inlined
def stage_3(h, y, k, out, count):
    """State of the third inner stage."""
    for i in range(count):
        out[i] = y[i] + h * (44.0 / 45.0 * k[0, i] - 56.0 / 15.0 * k[1, i] + 32.0 / 9.0 * k[2, i])


@inlined
def stage_4(h, y, k, out, count):
    """State of the fourth inner stage."""
    for i in range(count):
        out[i] = y[i] + h * (
            19372.0 / 6561.0 * k[0, i]
            - 25360.0 / 2187.0 * k[1, i]
            + 64448.0 / 6561.0 * k[2, i]
            - 212.0 / 729.0 * k[3, i]
        )


@inlined
def stage_5(h, y, k, out, count):
    """State of the fifth inner stage, at the end of the step."""
    for i in range(count):
        out[i] = y[i] + h * (
            9017.0 / 3168.0 * k[0, i]
            - 355.0 / 33.0 * k[1, i]
            + 46732.0 / 5247.0 * k[2, i]
            + 49.0 / 176.0 * k[3, i]
            - 5103.0 / 18656.0 * k[4, i]
        )


@inlined
def stage_6(h, y, k, out, count):
    """Return the solution of order 5, which is also the last stage."""
    for i in range(count):
        out[i] = y[i] + h * (
            35.0 / 384.0 * k[0, i]
            + 500.0 / 1113.0 * k[2, i]
            + 125.0 / 192.0 * k[3, i]
            - 2187.0 / 6784.0 * k[4, i]
            + 11.0 / 84.0 * k[5, i]
        )


@inlined
def local_error(h, k, out, count):
    """Difference of the solutions of order 5 and 4."""
    for i in range(count):
        out[i] = h * (
            71.0 / 57600.0 * k[0, i]
            - 71.0 / 16695.0 * k[2, i]
            + 71.0 / 1920.0 * k[3, i]
            - 17253.0 / 339200.0 * k[4, i]
            + 22.0 / 525.0 * k[5, i]
            - 1.0 / 40.0 * k[6, i]
        )


@called
def explicit_step(o, r, n, n_all, quadratures):
    """Dormand-Prince 5(4) from y (k[0] = f(t, y)) -> y1, k[6] = f(t + h, y1); error norm."""
    t = r.time
    h = r.step
    y = o.y
    k = r.k
    stage = r.stage
    stage_1(h, y, k, stage, n_all)
    derivative(t + 0.2 * h, stage, k[1], o, quadratures)
    stage_2(h, y, k, stage, n_all)
    derivative(t + 0.3 * h, stage, k[2], o, quadratures)
    stage_3(h, y, k, stage, n_all)
    derivative(t + 0.8 * h, stage, k[3], o, quadratures)
    stage_4(h, y, k, stage, n_all)
    derivative(t + 8.0 / 9.0 * h, stage, k[4], o, quadratures)
    stage_5(h, y, k, stage, n_all)
    derivative(t + h, stage, k[5], o, quadratures)
    stage_6(h, y, k, r.y1, n_all)
    derivative(t + h, r.y1, k[6], o, quadratures)
    local_error(h, k, r.error, n)
    return error_norm(y, r, n)


@inlined
def dense_element(h, y, y1, k, dense, i):
    """Coefficients of element i of the order-4 interpolant of the last explicit step."""
    d = y1[i] - y[i]
    b = h * k[0, i] - d
    dense[0, i] = y[i]
    dense[1, i] = d
    dense[2, i] = b
    dense[3, i] = d - h * k[6, i] - b
    dense[4, i] = h * (
        -12715105075.0 / 11282082432.0 * k[0, i]
        + 87487479700.0 / 32700410799.0 * k[2, i]
        - 10690763975.0 / 1880347072.0 * k[3, i]
        + 701980252875.0 / 199316789632.0 * k[4, i]
        - 1453857185.0 / 822651844.0 * k[5, i]
        + 69997945.0 / 29380423.0 * k[6, i]
    )


@called
def explicit_dense(h, y, y1, k, dense, n_all):
    """Coefficients of the order-4 interpolant of the last explicit step -> dense[0:5]."""
    for i in range(n_all):
        dense_element(h, y, y1, k, dense, i)


@inlined
def interpolated(theta, dense, i):
    """Element i of the state at the fraction theta of the last step."""
    rest = 1.0 - theta
    return dense[0, i] + theta * (
        dense[1, i] + rest * (dense[2, i] + theta * (dense[3, i] + rest * dense[4, i]))
    )


@called
def interpolate(theta, dense, out, n_all):
    """State at the fraction theta of the last step -> out."""
    for i in range(n_all):
        out[i] = interpolated(theta, dense, i)


@called
def differentiate(o, r, n, n_all, quadratures, resting):
    """Compute the derivatives of f = k[6] = f(t, y) by forward differences: by states -> jacobian, by time.

    By the first `resting` states, which do not change, they are zero: so these stay exactly where they are.
    """
    t = r.time
    y = o.y
    f = r.k[6]
    stage = r.stage
    column = r.column
    jacobian = r.jacobian
    for i in range(n_all):
        stage[i] = y[i]
    for j in range(resting):
        for i in range(n_all):
            jacobian[i, j] = 0.0
    for j in range(resting, n):
        delta = 1.5e-8 * max(abs(y[j]), r.scale[j])
        stage[j] = y[j] + delta
        delta = stage[j] - y[j]
        derivative(t, stage, column, o, quadratures)
        for i in range(n_all):
            jacobian[i, j] = (column[i] - f[i]) / delta
        stage[j] = y[j]
    time_rate = r.time_rate
    for i in range(n_all):
        time_rate[i] = 0.0
    if o.du[0] != 0.0 or o.du[1] != 0.0 or o.du[2] != 0.0:
        delta = 1e-9
        derivative(t + delta, y, column, o, quadratures)
        for i in range(n_all):
            time_rate[i] = (column[i] - f[i]) / delta


@called
def factorise(r, n, diagonal):
    """LU factors with partial pivoting of diagonal I - J -> lu, pivot."""
    lu = r.lu
    for i in range(n):
        for j in range(n):
            lu[i, j] = -r.jacobian[i, j]
        lu[i, i] += diagonal
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(lu[i, j]) > abs(lu[best, j]):
                best = i
        r.pivot[j] = best
        if best != j:
            for i in range(n):
                lu[j, i], lu[best, i] = lu[best, i], lu[j, i]
        for i in range(j + 1, n):
            lu[i, j] /= lu[j, j]
            for k in range(j + 1, n):
                lu[i, k] -= lu[i, j] * lu[j, k]


@called
def solve(r, x, n, n_all, diagonal):
    """Solve (diagonal I - J) x = x in place; quadrature rows follow from the states."""
    lu = r.lu
    jacobian = r.jacobian
    for j in range(n):
        best = int(r.pivot[j])
        if best != j:
            x[j], x[best] = x[best], x[j]
    for i in range(n):
        for j in range(i):
            x[i] -= lu[i, j] * x[j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= lu[i, j] * x[j]
        x[i] /= lu[i, i]
    for i in range(n, n_all):
        for j in range(n):
            x[i] += jacobian[i, j] * x[j]
        x[i] /= diagonal


@inlined
def combined(total, weights, count, k, i):
    """Return a total and elements i of the first `count` rows of k, times their weights."""
    for j in range(count):
        total += weights[j] * k[j, i]
    return total


@inlined
def stiff_stage(number, o, r, n, n_all, quadratures):
    """Stage 2 to 5 of Rodas4 -> k[number]; stage: the state at which it is taken."""
    h = r.step
    k = r.k
    stage = r.stage
    to_state, to_rate = TO_STATE[number], TO_RATE[number]
    for i in range(n_all):
        stage[i] = combined(o.y[i], to_state, number, k, i)
    derivative(r.time + STAGE_TIMES[number] * h, stage, k[number], o, quadratures)
    by_time = h * BY_TIME[number]
    for i in range(n_all):
        k[number, i] += combined(0.0, to_rate, number, k, i) / h + by_time * r.time_rate[i]
    solve(r, k[number], n, n_all, 1.0 / (h * 0.25))


@called
def stiff_step(o, r, n, n_all, quadratures):
    """Rodas4 from y (k[6] = f(t, y), derivatives by `differentiate`) -> y1, stages in k[0:6]; returns error norm."""
    h = r.step
    y = o.y
    k = r.k
    stage = r.stage
    ft = r.time_rate
    diagonal = 1.0 / (h * 0.25)
    factorise(r, n, diagonal)
    for i in range(n_all):
        k[0, i] = k[6, i] + h * 0.25 * ft[i]
    solve(r, k[0], n, n_all, diagonal)
    for i in range(n_all):
        stage[i] = y[i] + 1.544 * k[0, i]
    derivative(r.time + 0.386 * h, stage, k[1], o, quadratures)
    for i in range(n_all):
        k[1, i] += -5.6688 / h * k[0, i] - h * 0.1043 * ft[i]
    solve(r, k[1], n, n_all, diagonal)
    for number in range(2, 6):
        stiff_stage(number, o, r, n, n_all, quadratures)
    for i in range(n_all):
        r.y1[i] = stage[i] + k[5, i]
    for i in range(n):
        r.error[i] = k[5, i]
    return error_norm(y, r, n)


@called
def stiff_dense(y, y1, k, dense, n_all):
    """Coefficients of the order-4 interpolant of the last stiff step -> dense[0:5]."""
    for i in range(n_all):
        dense[0, i] = y[i]
        dense[1, i] = y1[i] - y[i]
        dense[2, i] = combined(0.0, TO_DENSE[0], 5, k, i)
        dense[3, i] = combined(0.0, TO_DENSE[1], 5, k, i)
        dense[4, i] = 0.0
