"""A stroke made ready to run: packed parameters, valve timing, start, sensors. Effects change it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np

from plant.devices.sensors import InternalChain
from plant.devices.spool import Spool
from plant.devices.valve import ValveTiming
from plant.effects.stroke_conditions import StrokeConditions
from plant.equations.fixed_piston import fixed_volumes
from plant.kernel.compiled import plain
from plant.kernel.layout import FIRST_PRESSURE, FIXED, FixedState, Parameters
from plant.kernel.packing import Floats, flow_coefficients, initial_state, pack
from plant.parameters import ParameterSet, cylinder


@dataclass(frozen=True)
class Curve:
    """A function by its values on an even grid, straight between them and level beyond."""

    low: float
    step: float
    nodes: Floats

    def at(self, where: Floats) -> Floats:
        """Return its values [n] at places [n], in the units of its axes."""
        grid = self.low + self.step * np.arange(len(self.nodes))
        return np.asarray(np.interp(where, grid, self.nodes))


@dataclass
class Setup:
    """Everything that decides a stroke.

    p, c: packed parameters and flow map; timing: valve thresholds and delays; creep_s: time of the
    plunger's travel [s]; residual_pa: overpressure of chambers at the start [Pa]; chain: the
    control unit's position chain, its pulses at `phase_s` within the period, with `internal_gain`,
    and its clock running `clock_offset_s + clock_drift t` late; gauge_lag_s: time constant of the
    pressure lines [s]; internal_error_m, gauge_error_pa: what the sensors report too much at a
    position [m] and a pressure [Pa]; has_line: the supply line has a volume and a restriction of its
    own; spool: of proportional valves.
    """

    conditions: StrokeConditions
    p: Parameters
    c: Floats
    timing: ValveTiming
    chain: InternalChain
    phase_s: float = 0.0
    creep_s: float = 0.0
    residual_pa: dict[str, float] = field(default_factory=dict)
    internal_gain: float = 1.0
    clock_offset_s: float = 0.0
    clock_drift: float = 0.0
    gauge_lag_s: float = 0.0
    internal_error_m: Curve | None = None
    gauge_error_pa: Curve | None = None
    has_line: bool = False
    spool: Spool | None = None

    def copy(self) -> Setup:
        """Return a setup that can be changed without changing this one."""
        twin = copy.copy(self)
        twin.p = self.p.copy()
        twin.residual_pa = dict(self.residual_pa)
        return twin

    @classmethod
    def of(cls, parameters: ParameterSet, conditions: StrokeConditions) -> Setup:
        """Return the setup of a stroke, without the effects of an extended model."""
        is_cylinder = conditions.system == FIXED and "cylinder.acting" in parameters
        p = pack(
            parameters,
            conditions.system,
            supply_pressure_pa=conditions.supply_pressure_pa,
            atmosphere_pa=conditions.atmosphere_pa,
            load=conditions.loads(),
            theoretical_flow=conditions.theoretical_flow,
        )
        if is_cylinder:
            rate = parameters.value("cylinder.spring_rate")
            p.f_external -= parameters.value("cylinder.spring_preload") + rate * p.spring_x0
            p.spring_k += rate
            p.flow_model = 2.0
            p.t_gas = conditions.temperature_k
            for name in ("valve_b", "wall_heat", "wall_density", "wall_ends"):
                setattr(p, name, parameters.value(f"cylinder.{name}"))
            p.air_kappa = parameters.value("cylinder.kappa")
        spool = None
        if is_cylinder and "cylinder.valve_frequency" in parameters:
            spool = Spool(*map(parameters.value, cylinder.PROPORTIONAL))
            p.closed_centre = 1.0
        return cls(
            conditions=conditions,
            p=p,
            c=flow_coefficients(parameters),
            timing=ValveTiming.from_parameters(parameters),
            chain=InternalChain.from_parameters(parameters),
            gauge_lag_s=parameters.value("cylinder.gauge_lag") if is_cylinder else 0.0,
            spool=spool,
        )

    def initial_state(self, p: Parameters | None = None, quadratures: int = 0) -> Floats:
        """Return the state at time 0 [states] in SI units, by parameters p also of several strokes: [strokes, states]."""
        conditions = self.conditions
        y = initial_state(
            conditions.system,
            self.p if p is None else p,
            position=conditions.start,
            charged=conditions.charged_before,
            quadratures=quadratures,
        )
        first = FIRST_PRESSURE[conditions.system]
        for chamber, pressure in self.residual_pa.items():
            y[..., first + conditions.chambers.index(chamber)] += pressure
        if self.p.air_kappa > 0.0:
            p = self.p if p is None else p
            state = FixedState(y)
            v_1, v_2 = plain(fixed_volumes)(state, p)
            state.m_1 = state.p_1 * v_1 / (p.r_air * p.t_gas)
            state.m_2 = state.p_2 * v_2 / (p.r_air * p.t_gas)
        return y

    @property
    def driven_by(self) -> tuple[object, ...]:
        """What decides modes and valves of the stroke."""
        return self.conditions, self.timing, self.creep_s, self.has_line, self.spool

    @property
    def exact_gauges(self) -> bool:
        """Whether the gauges report the chambers' true pressures."""
        return self.gauge_lag_s <= 0.0 and self.gauge_error_pa is None

    def reported_m(self, position_m: Floats) -> Floats:
        """Return the reported position [n] in m where a right sensor would report `position_m` [n]."""
        reported = self.internal_gain * position_m
        if self.internal_error_m is not None:
            reported = reported + self.internal_error_m.at(position_m)
        return reported

    @property
    def passive_chambers(self) -> tuple[str, ...]:
        """Chambers that the stroke's motion compresses (the far one of the length stroke is not)."""
        return {"fixed": ("2",), "N-B": ("N",), "N-F": ("N",), "B-N": ("B",), "F-N": ("F",)}[
            self.conditions.kind
        ]

    @property
    def charged_chamber(self) -> str:
        """The chamber that drives the stroke."""
        return {"fixed": "1", "N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}[self.conditions.kind]

    def volume_index(self, chamber: str) -> int:
        """Return the index of a chamber's dead volume in `p`."""
        name = {"1": "vol_b", "2": "vol_n"}.get(chamber, f"vol_{chamber.lower()}")
        return Parameters.fields[name].start
