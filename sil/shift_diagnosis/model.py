"""Recorded shifts as functions of what may differ: predicted positions and their derivatives.

The recorded commands drive the plant at their recorded instants through the batch kernel, in one
call for all shifts and all changes of parameters.
Checked by: tests/unit/sil/shift_diagnosis/test_model.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, shared, simulate_batch
from plant.devices.valve import switch_schedule
from plant.effects import CATALOGUE, Effect, EffectParameter, apply_effects
from plant.effects.effect import Variant
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import shift as shift_by
from plant.integrator.loop import DONE
from plant.kernel.layout import LENGTH, LengthState, Modes, Parameters
from plant.kernel.packing import fresh_modes, initial_state
from plant.parameters import ParameterSet
from sil.inference.candidate import scaled_of, value_of
from sil.shift_diagnosis.shifts import RecordedShift

Floats = NDArray[np.float64]

_NS: Final = 1_000_000_000
TINY_FORCE_N: Final = 1e-6
"""Holds every stroke in the scalar kernel, which knows all terms."""
IMPULSE_PER_SPEED: Final = 0.25 / 0.09
"""Impulse of the cone per speed difference, N s per rad/s: that of the default driveline."""
MESH_N, PULL_N = (600.0, 500.0), (300.0, 400.0)
"""Barriers into and out of gear: guess and standard deviation."""
JITTER_S: Final = 5e-5
"""Jitter of a pulse that its frame does not show."""
SPEED_NOISE_RAD_S: Final = 0.1
"""Noise of a speed difference."""
LEAST_NOISE_M: Final = 1.4e-5
"""Standard deviation of a position by the timer's resolution alone."""
DIFFERENCE: Final = 0.1
"""Step of a difference, in prior standard deviations or typical sizes."""


def unit_priors(parameters: ParameterSet) -> dict[str, float]:
    """Return the standard deviation of every quantity in which healthy trucks differ.

    Those of the actuator are the parameter set's tolerances; gearbox, teeth, cone, supply and the
    way of a pulse to the log are unknown within wider limits.
    """
    value = parameters.value
    delay = value("repeatability.unit_valve_delay_sd")
    flow, volume = (value(f"repeatability.unit_{name}_sd") for name in ("flow", "volume"))
    return {
        "friction": value("repeatability.unit_friction_sd"),
        "rise": delay,
        "fall": 3.0 * delay,
        "flow_in": flow,
        "flow_out": flow,
        "volume_a": volume,
        "volume_b": volume,
        "supply": 0.03,
        "linkage": 0.3,
        "mass": 0.2,
        "mesh": MESH_N[1],
        "pull": PULL_N[1],
        "cone_B": 0.3,
        "cone_F": 0.3,
        "latency": 3e-4,
        "offset": 1e-4,
        "gain": 0.005,
    }


def shift_priors(parameters: ParameterSet) -> dict[str, float]:
    """Return the standard deviation of every quantity in which shifts of one truck differ."""
    value = parameters.value
    return {
        "friction": value("repeatability.friction_sd"),
        "rise": value("repeatability.valve_delay_sd"),
        "fall": value("repeatability.valve_delay_sd"),
        "supply": 0.01,
        "cone_B": 0.04,
        "cone_F": 0.04,
        "latency": 1e-4,
    }


SHOWN: Final = ("latency", "offset", "gain")
"""Quantities that act on what is reported alone: slopes by them need no stroke."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One effect of the catalogue, with one size: in typical sizes of its first parameter."""

    effect: Effect
    variant: Variant
    others: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Its id with the variant, and the values of its other parameters."""
        values = ", ".join(f"{v:g}" for v in self.others)
        return ":".join(part for part in (self.effect.id, self.variant.name, values) if part)

    @property
    def parameter(self) -> EffectParameter:
        """The parameter that is estimated."""
        return self.effect.parameters[0]

    @property
    def is_narrowing(self) -> bool:
        """Whether the effect grows as its parameter falls from infinity: of a supply line."""
        return self.effect.sized_by == "none"

    @property
    def sign(self) -> int:
        """+1 or -1 if only such sizes are physical, 0 if both are."""
        return 1 if self.is_narrowing else self.parameter.sign

    def sizes(self, most: float) -> tuple[float, float]:
        """Return the least and the largest physical size, of at most so many typical ones."""
        low, high = (0.0 if self.sign > 0 else -most), (0.0 if self.sign < 0 else most)
        if self.is_narrowing:
            return low, high
        own = self.parameter
        return max(low, scaled_of(own, own.low)), min(high, scaled_of(own, own.high))

    def value(self, size: float) -> float:
        """Return the parameter's value [its unit] at a size in typical ones."""
        if self.is_narrowing:
            return min(self.parameter.high, self.parameter.typical * 4.0 / max(size, 1e-3))
        return value_of(self.parameter, size)

    def values(self, size: float) -> dict[str, float]:
        """Return all parameters of the effect at a size in typical ones."""
        rest = [p for p in self.effect.parameters[1:] if p.fitted]
        found = {p.name: v for p, v in zip(rest, self.others, strict=False)}
        return {**self.variant.fixed, **found, self.parameter.name: self.value(size)}


