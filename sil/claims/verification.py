"""Chapter 3.3-3.4: the system model and its verification.

The thesis's measurements are not at hand; a disturbed plant takes their part where a claim is
about the size and sign of deviations, and says so.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from plant.kernel.layout import LengthState, Parameters
from plant.systems.stroke import Stroke
from sil.claims.claim import GIVEN, NOT_MET, PARTLY, Outcome, judged
from sil.claims.strokes import arrival, first_motion_s, nominal, plain, relative_errors, run, value

WINDOW_S = 0.2


def _window(stroke: Stroke) -> NDArray[np.bool_]:
    return (stroke.time_s >= 0.01) & (stroke.time_s <= 0.01 + WINDOW_S)


DYNAMIC_FRICTION = (Parameters.f_run_s, Parameters.beta_s, Parameters.f_run_p, Parameters.beta_p)
TRIPLE_FRICTION = dict.fromkeys(DYNAMIC_FRICTION, 3.0)
"""Dynamic friction times three, as the thesis tried."""


def _f35_table() -> Outcome:
    p = plain("fixed").packed
    used = tuple(
        float(p[i])
        for i in (Parameters.alpha_m1, Parameters.alpha_1, Parameters.alpha_m2, Parameters.alpha_2)
    )
    return Outcome(GIVEN if used == (0.94, 0.87, 1.5, 1.05) else NOT_MET, (used,))


def _f36_durations() -> Outcome:
    stroke = plain("fixed")
    motion = arrival(stroke) - first_motion_s(stroke)
    p1 = stroke.pressure_pa("1")
    filled = float(stroke.time_s[np.argmax(p1 > 0.99 * 900000.0)]) - 0.01
    good = abs(motion - 0.015) < 0.0025 and 0.15 < filled < 0.26
    return judged(good, 1e3 * motion, 1e3 * filled)


def _f37_walk() -> Outcome:
    stroke = plain("N-B")
    contact = next(e for e in stroke.events if e.name == "collar 1 contact")
    before = stroke.time_s < contact.time_s
    still = float(np.max(np.abs(stroke.position_m[before])))
    other = float(np.max(np.abs(stroke.states[:, LengthState.x_2])))
    walked = float(np.interp(contact.time_s, stroke.time_s, stroke.states[:, LengthState.x_1]))
    good = still < 1e-9 and other < 1e-9 and abs(walked - 0.013) < 1e-4
    return judged(good, 1e3 * walked, 1e3 * still, 1e3 * other)


def _f38_imposed_position() -> Outcome:
    from plant.systems.driven import pressures_along
    from plant.systems.setup import make_setup

    stroke = run(
        "fixed",
        load="damper",
        scale={Parameters.k_in: 1.02, Parameters.k_out: 0.97, Parameters.vol_n: 1.02},
    )
    setup = make_setup(nominal(), stroke.conditions)
    simulated = pressures_along(setup, stroke.time_s, stroke.position_m)
    inside = _window(stroke)
    one = relative_errors(stroke.pressure_pa("1")[inside], simulated[inside, 0])
    two = relative_errors(stroke.pressure_pa("2")[inside], simulated[inside, 1])
    return Outcome(PARTLY, (100 * one[0], 100 * one[1], 100 * two[0], 100 * two[1], 1e3 * WINDOW_S))


def _f39_spring_volumes() -> Outcome:
    x0 = value("spring_test.x0")
    one = value("fixed.A1") * x0 / value("fixed.V10")
    two = value("fixed.A2") * x0 / value("fixed.V20")
    return judged(
        abs(one - 0.43) < 0.001 and abs(two - 0.16) < 0.001, 1e3 * x0, 100 * one, 100 * two
    )


def _spring(scale: Mapping[int, float]) -> Stroke:
    return run(
        "fixed",
        load="spring",
        spring_n_per_m=value("spring_test.k"),
        start_offset_m=value("spring_test.x0"),
        scale=scale,
    )


def _f40_spring_errors() -> Outcome:
    measured, simulated = _spring(TRIPLE_FRICTION), _spring({})
    inside = _window(measured)
    x = relative_errors(measured.position_m[inside], simulated.position_m[inside])
    late = 1e3 * (arrival(measured) - arrival(simulated))
    return Outcome(PARTLY, (100 * x[0], 100 * x[1], late))


def _f41_friction_matters() -> Outcome:
    base = plain("N-B")
    shifts = {}
    rubbing = (*DYNAMIC_FRICTION, Parameters.f_static_s, Parameters.f_static_p)
    for name, indices, key in (
        ("friction", rubbing, "unit_friction_sd"),
        ("charge flow", (Parameters.k_in,), "unit_flow_sd"),
        ("volumes", (Parameters.vol_b, Parameters.vol_n, Parameters.vol_f), "unit_volume_sd"),
        ("supply", (Parameters.p_supply,), "supply_sd"),
    ):
        known = value(f"repeatability.{key}")
        other = run("N-B", scale=dict.fromkeys(indices, 1.0 + known))
        name = f"{name} +{100 * known:g} %"
        shifts[name] = float(np.max(np.abs(other.position_m - base.position_m)))
    good = max(shifts, key=lambda k: shifts[k]).startswith("friction")
    changes = ", ".join(f"{k}: {1e3 * v:.2f} mm" for k, v in shifts.items())
    return judged(good, changes, 100 * value("repeatability.friction_sd"))


def _length_errors(simulated: Stroke, measured: Stroke) -> dict[str, tuple[float, float]]:
    """Return mean and maximum relative errors of position, charging and discharging pressure."""
    inside = _window(measured)

    def errors(name: str) -> tuple[float, float]:
        return relative_errors(
            measured.pressure_pa(name)[inside], simulated.pressure_pa(name)[inside]
        )

    x = relative_errors(measured.position_m[inside], simulated.position_m[inside])
    return {"x": x, "charging": errors("B"), "discharging": errors("N")}


def _listed(errors: dict[str, tuple[float, float]]) -> str:
    return ", ".join(f"{k} {100 * a:.1f}/{100 * b:.1f} %" for k, (a, b) in errors.items())


def _f42_too_fast() -> Outcome:
    measured = run("N-B", scale=TRIPLE_FRICTION)
    errors = _length_errors(plain("N-B"), measured)
    faster = arrival(plain("N-B")) < arrival(measured)
    order = (
        errors["charging"][0] < errors["x"][0] and errors["charging"][0] < errors["discharging"][0]
    )
    peak = np.max(plain("N-B").pressure_pa("N")) > np.max(measured.pressure_pa("N"))
    return Outcome(PARTLY if faster and order and peak else NOT_MET, (_listed(errors),))


def _f43_friction_repairs() -> Outcome:
    measured = run("N-B", scale=TRIPLE_FRICTION | {Parameters.k_out: 0.6})
    before = _length_errors(plain("N-B"), measured)
    after = _length_errors(run("N-B", scale=TRIPLE_FRICTION), measured)
    repaired = after["x"][0] < 0.5 * before["x"][0]
    remains = after["discharging"][0] > 0.2 * before["discharging"][0]
    verdict = PARTLY if repaired and remains else NOT_MET
    return Outcome(verdict, (_listed(before), _listed(after)))
