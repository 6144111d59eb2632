"""The fixed piston in plain Python for solvers that are not ours: equations, events, resets.

At rest until the pressure breaks it away, moving until it hits a stop or turns.  Written from the
thesis's equations; the numbers come from the packed set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.effects.setup import Setup
from plant.kernel.layout import FlowMap

Floats = NDArray[np.float64]


class Shown(NamedTuple):
    """What a solver found: impact [s after opening], its speed [m/s], pressures [n, 2] [Pa]."""

    impact_s: float
    speed_m_s: float
    pressures_pa: Floats


class Piston(NamedTuple):
    """Numbers of one stroke."""

    a1: float
    a2: float
    atmosphere_force: float
    v10: float
    v20: float
    mass: float
    static: float
    run: float
    beta: float
    stroke: float
    supply: float
    atmosphere: float
    charge_gain: float
    discharge_gain: float
    alpha_1: float
    alpha_2: float
    charge: tuple[float, ...]
    discharge: tuple[float, ...]

    @classmethod
    def of(cls, setup: Setup) -> Piston:
        """The numbers of a setup without leaks, damper or effects."""
        p, c = setup.p, setup.c
        return cls(
            p.area_p,
            p.area_p2,
            p.p_atm * p.area_s,
            p.vol_b,
            p.vol_n,
            p.m_s,
            max(p.f_static_s, p.f_run_s) + p.f_linkage,
            p.f_run_s + p.f_linkage,
            p.beta_s,
            p.stroke,
            p.p_supply,
            p.p_atm,
            p.r_air * p.alpha_m1 * p.k_in * p.p_supply,
            p.r_air * p.alpha_m2 * p.k_out * p.p_atm,
            p.alpha_1,
            p.alpha_2,
            tuple(float(v) for v in c[: FlowMap.z_split]),
            tuple(float(v) for v in c[FlowMap.z_split :]),
        )

    def filling(self, pressure: float) -> float:
        """R alpha_m1 f_in [Pa m^3/s]."""
        y_min, y_split, h0, h1, h2, h3, l0, l1, l2, l3, l4, slope = self.charge
        y = pressure / self.supply
        y = y if y > y_min else y_min
        if y < y_split:
            phi = h0 + y * (h1 + y * (h2 + y * h3))
        elif y <= 1.0:
            phi = l0 + y * (l1 + y * (l2 + y * (l3 + y * l4)))
        else:
            phi = slope * (y - 1.0)
        return self.charge_gain * phi

    def emptying(self, pressure: float) -> float:
        """R alpha_m2 f_out [Pa m^3/s]."""
        z_split, l0, l1, l2, l3, l4, h0, h1, h2, slope = self.discharge
        z = pressure / self.atmosphere
        if z < 1.0:
            phi = slope * (z - 1.0)
        elif z < z_split:
            phi = l0 + z * (l1 + z * (l2 + z * (l3 + z * l4)))
        else:
            phi = h0 + z * (h1 + z * h2)
        return self.discharge_gain * phi

    def drive(self, first: float, second: float) -> float:
        """Force of the gas on the piston [N]."""
        return first * self.a1 - second * self.a2 - self.atmosphere_force

    def rates(
        self, direction: int, u1: int, u2: int
    ) -> Callable[[float, Floats], tuple[float, ...]]:
        """Right-hand side x, v, P1, P2: at rest (direction 0) or moving, valves at u1, u2."""
        friction = direction * self.run

        def rates(_t: float, y: Floats) -> tuple[float, ...]:
            x, v, first, second = y.tolist()
            gas1 = self.filling(first) if u1 else -self.emptying(first)
            gas2 = self.filling(second) if u2 else -self.emptying(second)
            alpha1 = self.alpha_1 if u1 else self.alpha_2
            alpha2 = self.alpha_1 if u2 else self.alpha_2
            a = 0.0
            if direction:
                a = (self.drive(first, second) - friction - self.beta * v) / self.mass
            return (
                v,
                a,
                (gas1 - alpha1 * first * self.a1 * v) / (self.v10 + self.a1 * x),
                (gas2 + alpha2 * second * self.a2 * v) / (self.v20 - self.a2 * x),
            )

        return rates

    def guards(
        self, direction: int, x: float
    ) -> list[tuple[str, Callable[[float, Floats], float]]]:
        """Events that may end the mode, each crossing zero downward."""
        if direction:
            stop = self.stroke if direction > 0 else 0.0
            return [
                ("stop", lambda _t, y: direction * (stop - y[0])),
                ("turn", lambda _t, y: direction * y[1]),
            ]
        found: list[tuple[str, Callable[[float, Floats], float]]] = []
        if x < self.stroke:
            found.append(("forth", lambda _t, y: self.static - self.drive(y[2], y[3])))
        if x > 0.0:
            found.append(("back", lambda _t, y: self.static + self.drive(y[2], y[3])))
        return found


Switch = tuple[float, int, int]


def solve_with_scipy(
    piston: Piston,
    switches: Sequence[Switch],
    times: Floats,
    method: str = "LSODA",
    tolerance: float = 1e-6,
    begin_s: float = 0.0,
) -> Shown:
    """One stroke by solve_ivp, restarted at every event and switch (time, valve, position).

    Starts at rest, vented, and at `begin_s`, before which nothing may switch; pressures at `times`.
    Raises RuntimeError if the piston does not arrive.
    """
    from scipy.integrate import solve_ivp

    atol = tolerance * np.array([1e-3, 1e-1, 1e5, 1e5])
    pressures = np.full((len(times), 2), piston.atmosphere)
    y = np.array([0.0, 0.0, piston.atmosphere, piston.atmosphere])
    valves = [0, 0]
    pending = list(switches)
    t, end = begin_s, float(times[-1])
    direction = 0
    impact, speed = np.nan, np.nan
    while t < end:
        while pending and pending[0][0] <= t:
            _, valve, position = pending.pop(0)
            valves[valve] = position
        until = min(end, pending[0][0]) if pending else end
        names, events = [], []
        for name, guard in piston.guards(direction, y[0]):
            guard.terminal, guard.direction = True, -1.0  # type: ignore[attr-defined]
            names.append(name)
            events.append(guard)
        first, last = np.searchsorted(times, t), np.searchsorted(times, until, side="right")
        run = solve_ivp(
            piston.rates(direction, *valves), (t, until), y, method, times[first:last],
            events=events, rtol=tolerance, atol=atol,
        )  # fmt: skip
        if len(run.t):
            pressures[first : first + len(run.t)] = run.y[2:].T
        if run.status != 1:
            t = until
            if len(run.t) == 0 or run.t[-1] != until:
                raise RuntimeError("the stroke's times must hold its switches")
            y = run.y[:, -1].copy()
            continue
        at, happened = min(
            (float(found[0]), k) for k, found in enumerate(run.t_events) if len(found)
        )
        t, y = at, run.y_events[happened][0].copy()
        name = names[happened]
        if name == "stop":
            impact, speed = (t, abs(float(y[1]))) if np.isnan(impact) else (impact, speed)
            y[0] = piston.stroke if direction > 0 else 0.0
        if name in ("stop", "turn"):
            y[1] = 0.0
            direction = 0
            drive = piston.drive(y[2], y[3])
            if name == "turn" and abs(drive) > piston.static:
                direction = 1 if drive > 0.0 else -1
        else:
            direction = 1 if name == "forth" else -1
    if np.isnan(impact):
        raise RuntimeError("the piston does not arrive")
    return Shown(impact, speed, pressures)
