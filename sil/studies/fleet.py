"""A population of trucks and the shifts of each: drawn by seed, carried from shift to shift.

A truck is a unit with its tolerances. What lasts beyond one shift is carried along the sequence:
the temperature of unit and oil, the supply between two runs of the compressor, the friction of
each synchronizer, the valves, and the memory of the control unit. What the speeds on the bus do
not say of a shift is the friction of its synchronizer: J = I |dw| / (friction term).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np

from can_dbc import typed_toml
from can_dbc.errors import InputError

BEGIN_S = 0.1
"""Request of a shift whose chambers are empty, after the firmware's first reports."""
LASTS_S = 0.7
"""Simulated time of a shift from its request on."""
T_REF_K = 293.15
OIL_REF_K = 353.15
BLOCK_FORCE_N = 1500.0
"""Typical force of the actuator on the synchronizer, by which a drag torque is compared."""
SUPPLY_STEP_PA = 8000.0
"""Resolution with which a truck reports its supply (J1939-71, SPN 1087)."""
OWN = "controller.strategy_parameters"
EXAM_N_S = tuple(float(each) for each in np.geomspace(18.0, 250.0, 14))
"""Nominal impulses of an examination."""


RANGES = {
    **dict.fromkeys(("cone_drift", "cold_start", "direct", "closing_follows_current"), (0.0, 1.0)),
    **dict.fromkeys(("ambient_k", "warm_k"), (200.0, 450.0)),
    **dict.fromkeys(("cone_wander_shifts", "drag_fold_k", "warm_up_s"), (1e-3, 1e7)),
}
"""Numbers of the population with narrower limits: shares, temperatures, and divisors."""
ORDERED = tuple(
    (f"{name}_low_{unit}", f"{name}_high_{unit}")
    for name, unit in (("supply", "pa"), ("speed", "rad_s"), ("direct", "s"))
)
"""Limits of which the first may not be above the second."""

AssumedValue = Annotated[float, msgspec.Meta(ge=0.0, le=1e7)]
Assumed = tuple[AssumedValue, Annotated[str, msgspec.Meta(min_length=8)]]
"""A number of the population, with its source or the reason for it."""


class Factor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A factor of the plant that is 1 in the median, as the settings of many effects are."""

    path: Annotated[str, msgspec.Meta(min_length=3, max_length=80)]
    """Value that is set, by the path that --set takes."""
    unit: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    """sd between units."""
    shift: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    """sd between shifts."""
    source: Annotated[str, msgspec.Meta(min_length=8)]
    """Source or reason."""


class TruckTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What differs between trucks and shifts: each number with its source or reason.

    sd is a standard deviation, relative where the key has no unit.
    """

    rise_unit_s: Assumed
    """Opening delay: sd between units."""
    fall_unit_s: Assumed
    """Closing delay: sd between units."""
    valve_shift_s: Assumed
    """Either delay: sd between shifts."""
    rise_per_k: Assumed
    """Relative growth of the opening delay by temperature."""
    fall_per_k: Assumed
    """Relative fall of the closing delay by temperature."""
    closing_follows_current: Assumed = (1.0, "thesis 3.1.3: a smaller duty shortens the closing")
    """1: a valve closes sooner the less current is in its coil, as a unit that learns assumes; 0: never."""
    exchanged_rise_s: Assumed
    """Longer opening delay of valves that were exchanged."""
    cone_unit: Assumed
    """Friction of a synchronizer: sd between synchronizers."""
    cone_shift: Assumed
    """Friction of a synchronizer: sd between shifts, independent."""
    cone_wander: Assumed
    """Friction of a synchronizer: sd of its slow variation."""
    cone_wander_shifts: Assumed
    """Number of shifts after which the slow variation is forgotten to 1/e."""
    cone_drift: Assumed
    """Share of its friction that a synchronizer loses along the sequence."""
    drag_n_m: Assumed
    """Drag torque on the input side with warm oil; it helps upward and hinders downward."""
    drag_fold_k: Assumed
    """Cooling of the oil by which the drag grows e-fold."""
    speed_rad_s: Assumed
    """Median of the speed difference that the engine leaves over."""
    speed_spread: Assumed
    """sd of the logarithm of the speed difference."""
    speed_low_rad_s: Assumed
    """Least speed difference."""
    speed_high_rad_s: Assumed
    """Greatest speed difference."""
    speed_noise_rad_s: Assumed
    """sd of each reported shaft speed."""
    inertia_forward: Assumed
    """Inertia of the input side in the forward gear, by that in the backward gear."""
    mesh_n: Assumed
    """Median of the peak of the meshing force."""
    mesh_unit: Assumed
    """Peak of the meshing force: sd between gears and trucks."""
    mesh_shift: Assumed
    """Peak of the meshing force: sd between shifts."""
    supply_low_pa: Assumed
    """Supply pressure at which the compressor starts, absolute."""
    supply_high_pa: Assumed
    """Supply pressure at which the compressor stops, absolute."""
    supply_used_pa: Assumed
    """Mean fall of the supply pressure from shift to shift, brakes included."""
    supply_fill_pa_s: Assumed
    """Rise of the supply pressure while the compressor runs."""
    ambient_k: Assumed
    """Mean ambient temperature."""
    ambient_sd_k: Assumed
    """sd of the ambient temperature between trucks."""
    warm_k: Assumed
    """Mean temperature of a warm unit."""
    warm_sd_k: Assumed
    """sd of it between trucks."""
    warm_up_s: Assumed
    """Time constant with which unit and oil warm up."""
    cold_start: Assumed
    """Probability that a shift is the first after a night."""
    thermometer_k: Assumed
    """sd between units of the error of the reported temperature."""
    gap_s: Assumed
    """Mean time between two shifts."""
    direct: Assumed
    """Probability that a shift follows a blow on neutral whose air is still there."""
    direct_low_s: Assumed
    """Least time between the end of that blow and the request."""
    direct_high_s: Assumed
    """Greatest time between the end of that blow and the request."""
    shifts_per_year: Assumed
    """Shifts into a gear of this actuator per truck and year."""


class FleetTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Number of trucks and shifts, and what happens on the way."""

    trucks: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 20
    """Trucks, numbered from 1; each has one row for each strategy."""
    shifts: Annotated[int, msgspec.Meta(ge=1, le=5_000)] = 100
    """Shifts of each truck."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 53) - 1)] = 1
    """Seed of all draws, with the truck's number."""
    exchanged_at: Annotated[int, msgspec.Meta(ge=0, le=5_000)] = 0
    """Shift before which the valves of every second truck are exchanged; 0: never."""
    examined_after: Annotated[int, msgspec.Meta(ge=0, le=5_000)] = 0
    """Shifts after which 14 impulses from 18 to 250 N s are tried at 9 bar and 20 degrees Celsius,
    each with the memory of then; 0: never."""


@dataclass(frozen=True)
class Drawn:
    """One shift as drawn: settings of the scenario, and the impulses in N s.

    known: settings by which a strategy that learns is given what the truck knows besides the frames:
    its supply, its gear pairs, how long ago the neutral chamber was filled, and that its speeds agreed
    in the last gear, which it does not know after its valves were exchanged. expected_n_s: follows from the
    speeds with the nominal friction; impulse_n_s is what it takes.
    """

    settings: dict[str, Any]
    known: dict[str, Any]
    expected_n_s: float
    impulse_n_s: float


