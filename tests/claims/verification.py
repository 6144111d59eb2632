"""Chapter 3.3-3.4: the model's verification; a disturbed plant stands for the thesis's measurements, not at hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from plant.kernel.layout import LengthState, Parameters
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke
from tests.claims.claim import GIVEN, PARTLY, Outcome, judged
from tests.claims.strokes import (
    arrival,
    first_motion_s,
    ms,
    nominal,
    peak_bar,
    plain,
    relative_errors,
    run,
    value,
)
from tests.support.driven import pressures_along

WINDOW_S = 0.2

DYNAMIC_FRICTION = (Parameters.f_run_s, Parameters.beta_s, Parameters.f_run_p, Parameters.beta_p)
TRIPLE_FRICTION = dict.fromkeys(DYNAMIC_FRICTION, 3.0)
"""Dynamic friction times three, as the thesis tried."""


def _window(stroke: Stroke) -> NDArray[np.bool_]:
    return (stroke.time_s >= 0.01) & (stroke.time_s <= 0.01 + WINDOW_S)


def _f35_table() -> Outcome:
    p = plain("fixed").packed
    used = tuple(map(float, (p.alpha_m1, p.alpha_1, p.alpha_m2, p.alpha_2)))
    return judged(used == (0.94, 0.87, 1.5, 1.05), used, verdict=GIVEN)


def _f36_durations() -> Outcome:
    stroke = plain("fixed")
    motion = arrival(stroke) - first_motion_s(stroke)
    filled = float(stroke.time_s[np.argmax(stroke.pressure_pa("1") > 0.99 * 900000.0)]) - 0.01
    return judged(abs(motion - 0.015) < 0.0025 and 0.15 < filled < 0.26, *ms(motion, filled))


def _f37_walk() -> Outcome:
    stroke = plain("N-B")
    contact_s = next(e.time_s for e in stroke.events if e.name == "collar 1 contact")
    still = float(np.max(np.abs(stroke.position_m[stroke.time_s < contact_s])))
    other = float(np.max(np.abs(stroke.states[:, LengthState.x_2])))
    walked = float(np.interp(contact_s, stroke.time_s, stroke.states[:, LengthState.x_1]))
    good = still < 1e-9 and other < 1e-9 and abs(walked - 0.013) < 1e-4
    return judged(good, *ms(walked, still, other))


def _f38_imposed_position() -> Outcome:
    changed = {Parameters.k_in: 1.02, Parameters.k_out: 0.97, Parameters.vol_n: 1.02}
    stroke = run("fixed", load="damper", scale=changed)
    setup = make_setup(nominal(), stroke.conditions)
    simulated = pressures_along(setup, stroke.time_s, stroke.position_m)
    inside = _window(stroke)
    errors = [
        100 * error
        for k, name in enumerate("12")
        for error in relative_errors(stroke.pressure_pa(name)[inside], simulated[inside, k])
    ]
    return Outcome(PARTLY, (*errors, 1e3 * WINDOW_S))


def _f39_spring_volumes() -> Outcome:
    x0 = value("spring_test.x0")
    one, two = (value(f"fixed.A{k}") * x0 / value(f"fixed.V{k}0") for k in (1, 2))
    good = abs(one - 0.43) < 0.001 and abs(two - 0.16) < 0.001
    return judged(good, 1e3 * x0, 100 * one, 100 * two)


def _spring(scale: Mapping[int, float]) -> Stroke:
    rate, offset = value("spring_test.k"), value("spring_test.x0")
    return run("fixed", load="spring", spring_n_per_m=rate, start_offset_m=offset, scale=scale)


def _f40_spring_errors() -> Outcome:
    measured, simulated = _spring(TRIPLE_FRICTION), _spring({})
    inside = _window(measured)
    mean, most = relative_errors(measured.position_m[inside], simulated.position_m[inside])
    return Outcome(PARTLY, (100 * mean, 100 * most, 1e3 * (arrival(measured) - arrival(simulated))))


def _f41_friction_matters() -> Outcome:
    rubbing = (*DYNAMIC_FRICTION, Parameters.f_static_s, Parameters.f_static_p)
    shifts = {}
    for name, indices, key in (
        ("friction", rubbing, "unit_friction_sd"),
        ("charge flow", (Parameters.k_in,), "unit_flow_sd"),
        ("volumes", (Parameters.vol_b, Parameters.vol_n, Parameters.vol_f), "unit_volume_sd"),
        ("supply", (Parameters.p_supply,), "supply_sd"),
    ):
        known = value(f"repeatability.{key}")
        other = run("N-B", scale=dict.fromkeys(indices, 1.0 + known))
        moved = float(np.max(np.abs(other.position_m - plain("N-B").position_m)))
        shifts[f"{name} +{100 * known:g} %"] = moved
    good = max(shifts, key=lambda k: shifts[k]).startswith("friction")
    changes = ", ".join(f"{k}: {1e3 * v:.2f} mm" for k, v in shifts.items())
    return judged(good, changes, 100 * value("repeatability.friction_sd"))


def _length_errors(simulated: Stroke, measured: Stroke) -> dict[str, tuple[float, float]]:
    """Return mean and maximum relative errors of position, charging and discharging pressure."""
    inside = _window(measured)
    signals = {
        "x": (measured.position_m, simulated.position_m),
        "charging": (measured.pressure_pa("B"), simulated.pressure_pa("B")),
        "discharging": (measured.pressure_pa("N"), simulated.pressure_pa("N")),
    }
    return {name: relative_errors(one[inside], two[inside]) for name, (one, two) in signals.items()}


def _listed(errors: dict[str, tuple[float, float]]) -> str:
    return ", ".join(f"{k} {100 * a:.1f}/{100 * b:.1f} %" for k, (a, b) in errors.items())


def _f42_too_fast() -> Outcome:
    simulated, measured = plain("N-B"), run("N-B", scale=TRIPLE_FRICTION)
    errors = _length_errors(simulated, measured)
    faster = arrival(simulated) < arrival(measured)
    order = errors["charging"][0] < min(errors["x"][0], errors["discharging"][0])
    peak = peak_bar(simulated, "N") > peak_bar(measured, "N")
    return judged(faster and order and peak, _listed(errors), verdict=PARTLY)


def _f43_friction_repairs() -> Outcome:
    measured = run("N-B", scale=TRIPLE_FRICTION | {Parameters.k_out: 0.6})
    before = _length_errors(plain("N-B"), measured)
    after = _length_errors(run("N-B", scale=TRIPLE_FRICTION), measured)
    repaired = after["x"][0] < 0.5 * before["x"][0]
    remains = after["discharging"][0] > 0.2 * before["discharging"][0]
    return judged(repaired and remains, _listed(before), _listed(after), verdict=PARTLY)
