"""One stroke under stated conditions: commands in, motion and pressures out.

The same kernel and parts as the run over the bus; here the valve commands are a list.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from can_dbc.instants import NS_PER_S
from plant.devices.spool import spool_moves
from plant.devices.valve import seconds_to_ns, switch_schedule
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import FULL_DUTY, KINDS, StrokeConditions
from plant.equations.volumes import ends_of_travel, refuse_empty
from plant.errors import InputError
from plant.integrator.hybrid import DEFAULT_TOLERANCE, Balance, Event, HybridSystem
from plant.kernel.layout import FIRST_PRESSURE, FIXED, Parameters, Quadratures, pressure_slice
from plant.kernel.packing import Floats, state_record
from plant.parameters import ParameterSet
from plant.parts.damper import steady_oil_pressure
from plant.systems.setup import make_setup

__all__ = ["KINDS", "Stroke", "StrokeConditions", "run_setup", "simulate"]


@dataclass(frozen=True)
class Stroke:
    """A simulated stroke: states, one row an instant, in the order of plant.kernel.layout; events, balances.

    duty: commanded, of each chamber; internal_m: position as the control unit reports it; packed: the parameters that
    ran.
    """

    conditions: StrokeConditions
    time_s: Floats
    states: Floats
    duty: Floats
    internal_m: Floats
    events: tuple[Event, ...]
    balance: Balance
    packed: Parameters

    @property
    def position_m(self) -> Floats:
        """Stay position at `time_s` [m]."""
        return self.states[:, 0]

    def pressure_pa(self, chamber: str) -> Floats:
        """Pressure of a chamber ("1", "2", "B", "N", "F") or of the damper ("oil2") [Pa]."""
        if chamber == "oil2":
            return self.oil_pressure_pa()
        first = FIRST_PRESSURE[self.conditions.system]
        return self.states[:, first + self.conditions.chambers.index(chamber)]

    def oil_pressure_pa(self) -> Floats:
        """Pressure of the damper's chamber two, absolute [Pa], by the model that ran."""
        if self.conditions.damper_model == "incompressible":
            out = np.zeros(len(self.time_s))
            position = np.ascontiguousarray(self.states[:, 0])
            velocity = np.ascontiguousarray(self.states[:, 1])
            steady_oil_pressure(position, velocity, self.packed.array, out)
            return out
        return self.states[:, state_record(self.conditions.system).p_oil]

    @property
    def impact(self) -> Event | None:
        """First impact of the stay on an end stop (or neutral), None if there was none."""
        for event in self.events:
            if event.name == "stop":
                return event
        return None


def wrong_start(start_offset_m: float, stroke_m: float) -> str:
    """Return what is wrong with where a fixed piston starts; nothing where a measurement may be off."""
    slack_m = 0.02 * stroke_m
    if -slack_m <= start_offset_m <= stroke_m + slack_m:
        return ""
    return f"start_offset_m {start_offset_m:g}: expected 0 to the model's stroke, {stroke_m:.5g}"


class StrokeSystem(HybridSystem):
    """Either actuator, set up from a stroke's conditions at time 0."""

    def __init__(self, setup: Setup, tolerance: float) -> None:
        conditions = setup.conditions
        self.chambers = conditions.chambers
        system = conditions.system
        p = setup.p
        if system == FIXED and (why := wrong_start(conditions.start_offset_m, p.stroke)):
            raise InputError(why)
        refuse_empty(
            system, p, ends_of_travel(system, p, (conditions.kind[0], conditions.kind[-1]))
        )
        super().__init__(
            system,
            p,
            setup.c,
            setup.initial_state(quadratures=Quadratures.size),
            conditions.loads(),
            conditions.charged_before,
            tolerance,
            has_line=setup.has_line,
        )


def valve_moves(setup: Setup, until_ns: int) -> list[tuple[int, int, float, float]]:
    """Return the moves (instant ns, chamber index, position, slope 1/s), ascending; slope 0: at once."""
    conditions = setup.conditions
    names = conditions.chambers
    if setup.spool is not None:
        return sorted(_proportional_moves(setup, until_ns), key=lambda move: move[:2])
    switches = switch_schedule(
        [(time_s, names.index(valve), duty) for time_s, valve, duty in conditions.commands],
        setup.timing,
        len(names),
        [names.index(name) for name in conditions.charged_before],
        FULL_DUTY,
    )
    travel_ns = seconds_to_ns(setup.creep_s)
    moves: list[tuple[int, int, float, float]] = []
    for instant, chamber, target in switches:
        if travel_ns > 0:
            slope = (2.0 * target - 1.0) / setup.creep_s
            moves.append((instant, chamber, 1.0 - target, slope))
            moves.append((instant + travel_ns, chamber, target, 0.0))
        else:
            moves.append((instant, chamber, target, 0.0))
    return sorted(move for move in moves if move[0] <= until_ns)


