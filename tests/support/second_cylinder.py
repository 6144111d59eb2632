"""Drawn cylinders, no equation shared with the plant: lagging walls, Saint-Venant flow, smoothed sliding; Heun, 5 us."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi, sqrt
from pathlib import Path

import numpy as np
from numba import njit
from scipy.signal import lfilter

R, T0, P0 = 287.0, 293.15, 101325.0
STEP_S = 5e-6


@dataclass(frozen=True)
class Unit:
    """A cylinder in SI units; c_in, c_out: choked C_d A; tau_s: of its walls; leak: C_d A past the piston.

    b: where its nozzles choke; the ellipse of ISO 6358 closest to their flow (within 0.04 %) has one 0.5 to 2 % larger.
    """

    bore: float
    rod: float
    stroke: float
    mass: float
    coulomb: float
    breakaway: float
    viscous: float
    dead_1: float
    dead_2: float
    c_in: float
    c_out: float
    b: float
    tau_s: float
    rise_s: float
    fall_s: float
    leak: float = 0.0
    supply: float = 1.0


@dataclass(frozen=True)
class Stroke:
    """A stroke: which chamber drives, the other one charged before or not, and the supply."""

    file: str
    drives: int
    charged: bool
    supply_pa: float


STROKES = tuple(
    Stroke(f"{name}_{bar}{'_full' if charged else ''}.csv", drives, charged, bar * 1e5)
    for bar in (7, 6, 5)
    for name, drives in (("out", 1), ("back", 2))
    for charged in ((False, True) if bar == 7 else (False,))
)


@njit(cache=False)
def nozzle(up, t_up, down, t_down, area, b):  # type: ignore[no-untyped-def]
    """Mass flow [kg/s]: choked below b, then (x^1.43 - x^1.71) of the ratio stretched to b."""
    if up < down:
        return -nozzle(down, t_down, up, t_up, area, b)
    x = 0.5283 + (1.0 - 0.5283) * max(0.0, down / up - b) / (1.0 - b)
    x = min(x, 0.9995)
    psi = sqrt(7.0 * (x**1.428571 - x**1.714286))
    if down / up > 0.999:
        psi *= (1.0 - down / up) / 0.001
    return area * up / sqrt(R * t_up) * psi


@njit(cache=False)
def slope(y, u1, u2, v, dy):  # type: ignore[no-untyped-def]
    """Rates of position, speed, masses and temperatures -> dy; v: the unit's numbers."""
    a1, a2, stroke, mass, fs, fc, beta, d1, d2, cin, cout, b, tau, leak, supply = v
    x, s, m1, t1, m2, t2 = y
    v1, v2 = d1 + a1 * x, d2 + a2 * (stroke - x)
    p1, p2 = m1 * R * t1 / v1, m2 * R * t2 / v2
    in1 = nozzle(supply, T0, p1, t1, cin, b) if u1 > 0.5 else -nozzle(p1, t1, P0, T0, cout, b)
    in2 = nozzle(supply, T0, p2, t2, cin, b) if u2 > 0.5 else -nozzle(p2, t2, P0, T0, cout, b)
    across = nozzle(p1, t1, p2, t2, leak, 0.5)
    force = (p1 - P0) * a1 - (p2 - P0) * a2
    if s == 0.0 and abs(force) <= fs:
        dy[1] = 0.0
    else:
        direction = np.sign(force) if s == 0.0 else np.tanh(s / 1e-3)
        dy[1] = (force - direction * fc - beta * s) / mass
    dy[0] = s
    for k in range(2):
        q = in1 - across if k == 0 else in2 + across
        m, t = (m1, t1) if k == 0 else (m2, t2)
        p, dv = (p1, a1 * s) if k == 0 else (p2, -a2 * s)
        t_in = T0 if q > 0.0 else t
        # m cv dT = q (cp T_in - cv T) - p dV + m cv (T_0 - T) / tau
        dy[2 + 2 * k] = q
        dy[3 + 2 * k] = (q * (1.4 * t_in - t) - 0.4 / R * p * dv) / m + (T0 - t) / tau