def catalogue() -> list[Cause]:
    """Return the causes that a run can have and a bus could show."""
    found = []
    for effect in CATALOGUE.values():
        if "damper" in effect.needs or effect.nonparametric:
            continue
        for variant in effect.variants:
            scope = effect.scope_of(variant.fixed)
            sensor = scope == "instrument" and effect.equation == "sensor"
            if scope not in ("unit", "run") and not sensor:
                continue
            found += [
                Cause(effect, variant, other)
                for other in dict.fromkeys(start[1:] for start in variant.starts or ((0.0,),))
            ]
    return found


@dataclass(frozen=True)
class Point:
    """Where the model is evaluated: amounts of `unit_priors` in their units, and causes' sizes."""

    amounts: Mapping[str, float] = field(default_factory=dict)
    causes: tuple[tuple[Cause, float], ...] = ()

    @property
    def motion(self) -> tuple[object, ...]:
        """What the motion depends on: all but what acts on its report."""
        amounts = {name: by for name, by in self.amounts.items() if name not in SHOWN}
        return (*sorted(amounts.items()), self.causes)

    def moved(self, name: str, by: float) -> Point:
        """Return the point with one amount changed."""
        return Point({**self.amounts, name: self.amounts.get(name, 0.0) + by}, self.causes)

    def with_cause(self, cause: Cause, size: float) -> Point:
        """Return the point with one more cause, or the same at another size."""
        others = tuple(item for item in self.causes if item[0] is not cause)
        return Point(self.amounts, (*others, (cause, size)))


