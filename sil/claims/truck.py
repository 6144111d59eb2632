"""Chapter 4: the length stroke in the truck, and why feedback fails."""

from __future__ import annotations

from functools import cache

import numpy as np

from plant.parameters import load
from plant.systems.stroke import Stroke
from sil.claims.claim import GIVEN, MET, NOT_MET, PARTLY, Outcome, judged
from sil.claims.strokes import ATMOSPHERE_PA, SUPPLY_PA, arrival, nominal, run, value


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
    return Outcome(GIVEN if good else NOT_MET, (1e3 * value("synchronizer.x_block"), 1e3 * span))


def _f45_intervals() -> Outcome:
    value = nominal()
    mesh = value.values("synchronizer.F_mesh_typ")
    impulse = value.values("synchronizer.impulse_typ")
    pull = value.values("synchronizer.F_pull_typ")
    gear = [1e3 * _together_s(_into_gear(m, j)) for m, j in zip(mesh, impulse, strict=True)]
    neutral = [1e3 * _together_s(_to_neutral(f)) for f in pull]
    others = [1e3 * _together_s(_into_gear(m, j)) for m in (0.0, 1300.0) for j in (2.0, 250.0)]
    good = (
        60 <= gear[0] <= 80
        and 110 <= gear[1] <= 130
        and 35 <= neutral[0] <= 55
        and (85 <= neutral[1] <= 110)
    )
    figures = (*neutral, *gear, min(others), max(others))
    return Outcome(GIVEN if good else NOT_MET, figures)


def _f46_samples() -> Outcome:
    from can_dbc.messages import PositionPulse
    from sil.claims.equipment import loop

    record = loop("truck_into_gear_easy").record
    contact_s = next(e.time_s for e in record.events if e.name == "collar_1_contact")
    stop_s = next(e.time_s for e in record.events if e.name == "stay_stop")
    times, _ = record.series(PositionPulse, "pulse_s")
    count = int(np.count_nonzero((times >= contact_s) & (times <= stop_s)))
    return judged(count == 7, 1e3 * (stop_s - contact_s), count)


def _f47_budget() -> Outcome:
    from sil.claims.equipment import lags

    sensor = lags()[0]
    spent = sensor + value("opc4.velocity_delay") + value("valve.D_rise")
    lasts = {}
    for model in ("nominal", "truck_40ms"):
        loads = ((500.0, 5.0), (500.0, 18.0), (1300.0, 18.0))
        events = [_into_gear(*load, model).events for load in loads]
        lasts[model] = [
            next(e.time_s for e in found if e.name == "stop")
            - [e.time_s for e in found if e.name == "unblock"][-1]
            for found in events
        ]
    light, heavy = lasts["nominal"], lasts["truck_40ms"]
    around = min(heavy) > 0.03 and max(heavy) < 0.045
    verdict = NOT_MET if spent <= max(light + heavy) else MET if around else PARTLY
    figures = (min(light), max(light), min(heavy), max(heavy), sensor,
               value("opc4.velocity_delay"), value("valve.D_rise"), spent)  # fmt: skip
    return Outcome(verdict, tuple(1e3 * x for x in figures))


def _f48_stall() -> Outcome:
    p = _into_gear(500.0, 18.0).packed
    force = (SUPPLY_PA - ATMOSPHERE_PA) * (p.area_p + p.area_s)
    return judged(force >= 2200.0, force)


def _f49_spread() -> Outcome:
    from sil.claims.equipment import loop

    tuned = [
        'controller.strategy="predictive"',
        "controller.strategy_parameters.time_weight_m_s2=27.146",
        "controller.strategy_parameters.way_weight_per_s=552.12",
    ]
    figures = []
    for impulse in (None, 18.0, 78.0, 250.0):
        load = [] if impulse is None else [
            "plant.mounted=true", "plant.mesh_force_n=1300.0",
            f"driveline.impulse_backward_n_s={impulse}", "duration_s=0.9",
        ]  # fmt: skip
        for more in (tuned, []):
            figures.append(loop("lab_n_b", *load, *more).shifts[0].impact_worst_m_s or 0.0)
    bench, truck = figures[:2], figures[2:]
    fails = all(mpc > 0.95 * plain for mpc, plain in zip(truck[::2], truck[1::2], strict=True))
    return judged(bench[0] < 0.6 * bench[1] and fails, *figures)


def _f50_truck_channels() -> Outcome:
    from sil.claims.equipment import loop
    from sil.simulation import scenario

    mounted = scenario.load("full_shift").scenario.plant
    arrived = all(s.arrived_s is not None for s in loop("full_shift").shifts)
    return judged(mounted.mounted and mounted.damper == "none" and arrived)
