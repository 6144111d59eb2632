"""Chapters 5-6: hardware trends and proposals, on the fixed-piston actuator."""

from __future__ import annotations

from typing import Any

import numpy as np

from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.systems.stroke import Stroke
from sil.claims.claim import MET, NOT_MET, PARTLY, Outcome, judged
from sil.claims.strokes import Change, arrival, first_motion_s, plain, run, speed, value

N_CHARGED: dict[str, Any] = {
    "commands": ((0.01, "B", 0.98), (0.01, "N", 0.0)),
    "charged_before": ("N",),
}
"""Conditions of a stroke into B that begins with chamber N at supply pressure."""


def _drop_pa(stroke: Stroke) -> float:
    """Return the largest drop of the driving pressure P1 before the impact."""
    p = stroke.pressure_pa("1")[stroke.time_s < arrival(stroke)]
    return float(np.max(np.maximum.accumulate(p) - p))


def _radius(factor: float) -> Change:
    """Return a change of the piston radius of the fixed-piston actuator; the dead volumes stay.

    Areas grow with r^2, the swept volumes with them: chamber two starts larger, ends as it was.
    """

    def change(setup: Setup) -> None:
        p = setup.p
        dead = p.vol_n - p.area_p2 * p.stroke
        p.area_p *= factor**2
        p.area_p2 = p.area_p - p.area_s
        p.vol_n = dead + p.area_p2 * p.stroke

    return change


def _small_final(factor: float) -> Change:
    """Return a change of the final volume: chamber two with the stay at its end, times a factor."""

    def change(setup: Setup) -> None:
        p = setup.p
        final = p.vol_n - p.area_p2 * p.stroke
        p.vol_n = final * factor + p.area_p2 * p.stroke

    return change


def _f51_larger_radius() -> Outcome:
    parts = []
    figures = {}
    for factor in (1.0, 1.2, 1.5, 2.0):
        stroke = run("fixed", change=_radius(factor), until_s=0.5)
        stops = [e.position_m for e in stroke.events if e.name == "turn"]
        peak = float(np.max(stroke.pressure_pa("2"))) / 1e5
        figures[factor] = (stops, peak, arrival(stroke), speed(stroke))
        where = ", ".join(f"{1e3 * x:.1f}" for x in stops) or "none"
        parts.append(
            f"r x{factor:g}: P2 to {peak:.2f} bar, standstills at {where} mm, arrives after "
            f"{1e3 * arrival(stroke):.0f} ms with {speed(stroke):.2f} m/s"
        )
    brakes = figures[1.2]
    wild = figures[2.0]
    good = (
        brakes[1] > figures[1.0][1]
        and bool(brakes[0])
        and brakes[0][0] > 0.95 * 0.01285
        and brakes[3] < 0.2 * figures[1.0][3]
        and len(wild[0]) >= 2
        and wild[2] > brakes[2]
    )
    return judged(good, "; ".join(parts))


def _f52_larger_chambers() -> Outcome:
    radii = (1.0, 1.2, 1.5, 2.0)
    strokes = [run("fixed", change=_radius(r)) for r in radii]
    fill = [float(np.interp(0.2, s.time_s, s.pressure_pa("1"))) for s in strokes]
    drops = [_drop_pa(stroke) for stroke in strokes]
    slower, deeper = fill == sorted(fill, reverse=True), drops == sorted(drops)
    reason = "" if slower else "larger chambers do not fill more slowly"
    verdict = NOT_MET if not slower else MET if deeper else PARTLY
    return Outcome(verdict, tuple(p / 1e5 for p in (*fill, *drops)), reason)


def _f53_initial_volume() -> Outcome:
    def figures(factor: float) -> tuple[float, float]:
        stroke = run("fixed", scale={Parameters.vol_b: factor})
        return first_motion_s(stroke), _drop_pa(stroke)

    small, normal, large = (figures(f) for f in (0.1, 1.0, 3.0))
    good = small[0] < normal[0] < large[0] and small[1] > normal[1] >= large[1]
    three = (small, normal, large)
    starts, drops = ([1e3 * (x[0] - 0.018) for x in three], [x[1] / 1e5 for x in three])
    return judged(good, *starts, *drops)


