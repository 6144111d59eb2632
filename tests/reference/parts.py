"""The thesis' equations one by one, in plain Python, for the judge of the compiled kernel.

Written from the thesis, its errata and the conventions at the head of the nominal set; nothing here
is shared with the plant except the file of numbers.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

NOMINAL = Path(__file__).resolve().parents[2] / "plant" / "parameters" / "nominal.toml"

Values = dict[str, float | list[float]]


def nominal(changes: Mapping[str, float] | None = None) -> Values:
    """All numbers of the nominal set as `section.key`, some of them changed."""
    sections = tomllib.loads(NOMINAL.read_text(encoding="utf-8"))
    values: Values = {
        f"{section}.{key}": entry["value"]
        for section, table in sections.items()
        for key, entry in table.items()
    }
    for path, value in (changes or {}).items():
        if path not in values:
            raise KeyError(path)
        values[path] = value
    return values


def polynomial(coefficients: Sequence[float], x: float) -> float:
    """Sum of c_k x^k."""
    return math.fsum(c * x**k for k, c in enumerate(coefficients))


class Flow:
    """The flow maps: f_in = P_s phi(P/P_s), f_out = P_atm phi(P/P_atm) [K kg/s]."""

    def __init__(self, values: Values) -> None:
        self.c_in_low = values["flow_charge.c_low"]
        self.c_in_high = values["flow_charge.c_high"]
        self.y_min = values["flow_charge.y_min"]
        self.y_split = values["flow_charge.y_split"]
        self.c_out_low = values["flow_discharge.c_low"]
        self.c_out_high = values["flow_discharge.c_high"]
        self.z_split = values["flow_discharge.z_split"]
        self.slope_in = math.fsum(k * c for k, c in enumerate(self.c_in_low))
        self.slope_out = math.fsum(k * c for k, c in enumerate(self.c_out_low))

    def charge(self, pressure: float, supply: float) -> float:
        y = pressure / supply
        if y > 1.0:
            return supply * self.slope_in * (y - 1.0)
        if y < self.y_min:
            y = self.y_min
        c = self.c_in_high if y < self.y_split else self.c_in_low
        value = 0.0
        for k in reversed(c):
            value = value * y + k
        return supply * value

    def discharge(self, pressure: float, atmosphere: float) -> float:
        z = pressure / atmosphere
        if z < 1.0:
            return atmosphere * self.slope_out * (z - 1.0)
        c = self.c_out_low if z < self.z_split else self.c_out_high
        value = 0.0
        for k in reversed(c):
            value = value * z + k
        return atmosphere * value


def theoretical_flow(
    upstream: float, downstream: float, area: float, c_d: float, t: float, gamma: float, r: float
) -> float:
    """T m_dot by 3.12-3.20, step by step as printed, with the density factor outside the root [K kg/s]."""
    critical = ((gamma + 1.0) / 2.0) ** (-gamma / (gamma - 1.0))
    if downstream / upstream <= critical:
        choked = gamma / (r * t) * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (gamma - 1.0))
        return t * upstream * c_d * math.sqrt(choked) * area
    mach = math.sqrt(
        2.0 / (gamma - 1.0) * ((upstream / downstream) ** ((gamma - 1.0) / gamma) - 1.0)
    )
    spread = 1.0 + 0.5 * (gamma - 1.0) * mach * mach
    density = upstream / (r * t) * spread ** (-1.0 / (gamma - 1.0))
    sound = math.sqrt(gamma * r * t / spread)
    return t * density * mach * sound * area * c_d


def hole_area(distance: float, values: Values) -> float:
    """a_valve,B(x) of 3.27 from its two circular segments, capped at a_B0 [m^2]."""
    r = values["damper.r_hole"]
    covered = distance - values["damper.x_B"]
    if covered <= 0.0:
        hole = math.pi * r * r
    elif covered >= 2.0 * r:
        hole = 0.0
    elif covered <= r:  # less than half of each hole covered: area minus the covered segment
        angle = math.acos((r - covered) / r)
        hole = math.pi * r * r - (angle * r * r - r * (r - covered) * math.sin(angle))
    else:  # the open segment
        angle = math.acos((covered - r) / r)
        hole = r * r * angle - r * (covered - r) * math.sin(angle)
    return min(values["damper.A_B0"], 2.0 * hole)


def outlet(distance: float, speed: float, values: Values) -> float:
    """C_D A_valve of 3.27 and 3.35 [m^2]."""
    large = hole_area(distance, values)
    c_d = max(
        large / values["damper.A_B0"] + values["damper.C_D_slope"] * speed,
        values["damper.C_D_floor"],
    )
    return c_d * (values["damper.A_S"] + large)


def oil_pressure(distance: float, speed: float, values: Values) -> float:
    """Incompressible pressure over chamber one, 3.34 [Pa]; none on the way back."""
    if speed <= 0.0:
        return 0.0
    return (
        0.5
        * values["damper.rho"]
        * (values["damper.A_oil"] * speed / outlet(distance, speed, values)) ** 2
    )


def oil_rate(distance: float, speed: float, over: float, values: Values) -> float:
    """Rate of the compressible pressure over chamber one, 3.31 [Pa/s]; no suction; the root rounded off within a few Pa."""
    a_oil = values["damper.A_oil"]
    flow = 0.0
    if over > 0.0:
        root = over / (over * over + 25.0) ** 0.25
        flow = outlet(distance, speed, values) * math.sqrt(2.0 / values["damper.rho"]) * root
    rate = (
        values["damper.kappa_effective"]
        / (values["damper.V_oil2_0"] - a_oil * distance)
        * (a_oil * speed - flow)
    )
    return rate if over > 0.0 else max(rate, 0.0)


def barrier(peak: float, u: float) -> float:
    """Force barrier F cos^2(pi u / 2), zero for |u| >= 1 [N]."""
    return peak * math.cos(0.5 * math.pi * u) ** 2 if abs(u) < 1.0 else 0.0


def valve_switches(
    commands: Sequence[tuple[float, str, float]], charged: Sequence[str], values: Values
) -> list[tuple[float, str, float]]:
    """(instant s, valve, 1 or 0) after the delays; a command reversed in time is cancelled."""
    out = []
    for valve in sorted({name for _, name, _ in commands}):
        energised = valve in charged
        pending: tuple[float, str, float] | None = None
        for when, _, duty in sorted(c for c in commands if c[1] == valve):
            wanted = duty >= values["valve.duty_open"] or (
                energised and duty > values["valve.duty_closed"]
            )
            if pending is not None and pending[0] <= when + 1e-12:
                out.append(pending)
                pending = None
            if wanted == energised:
                continue
            energised = wanted
            delay = values["valve.D_rise"] if wanted else values["valve.D_fall"]
            pending = None if pending is not None else (when + delay, valve, float(wanted))
        if pending is not None:
            out.append(pending)
    return sorted(out)
