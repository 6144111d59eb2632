"""The fixed piston by the thesis's equations for other solvers; how contenders are compared by CPU time."""

from __future__ import annotations

import time
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


IMPACT_S, SPEED_M_S, PRESSURE_PA = 1e-6, 1e-3, 200.0
SCIPY_SETTINGS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
OUR_SETTINGS = (5e-5, 2e-5, 1e-5, 7e-6, 5e-6, 2e-6, 1e-6, 1e-7)


def best_s(once: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of several CPU times, after one call that warms up."""
    once()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        once()
        times.append(time.process_time() - begin)
    return min(times)


def errors(found: Sequence[Shown], reference: Sequence[Shown]) -> tuple[float, float, float]:
    """Largest errors of impact time [s], impact speed [m/s] and pressure [Pa]."""
    pairs = list(zip(found, reference, strict=True))
    return (
        max(abs(a.impact_s - b.impact_s) for a, b in pairs),
        max(abs(a.speed_m_s - b.speed_m_s) for a, b in pairs),
        max(float(np.abs(a.pressures_pa - b.pressures_pa).max()) for a, b in pairs),
    )


def accurate(worst: tuple[float, float, float]) -> bool:
    """True if errors are within the limits (a missing impact is not)."""
    return worst[0] < IMPACT_S and worst[1] < SPEED_M_S and worst[2] < PRESSURE_PA


def cheapest(
    solve: Callable[[float], Sequence[Shown]], settings: Sequence[float], reference: Sequence[Shown]
) -> tuple[float, tuple[float, float, float]]:
    """First of the settings, loosest first, that is accurate enough, with its errors."""
    for setting in settings:
        try:
            worst = errors(solve(setting), reference)
        except RuntimeError:
            continue
        if accurate(worst):
            return setting, worst
    raise RuntimeError("no setting is accurate enough")


def row(
    name: str, each_s: float, floors_s: Sequence[float], setting: float, worst: tuple[float, ...]
) -> str:
    """One contender's line: CPU time a stroke, how many times as fast as each floor, its errors."""
    ratios = " ".join(f"{floor_s / each_s:8.0f} x" for floor_s in floors_s)
    return (
        f"{name:44} {1e6 * each_s:9.1f} us {ratios}   at {setting:.0e}: "
        f"{1e6 * worst[0]:.2f} us, {1e3 * worst[1]:.2f} mm/s, {worst[2]:.0f} Pa"
    )


def one_by_one(
    setups: Sequence[Setup],
    times: Floats,
    pressures: slice,
    reference: Sequence[Shown],
    floors_s: Sequence[float],
) -> str:
    """Our line for single strokes, called from Python one after the other."""
    from plant.batch.prediction import Predictor
    from plant.kernel.layout import EventRow

    samples = np.rint(times * 1e9).astype(np.int64)

    def solve(tolerance: float) -> list[Shown]:
        predictor = Predictor(samples, tolerance)
        found = []
        for setup in setups:
            states = predictor.states(setup)
            stop = next(
                e for e in predictor.happened if e[EventRow.speed] > 0.0 and e[EventRow.lost] > 0.0
            )
            found.append(Shown(stop[EventRow.time], stop[EventRow.speed], states[:, pressures]))
        return found

    setting, worst = cheapest(solve, OUR_SETTINGS, reference)
    predictor = Predictor(samples, setting)

    def loop() -> None:
        for setup in setups:
            predictor.states(setup)

    each_s = best_s(loop, 40) / len(setups)
    return row("ours, one by one from Python", each_s, floors_s, setting, worst)
