"""Many strokes in one call: sweeps, fits, Monte Carlo; bit for bit the same for any number of workers.

Strokes that the lanes cover run eight at a time (plant/batch/lanes.py), the others through the scalar kernel.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.batch.lane_control import Result
from plant.batch.lane_steps import WIDTH
from plant.batch.lanes import MOVING_STATES, Batch, Room, find_covered, room_for_results, run_lanes
from plant.batch.singles import run_singles
from plant.effects.setup import Setup
from plant.integrator.filling import NO_CURVES, filling_curves
from plant.kernel.layout import FlowMap, Modes, Parameters
from plant.kernel.packing import Floats, Ints, fresh_modes, scales, state_record
from plant.systems.stroke import valve_moves

BATCH_TOLERANCE = 1e-6
Bools = NDArray[np.bool_]
Drive = tuple[Ints, Floats, Floats]
"""Modes, valves and switches of one stroke, as in `Strokes`."""


@dataclass(frozen=True)
class Strokes:
    """Strokes of one system as arrays; an array with one row is shared by all strokes.

    system : layout.FIXED or LENGTH
    packed : [n, PARAMETERS], one row a stroke
    flow : [1 or n, FLOW_COEFFICIENTS]
    initial : [1 or n, states], state at time 0
    modes : int64 [1 or n, MODES], damper model and supply line
    valves : [1 or n, 3], valve positions at time 0, 1 = supply
    switches : [1 or n, k, 4], rows (time s, chamber, position, slope 1/s), times ascending; rows
        of infinite time fill up
    duration_s : [1 or n]
    """

    system: int
    packed: Floats
    flow: Floats
    initial: Floats
    modes: Ints
    valves: Floats
    switches: Floats
    duration_s: Floats

    def __len__(self) -> int:
        return len(self.packed)

    @property
    def arrays(self) -> tuple[NDArray, ...]:
        """All arrays [1 or n, ...] in SI units, in the order of their fields."""
        return (
            self.packed, self.flow, self.initial, self.modes, self.valves, self.switches,
            self.duration_s,
        )  # fmt: skip

    def check(self) -> None:
        """Raise ValueError for shapes that do not match, switches that do not ascend, and no duration."""
        n = len(self.packed)
        tails: tuple[tuple[int, ...], ...] = (
            (Parameters.size,), (FlowMap.size,), (state_record(self.system).size,), (Modes.size,),
            (3,), (self.switches.shape[1], 4), (),
        )  # fmt: skip
        names = ("packed", "flow", "initial", "modes", "valves", "switches", "duration_s")
        for name, array, tail in zip(names, self.arrays, tails, strict=True):
            rows = (n,) if name == "packed" else (1, n)
            if array.shape[1:] != tail or len(array) not in rows:
                raise ValueError(f"{name}: shape {array.shape}; expected {rows} + {tail}")
        times = self.switches[:, :, 0]
        if not (times[:, 1:] >= times[:, :-1]).all():
            raise ValueError("switches: times must ascend")
        if not (np.isfinite(self.duration_s) & (self.duration_s > 0.0)).all():
            raise ValueError("duration_s: expected positive numbers")

    @classmethod
    def from_setups(cls, setups: Sequence[Setup], duration_s: float) -> Strokes:
        """Strokes of one system, each with its own setup. Raises ValueError if the setups mix the two systems."""
        if len({setup.conditions.system for setup in setups}) != 1:
            raise ValueError("a batch holds strokes of one system")
        like: tuple | None = None
        drives: list[Drive] = []
        for setup in setups:
            before, like = like, setup.driven_by
            drives.append(
                drives[-1] if like == before else drive_of(setup, round(duration_s * NS_PER_S))
            )
        modes_, valves, switches = zip(*drives, strict=True)
        longest = max(map(len, switches))
        return cls.driven(
            setups,
            (shared(modes_), shared(valves), shared([_padded(item, longest) for item in switches])),
            np.array([duration_s]),
        )

    @classmethod
    def driven(cls, setups: Sequence[Setup], drive: Drive, duration_s: Floats) -> Strokes:
        """Strokes by setups, and rows of what drives them [1 or n, ...] in SI units."""
        first = setups[0]
        packed = np.array([setup.p.array for setup in setups])
        if all(
            one.conditions is first.conditions and one.residual_pa == first.residual_pa
            for one in setups
        ):
            initial = first.initial_state(Parameters(packed))
        else:
            initial = np.array([setup.initial_state() for setup in setups])
        flow = shared([setup.c for setup in setups])
        return cls(first.conditions.system, packed, flow, initial, *drive, duration_s)

    @property
    def in_lanes(self) -> Bools:
        """Return which strokes [n] the lanes cover (True or False, no unit)."""
        covered = np.empty(len(self.packed), dtype=np.bool_)
        find_covered(self.packed, self.modes, covered)
        return covered


def drive_of(setup: Setup, end_ns: int) -> Drive:
    """Return what the conditions and the timing of the valves decide."""
    conditions = setup.conditions
    m = fresh_modes(conditions.system, conditions.loads())
    m.line = 1 if setup.has_line else 0
    m.masses = 1 if setup.p.air_kappa > 0.0 else 0
    valves = np.zeros(3)
    for index, name in enumerate(conditions.chambers):
        valves[index] = 1.0 if name in conditions.charged_before else 0.0
    moves = [(at / NS_PER_S, *move) for at, *move in valve_moves(setup, end_ns)]
    return m.array, valves, np.array(moves, dtype=np.float64).reshape(-1, 4)


def _padded(switches: Floats, rows: int) -> Floats:
    """Return the same switches, filled up to `rows` with rows of infinite time."""
    filled = np.zeros((rows, 4))
    filled[:, 0] = np.inf
    filled[: len(switches)] = switches
    return filled


def shared(arrays: Sequence[NDArray]) -> NDArray:
    """Return arrays [k] as one [n, k], with one row if all are equal; units are those of the arrays."""
    if all(item is arrays[0] for item in arrays):
        return arrays[0][None]
    rows = np.array(arrays)
    return rows[:1] if (rows == rows[:1]).all() else rows


def fill_still(out: Floats, strokes: Strokes, columns: Iterable[int], covered: Bools) -> None:
    """Write the states that do not move in a lane into samples [n, s, columns] in SI units of covered strokes [n]."""
    for place, column in enumerate(columns):
        if column >= MOVING_STATES[strokes.system]:
            still = np.broadcast_to(strokes.initial[:, column, None], out.shape[:2])
            out[covered, :, place] = still[covered]


@dataclass(frozen=True)
class BatchResult:
    """What became of a batch; in_lanes: which strokes the lanes ran.

    status: integrate.DONE or why the stroke stopped early (plant.integrator.hybrid.REASONS); arrival_s,
    impact_speed_m_s, impact_energy_j: first impact of the stay on a stop, nan if none; final [n, states]; samples [n,
    samples, columns]; events [n, room, EVENT_COLUMNS]: the first of each stroke, event_count: of all; steps: accepted
    ones.
    """

    status: Ints
    arrival_s: Floats
    impact_speed_m_s: Floats
    impact_energy_j: Floats
    final: Floats
    samples: Floats
    events: Floats
    event_count: Ints
    steps: Ints
    in_lanes: Bools


def _arrays(strokes: Strokes, sample_s: Floats | None, columns: Sequence[int] | None) -> Batch:
    """Return what the kernels take; raises ValueError as `simulate_batch` does."""
    strokes.check()
    n, states = len(strokes), strokes.initial.shape[1]
    if sample_s is None:
        instants = np.zeros((1, 0))
    else:
        instants = np.array(sample_s, dtype=np.float64, ndmin=2, order="C")
        if len(instants) not in (1, n) or not (np.diff(instants, axis=1) >= 0.0).all():
            raise ValueError("sample_s: expected ascending instants, shape [s] or [n, s]")
    wanted = np.arange(states) if columns is None else np.array(columns, dtype=np.int64)
    if not ((wanted >= 0) & (wanted < states)).all():
        raise ValueError(f"columns: expected numbers from 0 to {states - 1}")
    arrays = map(np.ascontiguousarray, strokes.arrays)
    return Batch._make((*arrays, instants, wanted, scales(strokes.system)))


def simulate_batch(
    strokes: Strokes,
    *,
    sample_s: Floats | None = None,
    columns: Sequence[int] | None = None,
    tolerance: float = BATCH_TOLERANCE,
    workers: int = 1,
    event_room: int = 0,
    lanes: bool = True,
) -> BatchResult:
    """Simulate all strokes of a batch.

    sample_s: [s] or [n, s], ascending instants in s at which states are wanted; columns: those to be sampled
    (plant.kernel.layout), all by default; tolerance: of the integrator, relative to each state's scale; workers:
    threads; event_room: how many events of each stroke to keep; lanes: False sends every stroke through the scalar
    kernel, rests included. Raises ValueError for strokes that `Strokes.check` refuses, instants that do not ascend and
    unknown columns. A stroke that cannot be continued does not stop the others: see `BatchResult.status`.
    """
    n, states = len(strokes), strokes.initial.shape[1]
    batch = _arrays(strokes, sample_s, columns)
    instants, wanted = batch.samples, batch.columns
    outcome = room_for_results(n, states, instants.shape[1], len(wanted), event_room)
    covered = strokes.in_lanes if lanes else np.zeros(n, dtype=np.bool_)
    curves = filling_curves(batch.flow)

    def run(order: Ints) -> None:
        room = Room.of(1, 1)
        inside, outside = order[covered[order]], order[~covered[order]]
        if len(inside):
            run_lanes(batch, outcome, room, curves, inside, tolerance, strokes.system, False)
        if len(outside):
            table = curves if lanes else NO_CURVES
            run_singles(batch, outcome, room, table, outside, tolerance, strokes.system, False)

    everything = np.arange(n)
    if workers <= 1 or n < 2 * WIDTH:
        run(everything)
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, np.array_split(everything, workers)))
    fill_still(outcome.out, strokes, wanted, covered)
    results = Result(outcome.results)
    return BatchResult(
        status=results.status.astype(np.int64),
        arrival_s=results.arrival,
        impact_speed_m_s=results.speed,
        impact_energy_j=results.energy,
        final=outcome.final,
        samples=outcome.out,
        events=outcome.events,
        event_count=results.events.astype(np.int64),
        steps=results.steps.astype(np.int64),
        in_lanes=covered,
    )
