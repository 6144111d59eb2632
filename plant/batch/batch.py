"""Many strokes in one call: sweeps, fits, Monte Carlo.

Strokes that the lanes cover run eight at a time (plant/batch/lanes.py); the others one after the other
through the scalar kernel, in the same call and compiled as well.  The result says which took which
path.  It is the same, bit for bit, for any number of workers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.batch.lane_control import Result
from plant.batch.lane_steps import FREE_OF, MODES_FREE_OF, WIDTH
from plant.batch.lanes import MOVING, Batch, Room, room_for_results, run_in_lanes
from plant.batch.singles import run_singles
from plant.effects.setup import Setup
from plant.integrator.filling import NO_CURVES, filling_curves
from plant.integrator.hybrid import NS
from plant.kernel.layout import FIRST_PRESSURE, FIXED, FlowMap, Modes, Parameters
from plant.kernel.packing import Floats, Ints, fresh_modes, initial_state, scales, state_record
from plant.systems.stroke import valve_moves

BATCH_TOLERANCE = 1e-6
LONGEST_GRID = 4096
NOT_IN_LANES = np.array([getattr(Parameters, name) for name in FREE_OF])
MODES_NOT_IN_LANES = np.array([getattr(Modes, name) for name in MODES_FREE_OF])
BEGIN = np.array(
    [
        Parameters.p_atm,
        Parameters.p_supply,
        Parameters.stroke,
        Parameters.stop_offset,
        Parameters.x_free,
    ]
)
"""What a state at time 0 depends on."""
Bools = NDArray[np.bool_]


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

    def __post_init__(self) -> None:
        n = len(self.packed)
        states = state_record(self.system).size
        for name, tail in (
            ("packed", (Parameters.size,)),
            ("flow", (FlowMap.size,)),
            ("initial", (states,)),
            ("modes", (Modes.size,)),
            ("valves", (3,)),
            ("switches", (self.switches.shape[1], 4)),
            ("duration_s", ()),
        ):
            array = getattr(self, name)
            rows = (n,) if name == "packed" else (1, n)
            if array.shape[1:] != tail or len(array) not in rows:
                raise ValueError(f"{name}: shape {array.shape}; expected {rows} + {tail}")
        times = self.switches[:, :, 0]
        if not (times[:, 1:] >= times[:, :-1]).all():
            raise ValueError("switches: times must ascend")
        if not (np.isfinite(self.duration_s) & (self.duration_s > 0.0)).all():
            raise ValueError("duration_s: expected positive numbers")

    def __len__(self) -> int:
        return len(self.packed)

    @classmethod
    def from_setups(cls, setups: Sequence[Setup], duration_s: float) -> Strokes:
        """Any strokes of one system, each with its own setup.

        Raises ValueError if the setups mix the two systems.
        """
        if len({setup.conditions.system for setup in setups}) != 1:
            raise ValueError("a batch holds strokes of one system")
        packed = np.array([setup.p.array for setup in setups])
        like: tuple | None = None
        driven: tuple[Ints, Floats, Floats] | None = None
        items = []
        for setup in setups:
            same = (setup.conditions, setup.timing, setup.creep_s, setup.has_line)
            if driven is None or same != like:
                like, driven = same, _driven(setup, duration_s)
            items.append(driven)
        if all(item is driven for item in items):
            items = items[:1]
        modes_, valves, switches = zip(*items, strict=True)
        longest = max(len(item) for item in switches)
        return cls(
            system=setups[0].conditions.system,
            packed=packed,
            flow=shared([setup.c for setup in setups]),
            initial=shared(initials(setups, packed)),
            modes=shared(modes_),
            valves=shared(valves),
            switches=shared([_padded(item, longest) for item in switches]),
            duration_s=np.array([duration_s]),
        )

    @classmethod
    def varied(
        cls, setup: Setup, duration_s: float, changes: Mapping[int, float | Floats]
    ) -> Strokes:
        """One stroke with some packed parameters changed: index in plant.kernel.layout -> values [n].

        Chambers that stand at the supply or at the atmosphere at the start follow their pressure.
        """
        base = cls.from_setups([setup], duration_s)
        n = max((np.size(value) for value in changes.values()), default=1)
        packed = np.repeat(base.packed, n, axis=0)
        for index, value in changes.items():
            packed[:, index] = value
        first = FIRST_PRESSURE[base.system]
        initial = base.initial
        if Parameters.p_supply in changes or Parameters.p_atm in changes:
            initial = np.repeat(initial, n, axis=0)
            for place in range(first, first + len(setup.conditions.chambers)):
                for index in (Parameters.p_supply, Parameters.p_atm):
                    if base.initial[0, place] == base.packed[0, index]:
                        initial[:, place] = packed[:, index]
        return cls(
            base.system,
            packed,
            base.flow,
            initial,
            base.modes,
            base.valves,
            base.switches,
            base.duration_s,
        )

    @property
    def in_lanes(self) -> Bools:
        """Return which strokes [n] the lanes cover (True or False, no unit)."""
        return covered_by_lanes(self.packed, self.modes)


def covered_by_lanes(packed: Floats, modes: Ints) -> Bools:
    """Return which strokes [n] the lanes cover; arrays and units as those of `Strokes`."""
    used = packed.take(NOT_IN_LANES, axis=1).any(axis=1)
    return np.logical_not(used | modes.take(MODES_NOT_IN_LANES, axis=1).any(axis=1))


def _initial(setup: Setup) -> Floats:
    """State at time 0."""
    conditions = setup.conditions
    system = conditions.system
    y = initial_state(
        system,
        setup.p,
        position=conditions.start_offset_m if system == FIXED else conditions.kind[0],
        charged=conditions.charged_before,
    )
    first = FIRST_PRESSURE[system]
    for chamber, pressure in setup.residual_pa.items():
        y[first + conditions.chambers.index(chamber)] += pressure
    return y


def initials(setups: Sequence[Setup], packed: Floats) -> list[Floats]:
    """Return the states [states] at time 0 in SI units, the same array for strokes that begin alike.

    packed: [n, Parameters.size] in SI units.
    """
    first = setups[0]
    begin = _initial(first)
    places = packed.take(BEGIN, axis=1)
    same = (places == places[0]).all(axis=1)
    return [
        begin
        if alike and one.conditions is first.conditions and one.residual_pa == first.residual_pa
        else _initial(one)
        for one, alike in zip(setups, same.tolist(), strict=True)
    ]


def _driven(setup: Setup, duration_s: float) -> tuple[Ints, Floats, Floats]:
    """Modes, valves and switches: what the conditions and the valves' timing decide."""
    conditions = setup.conditions
    m = fresh_modes(conditions.system, conditions.loads())
    m.line = 1 if setup.has_line else 0
    valves = np.zeros(3)
    for index, name in enumerate(conditions.chambers):
        valves[index] = 1.0 if name in conditions.charged_before else 0.0
    switches = [
        (instant / NS, chamber, target, slope)
        for instant, chamber, target, slope in valve_moves(setup, round(duration_s * NS))
    ]
    return m.array[: Modes.size], valves, np.array(switches).reshape(-1, 4)


