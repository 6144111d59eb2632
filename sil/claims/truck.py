"""Chapter 4: the length stroke in the truck, and why feedback fails."""

from __future__ import annotations

from functools import cache

import numpy as np

from plant.systems.stroke import Stroke
from sil.claims.claim import MET, NOT_MET, PARTLY, Outcome, judged
from sil.claims.strokes import ATMOSPHERE_PA, SUPPLY_PA, arrival, nominal, run, speed, value


@cache
def _into_gear(mesh_n: float, impulse_n_s: float) -> Stroke:
    return run(
        "N-B",
        mounted=True,
        mesh_force_n=mesh_n,
        sync_impulse_n_s=impulse_n_s,
        until_s=0.6,
        step_s=2e-4,
    )


@cache
def _to_neutral(pull_n: float) -> Stroke:
    return run("B-N", mounted=True, mesh_force_n=pull_n, until_s=0.4, step_s=2e-4)


def _together_s(stroke: Stroke) -> float:
    """Return the time from the first contact of stay and piston to the end stop [s]."""
    contact = [e.time_s for e in stroke.events if e.name.endswith("contact")]
    return arrival(stroke) - min(contact, default=0.018)


def _f44_plateau() -> Outcome:
    stroke = _into_gear(800.0, 40.0)
    held = np.abs(stroke.position_m - value("synchronizer.x_block")) < 1e-6
    span = float(np.count_nonzero(held)) * 2e-4
    good = span > 0.01 and stroke.impact is not None
    return judged(good, 1e3 * value("synchronizer.x_block"), 1e3 * span)


def _f45_intervals() -> Outcome:
    value = nominal()
    mesh = value.values("synchronizer.F_mesh_typ")
    impulse = value.values("synchronizer.impulse_typ")
    pull = value.values("synchronizer.F_pull_typ")
    gear = [1e3 * _together_s(_into_gear(m, j)) for m, j in zip(mesh, impulse, strict=True)]
    neutral = [1e3 * _together_s(_to_neutral(f)) for f in pull]
    good = (
        60 <= gear[0] <= 80
        and 110 <= gear[1] <= 130
        and 35 <= neutral[0] <= 55
        and (85 <= neutral[1] <= 110)
    )
    return judged(good, *neutral, *gear, otherwise=PARTLY)


def _f46_samples() -> Outcome:
    count = 0.070 / value("opc4.period")
    return judged(abs(count - 7) < 1e-9, count)


def _f47_budget() -> Outcome:
    from sil.claims.equipment import lags

    lasts = []
    for mesh, impulse in ((500.0, 18.0), (1300.0, 18.0)):
        stroke = _into_gear(mesh, impulse)
        lasts.append(arrival(stroke) - [e.time_s for e in stroke.events if e.name == "unblock"][-1])
    last = max(lasts)
    sensor = lags()[0]
    spent = sensor + value("opc4.velocity_delay") + value("valve.D_rise")
    figures = (
        min(lasts),
        last,
        sensor,
        value("opc4.velocity_delay"),
        value("valve.D_rise"),
        spent,
    )
    in_time = not spent > last
    verdict = NOT_MET if in_time else MET if last > 0.03 else PARTLY
    reason = "feedback would be in time" if in_time else ""
    return Outcome(verdict, tuple(1e3 * x for x in figures), reason)


def _f48_stall() -> Outcome:
    p = _into_gear(500.0, 18.0).packed
    force = (SUPPLY_PA - ATMOSPHERE_PA) * (p.area_p + p.area_s)
    return judged(force >= 2200.0, force)


def _f49_spread() -> Outcome:
    loads = ((0.0, 0.0), (500.0, 18.0), (1300.0, 78.0), (500.0, 250.0))
    found = [_into_gear(*load) for load in loads]
    times = [1e3 * arrival(stroke) for stroke in found]
    speeds = [speed(stroke) for stroke in found]
    good = 40.0 < max(times) - min(times) < 1e3 and max(speeds) / min(speeds) > 1.1
    return judged(good, min(times), max(times), min(speeds), max(speeds))


def _f50_truck_channels() -> Outcome:
    from sil.claims.equipment import loop
    from sil.simulation.scenario import load

    mounted = load("full_shift").scenario.plant
    arrived = all(s.arrived_s is not None for s in loop("full_shift").shifts)
    return judged(mounted.mounted and mounted.damper == "none" and arrived)