@njit(cache=False)
def run(y, v, moves, instants, out):  # type: ignore[no-untyped-def]
    """Integrate from time 0 -> out [instants, 3]: position and pressures; moves rows (time, chamber, 0 or 1)."""
    a1, a2, stroke, d1, d2 = v[0], v[1], v[2], v[7], v[8]
    u = np.zeros(2)
    k1, k2 = np.zeros(6), np.zeros(6)
    done = 0
    for step in range(int(instants[-1] / STEP_S) + 2):
        t = step * STEP_S
        while done < len(instants) and instants[done] <= t:
            out[done, 0] = y[0]
            out[done, 1] = y[2] * R * y[3] / (d1 + a1 * y[0])
            out[done, 2] = y[4] * R * y[5] / (d2 + a2 * (stroke - y[0]))
            done += 1
        for i in range(len(moves)):
            if moves[i, 0] <= t:
                u[int(moves[i, 1])] = moves[i, 2]
        slope(y, u[0], u[1], v, k1)
        slope(y + STEP_S * k1, u[0], u[1], v, k2)
        before = y[1]
        y = y + 0.5 * STEP_S * (k1 + k2)
        if before * y[1] < 0.0:
            y[1] = 0.0
        if y[0] < 0.0 or y[0] > stroke:
            y[0] = min(max(y[0], 0.0), stroke)
            y[1] = 0.0
        elif (y[0] == 0.0 and y[1] < 0.0) or (y[0] == stroke and y[1] > 0.0):
            y[1] = 0.0


def drawn(rng: np.random.Generator) -> Unit:
    """Return a unit of any ordinary size."""
    bore, stroke = rng.uniform(0.025, 0.063), rng.uniform(0.06, 0.2)
    rod = rng.uniform(0.3, 0.45) * bore
    area = pi / 4 * bore**2
    coulomb = rng.uniform(0.02, 0.05) * 6e5 * area
    inlet = rng.uniform(0.003, 0.008) * area
    return Unit(
        bore=bore, rod=rod, stroke=stroke, mass=rng.uniform(800.0, 3000.0) * area, coulomb=coulomb,
        breakaway=coulomb * rng.uniform(1.1, 1.5), viscous=coulomb * rng.uniform(0.5, 1.5),
        dead_1=rng.uniform(0.04, 0.12) * area * stroke, dead_2=rng.uniform(0.04, 0.12) * area * stroke,
        c_in=inlet, c_out=inlet * rng.uniform(0.9, 1.4), b=rng.uniform(0.2, 0.45),
        tau_s=10.0 ** rng.uniform(-2.0, 0.0), rise_s=rng.uniform(5e-3, 12e-3),
        fall_s=rng.uniform(15e-3, 40e-3),
    )  # fmt: skip


FAULTS = {
    "healthy": (0.0, 0.0),
    "dynamic_friction": (1.5, 2.5),
    "piston_leak": (0.03, 0.12),
    "valve_open_delay": (3e-3, 8e-3),
    "supply_low": (0.05, 0.12),
}
"""Cause and the sizes it is drawn from; of a leak as a share of the inlet."""


def faulty(unit: Unit, cause: str, size: float) -> tuple[Unit, float]:
    """Return a unit with a fault, and the size by which the catalogue counts it."""
    if cause == "dynamic_friction":
        worse = {name: size * getattr(unit, name) for name in ("coulomb", "breakaway", "viscous")}
        return replace(unit, **worse), size
    if cause == "piston_leak":
        return replace(unit, leak=size * unit.c_in), size * unit.c_in
    if cause == "valve_open_delay":
        return replace(unit, rise_s=unit.rise_s + size), size
    return replace(unit, supply=1.0 - size), size