def _padded(switches: Floats, rows: int) -> Floats:
    """Return the same switches, filled up to `rows` with rows of infinite time."""
    filled = np.zeros((rows, 4))
    filled[:, 0] = np.inf
    filled[: len(switches)] = switches
    return filled


def shared(arrays: Sequence[NDArray]) -> NDArray:
    """Return arrays [k] as one [n, k], with one row if all are equal; units are those of the arrays."""
    if all(item is arrays[0] for item in arrays):
        return arrays[0][None].copy()
    whole = np.array(arrays)
    return whole[:1].copy() if (whole == whole[:1]).all() else whole


@dataclass(frozen=True)
class BatchResult:
    """What became of a batch.

    status : integrate.DONE or why the stroke stopped early (plant.integrator.hybrid.REASONS)
    arrival_s, impact_speed_m_s, impact_energy_j : first impact of the stay on a stop, nan if none
    final : [n, states], state at the end
    samples : [n, samples, columns]
    events : [n, room, EVENT_COLUMNS], the first events of each stroke; event_count : all of them
    steps : accepted steps
    in_lanes : True where the lanes ran, False where the scalar kernel did
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
    contiguous = np.ascontiguousarray
    return Batch(
        packed=contiguous(strokes.packed),
        flow=contiguous(strokes.flow),
        initial=contiguous(strokes.initial),
        modes=contiguous(strokes.modes),
        valves=contiguous(strokes.valves),
        switches=contiguous(strokes.switches),
        duration=contiguous(strokes.duration_s),
        samples=instants,
        columns=wanted,
        scale=scales(strokes.system),
    )


def simulate_batch(
    strokes: Strokes,
    *,
    sample_s: Floats | None = None,
    columns: Sequence[int] | None = None,
    tolerance: float = BATCH_TOLERANCE,
    workers: int = 1,
    event_room: int = 0,
    lanes: bool = True,
    follow: bool = False,
) -> BatchResult:
    """Simulate all strokes of a batch.

    Parameters
    ----------
    strokes : the batch
    sample_s : [s] or [n, s], ascending instants at which states are wanted
    columns : states to be sampled (plant.kernel.layout), all of them if not given
    tolerance : of the integrator, relative to each state's scale
    workers : threads that share the strokes
    event_room : how many events of each stroke to keep
    lanes : False sends every stroke through the scalar kernel, rests included
    follow : the strokes are neighbours of the first one and take its steps: see `plant.batch.tangents`

    Raises ValueError for instants that do not ascend and for unknown columns.
    A stroke that cannot be continued does not stop the others: see `BatchResult.status`.
    Checked by: tests/unit/plant/batch/test_batch.py
    """
    n, states = len(strokes), strokes.initial.shape[1]
    batch = _arrays(strokes, sample_s, columns)
    instants, wanted = batch.samples, batch.columns
    found = room_for_results(n, states, instants.shape[1], len(wanted), event_room)
    covered = strokes.in_lanes if lanes else np.zeros(n, dtype=np.bool_)
    curves = filling_curves(batch.flow)

    def run(order: Ints) -> None:
        room = Room.of(instants.shape[1] if follow else 1, LONGEST_GRID if follow else 1)
        inside, outside = order[covered[order]], order[~covered[order]]
        if len(inside):
            leads = follow and bool(covered[0])
            run_in_lanes(batch, found, room, curves, inside, tolerance, strokes.system, leads)
        if len(outside):
            leads = follow and not covered[0]
            run_singles(
                batch, found, room, curves if lanes else NO_CURVES, outside, tolerance,
                strokes.system, leads,
            )  # fmt: skip

    everything = np.arange(n)
    if follow or workers <= 1 or n < 2 * WIDTH:
        run(everything)
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, np.array_split(everything, workers)))
    moving = MOVING[strokes.system]
    initial = np.broadcast_to(strokes.initial, (n, states))
    for column in np.flatnonzero(wanted >= moving):  # these states do not move in a lane
        found.out[covered, :, column] = initial[covered][:, wanted[column], None]
    results = Result(found.results)
    return BatchResult(
        status=results.status.astype(np.int64),
        arrival_s=results.arrival,
        impact_speed_m_s=results.speed,
        impact_energy_j=results.energy,
        final=found.final,
        samples=found.out,
        events=found.events,
        event_count=results.events.astype(np.int64),
        steps=results.steps.astype(np.int64),
        in_lanes=covered,
    )
