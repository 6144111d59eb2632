"""From a parameter set and a stroke's conditions to the records that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.kernel import layout
from plant.parameters import ParameterSet

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FIRST_STEP_S = 1e-4
"""First step of an integration."""

CHAMBER_NAMES = (("1", "2"), ("B", "N", "F"))
# Leading states that are integrated: without oil and supply line, with oil, with the line.
STATE_COUNTS = (
    (layout.FixedState.p_2 + 1, layout.FixedState.p_oil + 1, layout.FixedState.p_line + 1),
    (layout.LengthState.impulse + 1, layout.LengthState.p_oil + 1, layout.LengthState.size),
)
CYLINDER_STATES = layout.FixedState.size


@dataclass(frozen=True)
class Load:
    """What acts on the stay besides air and friction.

    damper: "none", "incompressible" or "compressible"; spring rate [N/m] and its unloaded position [m]; mounted on the
    gearbox or not; force barriers into and out of gear [N]; synchronizer impulse [N s] for the next engagement, 0 for
    none.
    """

    damper: str = "none"
    spring_n_per_m: float = 0.0
    spring_x0_m: float = 0.0
    mounted: bool = False
    mesh_force_n: float = 0.0
    pull_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0


def flow_coefficients(parameters: ParameterSet) -> Floats:
    """Return both flow maps as a `FlowMap` array [FlowMap.size], their slopes at equal pressures derived [-]."""
    c = layout.FlowMap.zeros()
    c.y_min = parameters.value("flow_charge.y_min")
    c.y_split = parameters.value("flow_charge.y_split")
    c.z_split = parameters.value("flow_discharge.z_split")
    for flow in ("charge", "discharge"):
        low, high = (parameters.values(f"flow_{flow}.c_{part}") for part in ("low", "high"))
        getattr(c, f"{flow}_low")[: len(low)] = low
        getattr(c, f"{flow}_high")[: len(high)] = high
        setattr(c, f"{flow}_slope", sum(k * low[k] for k in range(1, len(low))))
    return c.array


def pack(
    parameters: ParameterSet,
    system: int,
    *,
    supply_pressure_pa: float,
    atmosphere_pa: float,
    load: Load,
    theoretical_flow: bool = False,
) -> layout.Parameters:
    """Return the parameters of one stroke."""
    value = parameters.value
    p = layout.Parameters.zeros()
    for name, field in layout.Parameters.fields.items():
        path = field.paths[system if len(field.paths) > 1 else 0] if field.paths else ""
        if path:
            setattr(p, name, value(path))
    p.p_atm = atmosphere_pa
    p.p_supply = supply_pressure_pa
    p.k_in = 1.0
    p.k_out = 1.0
    p.flow_model = 1.0 if theoretical_flow else 0.0
    p.cda_in = value("orifice.A_valve") * value("orifice.C_d_in")
    p.cda_out = value("orifice.A_valve") * value("orifice.C_d_out")
    if system == layout.FIXED:
        p.m_s += value("fixed.m_p")
    if load.mounted:
        p.m_s += value("truck.m_gearbox")
        p.f_linkage = value("truck.F_gearbox")
    p.mesh_force = load.mesh_force_n
    p.pull_force = load.pull_force_n
    p.sync_impulse = load.sync_impulse_n_s
    p.spring_k = load.spring_n_per_m
    p.spring_x0 = load.spring_x0_m
    p.bump_width = 1.0
    p.detent_width = 1.0
    p.line_volume = 1.0
    return p


def scales(system: int) -> Floats:
    """Return the typical size of each state [states], in its SI unit, for the error control."""
    body = [0.01, 1.0]
    fixed = [*body, *[1e5] * 4, 1e-4, 1e-4]
    return np.array(fixed if system == layout.FIXED else [*body * 3, *[1e5] * 3, 1.0, 1e5, 1e5])


def fresh_modes(system: int, load: Load) -> layout.Modes:
    """Return modes with the system and the damper's model set."""
    m = layout.Modes.zeros(np.int64)
    m.system = system
    m.damper = ("none", "incompressible", "compressible").index(load.damper)
    return m


def active_states(system: int, m: layout.Modes) -> int:
    """How many leading states are integrated: oil, supply line and masses only where they exist."""
    if m.masses != 0:
        return CYLINDER_STATES
    counts = STATE_COUNTS[system]
    if m.line != 0:
        return counts[2]
    return counts[1] if m.damper == layout.COMPRESSIBLE else counts[0]


def initial_state(
    system: int,
    p: layout.Parameters,
    *,
    position: str | float,
    charged: Sequence[str],
    quadratures: int = 0,
) -> Floats:
    """State at rest [states] in SI units: fixed piston at a position [m], length stroke in gear N, B or F.

    p: also of several strokes, for [strokes, states]. Chambers in `charged` are at the supply pressure, the others at
    the atmosphere's. A piston measured beyond its stop starts on it.
    """
    record = state_record(system)
    size = record.size
    atmosphere, supply = p.p_atm, p.p_supply
    single = p.array.ndim == 1
    state = np.zeros(size + quadratures if single else (size + quadratures, len(p.array)))
    if system == layout.FIXED:
        state[0] = np.clip(position, 0.0, p.stroke)
    elif position in ("B", "F"):
        stroke = np.minimum(p.stroke + p.stop_offset, p.x_free)
        state[layout.LengthState.x_s] = stroke if position == "B" else -stroke
        state[layout.LengthState.x_1 if position == "B" else layout.LengthState.x_2] = (
            stroke + p.x_free
        )
    state[record.p_oil] = atmosphere
    state[record.p_line] = supply
    for index, name in enumerate(CHAMBER_NAMES[system], layout.FIRST_PRESSURE[system]):
        state[index] = supply if name in charged else atmosphere
    return state if single else np.ascontiguousarray(state.T)


def state_record(system: int) -> type[layout.FixedState | layout.LengthState]:
    """Return the record of a system's state."""
    return layout.FixedState if system == layout.FIXED else layout.LengthState
