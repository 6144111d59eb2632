"""Chapter 4: the length stroke in the truck, and why feedback fails."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from can_dbc.messages import PositionPulse
from plant.parameters import load
from plant.systems.stroke import Stroke
from sil.simulation import load_scenario
from tests.claims.claim import GIVEN, MET, NOT_MET, PARTLY, Outcome, judged
from tests.claims.equipment import lags
from tests.claims.strokes import ATMOSPHERE_PA, SUPPLY_PA, arrival, loop, ms, nominal, run, value


@cache
def _into_gear(mesh_n: float, impulse_n_s: float, model: str = "nominal") -> Stroke:
    return run(
        "N-B",
        parameters=load(model),
        mounted=True,
        mesh_force_n=mesh_n,
        sync_impulse_n_s=impulse_n_s,
        until_s=0.6,
        step_s=2e-4,
    )


def _together_s(stroke: Stroke) -> float:
    """Return the time from the first contact of stay and piston to the end stop [s]."""
    contact = [e.time_s for e in stroke.events if e.name.endswith("contact")]
    return arrival(stroke) - min(contact, default=0.018)


def _f44_plateau() -> Outcome:
    stroke, block_m = _into_gear(800.0, 40.0), value("synchronizer.x_block")
    held_s = np.count_nonzero(np.abs(stroke.position_m - block_m) < 1e-6) * 2e-4
    good = bool(held_s > 0.01) and stroke.impact is not None
    return judged(good, *ms(block_m, held_s), verdict=GIVEN)


def _f45_intervals() -> Outcome:
    mesh, impulse, pull = (
        nominal().values(f"synchronizer.{name}")
        for name in ("F_mesh_typ", "impulse_typ", "F_pull_typ")
    )
    gear = ms(*(_together_s(_into_gear(m, j)) for m, j in zip(mesh, impulse, strict=True)))
    to_neutral: dict[str, Any] = {"mounted": True, "until_s": 0.4, "step_s": 2e-4}
    neutral = ms(*(_together_s(run("B-N", mesh_force_n=f, **to_neutral)) for f in pull))
    others = ms(*(_together_s(_into_gear(m, j)) for m in (0.0, 1300.0) for j in (2.0, 250.0)))
    limits = ((35, 55), (85, 110), (60, 80), (110, 130))
    found = (*neutral, *gear)
    good = all(low <= x <= high for x, (low, high) in zip(found, limits, strict=True))
    return judged(good, *found, min(others), max(others), verdict=GIVEN)


def _f46_samples() -> Outcome:
    record = loop("truck_into_gear_easy").record
    contact_s, stop_s = (
        next(e.time_s for e in record.events if e.name == name)
        for name in ("collar_1_contact", "stay_stop")
    )
    times, _ = record.series(PositionPulse, "pulse_s")
    count = int(np.count_nonzero((times >= contact_s) & (times <= stop_s)))
    return judged(count == 7, 1e3 * (stop_s - contact_s), count)


def _f47_budget() -> Outcome:
    parts = lags()[0], value("opc4.velocity_delay"), value("valve.D_rise")
    lasts = []
    for model in ("nominal", "truck_40ms"):
        for mesh_n, impulse_n_s in ((500.0, 5.0), (500.0, 18.0), (1300.0, 18.0)):
            events = _into_gear(mesh_n, impulse_n_s, model).events
            unblocked_s = [e.time_s for e in events if e.name == "unblock"][-1]
            lasts.append(next(e.time_s for e in events if e.name == "stop") - unblocked_s)
    light, heavy, spent = lasts[:3], lasts[3:], sum(parts)
    around = min(heavy) > 0.03 and max(heavy) < 0.045
    verdict = NOT_MET if spent <= max(lasts) else MET if around else PARTLY
    return Outcome(verdict, ms(min(light), max(light), min(heavy), max(heavy), *parts, spent))


def _f48_stall() -> Outcome:
    p = _into_gear(500.0, 18.0).packed
    force = (SUPPLY_PA - ATMOSPHERE_PA) * (p.area_p + p.area_s)
    return judged(force >= 2200.0, force)


def _f49_spread() -> Outcome:
    tuned = {
        "controller.strategy": "predictive",
        "controller.strategy_parameters.time_weight_m_s2": 27.146,
        "controller.strategy_parameters.way_weight_per_s": 552.12,
    }
    mounted = {"plant.mounted": True, "plant.mesh_force_n": 1300.0, "duration_s": 0.9}
    loads = [mounted | {"driveline.impulse_backward_n_s": j} for j in (18.0, 78.0, 250.0)]
    figures = [
        loop("lab_n_b", **load, **more).shifts[0].impact_worst_m_s or 0.0
        for load in ({}, *loads)
        for more in (tuned, {})
    ]
    bench, truck = figures[:2], figures[2:]
    fails = all(mpc > 0.95 * plain for mpc, plain in zip(truck[::2], truck[1::2], strict=True))
    return judged(bench[0] < 0.6 * bench[1] and fails, *figures)


def _f50_truck_channels() -> Outcome:
    plant = load_scenario.load("full_shift").scenario.plant
    arrived = all(s.arrived_s is not None for s in loop("full_shift").shifts)
    return judged(plant.mounted and plant.damper == "none" and arrived)
