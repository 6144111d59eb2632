"""One stroke under stated conditions: commands in, motion and pressures out.

The same kernel and parts as the run over the bus; here the valve commands are a list.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import layout as L
from .errors import InputError
from .hybrid import DEFAULT_TOLERANCE, NS, Balance, Event, HybridSystem
from .packing import Floats, Load, flow_coefficients, initial_state, pack
from .one_equation import steady_oil_pressure
from .parameters import ParameterSet
from .sensors import InternalChain
from .valve import ValveTiming, switch_schedule

KINDS = ("fixed", "N-B", "B-N", "N-F", "F-N")
FULL_DUTY = 0.98


@dataclass(frozen=True)
class StrokeConditions:
    """What is known of a stroke before it runs.

    kind: one of KINDS; pressures absolute [Pa]; load "none", "damper" or "spring"; spring rate
    [N/m] and start offset [m] (fixed rig; the spring is unloaded there); commands are
    (time s, valve, duty); charged_before names the chambers at supply pressure at time 0;
    mesh_force_n is the force barrier into gear, or out of gear for a shift to neutral;
    theoretical_flow replaces the mapped flows by 3.13/3.20.
    """

    kind: str
    supply_pressure_pa: float
    commands: tuple[tuple[float, str, float], ...]
    atmosphere_pa: float = 101325.0
    temperature_k: float = 293.15
    load: str = "none"
    spring_n_per_m: float = 0.0
    start_offset_m: float = 0.0
    charged_before: tuple[str, ...] = ()
    damper_model: str = "compressible"
    mounted: bool = False
    mesh_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0
    rest_s: float = 60.0
    theoretical_flow: bool = False

    @property
    def system(self) -> int:
        """Layout number of the actuator: FIXED or LENGTH."""
        return L.FIXED if self.kind == "fixed" else L.LENGTH

    @property
    def chambers(self) -> tuple[str, ...]:
        """Names of its chambers in order."""
        return ("1", "2") if self.kind == "fixed" else ("B", "N", "F")

    @property
    def into_gear(self) -> bool:
        """True if the stroke engages a gear."""
        return self.kind in ("N-B", "N-F")

    def loads(self) -> Load:
        """The loads on the stay, as the equations take them."""
        return Load(
            damper=self.damper_model if self.load == "damper" else None,
            spring_n_per_m=self.spring_n_per_m if self.load == "spring" else 0.0,
            spring_x0_m=self.start_offset_m,
            mounted=self.mounted,
            mesh_force_n=self.mesh_force_n if self.into_gear else 0.0,
            pull_force_n=0.0 if self.into_gear else self.mesh_force_n,
            sync_impulse_n_s=self.sync_impulse_n_s if self.into_gear else 0.0,
        )


@dataclass(frozen=True)
class Stroke:
    """A simulated stroke: states at the sampled instants, events, balances.

    states has one row an instant, in the order of plant.layout (FX.. or XS..); valves is the
    commanded duty of each chamber; internal_m the position as the control unit reports it;
    packed the parameter array that ran.
    """

    conditions: StrokeConditions
    time_s: Floats
    states: Floats
    duty: Floats
    internal_m: Floats
    events: tuple[Event, ...]
    balance: Balance
    packed: Floats

    @property
    def position_m(self) -> Floats:
        """Stay position at `time_s` [m]."""
        return self.states[:, 0]

    def pressure_pa(self, chamber: str) -> Floats:
        """Pressure of a chamber ("1", "2", "B", "N", "F") or of the damper ("oil2") [Pa]."""
        if chamber == "oil2":
            return self.oil_pressure_pa()
        first = L.FP1 if self.conditions.system == L.FIXED else L.PB
        return self.states[:, first + self.conditions.chambers.index(chamber)]

    def oil_pressure_pa(self) -> Floats:
        """Pressure of the damper's chamber two, absolute [Pa], by the model that ran."""
        if self.conditions.damper_model == "incompressible":
            out = np.zeros(len(self.time_s))
            position = np.ascontiguousarray(self.states[:, 0])
            velocity = np.ascontiguousarray(self.states[:, 1])
            steady_oil_pressure(position, velocity, self.packed, out)
            return out
        return self.states[:, L.FOIL if self.conditions.system == L.FIXED else L.LOIL]

    @property
    def impact(self) -> Event | None:
        """First impact of the stay on an end stop (or neutral), None if there was none."""
        for event in self.events:
            if event.name == "stop":
                return event
        return None