def write_campaign(
    unit: Unit,
    folder: Path,
    rng: np.random.Generator,
    strokes: Sequence[Stroke] = STROKES,
    rate_hz: float = 2000.0,
    lag_s: float = 0.0,
) -> Path:
    """Write a campaign of the unit: strokes that scatter, gauges with noise and offsets, behind lines that lag."""
    folder.mkdir(parents=True)
    offsets = rng.normal(0.0, 1000.0, 2)
    area = pi / 4 * unit.bore**2
    end_s = 0.12 + 3.5 * unit.stroke * area / (unit.c_in * 0.68 * sqrt(R * T0))
    lines = [
        f'name = "{folder.name}"', 'rig = "fixed"', f"atmosphere_pa = {P0}",
        f"temperature_k = {T0}", f"sample_rate_hz = {rate_hz}",
    ]  # fmt: skip
    for stroke in strokes:
        friction, late_s = rng.normal(1.0, 0.05), rng.normal(0.0, 2e-4)
        supply = stroke.supply_pa * unit.supply * rng.normal(1.0, 0.003)
        driving, other = stroke.drives - 1, 2 - stroke.drives
        x = 0.0 if driving == 0 else unit.stroke
        pressures = np.full(2, P0)
        if stroke.charged:
            pressures[other] = supply
        v1 = unit.dead_1 + area * x
        ring = area - pi / 4 * unit.rod**2
        v2 = unit.dead_2 + ring * (unit.stroke - x)
        y = np.array([x, 0.0, pressures[0] * v1 / (R * T0), T0, pressures[1] * v2 / (R * T0), T0])
        numbers = (
            area, ring, unit.stroke, unit.mass, friction * unit.breakaway, friction * unit.coulomb,
            friction * unit.viscous, unit.dead_1, unit.dead_2, unit.c_in, unit.c_out,
            unit.b, unit.tau_s, unit.leak, supply,
        )  # fmt: skip
        moves = [(0.02 + unit.rise_s + late_s, driving, 1.0)]
        commands = f'[[0.02, "{stroke.drives}", 0.98]'
        if stroke.charged:
            moves += [(0.0, other, 1.0), (0.03 + unit.fall_s, other, 0.0)]
            commands += f', [0.03, "{other + 1}", 0.0]'
        time_s = np.arange(0.0, end_s, 1.0 / rate_hz)
        fine = 1 if lag_s == 0.0 else 20
        out = np.zeros((fine * len(time_s), 3))
        instants = np.arange(len(out)) / (fine * rate_hz)
        run(y, numbers, np.array(sorted(moves)), instants, out)
        if lag_s > 0.0:
            kept = float(np.exp(-1.0 / (fine * rate_hz * lag_s)))
            begin = kept * out[0, 1:]
            out[:, 1:], _ = lfilter([1.0 - kept], [1.0, -kept], out[:, 1:], axis=0, zi=begin[None])
        out = out[::fine]
        step = 12e5 / 4096
        gauges = out[:, 1:] + offsets + rng.normal(0.0, 500.0, (len(time_s), 2))
        wiper = out[:, 0] + rng.normal(0.0, 2e-5, len(time_s))
        columns = (time_s, np.round(wiper / 5e-5) * 5e-5, *(np.round(gauges / step) * step).T)
        np.savetxt(
            folder / stroke.file, np.column_stack(columns), delimiter=",", comments="",
            header="time_s,position_m,pressure_1_pa,pressure_2_pa",
            fmt=("%.4f", "%.5f", "%.0f", "%.0f"),
        )  # fmt: skip
        charged = f'["{other + 1}"]' if stroke.charged else "[]"
        lines += [
            "[[stroke]]", f'file = "{stroke.file}"', f'label = "{stroke.file[:-4]}"', 'kind = "fixed"',
            f"supply_pressure_pa = {stroke.supply_pa}", 'load = "none"', "rest_s = 60.0",
            f"commands = {commands}]", f"charged_before = {charged}", f"start_offset_m = {x}",
        ]  # fmt: skip
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def write_sheet(unit: Unit, path: Path, rng: np.random.Generator, error: float) -> Path:
    """Write what a user can state of the unit, flows, dead volumes and friction wrong by about `error`."""

    def off(value: float) -> float:
        return value * (1.0 + rng.choice((-1.0, 1.0)) * error * rng.uniform(0.5, 1.0))

    rows = {
        "acting": (2.0, "-"), "bore": (unit.bore, "m"), "rod": (unit.rod, "m"),
        "stroke": (unit.stroke, "m"), "dead_volume_1": (off(unit.dead_1), "m^3"),
        "dead_volume_2": (off(unit.dead_2), "m^3"), "mass": (unit.mass, "kg"),
        "breakaway": (off(1.3 * unit.coulomb), "N"), "coulomb": (off(unit.coulomb), "N"),
        "viscous": (off(unit.viscous), "N s/m"), "spring_rate": (0.0, "N/m"),
        "spring_preload": (0.0, "N"), "valve_cda_in": (off(unit.c_in), "m^2"),
        "valve_cda_out": (off(unit.c_out), "m^2"), "tube_length": (0.0, "m"),
        "tube_diameter": (0.006, "m"),
    }  # fmt: skip
    lines = ["[base]", 'model = "nominal"', "[cylinder]"]
    lines += [
        f'{name} = {{ value = {float(value)!r}, unit = "{unit_}", source = "data sheet" }}'
        for name, (value, unit_) in rows.items()
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
