"""Chapter 4: the length stroke in the truck, and why feedback fails."""

from __future__ import annotations

from functools import cache

import numpy as np

from plant.systems.stroke import Stroke
from sil.claims.claim import MET, NOT_MET, PARTLY, Outcome, judged, shows
from sil.claims.strokes import ATMOSPHERE_PA, SUPPLY_PA, arrival, nominal, run, speed, value


@cache
def into_gear(mesh_n: float, impulse_n_s: float) -> Stroke:
    """Return a truck shift from neutral to backward."""
    return run(
        "N-B",
        mounted=True,
        mesh_force_n=mesh_n,
        sync_impulse_n_s=impulse_n_s,
        until_s=0.6,
        step_s=2e-4,
    )


@cache
def to_neutral(pull_n: float) -> Stroke:
    """Return a truck shift from backward to neutral."""
    return run("B-N", mounted=True, mesh_force_n=pull_n, until_s=0.4, step_s=2e-4)


def together_s(stroke: Stroke) -> float:
    """Return the time from the first contact of stay and piston to the end stop [s]."""
    contact = [e.time_s for e in stroke.events if e.name.endswith("contact")]
    return arrival(stroke) - min(contact, default=0.018)


@shows("F44")
def _plateau() -> Outcome:
    stroke = into_gear(800.0, 40.0)
    held = np.abs(stroke.position_m - value("synchronizer.x_block")) < 1e-6
    span = float(np.count_nonzero(held)) * 2e-4
    good = span > 0.01 and stroke.impact is not None
    return judged(
        good,
        f"stays at {1e3 * value('synchronizer.x_block'):.1f} mm for {1e3 * span:.0f} ms, "
        "then goes on to its stop",
    )


@shows("F45")
def _intervals() -> Outcome:
    value = nominal()
    mesh = value.values("synchronizer.F_mesh_typ")
    impulse = value.values("synchronizer.impulse_typ")
    pull = value.values("synchronizer.F_pull_typ")
    gear = [1e3 * together_s(into_gear(m, j)) for m, j in zip(mesh, impulse, strict=True)]
    neutral = [1e3 * together_s(to_neutral(f)) for f in pull]
    good = (
        60 <= gear[0] <= 80
        and 110 <= gear[1] <= 130
        and 35 <= neutral[0] <= 55
        and (85 <= neutral[1] <= 110)
    )
    return Outcome(
        MET if good else PARTLY,
        f"to neutral {neutral[0]:.0f}-{neutral[1]:.0f} ms, into gear {gear[0]:.0f}-{gear[1]:.0f} ms over "
        "the typical loads",
        "" if good else "the ends of the range differ by more than 10 ms",
    )


@shows("F46")
def _samples() -> Outcome:
    count = 0.070 / value("opc4.period")
    return judged(abs(count - 7) < 1e-9, f"{count:.0f} samples")


@shows("F47")
def _budget() -> Outcome:
    from sil.claims.equipment import lags

    lasts = []
    for mesh, impulse in ((500.0, 18.0), (1300.0, 18.0)):
        stroke = into_gear(mesh, impulse)
        lasts.append(arrival(stroke) - [e.time_s for e in stroke.events if e.name == "unblock"][-1])
    last = max(lasts)
    sensor = lags()[0]
    spent = sensor + value("opc4.velocity_delay") + value("valve.D_rise")
    if not spent > last:
        return Outcome(
            NOT_MET,
            f"{1e3 * spent:.0f} ms gone, the last part takes {1e3 * last:.0f} ms",
            "feedback would be in time",
        )
    return Outcome(
        MET if last > 0.03 else PARTLY,
        f"last part {1e3 * min(lasts):.0f}-{1e3 * last:.0f} ms; sensor {1e3 * sensor:.0f} + second sample "
        f"{1e3 * value('opc4.velocity_delay'):.0f} + valve {1e3 * value('valve.D_rise'):.0f} = "
        f"{1e3 * spent:.0f} ms",
        ""
        if last > 0.03
        else "the delays are as claimed; the last part, from the synchronizer's release "
        "to the stop, is shorter here than 40 ms, which leaves feedback still less time",
    )


@shows("F48")
def _stall() -> Outcome:
    p = into_gear(500.0, 18.0).packed
    force = (SUPPLY_PA - ATMOSPHERE_PA) * (p.area_p + p.area_s)
    return judged(force >= 2200.0, f"stall force {force:.0f} N at 9 bar")


@shows("F49")
def _spread() -> Outcome:
    loads = ((0.0, 0.0), (500.0, 18.0), (1300.0, 78.0), (500.0, 250.0))
    found = [into_gear(*load) for load in loads]
    times = [1e3 * arrival(stroke) for stroke in found]
    speeds = [speed(stroke) for stroke in found]
    good = 40.0 < max(times) - min(times) < 1e3 and max(speeds) / min(speeds) > 1.1
    return judged(
        good,
        f"the same command ends after {min(times):.0f}-{max(times):.0f} ms with "
        f"{min(speeds):.2f}-{max(speeds):.2f} m/s over the loads",
    )


@shows("F50")
def _truck_channels() -> Outcome:
    from sil.claims.equipment import loop
    from sil.simulation.scenario import load

    mounted = load("full_shift").scenario.plant
    arrived = all(s.arrived_s is not None for s in loop("full_shift").shifts)
    return judged(
        mounted.mounted and mounted.damper == "none" and arrived,
        "the truck scenarios mount no damper; a campaign without position_m is read, and what it "
        "can no longer decide is said",
    )
