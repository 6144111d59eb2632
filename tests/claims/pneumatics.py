"""Chapter 3.1: process laws, valves, mass flow, friction."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from can_dbc.messages import ValveCommand
from plant.devices.coil import CoilValve
from plant.devices.valve import CoilConfig, ValveTiming
from plant.effects.setup import Setup
from plant.kernel.compiled import plain as as_python
from plant.kernel.layout import FixedState, FlowMap, Parameters
from plant.kernel.packing import flow_coefficients
from plant.parts.flow import charge, discharge, orifice
from plant.systems.stroke import Stroke
from sil.campaign.campaign import Floats
from tests.claims.claim import NOT_MET, PARTLY, Outcome, judged
from tests.claims.strokes import (
    ATMOSPHERE_PA,
    SUPPLY_PA,
    loop,
    ms,
    nominal,
    peak_bar,
    plain,
    run,
    value,
)


def _f12_alpha_range() -> Outcome:
    names = ("alpha_m1", "alpha_1", "alpha_m2", "alpha_2")
    outside = [n for n in names if not 1.0 <= value(f"alpha.{n}") <= value("gas.gamma")]
    values = ", ".join(f"{n} {value(f'alpha.{n}')}" for n in names)
    return judged(not outside, values, ", ".join(outside), otherwise=PARTLY)


def _f13_process_laws() -> Outcome:
    spread = []
    for alpha in (1.0, 1.4):
        shut = dict.fromkeys((Parameters.k_in, Parameters.k_out), 0.0)
        alike = dict.fromkeys((Parameters.alpha_1, Parameters.alpha_2), alpha)
        stroke = run("fixed", put=shut | alike | {Parameters.f_external: 400.0}, until_s=0.1)
        volume = stroke.packed.vol_n - stroke.packed.area_p2 * stroke.position_m
        constant = stroke.pressure_pa("2") * volume**alpha
        compressed = float(np.max(stroke.pressure_pa("2"))) / ATMOSPHERE_PA
        spread.append((float(np.ptp(constant) / constant[0]), compressed))
    good = all(s < 1e-6 and c > 1.05 for s, c in spread)
    return judged(good, *spread[0], *spread[1])


def _f14_duty() -> Outcome:
    highest = max(loop("lab_n_b").record.series(ValveCommand, "duty_b")[1])
    return judged(abs(highest - 0.98) < 1e-9, 100 * highest)


def _f15_thresholds() -> Outcome:
    peaks = [
        peak_bar(run("fixed", commands=((0.01, "1", duty),), until_s=0.2), "1")
        for duty in (0.2, 0.33, 0.34, 0.35, 0.5, 0.98)
    ]
    good = peaks[1] < 1.02 and peaks[3] > 5.0 and abs(peaks[3] - peaks[5]) < 1e-9
    return judged(good, *peaks)


def _f16_delays() -> Outcome:
    stroke = run("fixed", commands=((0.01, "1", 0.98), (0.2, "1", 0.0)), until_s=0.3, step_s=2e-5)
    p1 = stroke.pressure_pa("1")
    opens = stroke.time_s[np.argmax(p1 > p1[0] + 50.0)] - 0.01
    falls = stroke.time_s[np.argmax(p1)] - 0.2
    found = (opens, falls, *_coil_delays_s())
    expected = ((0.008, 1e-4), (0.035, 1e-4), (0.008, 5e-4), (0.035, 5e-4))
    good = all(abs(x - at) < room for x, (at, room) in zip(found, expected, strict=True))
    return judged(good, *ms(*found))


def _coil_delays_s(duty: float = 0.98, **changes: float) -> tuple[float, float]:
    """Opening and closing delay of a valve with its coil: full duty, held at `duty`, 0.5 s; changes: fields of `CoilConfig`."""
    on_ns, off_ns = 0, 500_000_000
    valve = CoilValve(ValveTiming.from_parameters(nominal()), CoilConfig(**changes))  # type: ignore[arg-type]
    valve.command(on_ns, 0.98)
    valve.command(off_ns // 2, duty)
    valve.command(off_ns, 0.0)
    moves = valve.moves(2 * off_ns)
    if [u for _, u in moves] != [1.0, 0.0]:
        return float("nan"), float("nan")
    return moves[0][0] * 1e-9, (moves[1][0] - off_ns) * 1e-9


def _f17_sensitive_delays() -> Outcome:
    cold, warm, hot = (_coil_delays_s(temperature_k=t) for t in (253.15, 293.15, 373.15))
    weak, strong = _coil_delays_s(supply_v=20.0)[0], _coil_delays_s(supply_v=28.0)[0]
    least = 10.0 * value("repeatability.valve_delay_sd")  # far more than from stroke to stroke
    sensitive = hot[0] - cold[0] > least or cold[1] - hot[1] > least
    figures = (cold[0], warm[0], hot[0], cold[1], warm[1], hot[1], weak, strong)
    return judged(sensitive, *ms(*figures), verdict=PARTLY)


def _f18_duty_closing() -> Outcome:
    falls = [_coil_delays_s(duty)[1] for duty in (0.98, 0.7, 0.36)]
    zener = _coil_delays_s(decay_v=40.0)[1]
    good = falls[0] > falls[1] > falls[2] and zener < 0.5 * falls[0]
    return judged(good, *ms(*falls, zener))


def _flow(ratio: float) -> float:
    """Return the theoretical charge flow at a pressure ratio [K kg/s]."""
    cda = value("orifice.A_valve") * value("orifice.C_d_in")
    return float(orifice(SUPPLY_PA, ratio * SUPPLY_PA, cda, value("gas.T"), 1.4, 287.05))


def _critical_ratio() -> float:
    gamma = value("gas.gamma")
    return float((2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0)))


def _f19_critical() -> Outcome:
    ratio = _critical_ratio()
    below, at, above = (_flow(ratio * share) for share in (0.9, 1.0, 1.05))
    return judged(
        abs(ratio - 0.5283) < 5e-5 and abs(below / at - 1) < 1e-12 and above < below, ratio
    )


def _f20_choking() -> Outcome:
    edge = _critical_ratio()
    constant = abs(_flow(0.1) / _flow(0.5) - 1.0)
    jump = abs(_flow(edge + 1e-12) / _flow(edge - 1e-12) - 1.0)
    return judged(constant < 1e-12 and jump < 1e-9 and _flow(1.0) == 0.0, constant, jump)


@cache
def _fill(factor: float, theoretical: bool, empty: bool) -> Floats:
    """Return the pressure [times] in Pa of a fixed volume, the stay held, while filled or emptied."""

    def change(setup: Setup) -> None:
        p = setup.p
        p.vol_b = (p.vol_b + p.area_p * p.stroke) * factor
        p.area_p = p.area_p2 = 1e-12
        p.f_static_s = 1e9

    stroke = run(
        "fixed",
        change=change,
        commands=((0.01, "1", 0.0 if empty else 0.98),),
        charged_before=("1",) if empty else (),
        theoretical_flow=theoretical,
        until_s=0.4,
    )
    return stroke.pressure_pa("1")


def _time_ratio(factor: float, empty: bool) -> Floats:
    """Return how many times as long a volume times `factor` takes to pressures from 2 to 8 bar [13]."""
    sign, opening_s = (-1.0, 0.045) if empty else (1.0, 0.018)
    levels_pa = sign * np.linspace(2e5, 8e5, 13)
    one, larger = (sign * _fill(size, False, empty) for size in (1.0, factor))
    time_s = np.arange(len(one)) * 1e-4 - opening_s
    ratio: Floats = np.interp(levels_pa, larger, time_s) / np.interp(levels_pa, one, time_s)
    return ratio


def _f21_theory_poor() -> Outcome:
    errors = [
        float(np.max(np.abs(_fill(1.0, True, empty) - _fill(1.0, False, empty))))
        / float(np.max(_fill(1.0, False, empty)))
        for empty in (False, True)
    ]
    poor = [error > 0.03 for error in errors]
    return judged(all(poor), *(100 * e for e in errors), otherwise=PARTLY if any(poor) else NOT_MET)


def _f22_map_consistent() -> Outcome:
    c = FlowMap(flow_coefficients(nominal()))
    into, out = as_python(charge), as_python(discharge)
    y, z = value("flow_charge.y_split"), value("flow_discharge.z_split")
    eps = 1e-9

    def jump(function: Callable[..., float], upstream: float, at: float) -> float:
        low = function((at - eps) * upstream, upstream, c)
        high = function((at + eps) * upstream, upstream, c)
        return abs(high - low) / function(0.5 * upstream if at < 1 else 5 * upstream, upstream, c)

    jumps = (jump(into, SUPPLY_PA, y), jump(out, ATMOSPHERE_PA, z))
    roots = (
        abs(into(SUPPLY_PA, SUPPLY_PA, c)) / into(3e5, SUPPLY_PA, c),
        abs(out(ATMOSPHERE_PA, ATMOSPHERE_PA, c)) / out(3e5, ATMOSPHERE_PA, c),
    )
    good = max(jumps) < 1e-5 and max(roots) < 1e-5
    return judged(good, *jumps, *roots)


def _f23_flow_of_pressure() -> Outcome:
    ratio = _time_ratio(2.0, empty=False)
    worst = float(np.max(np.abs(ratio - 2.0)))
    return judged(worst < 0.002, np.mean(ratio), worst)


def _f24_three_volumes() -> Outcome:
    ratio = _time_ratio(3.0, empty=True)
    worst = float(np.max(np.abs(ratio - 3.0)))
    return judged(worst < 0.005, np.mean(ratio))


def _f25_alpha_after() -> Outcome:
    return Outcome(NOT_MET, (value("alpha.alpha_m1"), value("alpha.alpha_m2")))


def _f26_breakaway() -> Outcome:
    stroke = run("fixed", step_s=1e-5, until_s=0.05)
    when_s = next(e.time_s for e in stroke.events if e.name == "breakaway")
    force = float(np.interp(when_s, stroke.time_s, _drive_n(stroke)))
    return judged(abs(force - 71.0) < 0.2, force, 1e3 * when_s)


def _f27_stroke_length() -> Outcome:
    ways = [abs(x[-1] - x[0]) for x in (plain(kind).position_m for kind in ("fixed", "N-B"))]
    return judged(all(abs(way - 0.01285) < 1e-9 for way in ways), *ms(*ways))


def _drive_n(stroke: Stroke) -> Floats:
    """Return the force of the pressures [times] in N on the piston of the fixed actuator."""
    p = stroke.packed
    one, two = stroke.pressure_pa("1") * p.area_p, stroke.pressure_pa("2") * p.area_p2
    force: Floats = one - two - ATMOSPHERE_PA * p.area_s
    return force


def _f28_dynamic_friction() -> Outcome:
    speeds, forces = [], []
    for supply in (SUPPLY_PA, 600000.0):
        stroke = run("fixed", supply_pressure_pa=supply, step_s=1e-5, until_s=0.05)
        velocity = stroke.states[:, FixedState.v]
        acceleration = np.gradient(velocity, stroke.time_s)
        moving = (velocity > 0.05) & (stroke.position_m < 0.0125)
        speeds.append(velocity[moving])
        forces.append((_drive_n(stroke) - stroke.packed.m_s * acceleration)[moving])
    slope, offset = np.polyfit(np.concatenate(speeds), np.concatenate(forces), 1)
    good = abs(slope - 38.8) < 0.5 and abs(offset - 50.9) < 0.5
    return judged(good, slope, offset)


def _f29_friction_scatter() -> Outcome:
    from tests.reference.instruments import potentiometer

    generator = np.random.default_rng(29)
    stroke = plain("fixed")
    numbers = {name: value(name) for name in ("potentiometer.resolution", "potentiometer.noise_sd")}
    measured = potentiometer(stroke.position_m, 0.0, numbers, generator)
    velocity = np.gradient(measured, stroke.time_s)
    kernel = np.hanning(11) / np.hanning(11).sum()
    smooth = np.convolve(velocity, kernel, "same")
    acceleration = np.convolve(np.gradient(smooth, stroke.time_s), kernel, "same")
    moving = (stroke.position_m > 0.002) & (stroke.position_m < 0.011)
    force = _drive_n(stroke) - stroke.packed.m_s * acceleration
    residual = force[moving] - (50.9 + 38.8 * smooth[moving])
    scatter = float(np.std(residual))
    return judged(scatter > 20.0, scatter)
