"""Recorded shifts as functions of what may differ: the positions that the pulses would report.

The recorded commands drive the plant at their recorded instants through the batch kernel, any number
of shifts and amounts in one call. Chambers begin with what is left in them since their valve was last switched off.
Checked by: tests/unit/sil/inference/truck/test_simulator.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.batch.batch import Strokes, shared, simulate_batch
from plant.devices.sensors import InductiveSensor
from plant.devices.valve import switch_schedule
from plant.effects import apply_effects
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import FACTORS
from plant.integrator.filling import vented
from plant.integrator.loop import DONE
from plant.kernel.layout import LENGTH, LengthState, Modes, Parameters
from plant.kernel.packing import fresh_modes, initial_state
from plant.parameters import ParameterSet
from sil.inference.problem import Floats
from sil.inference.truck.causes import Cause
from sil.inference.truck.quantities import Layout, quantities
from sil.log_replay.recorded_shifts import LEAD_S, RecordedShift

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
PASSING_N_S = 0.3
"""Impulse of a cone up to which the stay passes without a stop, or nearly so: at equal speeds."""
EQUAL_RAD_S = 0.5
"""Speed difference at the command that an engine which synchronizes has taken away when the stay is there."""


@dataclass(frozen=True)
class Actuator:
    """The actuator with one cause of one size.

    modes: of its strokes; rests [3, states]: at rest in B, N, F; timing: delays of opening and closing in ns, and by how
    much later pulses come in s; report: what decides how positions are reported.
    """

    setup: Setup
    modes: Ints
    rests: Floats
    timing: tuple[float, float, float]
    report: tuple[object, ...]


class ShiftModel:
    """The plant of a truck, or of a rig without gearbox, for recorded shifts.

    position_m [shifts, pulses]: as recorded, in steps of tick_m; recorded [shifts, pulses]: whether there is a pulse; acts
    [shifts, quantities]: which quantities a shift depends on; passing [shifts]: the cone's amount up to which it
    stops nothing; strokes: simulated so far.
    """

    def __init__(
        self,
        shifts: Sequence[RecordedShift],
        parameters: ParameterSet,
        mounted: bool = True,
        trips: Sequence[str] = (),
        tolerance: float = 1e-5,
    ) -> None:
        """Take the shifts; trips: sources of more of them, in whose model these take part.

        tolerance: of the integrator; as it is, 99 of 100 positions are off by 1 um at most, a tenth of what a fit
        allows for.
        """
        self.shifts, self.mounted, self.tolerance = tuple(shifts), mounted, tolerance
        self.parameters = parameters
        self.supply_pa = parameters.value("supply.P_s")
        self.mass_kg = parameters.value("truck.m_gearbox") if mounted else 0.0
        self.latency_s = parameters.value("position_sensor.latency")
        sensor = InductiveSensor.from_parameters(parameters)
        self.tick_m = sensor.tick_s / sensor.slope_s_m
        has_supply = not any(np.isnan(s.supply_pa) for s in shifts)
        self.trips = trips or trips_of(shifts)
        self.layout = Layout(quantities(parameters, has_supply, len(self.trips)))
        self.strokes = 0
        lengths = np.array([len(s.time_s) for s in shifts])
        most = int(lengths.max())
        self.recorded: Bools = np.arange(most) < lengths[:, None]
        self.time_s: Floats = np.array([_filled(s.time_s, most) for s in shifts])
        self.position_m: Floats = np.array([_filled(s.position_m, most) for s in shifts])
        self._supply: Floats = np.array(
            [1.0 if np.isnan(s.supply_pa) else s.supply_pa / self.supply_pa for s in shifts]
        )
        self._impulse: Floats = np.array([_impulse_n_s(s) for s in shifts])
        self.passing: Floats = np.log(PASSING_N_S / self._impulse)
        self._starts = np.array(["BNF".index(s.start) for s in shifts])
        self._off_s: Floats = np.array([s.off_s for s in shifts])
        into = [any(c != 1 and duty > 0.5 for _, c, duty in s.commands) for s in shifts]
        kinds = {
            "always": np.ones(len(shifts), dtype=bool),
            "report": np.ones(len(shifts), dtype=bool),
            "mounted": np.full(len(shifts), mounted),
            "into gear": np.array(into) & mounted,
        }
        for k, trip in enumerate(self.trips):
            kinds[f"trip {k}"] = np.array([s.source == trip for s in shifts])
        self.acts: Bools = np.array([kinds[item.acts] for item in self.layout.own]).T
        conditions = StrokeConditions(
            kind="N-B", supply_pressure_pa=self.supply_pa, commands=(), mounted=mounted
        )
        self._healthy = Setup.of(parameters, conditions)
        apply_effects(self._healthy, parameters)
        names = ("friction", "flow_in", "flow_out", "volume_a", "volume_b", "supply")
        scaled = [(column, self.layout.at[name]) for name in names for column in FACTORS[name]]
        self._scaled, self._scaling = np.array(scaled).T
        self._actuators: dict[tuple[Cause | None, float, float], Actuator] = {}
        self._rows: dict[tuple[int, int, int], int] = {}
        self._moves: Floats = np.empty((0, max(len(s.commands) for s in shifts), 4))

    def __len__(self) -> int:
        return len(self.shifts)

    def only(self, which: Ints) -> ShiftModel:
        """Return the model of the shifts `which` [n] alone."""
        model = ShiftModel(
            [self.shifts[k] for k in which],
            self.parameters,
            self.mounted,
            self.trips,
            self.tolerance,
        )
        model._actuators = self._actuators
        return model

    def actuator(self, cause: Cause | None, size: float, supply: float = 1.0) -> Actuator:
        """Return the actuator with a cause of a size in typical ones, set at a share of the usual supply."""
        key = (cause, size, supply)
        if key not in self._actuators:
            if len(self._actuators) > 4000:
                self._actuators.clear()
            setup = self._healthy.copy()
            if cause is not None and cause.moves(size):
                setup.p.p_supply *= supply
                cause.effect.apply(setup, cause.effect.on_run(cause.values(size)))
                setup.p.p_supply /= supply
            modes = fresh_modes(LENGTH, setup.conditions.loads())
            modes.line = 1 if setup.has_line else 0
            rests = [initial_state(LENGTH, setup.p, position=g, charged=()) for g in "BNF"]
            later_s = setup.chain.latency_s - self.latency_s
            self._actuators[key] = Actuator(
                setup,
                modes.array[: Modes.size],
                np.array(rests),
                (setup.timing.rise_ns, setup.timing.fall_ns, later_s),
                (id(setup.chain), setup.internal_gain, id(setup.internal_error_m)),
            )
        return self._actuators[key]

    def positions(
        self, which: Ints, amounts: Floats, cause: Cause | None = None, sizes: Floats | float = 0.0
    ) -> tuple[Floats, Bools]:
        """Simulate strokes of shifts `which` [n] with amounts [n, quantities] in their units.

        sizes: of the cause, [n] or one, in typical ones. Returns the reported positions [n, pulses] in m, and
        which strokes [n] could be simulated.
        """
        self.strokes += len(which)
        at = self.layout.at
        amounts = np.where(self.acts[which], amounts, 0.0)
        actuators, of_stroke = self._actuators_of(which, cause, sizes)
        setups = [item.setup for item in actuators]
        packed = self._packed(which, amounts, np.array([s.p.array for s in setups])[of_stroke])
        initial = np.array([item.rests for item in actuators])[of_stroke, self._starts[which]]
        initial[:, LengthState.p_line] = packed[:, Parameters.p_supply]
        timing = np.array([item.timing for item in actuators])[of_stroke]
        own_ns = (NS_PER_S * amounts[:, [at["rise"], at["fall"]]]).round()
        delays_ns = np.maximum(timing[:, :2] + own_ns, 0.0).astype(np.int64)
        since_s = np.maximum(LEAD_S - self._off_s[which] - delays_ns[:, 1:] / NS_PER_S, 0.0)
        # one for all: rests of a single flow map have a closed form
        flow, modes = shared([s.c for s in setups]), shared([item.modes for item in actuators])
        for number, c in enumerate(flow):
            rows = of_stroke == number if len(flow) > 1 else slice(None)
            initial[rows] = vented(since_s[rows], packed[rows], c, initial[rows])
        late_s = amounts[:, at["latency"]] + timing[:, 2]
        # nothing moves before the first command: a stroke begins there
        instants = np.maximum(self.time_s[which] - late_s[:, None] - LEAD_S, 0.0)
        strokes = Strokes(
            system=LENGTH,
            packed=packed,
            flow=flow if len(flow) == 1 else flow[of_stroke],
            initial=initial,
            modes=modes if len(modes) == 1 else modes[of_stroke],
            valves=np.zeros((1, 3)),
            switches=self._switches(which, delays_ns, setups[0]),
            duration_s=instants[:, -1] + 1e-6,
        )
        result = simulate_batch(
            strokes, sample_s=instants, columns=[LengthState.x_s], tolerance=self.tolerance
        )
        x = result.samples[:, :, 0]
        reported = np.empty_like(x)
        for report, setup in {item.report: item.setup for item in actuators}.items():
            rows = np.array([item.report == report for item in actuators])[of_stroke]
            chain = setup.chain
            pulses = chain.sensor.duration_s(x[rows], chain.coil_temperature_k)
            seen = chain.calibration.position_m(pulses, chain.measured_temperature_k)
            reported[rows] = setup.reported_m(seen)
        gain, offset = amounts[:, at["gain"], None], amounts[:, at["offset"], None]
        return reported * (1.0 + gain) + offset, result.status == DONE

    def _actuators_of(
        self, which: Ints, cause: Cause | None, sizes: Floats | float
    ) -> tuple[list[Actuator], Ints]:
        """Return the actuators of strokes of shifts `which` [n] with a cause of sizes, and the number [n] of each stroke's."""
        sizes_of = np.broadcast_to(sizes, len(which)).tolist()
        supplies = [1.0] * len(which)
        if cause is not None and cause.is_by_supply:
            supplies = self._supply[which].tolist()
        numbers = dict[tuple[float, float], int]()
        pairs = zip(sizes_of, supplies, strict=True)
        of_stroke = np.array([numbers.setdefault(pair, len(numbers)) for pair in pairs])
        return [self.actuator(cause, *pair) for pair in numbers], of_stroke

    def _packed(self, which: Ints, amounts: Floats, packed: Floats) -> Floats:
        """Return packed parameters [n, parameters] of strokes, from those of their actuators."""
        at = self.layout.at
        packed[:, self._scaled] *= np.exp(amounts[:, self._scaling])
        p = Parameters(packed)
        of_trip = amounts[:, self.layout.of_trips].sum(axis=1)
        p.p_supply = p.p_supply * self._supply[which] * np.exp(of_trip)
        p.m_s = p.m_s + self.mass_kg * (np.exp(amounts[:, at["mass"]]) - 1.0)
        p.f_linkage = p.f_linkage * np.exp(amounts[:, at["linkage"]])
        mesh, pull = (self.layout.own[at[n]].usual * self.mounted for n in ("mesh", "pull"))
        p.mesh_force = np.maximum(0.0, p.mesh_force + mesh + amounts[:, at["mesh"]])
        p.pull_force = np.maximum(0.0, p.pull_force + pull + amounts[:, at["pull"]])
        cone = self._impulse[which] * np.exp(np.clip(amounts[:, at["cone"]], -6.0, 4.0))
        cone = np.maximum(cone - PASSING_N_S, 0.0)
        p.sync_impulse = np.where(self.acts[which, at["cone"]], cone, 0.0)
        out: Floats = p.array
        return out

    def _switches(self, which: Ints, delays_ns: Ints, like: Setup) -> Floats:
        """Return the moves of the valves [n, k, 4] as rows of `plant.batch.batch.Strokes`, by their delays."""
        # delays within 0.5 ms have the same moves of the valves, in another place
        steps = delays_ns // 500_000
        later_s = (delays_ns - 500_000 * steps - 250_000) / NS_PER_S
        if len(self._rows) + len(which) > len(self._moves):
            self._rows.clear()
            self._moves = np.zeros((4000 + len(which), *self._moves.shape[1:]))
            self._moves[:, :, 0] = np.inf
        keys = zip(which.tolist(), *steps.T.tolist(), strict=True)
        switches = self._moves[[self._row_of(key, like) for key in keys]]
        switches[:, :, 0] += np.where(switches[:, :, 2] > 0.5, later_s[:, :1], later_s[:, 1:])
        order = np.argsort(switches[:, :, 0], axis=1, kind="stable")
        return np.asarray(switches[np.arange(len(order))[:, None], order])

    def _row_of(self, key: tuple[int, int, int], like: Setup) -> int:
        """Return the row of the moves of a shift's valves at delays in the middle of steps of 0.5 ms."""
        if key not in self._rows:
            shift, *steps = key
            rise_ns, fall_ns = (500_000 * step + 250_000 for step in steps)
            near = replace(like.timing, rise_ns=rise_ns, fall_ns=fall_ns)
            row = self._rows[key] = len(self._rows)
            moves = switch_schedule(self.shifts[shift].commands, near, 3)
            for k, (at_ns, chamber, u) in enumerate(moves):
                self._moves[row, k] = at_ns / NS_PER_S - LEAD_S, chamber, u, 0.0
        return self._rows[key]


def trips_of(shifts: Sequence[RecordedShift]) -> list[str]:
    """Return the logs that shifts are from."""
    return list(dict.fromkeys(shift.source for shift in shifts))


def _filled(values: Floats, most: int) -> Floats:
    return np.pad(values, (0, most - len(values)), "edge")


def _impulse_n_s(shift: RecordedShift) -> float:
    """Return the usual impulse of the cone, N s, at the speed difference of a shift."""
    if np.isnan(shift.difference_rad_s) or shift.end == "N":
        return 30.0
    difference_rad_s = abs(shift.difference_rad_s)
    if difference_rad_s < EQUAL_RAD_S:
        return 0.5 * PASSING_N_S
    return 0.25 / 0.09 * difference_rad_s  # of the default driveline: 0.25 N s at 0.09 rad/s