class Truck:
    """The truck of a number: its unit, drawn once, and its state, carried from shift to shift.

    nominal: the scenario's values of `NOMINAL`, which the draws change.
    """

    NOMINAL = (
        *("valve.D_rise", "valve.D_fall", "valve.fall_base", "valve.fall_tau"),
        *("driveline.cone_gain_m", "driveline.inertia_kg_m2"),
    )

    def __init__(
        self,
        table: TruckTable,
        factors: Sequence[Factor],
        fleet: FleetTable,
        number: int,
        nominal: Mapping[str, float],
    ) -> None:
        self._of = {name: getattr(table, name)[0] for name in table.__struct_fields__}
        self._fleet, self._number, self._nominal = fleet, number, nominal
        self._rng = rng = np.random.default_rng([fleet.seed, number])
        of = self._of
        self.factors = [(each, self._drawn(each.unit)) for each in factors]
        self.rise_s = of["rise_unit_s"] * rng.standard_normal()
        self.fall_s = of["fall_unit_s"] * rng.standard_normal()
        self.cones = {gear: self._factor("cone_unit") for gear in ("backward", "forward")}
        self.mesh_n = {gear: of["mesh_n"] * self._factor("mesh_unit") for gear in self.cones}
        self.thermometer_k = of["thermometer_k"] * rng.standard_normal()
        self.ambient_k = of["ambient_k"] + of["ambient_sd_k"] * rng.standard_normal()
        self.warm_k = of["warm_k"] + of["warm_sd_k"] * rng.standard_normal()
        self.phase_s = rng.uniform(0.0, 0.01)
        self._wander = {gear: float(rng.standard_normal()) for gear in self.cones}
        self._unit_k, self._oil_k = self.ambient_k, self.ambient_k
        self._supply_pa = rng.uniform(of["supply_low_pa"], of["supply_high_pa"])
        self._filling = False

    def shifts(self) -> tuple[list[Drawn], list[Drawn]]:
        """Return the shifts in their order, and those of the examination."""
        found, exam = [], []
        for k in range(self._fleet.shifts):
            found.append(self._shift(k))
            if k + 1 == self._fleet.examined_after:
                exam = [self._examined(k, each) for each in EXAM_N_S]
        return found, exam

    def _factor(self, name: str) -> float:
        """Return a factor around 1 whose logarithm has the standard deviation of that name."""
        return self._drawn(self._of[name])

    def _drawn(self, sd: float) -> float:
        """Return a factor around 1 whose logarithm has a standard deviation."""
        return math.exp(sd * self._rng.standard_normal())

    def _cone_gain_m(self, k: int, gear: str) -> float:
        """Return the friction term of a synchronizer at shift `k`."""
        of = self._of
        drift = 1.0 - of["cone_drift"] * k / max(self._fleet.shifts - 1, 1)
        slow = math.exp(of["cone_wander"] * self._wander[gear])
        factor = self.cones[gear] * slow * drift * self._factor("cone_shift")
        return float(self._nominal["driveline.cone_gain_m"] * factor)

    def _carry_on(self) -> None:
        """Let the time to the next shift pass: temperatures, supply, friction."""
        of, rng = self._of, self._rng
        gap_s = rng.exponential(of["gap_s"])
        if rng.random() < of["cold_start"]:
            self._unit_k = self._oil_k = self.ambient_k
        share = -math.expm1(-gap_s / of["warm_up_s"])
        self._unit_k += share * (self.warm_k - self._unit_k)
        self._oil_k += share * (OIL_REF_K - self._oil_k)
        self._supply_pa -= rng.exponential(of["supply_used_pa"])
        self._filling |= self._supply_pa < of["supply_low_pa"]
        if self._filling:
            self._supply_pa += of["supply_fill_pa_s"] * gap_s
            self._filling = self._supply_pa < of["supply_high_pa"]
        self._supply_pa = min(self._supply_pa, of["supply_high_pa"])
        stays = math.exp(-1.0 / of["cone_wander_shifts"])
        for gear, old in self._wander.items():
            self._wander[gear] = stays * old + math.sqrt(1.0 - stays**2) * rng.standard_normal()

    def _shift(self, k: int) -> Drawn:
        of, rng = self._of, self._rng
        self._carry_on()
        gear = "backward" if rng.random() < 0.5 else "forward"
        drawn = of["speed_rad_s"] * self._factor("speed_spread")
        upward = rng.random() < 0.5
        speed_rad_s = min(max(drawn, of["speed_low_rad_s"]), of["speed_high_rad_s"])
        drag_n_m = of["drag_n_m"] * math.exp((OIL_REF_K - self._oil_k) / of["drag_fold_k"])
        gain_m = self._cone_gain_m(k, gear) + (1 if upward else -1) * drag_n_m / BLOCK_FORCE_N
        direct, blow_s = rng.random(), rng.uniform(of["direct_low_s"], of["direct_high_s"])
        found = self._settings(
            k,
            gear,
            speed_rad_s if upward else -speed_rad_s,
            gain_m,
            self._unit_k,
            blow_s if direct < of["direct"] else None,
            {
                "plant.supply_pressure_pa": self._supply_pa,
                "plant.mesh_force_n": self.mesh_n[gear] * self._factor("mesh_shift"),
            },
        )
        if self._is_exchanged(k) and not self._is_exchanged(k - 1):
            found.known[f"{OWN}.speeds_agreed"] = False  # the unit was off
        return found

    def _is_exchanged(self, k: int) -> bool:
        """Return whether the valves were exchanged before shift `k`, counted from 0."""
        return 0 < self._fleet.exchanged_at <= k + 1 and self._number % 2 == 1

    def _examined(self, k: int, impulse_n_s: float) -> Drawn:
        """Return a shift into the first gear that nominally needs an impulse, at 9 bar and 20 °C."""
        gain_m, inertia = (
            self._nominal[f"driveline.{name}"] for name in ("cone_gain_m", "inertia_kg_m2")
        )
        mesh_n = self.mesh_n["backward"] * self._factor("mesh_shift")
        fixed = {"plant.supply_pressure_pa": 9e5, "plant.mesh_force_n": mesh_n}
        speed_rad_s = impulse_n_s * gain_m / inertia
        gain_m = self._cone_gain_m(k, "backward")
        return self._settings(k, "backward", speed_rad_s, gain_m, T_REF_K, None, fixed)

    def _settings(
        self,
        k: int,
        gear: str,
        speed_rad_s: float,
        gain_m: float,
        unit_k: float,
        blow_s: float | None,
        fixed: dict[str, float],
    ) -> Drawn:
        of, rng, nominal = self._of, self._rng, self._nominal
        rise_s = nominal["valve.D_rise"] * (1.0 + of["rise_per_k"] * (unit_k - T_REF_K))
        rise_s += self.rise_s + self._is_exchanged(k) * of["exchanged_rise_s"]
        fall_s = nominal["valve.D_fall"] * math.exp(-of["fall_per_k"] * (unit_k - T_REF_K))
        rise_s += of["valve_shift_s"] * rng.standard_normal()
        fall_s += self.fall_s + of["valve_shift_s"] * rng.standard_normal()
        inertia = nominal["driveline.inertia_kg_m2"]
        inertia *= 1.0 if gear == "backward" else of["inertia_forward"]
        begin_s = BEGIN_S if blow_s is None else blow_s
        settings: dict[str, Any] = {
            "plant.mounted": True,
            "request": [{"at_s": begin_s, "gear": gear}],
            "duration_s": begin_s + LASTS_S,
            "driveline.residual_rad_s": speed_rad_s,
            "driveline.cone_gain_m": gain_m,
            "driveline.inertia_kg_m2": inertia,
            "driveline.noise_rad_s": of["speed_noise_rad_s"],
            "valve.D_rise": rise_s,
            "valve.D_fall": fall_s,
            **self._closing(fall_s),
            "sensor.coil_temperature_k": unit_k,
            "sensor.measured_temperature_k": unit_k + self.thermometer_k,
            "sensor.phase_s": self.phase_s,
            **{each.path: size * self._drawn(each.shift) for each, size in self.factors},
            "seed": int(rng.integers(1 << 32)),
            **fixed,
        }
        if blow_s is not None:
            settings["plant.charged"] = ["N"]
        settings = {
            path: float(value) if isinstance(value, float) else value
            for path, value in settings.items()
        }
        supply_pa = SUPPLY_STEP_PA * round(fixed["plant.supply_pressure_pa"] / SUPPLY_STEP_PA)
        per_rad_s = inertia / nominal["driveline.cone_gain_m"]
        known = {
            f"{OWN}.supply_pa": supply_pa,
            f"{OWN}.impulse_per_rad_s": per_rad_s,
            f"{OWN}.closing_follows_current": bool(of["closing_follows_current"]),
            f"{OWN}.speeds_agreed": True,
        }
        if blow_s is not None:
            known[f"{OWN}.rest_s"] = blow_s
        size_n_s = inertia * abs(speed_rad_s)
        return Drawn(
            settings, known, size_n_s / nominal["driveline.cone_gain_m"], size_n_s / gain_m
        )

    def _closing(self, fall_s: float) -> dict[str, Any]:
        """Return the settings of valves whose closing delay after a long full duty is `fall_s`."""
        if not self._of["closing_follows_current"]:
            return {}
        names = "valve.fall_base", "valve.fall_tau"
        slower = fall_s / self._nominal["valve.D_fall"]
        scaled = {name: slower * self._nominal[name] for name in names}
        return {"plant.closing_follows_duty": True, **scaled}


def truck_table(table: TruckTable, changed: Mapping[str, Any]) -> TruckTable:
    """Return a population with some of its numbers replaced. Raises InputError for wrong ones."""
    new = {
        name: (typed_toml.convert(value, AssumedValue, key=f"truck.{name}"), "set by the study")
        for name, value in changed.items()
    }
    table = msgspec.structs.replace(table, **new)
    of = {name: getattr(table, name)[0] for name in table.__struct_fields__}
    for name, (least, most) in RANGES.items():
        if not least <= of[name] <= most:
            raise InputError(f"truck.{name}: {of[name]:g}; expected {least:g} to {most:g}")
    for low, high in ORDERED:
        if of[low] > of[high]:
            raise InputError(
                f"truck.{low}: {of[low]:g}; expected at most truck.{high}, {of[high]:g}"
            )
    return table
