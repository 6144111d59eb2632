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
    """The actuator with one cause of one size: its setup, and the modes of its strokes."""

    setup: Setup
    modes: Ints


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
        self._starts = np.array([s.start for s in shifts])
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
        self._actuators: dict[tuple[str, float, float], Actuator] = {}
        self._moves: dict[tuple[int, int, int], Floats] = {}

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
        key = ("" if cause is None else cause.name, size, supply)
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
            self._actuators[key] = Actuator(setup, modes.array[: Modes.size])
        return self._actuators[key]

    def positions(
        self, which: Ints, amounts: Floats, cause: Cause | None = None, sizes: Floats | float = 0.0
    ) -> tuple[Floats, Bools]:
        """Simulate strokes of shifts `which` [n] with amounts [n, quantities] in their units.

        sizes: of the cause, [n] or one, in typical ones. Returns the reported positions [n, pulses] in m, and
        which strokes [n] could be simulated.
        """
        self.strokes += len(which)
        at, acts = self.layout.at, self.acts[which]
        amounts = np.where(acts, amounts, 0.0)
        is_by_supply = cause is not None and cause.is_by_supply
        supplies = self._supply[which] if is_by_supply else np.ones(len(which))
        pairs = dict[tuple[float, float], int]()
        of_strokes = np.transpose([np.broadcast_to(sizes, len(which)), supplies]).tolist()
        of_pair = np.array([pairs.setdefault(tuple(pair), len(pairs)) for pair in of_strokes])
        actuators = [self.actuator(cause, *pair) for pair in pairs]
        setups = [item.setup for item in actuators]
        packed = self._packed(which, amounts, np.array([s.p.array for s in setups])[of_pair])
        initial = np.empty((len(which), LengthState.size))
        starts = self._starts[which]
        for gear in set(starts.tolist()):
            rows = starts == gear
            initial[rows] = initial_state(
                LENGTH, Parameters(packed[rows]), position=gear, charged=()
            )
        delays_ns = self._delays_ns(amounts, setups, of_pair)
        since_s = np.maximum(LEAD_S - self._off_s[which] - delays_ns[:, 1:] / NS_PER_S, 0.0)
        # one for all: rests of a single flow map have a closed form
        flow, modes = shared([s.c for s in setups]), shared([item.modes for item in actuators])
        for number, c in enumerate(flow):
            rows = of_pair == number if len(flow) > 1 else slice(None)
            initial[rows] = vented(since_s[rows], packed[rows], c, initial[rows])
        latency_s = np.array([s.chain.latency_s for s in setups]) - self.latency_s
        late_s = amounts[:, at["latency"]] + latency_s[of_pair]
        # nothing moves before the first command: a stroke begins there
        instants = np.maximum(self.time_s[which] - late_s[:, None] - LEAD_S, 0.0)
        strokes = Strokes(
            system=LENGTH,
            packed=packed,
            flow=flow if len(flow) == 1 else flow[of_pair],
            initial=initial,
            modes=modes if len(modes) == 1 else modes[of_pair],
            valves=np.zeros((1, 3)),
            switches=self._switches(which, delays_ns, setups[0]),
            duration_s=instants[:, -1] + 1e-6,
        )
        result = simulate_batch(
            strokes, sample_s=instants, columns=[LengthState.x_s], tolerance=self.tolerance
        )
        x = result.samples[:, :, 0]
        reported = np.empty_like(x)
        reports = [(id(s.chain), s.internal_gain, id(s.internal_error_m)) for s in setups]
        for report, setup in dict(zip(reports, setups, strict=True)).items():
            rows, chain = np.array([one == report for one in reports])[of_pair], setup.chain
            pulses = chain.sensor.duration_s(x[rows], chain.coil_temperature_k)
            seen = chain.calibration.position_m(pulses, chain.measured_temperature_k)
            reported[rows] = setup.reported_m(seen)
        gain, offset = amounts[:, at["gain"], None], amounts[:, at["offset"], None]
        return reported * (1.0 + gain) + offset, result.status == DONE

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

    def _delays_ns(self, amounts: Floats, setups: Sequence[Setup], of_pair: Ints) -> Ints:
        """Return the delays of opening and closing [n, 2]."""
        delays = np.array([(s.timing.rise_ns, s.timing.fall_ns) for s in setups])[of_pair]
        own_ns = [NS_PER_S * amounts[:, self.layout.at[name]] for name in ("rise", "fall")]
        return np.maximum(0, delays + np.array(own_ns).round().astype(np.int64).T)

    def _switches(self, which: Ints, delays: Ints, like: Setup) -> Floats:
        """Return the moves of the valves [n, k, 4] as rows of `plant.batch.batch.Strokes`, by their delays in ns."""
        # delays within 0.5 ms have the same moves of the valves, in another place
        steps = delays // 500_000
        later_s = (delays - 500_000 * steps - 250_000) / NS_PER_S
        keys = dict[tuple[int, int, int], int]()
        rows = zip(which.tolist(), *steps.T.tolist(), strict=True)
        of_key = np.array([keys.setdefault(key, len(keys)) for key in rows])
        if len(self._moves) > 4000:
            self._moves.clear()
        moves = [self._moves_of(*key, like) for key in keys]
        table = np.zeros((len(moves), max(map(len, moves)), 4))
        table[:, :, 0] = np.inf
        for place, rows_of_key in zip(table, moves, strict=True):
            place[: len(rows_of_key)] = rows_of_key
        switches = table[of_key]
        switches[:, :, 0] += np.where(switches[:, :, 2] > 0.5, later_s[:, :1], later_s[:, 1:])
        order = np.argsort(switches[:, :, 0], axis=1, kind="stable")
        return np.asarray(switches[np.arange(len(order))[:, None], order])

    def _moves_of(self, shift: int, rise: int, fall: int, like: Setup) -> Floats:
        """Return the moves [k, 4] of a shift's valves at delays in the middle of steps of 0.5 ms."""
        key = shift, rise, fall
        if key not in self._moves:
            rise_ns, fall_ns = (500_000 * step + 250_000 for step in (rise, fall))
            near = replace(like.timing, rise_ns=rise_ns, fall_ns=fall_ns)
            rows = switch_schedule(self.shifts[shift].commands, near, 3)
            timed = [(at / NS_PER_S - LEAD_S, chamber, u, 0.0) for at, chamber, u in rows]
            self._moves[key] = np.array(timed).reshape(-1, 4)
        return self._moves[key]


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
