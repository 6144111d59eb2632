"""Chapter 3.2: the oil damper."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from plant.kernel.layout import Parameters
from plant.parts.damper import bulk_modulus, discharge_coefficient, large_area
from plant.systems.stroke import Stroke
from sil.claims.claim import NOT_MET, PARTLY, Outcome, judged, shows
from sil.claims.strokes import ATMOSPHERE_PA, arrival, run, speed, value

FINE: dict[str, Any] = {"until_s": 0.12, "step_s": 1e-5}
"""End and output step of the strokes with the damper."""


@cache
def damped(variant: str) -> Stroke:
    """Return the fixed stroke with the damper: kappa/10, kappa, or kappa with free air."""
    put = {} if variant == "kappa/10" else {Parameters.kappa: value("damper.kappa")}
    if variant == "air":
        put[Parameters.air_fraction] = value("damper.air_fraction")
    return run("fixed", load="damper", put=put, **FINE)


@cache
def steady() -> Stroke:
    """Return the fixed stroke with the incompressible damper."""
    return run("fixed", load="damper", damper_model="incompressible", **FINE)


@shows("F30")
def _outlet() -> Outcome:
    cap, r, hole = value("damper.A_B0"), value("damper.r_hole"), value("damper.x_B")
    x = np.linspace(0.0, value("fixed.stroke"), 400)
    area = np.array([large_area(a, cap, r, hole) for a in x])
    free = run("fixed", until_s=0.12)
    stroke = damped("kappa/10")
    closes = area[0] == cap and area[-1] == 0.0 and bool(np.all(np.diff(area) <= 0.0))
    good = closes and 0.0 < speed(stroke) < 0.3 * speed(free)
    return judged(
        good,
        f"large outlet {1e6 * area[0]:.0f} mm^2 closing to 0 at "
        f"{1e3 * x[np.argmax(area <= 0)]:.1f} mm; impact "
        f"{speed(stroke):.2f} m/s against {speed(free):.2f}",
    )


def fall_times(stroke: Stroke) -> tuple[float, float]:
    """Return the times in which the oil pressure falls from 90 to 20 % and to 10 % after the stop [s]."""
    after = stroke.time_s >= arrival(stroke)
    t, p = stroke.time_s[after], stroke.pressure_pa("oil2")[after]
    top = p[0]
    at = [float(t[np.argmax(p <= share * top)]) for share in (0.9, 0.2, 0.1)]
    return at[1] - at[0], at[2] - at[0]


@shows("F31")
def _decay() -> Outcome:
    tenth = fall_times(damped("kappa/10"))
    air = fall_times(damped("air"))
    achieved = (
        f"kappa/10: {1e3 * tenth[0]:.1f} and {1e3 * tenth[1]:.1f} ms; "
        f"kappa with 1.75 % free air: {1e3 * air[0]:.1f} and {1e3 * air[1]:.1f} ms"
    )
    return Outcome(
        NOT_MET,
        achieved,
        "with the thesis's kappa/10 the two times have a fixed ratio, so it cannot give both; free air "
        "can, which supports the guess of trapped air",
    )


@shows("F32")
def _chamber_one() -> Outcome:
    share = (ATMOSPHERE_PA - value("damper.P_oil1_min")) / float(
        np.max(damped("kappa/10").pressure_pa("oil2")) - ATMOSPHERE_PA
    )
    return Outcome(
        PARTLY,
        f"chamber one is held at the atmosphere; the neglected suction is {100 * share:.1f} % of the "
        "largest difference",
        "the relief valve is not modelled: 3.29 sets the pressure",
    )


@shows("F33")
def _coefficient() -> Outcome:
    cap = value("damper.A_B0")
    early = discharge_coefficient(cap, cap, 0.5, 0.65, 0.65)
    late = discharge_coefficient(0.0, cap, 0.2, 0.65, 0.65)
    return judged(
        abs(early - 1.325) < 1e-12 and late == 0.65,
        f"{early:.2f} early at 0.5 m/s, {late:.2f} at the end",
    )


@shows("F34")
def _mount_friction() -> Outcome:
    from scipy.optimize import brentq

    force = 200.0

    def rubbing(outlet: float) -> Stroke:
        """Return the stroke with mount friction and larger outlets."""
        return run(
            "fixed",
            load="damper",
            damper_model="incompressible",
            put={Parameters.damper_drag: force},
            scale={Parameters.a_small: outlet, Parameters.a_large: outlet},
            **FINE,
        )

    def late_s(outlet: float) -> float:
        return arrival(rubbing(outlet)) - arrival(steady())

    fitted = rubbing(brentq(late_s, 1.0, 3.0, xtol=1e-4))
    plain = steady()
    acts = (plain.position_m > 0.0100) & (plain.position_m < 0.0126)
    difference = (plain.pressure_pa("oil2") - fitted.pressure_pa("oil2"))[acts]
    drop = float(np.mean(difference)) / 1e5
    return judged(
        4.0 < drop < 6.0,
        f"with {force:.0f} N in the mount, and outlets opened until the arrival fits again, the "
        f"oil pressure is {drop:.1f} bar lower where the damper acts: {force:.0f} N / A_oil = "
        f"{force / value('damper.A_oil') / 1e5:.0f} bar",
        "another pressure difference",
    )


def maxima(stroke: Stroke) -> int:
    """Return the number of pressure maxima of the oil before the stop that stand out by 0.2 bar."""
    from scipy.signal import find_peaks

    p = stroke.pressure_pa("oil2")[stroke.time_s <= arrival(stroke)]
    return len(find_peaks(p, prominence=0.2e5)[0])


@shows("F34b")
def _compressibility() -> Outcome:
    stiff, soft, rigid = damped("kappa"), damped("kappa/10"), steady()
    gap = float(np.max(np.abs(stiff.position_m - rigid.position_m)))
    far = float(np.max(np.abs(soft.position_m - rigid.position_m)))
    counts = [maxima(s) for s in (rigid, stiff, soft)]
    modulus = bulk_modulus(5e5, 1.724e9, 0.0, ATMOSPHERE_PA)
    good = gap < far and counts[2] > counts[0]
    return judged(
        good,
        f"position against incompressible: kappa {1e3 * gap:.2f} mm, kappa/10 {1e3 * far:.2f} mm; "
        f"pressure maxima {counts[0]} (incompressible), {counts[1]} (kappa), {counts[2]} (kappa/10); "
        f"kappa {modulus:.3g} Pa",
        "no additional fluctuation with kappa/10",
    )
