"""Chapter 3.2: the oil damper."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.signal import find_peaks

from plant.kernel.layout import Parameters
from plant.parts.damper import bulk_modulus, discharge_coefficient, large_area
from plant.systems.stroke import Stroke
from tests.claims.claim import NOT_MET, PARTLY, Outcome, judged
from tests.claims.strokes import ATMOSPHERE_PA, arrival, ms, run, speed, value

FINE: dict[str, Any] = {"load": "damper", "until_s": 0.12, "step_s": 1e-5}
"""Load, end and output step of the strokes with the damper."""
STEADY: dict[str, Any] = {**FINE, "damper_model": "incompressible"}


@cache
def _damped(variant: str) -> Stroke:
    """Return the fixed stroke with the damper: kappa/10, kappa, kappa with free air, or steady."""
    if variant in ("steady", "kappa/10"):
        return run("fixed", **(STEADY if variant == "steady" else FINE))
    put = {Parameters.kappa: value("damper.kappa")}
    if variant == "air":
        put[Parameters.air_fraction] = value("damper.air_fraction")
    return run("fixed", put=put, **FINE)


def _f30_outlet() -> Outcome:
    cap, r, hole = value("damper.A_B0"), value("damper.r_hole"), value("damper.x_B")
    x = np.linspace(0.0, value("fixed.stroke"), 400)
    area = np.array([large_area(a, cap, r, hole) for a in x])
    free, damped = speed(run("fixed", until_s=0.12)), speed(_damped("kappa/10"))
    closes = area[0] == cap and area[-1] == 0.0 and bool(np.all(np.diff(area) <= 0.0))
    closed_m = x[np.argmax(area <= 0)]
    return judged(closes and 0.0 < damped < 0.3 * free, 1e6 * area[0], 1e3 * closed_m, damped, free)


def _fall_times(stroke: Stroke) -> tuple[float, float]:
    """Return the times in which the oil pressure falls from 90 to 20 % and to 10 % after the stop [s]."""
    after = stroke.time_s >= arrival(stroke)
    t, p = stroke.time_s[after], stroke.pressure_pa("oil2")[after]
    at = [float(t[np.argmax(p <= share * p[0])]) for share in (0.9, 0.2, 0.1)]
    return at[1] - at[0], at[2] - at[0]


def _f31_decay() -> Outcome:
    return Outcome(NOT_MET, ms(*_fall_times(_damped("kappa/10")), *_fall_times(_damped("air"))))


def _f32_chamber_one() -> Outcome:
    stroke = _damped("kappa/10")
    moves = stroke.time_s <= arrival(stroke)
    pressure, x = stroke.pressure_pa("oil2")[moves], stroke.position_m[moves]
    share = (ATMOSPHERE_PA - value("damper.P_oil1_min")) / float(np.max(pressure) - ATMOSPHERE_PA)
    # what the compressed oil of chamber two keeps back is missing in chamber one
    volume = value("damper.V_oil2_0") - value("damper.A_oil") * x
    taken = np.gradient(pressure, stroke.time_s[moves]) * volume / value("damper.kappa_effective")
    missing = np.cumsum(taken) * FINE["step_s"]
    return Outcome(PARTLY, (100 * share, 1e6 * np.max(missing), 6e4 * np.max(taken)))


def _f33_coefficient() -> Outcome:
    cap = value("damper.A_B0")
    early = discharge_coefficient(cap, cap, 0.5, 0.65, 0.65)
    late = discharge_coefficient(0.0, cap, 0.2, 0.65, 0.65)
    return judged(abs(early - 1.325) < 1e-12 and late == 0.65, early, late)


def _f34_mount_friction() -> Outcome:
    force, plain = 200.0, _damped("steady")

    def rubbing(outlet: float) -> Stroke:
        """Return the stroke with mount friction and larger outlets."""
        larger = {Parameters.a_small: outlet, Parameters.a_large: outlet}
        return run("fixed", put={Parameters.damper_drag: force}, scale=larger, **STEADY)

    fitted = rubbing(brentq(lambda x: arrival(rubbing(x)) - arrival(plain), 1.0, 3.0, xtol=1e-4))
    acts = (plain.position_m > 0.0100) & (plain.position_m < 0.0126)
    difference = (plain.pressure_pa("oil2") - fitted.pressure_pa("oil2"))[acts]
    drop = float(np.mean(difference)) / 1e5
    return judged(4.0 < drop < 6.0, force, drop, force, force / value("damper.A_oil") / 1e5)


def _maxima(stroke: Stroke) -> int:
    """Return the number of pressure maxima of the oil before the stop that stand out by 0.2 bar."""
    p = stroke.pressure_pa("oil2")[stroke.time_s <= arrival(stroke)]
    return len(find_peaks(p, prominence=0.2e5)[0])


def _f34b_compressibility() -> Outcome:
    rigid, stiff, soft = (_damped(variant) for variant in ("steady", "kappa", "kappa/10"))
    gap, far = (float(np.max(np.abs(s.position_m - rigid.position_m))) for s in (stiff, soft))
    counts = [_maxima(s) for s in (rigid, stiff, soft)]
    modulus = bulk_modulus(5e5, 1.724e9, 0.0, ATMOSPHERE_PA)
    return judged(gap < far and counts[2] > counts[0], *ms(gap, far), *counts, modulus)
