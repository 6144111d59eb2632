"""Position-driven mode: a measured motion in, chamber pressures out (thesis 3.4.2).

The fixed piston's chamber equations alone: no force balance, so a deviation belongs to flow, volume, exponents or
timing.
"""

from __future__ import annotations

from plant.kernel.compiled import kernel
from plant.kernel.layout import flow_map, parameters
from plant.parts.chamber import chamber


@kernel
def chamber_along(time, volume, start, moves, p, c, out):
    """Pressure of one chamber along a known volume -> out, by Runge-Kutta of order four.

    time [s], volume [m^3] (straight between samples), moves rows (time s, position, slope 1/s) of its valve, which
    split steps.
    """
    p = parameters(p)
    c = flow_map(c)
    alphas = (p.alpha_m1, p.alpha_1, p.alpha_m2, p.alpha_2)
    substeps = 4
    pressure = start
    out[0] = pressure
    u = moves[0, 1]
    slope = 0.0
    since = 0.0
    k = 1
    for i in range(1, len(time)):
        t = time[i - 1]
        rate = (volume[i] - volume[i - 1]) / (time[i] - time[i - 1])
        while t < time[i]:
            while k < len(moves) and moves[k, 0] <= t:
                u = moves[k, 1]
                slope = moves[k, 2]
                since = moves[k, 0]
                k += 1
            end = time[i]
            if k < len(moves) and moves[k, 0] < end:
                end = moves[k, 0]
            h = (end - t) / substeps
            for _ in range(substeps):
                total = 0.0
                slope_before = 0.0
                for stage in range(4):
                    part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                    at = t + part * h
                    value = pressure + part * h * slope_before
                    position = u + slope * (at - since)
                    at_volume = volume[i - 1] + rate * (at - time[i - 1])
                    slope_before = chamber(
                        value, p.t_gas, position, 0.0, at_volume, rate, p.p_supply, alphas, p, c
                    )[0]
                    total += slope_before if part == 0.0 or part == 1.0 else 2.0 * slope_before
                pressure += h * total / 6.0
                t += h
            t = end
        out[i] = pressure
