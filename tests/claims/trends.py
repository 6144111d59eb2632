"""Chapters 5-6: hardware trends and proposals, on the fixed-piston actuator."""

from __future__ import annotations

from typing import Any

import numpy as np

from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.systems.stroke import Stroke
from tests.claims.claim import MET, NOT_MET, PARTLY, Outcome, judged
from tests.claims.strokes import (
    Change,
    arrival,
    first_motion_s,
    ms,
    peak_bar,
    plain,
    run,
    speed,
    value,
)

N_CHARGED: dict[str, Any] = {
    "commands": ((0.01, "B", 0.98), (0.01, "N", 0.0)),
    "charged_before": ("N",),
}
"""Conditions of a stroke into B that begins with chamber N at supply pressure."""


def _drop_bar(stroke: Stroke) -> float:
    """Return the largest drop of the driving pressure P1 before the impact."""
    p = stroke.pressure_pa("1")[stroke.time_s < arrival(stroke)]
    return float(np.max(np.maximum.accumulate(p) - p)) / 1e5


def _resized(radius: float = 1.0, final: float = 1.0) -> Change:
    """Return a change of piston radius and final volume of the fixed-piston actuator by factors.

    Areas grow with r^2, the swept volumes with them: chamber two starts larger, ends as it was, or
    with the final volume times its factor.
    """

    def change(setup: Setup) -> None:
        p = setup.p
        left = (p.vol_n - p.area_p2 * p.stroke) * final
        if radius != 1.0:
            p.area_p *= radius**2
            p.area_p2 = p.area_p - p.area_s
        p.vol_n = left + p.area_p2 * p.stroke

    return change


def _f51_larger_radius() -> Outcome:
    parts, strokes, stops = [], [], []
    for factor in (1.0, 1.2, 1.5, 2.0):
        stroke = run("fixed", change=_resized(radius=factor), until_s=0.5)
        strokes.append(stroke)
        stops.append([e.position_m for e in stroke.events if e.name == "turn"])
        where = ", ".join(f"{1e3 * x:.1f}" for x in stops[-1]) or "none"
        parts.append(
            f"r x{factor:g}: P2 to {peak_bar(stroke, '2'):.2f} bar, standstills at {where} mm, arrives "
            f"after {1e3 * arrival(stroke):.0f} ms with {speed(stroke):.2f} m/s"
        )
    base, brakes, _, wild = strokes
    good = (
        peak_bar(brakes, "2") > peak_bar(base, "2")
        and bool(stops[1])
        and stops[1][0] > 0.95 * 0.01285
        and speed(brakes) < 0.2 * speed(base)
        and len(stops[3]) >= 2
        and arrival(wild) > arrival(brakes)
    )
    return judged(good, "; ".join(parts))


def _f52_larger_chambers() -> Outcome:
    strokes = [run("fixed", change=_resized(radius=r)) for r in (1.0, 1.2, 1.5, 2.0)]
    fill = [float(np.interp(0.2, s.time_s, s.pressure_pa("1"))) / 1e5 for s in strokes]
    drops = [_drop_bar(stroke) for stroke in strokes]
    slower, deeper = fill == sorted(fill, reverse=True), drops == sorted(drops)
    reason = "" if slower else "larger chambers do not fill more slowly"
    verdict = NOT_MET if not slower else MET if deeper else PARTLY
    return Outcome(verdict, (*fill, *drops), reason)


def _f53_initial_volume() -> Outcome:
    strokes = [run("fixed", scale={Parameters.vol_b: factor}) for factor in (0.1, 1.0, 3.0)]
    starts, drops = [first_motion_s(s) for s in strokes], [_drop_bar(s) for s in strokes]
    good = starts[0] < starts[1] < starts[2] and drops[0] > drops[1] >= drops[2]
    return judged(good, *ms(*(start - 0.018 for start in starts)), *drops)


def _f54_walk_time() -> Outcome:
    saved = 1e3 * (arrival(plain("N-B")) - arrival(run("N-B", scale={Parameters.vol_b: 0.1})))
    return judged(0.0 < saved < 10.0, saved)


def _f55_final_volume() -> Outcome:
    strokes = [run("fixed", change=_resized(final=f), until_s=0.5) for f in (0.1, 1.0, 10.0)]
    peaks, speeds = [peak_bar(s, "2") for s in strokes], [speed(s) for s in strokes]
    good = peaks[0] > 1.5 * peaks[1] and peaks[2] < 1.25 and speeds[0] < 0.6 * speeds[1]
    return judged(good, *peaks, *speeds)


def _f56_both_small() -> Outcome:
    base, smaller = plain("fixed"), {Parameters.vol_b: 0.1}
    stroke = run("fixed", scale=smaller, change=_resized(final=0.1), until_s=0.5)
    earlier_s = first_motion_s(base) - first_motion_s(stroke)
    good = speed(stroke) < speed(base) and earlier_s > 0.0
    return judged(good, speed(stroke), speed(base), 1e3 * earlier_s)


def _f57_lighter() -> Outcome:
    base, light = (run("N-B", mounted=True, scale={Parameters.m_p: m}) for m in (1.0, 0.5))
    dt = 1e3 * abs(arrival(light) - arrival(base))
    dv = abs(speed(light) / speed(base) - 1.0)
    return judged(dt < 1.0 and dv < 0.03, dt, 100 * dv)


def _charged_and_vented(mesh_n: float = 0.0, impulse_n_s: float = 0.0) -> tuple[Stroke, Stroke]:
    load: dict[str, Any] = {"mesh_force_n": mesh_n, "sync_impulse_n_s": impulse_n_s}
    charged, vented = (
        run("N-B", mounted=True, until_s=0.6, **load, **more) for more in (N_CHARGED, {})
    )
    return charged, vented


def _f59_residual_pressure() -> Outcome:
    charged, vented = _charged_and_vented(500.0, 18.0)
    lost = 1e3 * (arrival(charged) - arrival(vented))
    return judged(45.0 <= lost <= 105.0, 1e3 * value("truck.safety_blow"), lost)


def _f60_cushion() -> Outcome:
    pairs = [_charged_and_vented(*load) for load in ((), (500.0, 18.0), (1300.0, 78.0))]
    speeds = [(speed(charged), speed(vented)) for charged, vented in pairs]
    softer = [charged < 0.8 * vented for charged, vented in speeds]
    verdict = MET if all(softer) else PARTLY if any(softer) else NOT_MET
    return Outcome(verdict, tuple(x for pair in speeds for x in pair))


def _f61_closed_chamber() -> Outcome:
    volume, alpha = value("fixed.V20"), value("alpha.alpha_2")
    final = volume - value("fixed.A2") * value("fixed.stroke")
    ratio, tenth = (volume / final) ** alpha, (volume / (0.1 * final)) ** alpha
    through, stalled = (
        peak_bar(run("N-B", mounted=True, sync_impulse_n_s=j, until_s=0.5), "N")
        for j in (0.0, 60.0)
    )
    return judged(tenth > 5 * ratio and stalled < through, ratio, tenth, through, stalled)


def _f63_burst() -> Outcome:
    def stroke(length_s: float) -> Stroke:
        burst = ((0.02, "N", 0.98), (0.02 + length_s, "N", 0.0))
        return run("N-B", commands=((0.01, "B", 0.98), *burst), step_s=2e-5)

    short, long = stroke(0.0075), stroke(0.0085)
    burst_s = long.time_s[np.argmax(long.pressure_pa("N"))] - 0.028
    good = peak_bar(short, "N") <= 4.0 < peak_bar(long, "N") and burst_s > 0.03
    return judged(good, 1e3 * burst_s)
