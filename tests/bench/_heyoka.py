"""The fixed-piston stroke by heyoka's Taylor integrator with events; imports heyoka when called.

The flow maps' regions are chosen by `select` inside the expressions; breakaway and stop are terminal
events, the mode is a parameter of the equations.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata

import numpy as np

from tests.bench._piston import Floats, Piston, Shown

SETTINGS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-9)


def version() -> str | None:
    """heyoka's version, None where it is not installed."""
    try:
        return metadata.version("heyoka")
    except metadata.PackageNotFoundError:
        return None


def solver(
    piston: Piston, opening_s: float, times: Floats, tolerance: float
) -> Callable[[], Shown]:
    """A function that solves the stroke; valve 1 opens at `opening_s`, one of `times`."""
    import heyoka as hy  # type: ignore[import-not-found]

    x, v, first, second = hy.make_vars("x", "v", "p1", "p2")
    moving = hy.par[0]

    def series(coefficients: tuple[float, ...], r: object) -> object:
        total: object = coefficients[-1]
        for value in reversed(coefficients[:-1]):
            total = value + r * total  # type: ignore[operator]
        return total

    y_min, y_split = piston.charge[:2]
    # constant below y_min: select takes its value there
    y = hy.select(hy.lt(first / piston.supply, y_min), y_min, first / piston.supply)
    phi_in = hy.select(
        hy.lt(y, y_split),
        series(piston.charge[2:6], y),
        hy.select(hy.lte(y, 1.0), series(piston.charge[6:11], y), piston.charge[11] * (y - 1.0)),
    )
    z_split = piston.discharge[0]
    z = second / piston.atmosphere
    phi_out = hy.select(
        hy.lt(z, 1.0),
        piston.discharge[9] * (z - 1.0),
        hy.select(
            hy.lt(z, z_split), series(piston.discharge[1:6], z), series(piston.discharge[6:9], z)
        ),
    )
    drive = first * piston.a1 - second * piston.a2 - piston.atmosphere_force
    equations = [
        (x, v),
        (v, moving * (drive - piston.run - piston.beta * v) / piston.mass),
        (
            first,
            (piston.charge_gain * phi_in - piston.alpha_1 * first * piston.a1 * v)
            / (piston.v10 + piston.a1 * x),
        ),
        (
            second,
            (-piston.discharge_gain * phi_out + piston.alpha_2 * second * piston.a2 * v)
            / (piston.v20 - piston.a2 * x),
        ),
    ]
    found = np.zeros(2)

    def breakaway(ta: object, _sign: int) -> bool:
        if ta.pars[0] == 0.0 and ta.state[0] == 0.0:  # type: ignore[attr-defined]
            ta.pars[0] = 1.0  # type: ignore[attr-defined]
        return True

    def stop(ta: object, _sign: int) -> bool:
        found[:] = ta.time, ta.state[1]  # type: ignore[attr-defined]
        ta.state[0] = piston.stroke  # type: ignore[attr-defined]
        ta.state[1] = 0.0  # type: ignore[attr-defined]
        ta.pars[0] = 0.0  # type: ignore[attr-defined]
        return True

    up = hy.event_direction.positive
    ta = hy.taylor_adaptive(
        equations,
        [0.0, 0.0, piston.atmosphere, piston.atmosphere],
        tol=tolerance,
        t_events=[
            hy.t_event(drive - piston.static, callback=breakaway, direction=up),
            hy.t_event(x - piston.stroke, callback=stop, direction=up),
        ],
    )
    later = times[times >= opening_s]
    before = len(times) - len(later)

    def solve() -> Shown:
        ta.time = opening_s
        ta.state[:] = 0.0, 0.0, piston.atmosphere, piston.atmosphere
        ta.pars[0] = 0.0
        ta.reset_cooldowns()
        grid = ta.propagate_grid(later)[-1]
        pressures = np.full((len(times), 2), piston.atmosphere)
        pressures[before : before + len(grid)] = grid[:, 2:]
        return Shown(float(found[0]), float(found[1]), pressures)

    return solve