class PlantModel:
    """The plant of a truck, or of a rig without gearbox, for recorded shifts."""

    def __init__(self, parameters: ParameterSet, mounted: bool) -> None:
        self.parameters = parameters
        self.mounted = mounted
        self.mass_kg = parameters.value("truck.m_gearbox") if mounted else 0.0
        self.supply_pa = parameters.value("supply.P_s")
        self.unit, self.each = unit_priors(parameters), shift_priors(parameters)
        self.latency_s = parameters.value("position_sensor.latency")
        self._setups: dict[float, Setup] = {}

    def setup(self, point: Point, supply_pa: float) -> Setup:
        """Return the actuator at a point, at a stated supply [Pa]."""
        if supply_pa not in self._setups:
            conditions = StrokeConditions(
                kind="N-B", supply_pressure_pa=supply_pa, commands=(), mounted=self.mounted
            )
            self._setups[supply_pa] = Setup.of(self.parameters, conditions)
            apply_effects(self._setups[supply_pa], self.parameters)
        setup = self._setups[supply_pa].copy()
        p, amount = setup.p, point.amounts.get
        for name in ("friction", "rise", "fall", "flow_in", "flow_out", "volume_a", "volume_b"):
            shift_by(setup, name, amount(name, 0.0))
        shift_by(setup, "supply", amount("supply", 0.0))
        p.m_s += self.mass_kg * (np.exp(amount("mass", 0.0)) - 1.0)
        p.f_linkage *= np.exp(amount("linkage", 0.0))
        p.mesh_force = max(TINY_FORCE_N, MESH_N[0] * self.mounted + amount("mesh", 0.0))
        p.pull_force = max(0.0, PULL_N[0] * self.mounted + amount("pull", 0.0))
        for cause, size in point.causes:
            values = cause.effect.on_run(cause.values(size))
            cause.effect.apply(setup, values)
        return setup

    def predict(
        self, shifts: Sequence[RecordedShift], points: Sequence[Point]
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Simulate every shift at every point.

        Returns positions [m] and speeds [m/s] that the pulses would report, both
        [shifts, points, pulses] with NaN behind a shift's last pulse, and whether [shifts, points]
        could be simulated. Raises ValueError for a shift whose speed difference is not known.
        """
        if any(np.isnan(shift.difference_rad_s) for shift in shifts):
            raise ValueError("a shift without a speed difference; expected one found by own_loads")
        most = max(len(shift.time_s) for shift in shifts)
        found = np.full((2, len(shifts), len(points), most), np.nan)
        done = np.empty((len(shifts), len(points)), dtype=np.bool_)
        same: dict[tuple[object, ...], list[int]] = {}
        for j, point in enumerate(points):
            same.setdefault(point.motion, []).append(j)
        for size in sorted({len(own) for own in same.values()}):
            groups = [own for own in same.values() if len(own) == size]
            x, v, able = self._strokes(shifts, [[points[j] for j in own] for own in groups])
            for k, own in enumerate(groups):
                found[:, :, own], done[:, own] = [x[:, k], v[:, k]], able[:, k, None]
        return found[0], found[1], done

    def _strokes(
        self, shifts: Sequence[RecordedShift], groups: Sequence[Sequence[Point]]
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Simulate every shift once for each group of points of the same motion, all of one length.

        Returns positions and speeds [shifts, groups, points, pulses], and whether [shifts, groups]
        could be simulated.
        """
        each = [self.supply_pa if np.isnan(s.supply_pa) else s.supply_pa for s in shifts]
        setups = {pa: [self.setup(own[0], pa) for own in groups] for pa in dict.fromkeys(each)}
        of_usual = setups[min(setups)]
        late_s = np.array([self._late_s(own, s) for own, s in zip(groups, of_usual, strict=True)])
        most = max(len(shift.time_s) for shift in shifts)
        ends = [np.pad(s.time_s, (0, most - len(s.time_s)), "edge") for s in shifts]
        times = np.maximum(np.array(ends)[:, None, None] - late_s[..., None], 0.0)
        shape = times.shape
        flat = times.reshape(len(shifts) * len(groups), -1)
        order = np.argsort(flat, axis=1, kind="stable")
        instants = np.take_along_axis(flat, order, 1)
        cones = {end: np.exp([own[0].amounts.get(f"cone_{end}", 0.0) for own in groups])
                 for end in {s.end for s in shifts}}  # fmt: skip
        packed = {pa: Parameters(np.array([s.p.array for s in own])) for pa, own in setups.items()}
        modes = {pa: [_modes(s) for s in own] for pa, own in setups.items()}
        rows, initial, moves = [], [], []
        for shift, pa in zip(shifts, each, strict=True):
            p = packed[pa].copy()
            p.sync_impulse = IMPULSE_PER_SPEED * abs(shift.difference_rad_s) * cones[shift.end]
            p.mesh_force = np.maximum(TINY_FORCE_N, p.mesh_force + shift.load_n)
            p.pull_force = np.maximum(0.0, p.pull_force + shift.load_n)
            rows.append(p.array)
            initial.append(initial_state(LENGTH, p, position=shift.start, charged=()))
            schedules: dict[tuple[int, int], Floats] = {}
            for setup in setups[pa]:
                timing = setup.timing.rise_ns, setup.timing.fall_ns
                if timing not in schedules:
                    schedules[timing] = _moves(shift, setup)
                moves.append(schedules[timing])
        strokes = Strokes(
            system=LENGTH,
            packed=np.concatenate(rows),
            flow=shared([setup.c for pa in each for setup in setups[pa]]),
            initial=np.concatenate(initial),
            modes=shared([own for pa in each for own in modes[pa]]),
            valves=np.zeros((1, 3)),
            switches=_filled(moves),
            duration_s=instants[:, -1] + 1e-6,
        )
        columns = [LengthState.x_s, LengthState.v_s]
        result = simulate_batch(strokes, sample_s=instants, columns=columns)
        samples = np.empty_like(result.samples)
        np.put_along_axis(samples, order[..., None], result.samples, 1)
        x, v = samples.reshape(*shape, 2).transpose(4, 0, 1, 2, 3)
        for k, (own, setup) in enumerate(zip(groups, of_usual, strict=True)):
            for n, point in enumerate(own):
                x[:, k, n] = self._reported(x[:, k, n], setup, point)
        for k, shift in enumerate(shifts):
            x[k, ..., len(shift.time_s) :] = v[k, ..., len(shift.time_s) :] = np.nan
        return x, v, (result.status == DONE).reshape(shape[:2])

    def _late_s(self, points: Sequence[Point], setup: Setup) -> Floats:
        """Return how much earlier than stated the pulses measure [points]."""
        own_s = setup.chain.latency_s - self.latency_s
        return np.array([point.amounts.get("latency", 0.0) + own_s for point in points])

    def _reported(self, position_m: Floats, setup: Setup, point: Point) -> Floats:
        """Return what the sensor reports of true positions, without the timer's rounding."""
        chain = setup.chain
        pulses = chain.sensor.duration_s(position_m, chain.coil_temperature_k)
        found = chain.calibration.position_m(pulses, chain.measured_temperature_k)
        amount = point.amounts.get
        return setup.reported_m(found) * (1.0 + amount("gain", 0.0)) + amount("offset", 0.0)


def _modes(setup: Setup) -> NDArray[np.int64]:
    """Return the modes with which a stroke begins."""
    m = fresh_modes(LENGTH, setup.conditions.loads())
    m.line = 1 if setup.has_line else 0
    found: NDArray[np.int64] = m.array[: Modes.size]
    return found


def _moves(shift: RecordedShift, setup: Setup) -> Floats:
    """Return the moves of a shift's valves [k, 4] as rows of `plant.batch.batch.Strokes`."""
    rows = switch_schedule(shift.commands, setup.timing, 3)
    return np.array([(at / _NS, chamber, u, 0.0) for at, chamber, u in rows]).reshape(-1, 4)


def _filled(moves: Sequence[Floats]) -> Floats:
    """Return the moves of all strokes as one array, filled up with rows of infinite time."""
    filled = np.zeros((len(moves), max(map(len, moves)), 4))
    filled[:, :, 0] = np.inf
    for row, own in zip(filled, moves, strict=True):
        row[: len(own)] = own
    return filled