class StrokeSystem(HybridSystem):
    """Either actuator, set up from a stroke's conditions at time 0."""

    def __init__(
        self, parameters: ParameterSet, conditions: StrokeConditions, tolerance: float
    ) -> None:
        self.chambers = conditions.chambers
        system = conditions.system
        load = conditions.loads()
        p = pack(
            parameters,
            system,
            supply_pressure_pa=conditions.supply_pressure_pa,
            atmosphere_pa=conditions.atmosphere_pa,
            load=load,
            theoretical_flow=conditions.theoretical_flow,
        )
        position: str | float
        position = conditions.start_offset_m if system == L.FIXED else conditions.kind[0]
        if system == L.FIXED and not 0.0 <= conditions.start_offset_m <= p[L.STROKE]:
            raise InputError(
                f"start offset {conditions.start_offset_m} m: expected 0 to {p[L.STROKE]}"
            )
        y = initial_state(
            system,
            p,
            position=position,
            charged=conditions.charged_before,
            quadratures=L.QUADRATURES,
        )
        super().__init__(
            system,
            p,
            flow_coefficients(parameters),
            y,
            load,
            conditions.charged_before,
            tolerance,
        )


def valve_moves(
    parameters: ParameterSet, conditions: StrokeConditions, until_ns: int
) -> list[tuple[int, int, float]]:
    """Instants (ns) at which the valves really move: (instant, chamber index, 1 or 0), ascending."""
    names = conditions.chambers
    switches = switch_schedule(
        [(time_s, names.index(valve), duty) for time_s, valve, duty in conditions.commands],
        ValveTiming.from_parameters(parameters),
        len(names),
        [names.index(name) for name in conditions.charged_before],
        FULL_DUTY,
    )
    return [switch for switch in switches if switch[0] <= until_ns]


def duty_at(conditions: StrokeConditions, time_s: Floats) -> Floats:
    """Commanded duty of each chamber at `time_s`, shape [n, chambers]."""
    duty = np.zeros((len(time_s), len(conditions.chambers)))
    for index, name in enumerate(conditions.chambers):
        duty[:, index] = FULL_DUTY if name in conditions.charged_before else 0.0
        for when, target, value in conditions.commands:
            if target == name:
                duty[time_s >= when - 1e-9, index] = value
    return duty


def simulate(
    parameters: ParameterSet,
    conditions: StrokeConditions,
    time_s: Floats,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    internal: bool = True,
) -> Stroke:
    """Simulate one stroke and sample it at `time_s` (ascending, from 0).

    Returns the noise-free states, the position as the control unit would report it, the located
    events and the balances.

    Raises
    ------
    InputError : conditions outside what the model covers
    plant.hybrid.IntegrationError : the motion cannot be continued

    Checked by: tests/physics/test_stroke.py
    """
    sample_ns = np.rint(np.asarray(time_s) * NS).astype(np.int64)
    end_ns = int(sample_ns[-1])
    system = StrokeSystem(parameters, conditions, tolerance)
    chain = InternalChain.from_parameters(parameters)
    end_s = float(time_s[-1])
    instants = np.minimum(chain.measurement_instants_ns(end_s), end_ns)
    wanted = np.unique(np.concatenate([sample_ns, instants]))
    states = system.advance(end_ns, valve_moves(parameters, conditions, end_ns), wanted)
    reported = np.zeros(0)
    if internal:
        measured = states[np.searchsorted(wanted, instants), 0]
        reported = chain.held_m(np.asarray(time_s), chain.ticks_s(end_s), measured)
    return Stroke(
        conditions=conditions,
        time_s=np.asarray(time_s),
        states=states[np.searchsorted(wanted, sample_ns)],
        duty=duty_at(conditions, np.asarray(time_s)),
        internal_m=reported,
        events=tuple(system.events),
        balance=system.balance(),
        packed=system.packed,
    )
