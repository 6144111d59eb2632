"""The judge's actuators with something wrong: every cause of the vocabulary, and some it lacks.

Written for the hidden-effect study, from the causes' descriptions and not from the plant's effects:
where a description leaves something open, another reading than the plant's may stand here.
"""

from __future__ import annotations

from math import exp, log10, pi, sin
from typing import Any

import numpy as np

from tests.reference import parts
from tests.reference.actuator import Actuator, Case, FixedPiston, LengthStroke, Mode, State

Change = dict[str, float]

DRIVING = {"fixed": "1", "N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}
COMPRESSED = {"fixed": "2", "N-B": "N", "N-F": "N", "B-N": "B", "F-N": "F"}

FACTORS = {
    "running": ("F_rf", "F_rf_s", "F_rf_p", "beta", "beta_s", "beta_p"),
    "static": ("F_sf", "F_sf_s", "F_sf_p"),
}


def changed_values(values: parts.Values, change: Change) -> parts.Values:
    """The numbers with those changes that are no more than another number."""
    out: dict[str, Any] = dict(values)
    both = change.get("friction", 1.0)
    for kind, names in FACTORS.items():
        factor = both * change.get(kind, 1.0)
        for name in names:
            for section in ("friction_fixed", "friction_length"):
                if f"{section}.{name}" in out:
                    out[f"{section}.{name}"] *= factor
    out["damper.A_S"] *= change.get("small_outlet", 1.0)
    out["length.x_free_total"] += change.get("free_travel_m", 0.0)
    out["stops.restitution"] = change.get("restitution", out["stops.restitution"])
    out["valve.D_rise"] += change.get("open_later_s", 0.0)
    out["valve.D_fall"] += change.get("close_later_s", 0.0)
    outer = 1.0 + change.get("outer_volume", 0.0)
    inner = 1.0 + change.get("inner_volume", 0.0)
    for name in ("fixed.V10", "length.V_B0", "length.V_F0"):
        out[name] *= outer
    for name in ("fixed.V20", "length.V_N0"):
        out[name] *= inner
    return out


class Changed(Actuator):
    """What is wrong, hung into the judge's equations; `change` holds amounts, absent ones are nil."""

    areas: tuple[float, ...] = ()
    across: tuple[tuple[int, int], ...] = ()  # chambers at either side of each piston

    def __init__(
        self, values: parts.Values, case: Case, change: Change, rest_s: float = 2.0
    ) -> None:
        self.c = change
        super().__init__(changed_values(values, change), case)
        self.masses = (self.masses[0] + change.get("mass_kg", 0.0), *self.masses[1:])
        self.supply = case.supply_pa * (1.0 + change.get("supply", 0.0))
        self.rest_s = rest_s
        self.line = change.get("line_cda_m2", 0.0) > 0.0

    # --- start --------------------------------------------------------------------------------
    def initial(self) -> State:
        y = super().initial()
        for k, name in enumerate(self.chambers):
            if name in self.case.charged:
                y[self.first_pressure + k] = self.supply
            elif name == COMPRESSED[self.case.kind]:
                y[self.first_pressure + k] += self.c.get("left_pa", 0.0)
        worn = self.c.get("stop_m", 0.0)
        if self.case.kind in ("B-N", "F-N"):
            side = 1.0 if y[0] > 0.0 else -1.0
            y[0] += side * worn
            y[2 if side > 0.0 else 4] += side * worn
        if self.line:
            y.append(self.supply)
        return y

    # --- forces -------------------------------------------------------------------------------
    def stops(self) -> tuple[float, ...]:
        """Rest and engaged positions of the stay [m]."""
        raise NotImplementedError

    def drives(self, y: State) -> list[float]:
        out = super().drives(y)
        c, x = self.c, y[0]
        out[0] += c.get("force_n", 0.0)
        if "detent_n" in c:
            width = c["detent_m"]
            for place in self.stops():
                away = x - place
                if abs(away) < width:
                    out[0] -= c["detent_n"] * sin(pi * away / width)
        if "wave_n" in c:
            out[0] += c["wave_n"] * sin(2.0 * pi * x / c["wave_m"])
        if "centring_n_m" in c:
            out[0] -= c["centring_n_m"] * x
        return out

    def friction(self, y: State, body: int, direction: int, sliding: bool) -> float:
        c = self.c
        speed = abs(y[2 * body + 1])
        level = super().friction(y, body, direction, sliding)
        if sliding and "stribeck_m_s" in c:
            at_rest = super().friction(
                [0.0 if i == 2 * body + 1 else v for i, v in enumerate(y)], body, direction, False
            )
            at_zero = super().friction(
                [0.0 if i == 2 * body + 1 else v for i, v in enumerate(y)], body, direction, True
            )
            shape = c.get("stribeck_power", 1.0)
            level += (at_rest - at_zero) * exp(-((speed / c["stribeck_m_s"]) ** shape))
        if body == 0:
            if "bump_n" in c:
                level += c["bump_n"] * exp(
                    -0.5 * ((y[0] - c["bump_at_m"]) / c["bump_width_m"]) ** 2
                )
            if "drag_n_s2_m2" in c:
                level += c["drag_n_s2_m2"] * speed * speed
            if self.case.damper is not None:
                level += c.get("damper_drag_n", 0.0)
        if "seal" in c:
            first, second = self.across[body]
            if first != second:
                p = self.first_pressure
                level += c["seal"] * abs(y[p + first] - y[p + second]) * self.areas[body]
        level *= 1.0 + c.get("one_way", 0.0) * direction
        if "rest_share" in c:
            level *= 1.0 + c["rest_share"] * log10(max(self.rest_s, 1.0))
        return level

    def limits(self, y: State, body: int) -> tuple[float, float]:
        low, high = super().limits(y, body)
        if body == 0:
            worn, block = self.c.get("stop_m", 0.0), self.v["synchronizer.x_block"]
            if high > 0.0 and high != block and self.case.kind in ("fixed", "N-B", "B-N"):
                high += worn
            if low < 0.0 and low != -block and self.case.kind in ("N-F", "F-N"):
                low -= worn
        return low, high

    # --- gas ----------------------------------------------------------------------------------
    def opening(self, name: str) -> float:
        """How far a valve stands towards supply: a plunger takes its time, or none."""
        travel = self.c.get("creep_s", 0.0)
        target = self.u[name]
        since = self.now_s - self.turned_s.get(name, -1.0)
        if travel <= 0.0 or since >= travel:
            return target
        share = since / travel
        return share if target == 1.0 else 1.0 - share

    def orifice(self, from_pa: float, to_pa: float, cda_m2: float) -> float:
        """T m_dot through a hole, either way [K kg/s]."""
        v = self.v
        up, down = max(from_pa, to_pa), min(from_pa, to_pa)
        if up <= down * (1.0 + 1e-12):
            return 0.0
        size = parts.theoretical_flow(
            up, down, cda_m2, 1.0, v["gas.T"], v["gas.gamma"], v["gas.R_air"]
        )
        # the slope at equal pressures is infinite: rounded off within 50 Pa
        size *= (up - down) / (up - down + 50.0) if up - down < 5000.0 else 1.0
        return size if from_pa > to_pa else -size

    def rates(self, y: State, mode: Mode) -> State:
        out = super().rates(y, mode)
        v, c = self.v, self.c
        r, atmosphere = v["gas.R_air"], v["gas.P_atm"]
        feed = y[-1] if self.line else self.supply
        drawn = 0.0
        leaks = [0.0] * len(self.chambers)
        if "piston_leak_m2" in c:
            for first, second in sorted({pair for pair in self.across if pair[0] != pair[1]}):
                p = self.first_pressure
                flow = self.orifice(y[p + first], y[p + second], c["piston_leak_m2"])
                leaks[first] -= flow
                leaks[second] += flow
        for k, ((volume, rate), name) in enumerate(
            zip(self.volumes(y), self.chambers, strict=True)
        ):
            i = self.first_pressure + k
            pressure = y[i]
            volume += c.get("driving_volume_m3", 0.0) * (name == DRIVING[self.case.kind])
            volume += c.get("compressed_volume_m3", 0.0) * (name == COMPRESSED[self.case.kind])
            u = self.opening(name)
            charge = discharge = 0.0
            if u > 0.0:
                charge = c.get("inlet", 1.0) * self.flow.charge(pressure, feed)
                charge *= 1.0 - c.get("inlet_late", 0.0) * (pressure / feed) ** 2
            if u < 1.0:
                discharge = c.get("outlet", 1.0) * self.flow.discharge(pressure, atmosphere)
                over = max(pressure / atmosphere - 1.0, 0.0)
                discharge *= 1.0 - c.get("outlet_high", 0.0) * over / (over + 2.0)
            drawn += u * charge
            heat = self.exponent_shift(rate)
            gas = u * (v["alpha.alpha_m1"]) * charge - (1.0 - u) * v["alpha.alpha_m2"] * discharge
            alpha = u * v["alpha.alpha_1"] + (1.0 - u) * v["alpha.alpha_2"]
            if heat:
                alpha += heat * (v["gas.gamma"] - alpha)
            if name == DRIVING[self.case.kind] and "leak_out_m2" in c:
                leaks[k] -= self.orifice(pressure, atmosphere, c["leak_out_m2"])
            if "relief_pa" in c and pressure > c["relief_pa"]:
                leaks[k] -= c["relief_k_kg_s_pa"] * (pressure - c["relief_pa"])
            out[i] = (r * (gas + leaks[k]) - alpha * pressure * rate) / volume
        if self.line:
            fed = self.orifice(self.supply, feed, c["line_cda_m2"])
            out[-1] = r * (fed - drawn) / c["line_m3"]
        else:
            out = out[: self.oil + 1]
        if "oil_air" in c and self.case.damper == "compressible" and not self.oil_rests:
            absolute = y[self.oil] + atmosphere
            stiff = v["damper.kappa_effective"]
            out[self.oil] *= 1.0 / (1.0 + stiff * c["oil_air"] * atmosphere / absolute**2)
        return out

    def exponent_shift(self, rate: float) -> float:
        """Share of the way to an adiabatic change, from the speed of the piston."""
        if "heat_share" not in self.c:
            return 0.0
        speed = abs(rate) / self.areas[-1]
        return self.c["heat_share"] * (1.0 - exp(-speed / self.c["heat_m_s"]))

    def tolerances(self) -> list[float]:
        return super().tolerances() + ([1e-5] if self.line else [])

    def switches(self) -> list[tuple[float, str, float]]:
        slope = self.c.get("open_later_s_pa", 0.0)
        values = self.v
        if slope:
            values = dict(values)
            values["valve.D_rise"] += slope * (self.supply - 900000.0)
        return parts.valve_switches(self.case.commands, self.case.charged, values)


class ChangedFixed(Changed, FixedPiston):
    """Fixed piston with something wrong."""

    across = ((0, 1),)

    def __init__(
        self, values: parts.Values, case: Case, change: Change, rest_s: float = 2.0
    ) -> None:
        super().__init__(values, case, change, rest_s)
        self.areas = (self.v["fixed.A2"],)

    def stops(self) -> tuple[float, ...]:
        return (0.0, self.v["fixed.stroke"])


class ChangedLength(Changed, LengthStroke):
    """Length stroke with something wrong."""

    across = ((0, 0), (0, 1), (1, 2))

    def __init__(
        self, values: parts.Values, case: Case, change: Change, rest_s: float = 2.0
    ) -> None:
        super().__init__(values, case, change, rest_s)
        area = self.v["length.A_p"]
        self.areas = (0.0, area, area)

    def stops(self) -> tuple[float, ...]:
        reach = self.v["length.stroke"]
        return (0.0, reach, -reach)


def changed(case: Case, change: Change, rest_s: float = 2.0) -> Changed:
    """The judge's actuator of a case with what is wrong."""
    values = parts.nominal()
    kind = ChangedFixed if case.kind == "fixed" else ChangedLength
    return kind(values, case, change, rest_s)


def lagging(time_s: np.ndarray, values: np.ndarray, lag_s: float) -> np.ndarray:
    """First-order lag by exponential smoothing on an even grid, settled at the start."""
    share = 1.0 - np.exp(-(time_s[1] - time_s[0]) / lag_s)
    out = np.array(values, dtype=float)
    for k in range(1, len(out)):
        out[k] = out[k - 1] + share * (values[k] - out[k - 1])
    return out
