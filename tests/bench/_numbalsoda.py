"""The fixed-piston stroke by numbalsoda's DOP853 with events; imports numbalsoda when called.

Restarted at breakaway and stop, all of it compiled; the first step is given, as its own choice was
observed to hang at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata

import numpy as np

from tests.bench._piston import Floats, Piston, Shown

SETTINGS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
FIRST_STEP_S = 1e-5


def version() -> str | None:
    """numbalsoda's version, None where it is not installed."""
    try:
        return metadata.version("numbalsoda")
    except metadata.PackageNotFoundError:
        return None


def solver(
    piston: Piston, opening_s: float, times: Floats, tolerance: float
) -> Callable[[], Shown]:
    """A function that solves the stroke; valve 1 opens at `opening_s`, one of `times`."""
    stroke, rates, happens = compiled()
    later = times[times >= opening_s]
    before = len(times) - len(later)
    numbers = np.array([*piston[:16], *piston.charge, *piston.discharge, 0.0])
    start = np.array([0.0, 0.0, piston.atmosphere, piston.atmosphere])
    out = np.zeros((len(later), 4))

    def solve() -> Shown:
        numbers[-1] = 0.0
        impact, speed = stroke(rates, happens, later, start, numbers, tolerance, out)
        if not impact > 0.0:
            raise RuntimeError("the piston does not arrive")
        pressures = np.full((len(times), 2), piston.atmosphere)
        pressures[before:] = out[:, 2:]
        return Shown(impact, speed, pressures)

    return solve


def compiled() -> tuple[Callable[..., tuple[float, float]], int, int]:
    """The stroke's loop, and the addresses of right-hand side and event function."""
    import numba as nb
    from numbalsoda import lsoda_sig, solve_ivp  # type: ignore[import-not-found]

    global _COMPILED
    if _COMPILED is not None:
        return _COMPILED

    @nb.njit
    def drive(u, q):  # type: ignore[no-untyped-def]
        return u[2] * q[0] - u[3] * q[1] - q[2]

    @nb.cfunc(lsoda_sig)
    def rates(_t, u, du, data):  # type: ignore[no-untyped-def]
        q = nb.carray(data, (39,))
        y = max(u[2] / q[10], q[16])
        if y < q[17]:
            phi_in = q[18] + y * (q[19] + y * (q[20] + y * q[21]))
        elif y <= 1.0:
            phi_in = q[22] + y * (q[23] + y * (q[24] + y * (q[25] + y * q[26])))
        else:
            phi_in = q[27] * (y - 1.0)
        z = u[3] / q[11]
        if z < 1.0:
            phi_out = q[37] * (z - 1.0)
        elif z < q[28]:
            phi_out = q[29] + z * (q[30] + z * (q[31] + z * (q[32] + z * q[33])))
        else:
            phi_out = q[34] + z * (q[35] + z * q[36])
        v = u[1]
        du[0] = v
        du[1] = q[38] * (drive(u, q) - q[7] - q[8] * v) / q[5]
        du[2] = (q[12] * phi_in - q[14] * u[2] * q[0] * v) / (q[3] + q[0] * u[0])
        du[3] = (-q[13] * phi_out + q[15] * u[3] * q[1] * v) / (q[4] - q[1] * u[0])

    @nb.cfunc(
        nb.types.void(
            nb.double,
            nb.types.CPointer(nb.double),
            nb.types.CPointer(nb.double),
            nb.types.CPointer(nb.double),
        )
    )
    def happens(_t, u, found, data):  # type: ignore[no-untyped-def]
        q = nb.carray(data, (39,))
        found[0] = drive(u, q) - q[6] if q[38] == 0.0 else u[0] - q[9]

    @nb.njit
    def stroke(rates, happens, times, start, numbers, tolerance, out):  # type: ignore[no-untyped-def]
        y = start.copy()
        t = times[0]
        end = times[-1]
        impact = np.nan
        speed = np.nan
        written = 0
        for phase in range(3):
            numbers[38] = 1.0 if phase == 1 else 0.0
            run = solve_ivp(
                rates, np.array([t, end]), y, t_eval=times[written:],
                n_events=1 if phase < 2 else 0, event_fcn=happens, data=numbers.ctypes.data,
                first_step=FIRST_STEP_S, rtol=tolerance, atol=1e-4 * tolerance,
            )  # fmt: skip
            k = len(run.t)
            out[written : written + k] = run.y
            written += k
            if phase == 2 or not run.event_found:
                break
            t = run.t_event
            y = run.y_event.copy()
            if phase == 1:
                impact = t
                speed = y[1]
                y[0] = numbers[9]
                y[1] = 0.0
        return impact, speed

    _COMPILED = (stroke, rates.address, happens.address)
    return _COMPILED


_COMPILED: tuple[Callable[..., tuple[float, float]], int, int] | None = None