def _f54_walk_time() -> Outcome:
    saved = 1e3 * (arrival(plain("N-B")) - arrival(run("N-B", scale={Parameters.vol_b: 0.1})))
    return judged(0.0 < saved < 10.0, saved)


def _f55_final_volume() -> Outcome:
    small, base, large = (
        run("fixed", change=_small_final(f), until_s=0.5) for f in (0.1, 1.0, 10.0)
    )
    peaks = [float(np.max(s.pressure_pa("2"))) / 1e5 for s in (small, base, large)]
    speeds = [speed(s) for s in (small, base, large)]
    good = peaks[0] > 1.5 * peaks[1] and peaks[2] < 1.25 and speeds[0] < 0.6 * speeds[1]
    return judged(good, *peaks, *speeds)


def _f56_both_small() -> Outcome:
    base = plain("fixed")
    stroke = run("fixed", scale={Parameters.vol_b: 0.1}, change=_small_final(0.1), until_s=0.5)
    starts = (first_motion_s(stroke), first_motion_s(base))
    good = speed(stroke) < speed(base) and starts[0] < starts[1]
    return judged(good, speed(stroke), speed(base), 1e3 * (starts[1] - starts[0]))


def _f57_lighter() -> Outcome:
    base = run("N-B", mounted=True)
    stroke = run("N-B", mounted=True, scale={Parameters.m_p: 0.5})
    dt = 1e3 * abs(arrival(stroke) - arrival(base))
    dv = abs(speed(stroke) / speed(base) - 1.0)
    return judged(dt < 1.0 and dv < 0.03, dt, 100 * dv)


def _f59_residual_pressure() -> Outcome:
    easy: dict[str, Any] = {
        "mounted": True,
        "mesh_force_n": 500.0,
        "sync_impulse_n_s": 18.0,
        "until_s": 0.5,
    }
    vented, charged = run("N-B", **easy), run("N-B", **easy, **N_CHARGED)
    lost = 1e3 * (arrival(charged) - arrival(vented))
    blow = value("truck.safety_blow")
    return judged(45.0 <= lost <= 105.0, 1e3 * blow, lost)


def _f60_cushion() -> Outcome:
    loads: tuple[dict[str, Any], ...] = ({}, {"mesh_force_n": 500.0, "sync_impulse_n_s": 18.0},
             {"mesh_force_n": 1300.0, "sync_impulse_n_s": 78.0})  # fmt: skip
    truck: list[dict[str, Any]] = [{"mounted": True, "until_s": 0.6, **load} for load in loads]
    pairs = [(speed(run("N-B", **each, **N_CHARGED)), speed(run("N-B", **each))) for each in truck]
    softer = [charged < 0.8 * vented for charged, vented in pairs]
    verdict = MET if all(softer) else PARTLY if any(softer) else NOT_MET
    return Outcome(verdict, tuple(x for pair in pairs for x in pair))


def _f61_closed_chamber() -> Outcome:
    volume = value("fixed.V20")
    final = volume - value("fixed.A2") * value("fixed.stroke")
    alpha = value("alpha.alpha_2")
    ratio = (volume / final) ** alpha
    tenth = (volume / (0.1 * final)) ** alpha
    stalled = run("N-B", mounted=True, sync_impulse_n_s=60.0, until_s=0.5)
    through = run("N-B", mounted=True, until_s=0.5)
    peaks = [float(np.max(s.pressure_pa("N"))) / 1e5 for s in (through, stalled)]
    good = tenth > 5 * ratio and peaks[1] < peaks[0]
    return judged(good, ratio, tenth, *peaks)


def _f63_burst() -> Outcome:
    def stroke(length_s: float) -> Stroke:
        on = 0.02
        return run(
            "N-B",
            commands=((0.01, "B", 0.98), (on, "N", 0.98), (on + length_s, "N", 0.0)),
            until_s=0.3,
            step_s=2e-5,
        )

    short, long = stroke(0.0075), stroke(0.0085)
    opened = [float(np.max(s.pressure_pa("N"))) > 4e5 for s in (short, long)]
    p = long.pressure_pa("N")
    falls = long.time_s[np.argmax(p)]
    burst_s = falls - 0.028
    good = opened == [False, True] and burst_s > 0.03
    return judged(good, 1e3 * burst_s)