def _proportional_moves(setup: Setup, until_ns: int) -> Iterator[tuple[int, int, float, float]]:
    """Yield the moves of proportional valves, valve by valve."""
    conditions = setup.conditions
    assert setup.spool is not None
    for index, name in enumerate(conditions.chambers):
        signals = [
            (seconds_to_ns(at), value) for at, valve, value in conditions.commands if valve == name
        ]
        start = 1.0 if name in conditions.charged_before else 0.0
        for instant, opening, slope in spool_moves(
            setup.spool, setup.timing, sorted(signals), start, until_ns, setup.creep_s
        ):
            yield instant, index, opening, slope


def duty_at(conditions: StrokeConditions, time_s: Floats) -> Floats:
    """Commanded duty of each chamber at `time_s`, shape [n, chambers]."""
    duty = np.zeros((len(time_s), len(conditions.chambers)))
    for index, name in enumerate(conditions.chambers):
        duty[:, index] = FULL_DUTY if name in conditions.charged_before else 0.0
        for when, target, value in conditions.commands:
            if target == name:
                duty[time_s >= when - 1e-9, index] = value
    return duty


def lagged(time_s: Floats, values: Floats, lag_s: float) -> Floats:
    """Values [n] or [n, k] behind a lag, y' = (x - y) / lag, settled at the start, straight between samples."""
    if lag_s <= 0.0:
        return values
    from scipy.linalg import solve_banded

    step = np.diff(time_s)
    decay = np.exp(-step / lag_s)
    shape = (-1,) + (1,) * (values.ndim - 1)
    ahead = lag_s * np.diff(values, axis=0) / step.reshape(shape)
    driven = values[1:] - ahead + (ahead - values[:-1]) * decay.reshape(shape)
    # out[k] - decay[k] out[k-1] = driven[k]
    bands = np.vstack([np.ones(len(time_s)), np.concatenate([-decay, [0.0]])])
    right_side = np.concatenate([values[:1], driven])
    return np.asarray(solve_banded((1, 0), bands, right_side, check_finite=False))


def gauged(setup: Setup, time_s: Floats, pressures_pa: Floats) -> Floats:
    """Chamber pressures [n, k] as the gauges show them: behind their lines, with their error."""
    shown = lagged(time_s, pressures_pa, setup.gauge_lag_s)
    if setup.gauge_error_pa is not None:
        shown = shown + setup.gauge_error_pa.at(shown)
    return shown


def simulate(
    parameters: ParameterSet,
    conditions: StrokeConditions,
    time_s: Floats,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    internal: bool = True,
) -> Stroke:
    """Simulate one stroke and sample it at `time_s` [n] in s, ascending from 0.

    Returns the noise-free states, the position as the control unit would report it, the located events and the
    balances. Raises InputError for conditions outside what the model covers, IntegrationError if the motion cannot be
    continued.
    """
    return run_setup(make_setup(parameters, conditions), time_s, tolerance, internal)


def run_setup(
    setup: Setup, time_s: Floats, tolerance: float = DEFAULT_TOLERANCE, internal: bool = True
) -> Stroke:
    """Simulate a stroke that is ready to run; time_s: [n] in s (see `simulate`)."""
    conditions = setup.conditions
    time_s = np.asarray(time_s, dtype=np.float64)
    sample_ns = np.rint(time_s * NS_PER_S).astype(np.int64)
    end_ns = int(sample_ns[-1])
    system = StrokeSystem(setup, tolerance)
    chain = setup.chain
    end_s = float(time_s[-1])
    wanted = sample_ns
    instants = sample_ns[:0]
    if internal:
        instants = np.minimum(chain.measurement_instants_ns(end_s, setup.phase_s), end_ns)
        wanted = np.unique(np.concatenate([sample_ns, instants]))
    states = system.advance(end_ns, valve_moves(setup, end_ns), wanted)
    reported = np.zeros(0)
    if internal:
        measured = states[np.searchsorted(wanted, instants), 0]
        clock_s = time_s - setup.clock_offset_s - setup.clock_drift * time_s
        sampled = chain.held_m(clock_s, chain.ticks_s(end_s, setup.phase_s), measured)
        reported = setup.reported_m(sampled)
    if internal and len(wanted) != len(sample_ns):
        states = states[np.searchsorted(wanted, sample_ns)]
    pressures = pressure_slice(conditions.system)
    states[:, pressures] = gauged(setup, time_s, states[:, pressures])
    return Stroke(
        conditions=conditions,
        time_s=time_s,
        states=states,
        duty=duty_at(conditions, time_s),
        internal_m=reported,
        events=tuple(system.events),
        balance=system.balance(),
        packed=system.packed,
    )
