"""From a parameter set and a stroke's conditions to the arrays that the kernels read.

The only place where parameter names meet array positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.kernel import layout as L
from plant.parameters import ParameterSet

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FIXED_SCALE = (0.01, 1.0, 1e5, 1e5, 1e5, 1e5)
LENGTH_SCALE = (0.01, 1.0, 0.01, 1.0, 0.01, 1.0, 1e5, 1e5, 1e5, 1.0, 1e5, 1e5)


@dataclass(frozen=True)
class Load:
    """What stands against the stay besides air and friction.

    damper: None, "incompressible" or "compressible"; spring rate [N/m] and its unloaded position
    [m]; mounted on the gearbox or not; force barriers into and out of gear [N]; synchronizer
    impulse [N s] for the next engagement, 0 for none.
    """

    damper: str | None = None
    spring_n_per_m: float = 0.0
    spring_x0_m: float = 0.0
    mounted: bool = False
    mesh_force_n: float = 0.0
    pull_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0


def flow_coefficients(parameters: ParameterSet) -> Floats:
    """Coefficients of both flow maps in the kernels' order, with the end slopes derived."""
    c = np.zeros(L.FLOW_COEFFICIENTS)
    c[L.C_Y_MIN] = parameters.value("flow_charge.y_min")
    c[L.C_Y_SPLIT] = parameters.value("flow_charge.y_split")
    high = parameters.values("flow_charge.c_high")
    low = parameters.values("flow_charge.c_low")
    c[L.C_HIGH : L.C_HIGH + len(high)] = high
    c[L.C_LOW : L.C_LOW + len(low)] = low
    c[L.C_SLOPE] = sum(k * low[k] for k in range(1, len(low)))
    c[L.D_Z_SPLIT] = parameters.value("flow_discharge.z_split")
    low = parameters.values("flow_discharge.c_low")
    high = parameters.values("flow_discharge.c_high")
    c[L.D_LOW : L.D_LOW + len(low)] = low
    c[L.D_HIGH : L.D_HIGH + len(high)] = high
    c[L.D_SLOPE] = sum(k * low[k] for k in range(1, len(low)))
    return c


def pack(
    parameters: ParameterSet,
    system: int,
    *,
    supply_pressure_pa: float,
    atmosphere_pa: float,
    load: Load,
    theoretical_flow: bool = False,
) -> Floats:
    """The parameter array `p` of one stroke (layout: plant/kernel/layout.py)."""
    value = parameters.value
    p = np.zeros(L.PARAMETERS)
    p[L.R_AIR] = value("gas.R_air")
    p[L.T_GAS] = value("gas.T")
    p[L.P_ATM] = atmosphere_pa
    p[L.P_SUPPLY] = supply_pressure_pa
    p[L.ALPHA_M1] = value("alpha.alpha_m1")
    p[L.ALPHA_1] = value("alpha.alpha_1")
    p[L.ALPHA_M2] = value("alpha.alpha_m2")
    p[L.ALPHA_2] = value("alpha.alpha_2")
    p[L.K_IN] = 1.0
    p[L.K_OUT] = 1.0
    p[L.FLOW_MODEL] = 1.0 if theoretical_flow else 0.0
    p[L.CDA_IN] = value("orifice.A_valve") * value("orifice.C_d_in")
    p[L.CDA_OUT] = value("orifice.A_valve") * value("orifice.C_d_out")
    p[L.GAMMA] = value("gas.gamma")
    if system == L.FIXED:
        p[L.STROKE] = value("fixed.stroke")
        p[L.AREA_P] = value("fixed.A1")
        p[L.AREA_P2] = value("fixed.A2")
        p[L.AREA_S] = value("fixed.A_s")
        p[L.VOL_B] = value("fixed.V10")
        p[L.VOL_N] = value("fixed.V20")
        p[L.M_S] = value("fixed.m_s") + value("fixed.m_p")
        p[L.F_STATIC_S] = value("friction_fixed.F_sf")
        p[L.F_RUN_S] = value("friction_fixed.F_rf")
        p[L.BETA_S] = value("friction_fixed.beta")
    else:
        p[L.STROKE] = value("length.stroke")
        p[L.X_FREE] = value("length.x_free_total")
        p[L.AREA_P] = value("length.A_p")
        p[L.AREA_S] = value("length.A_s")
        p[L.VOL_B] = value("length.V_B0")
        p[L.VOL_N] = value("length.V_N0")
        p[L.VOL_F] = value("length.V_F0")
        p[L.M_S] = value("length.m_s")
        p[L.M_P] = value("length.m_p")
        p[L.F_STATIC_S] = value("friction_length.F_sf_s")
        p[L.F_RUN_S] = value("friction_length.F_rf_s")
        p[L.BETA_S] = value("friction_length.beta_s")
        p[L.F_STATIC_P] = value("friction_length.F_sf_p")
        p[L.F_RUN_P] = value("friction_length.F_rf_p")
        p[L.BETA_P] = value("friction_length.beta_p")
    if load.mounted:
        p[L.M_S] += value("truck.m_gearbox")
        p[L.F_LINKAGE] = value("truck.F_gearbox")
    p[L.MESH_FORCE] = load.mesh_force_n
    p[L.PULL_FORCE] = load.pull_force_n
    p[L.X_MESH] = value("synchronizer.x_mesh")
    p[L.W_MESH] = value("synchronizer.w_mesh")
    p[L.W_PULL] = value("synchronizer.w_pull")
    p[L.X_BLOCK] = value("synchronizer.x_block")
    p[L.SYNC_IMPULSE] = load.sync_impulse_n_s
    p[L.SPRING_K] = load.spring_n_per_m
    p[L.SPRING_X0] = load.spring_x0_m
    p[L.BUMP_WIDTH] = 1.0
    p[L.DETENT_WIDTH] = 1.0
    p[L.RESTITUTION] = value("stops.restitution")
    p[L.LINE_VOLUME] = 1.0
    p[L.A_OIL] = value("damper.A_oil")
    p[L.A_SMALL] = value("damper.A_S")
    p[L.A_LARGE] = value("damper.A_B0")
    p[L.R_HOLE] = value("damper.r_hole")
    p[L.X_HOLE] = value("damper.x_B")
    p[L.RHO_OIL] = value("damper.rho")
    p[L.KAPPA] = value("damper.kappa_effective")
    p[L.V_OIL] = value("damper.V_oil2_0")
    p[L.CD_FLOOR] = value("damper.C_D_floor")
    p[L.CD_SLOPE] = value("damper.C_D_slope")
    p[L.TERM_STEP] = 1.0
    return p


def scales(system: int) -> Floats:
    """Typical size of each state, for the error control."""
    return np.array(FIXED_SCALE if system == L.FIXED else LENGTH_SCALE)


def modes(system: int, load: Load) -> Ints:
    """A fresh mode array for the system, with the damper model set."""
    m = np.zeros(32, dtype=np.int64)
    m[L.M_SYSTEM] = system
    m[L.M_DAMPER] = {None: 0, "incompressible": 1, "compressible": 2}[load.damper]
    return m


def active_states(system: int, m: Ints) -> int:
    """How many leading states are integrated: oil and supply line only where they exist."""
    if m[L.M_LINE] != 0:
        return L.FIXED_STATES if system == L.FIXED else L.LENGTH_STATES
    if m[L.M_DAMPER] == 2:
        return L.FOIL + 1 if system == L.FIXED else L.LOIL + 1
    return L.FP2 + 1 if system == L.FIXED else L.SPENT + 1


def initial_state(
    system: int,
    p: Floats,
    *,
    position: str | float,
    charged: Sequence[str],
    quadratures: int = 0,
) -> Floats:
    """State at rest: fixed piston at a start position [m], length stroke in gear N, B or F.

    Chambers named in `charged` stand at the supply pressure, the others at the atmosphere.
    """
    states = L.FIXED_STATES if system == L.FIXED else L.LENGTH_STATES
    y = np.zeros(states + quadratures)
    atmosphere, supply = p[L.P_ATM], p[L.P_SUPPLY]
    if system == L.FIXED:
        y[L.FX] = float(position)
        for index, name in ((L.FP1, "1"), (L.FP2, "2")):
            y[index] = supply if name in charged else atmosphere
        y[L.FOIL] = atmosphere
        y[L.FLINE] = supply
        return y
    stroke = min(p[L.STROKE] + p[L.STOP_OFFSET], p[L.X_FREE])
    if position == "B":
        y[L.XS] = stroke
        y[L.X1] = stroke + p[L.X_FREE]
    elif position == "F":
        y[L.XS] = -stroke
        y[L.X2] = stroke + p[L.X_FREE]
    for index, name in ((L.PB, "B"), (L.PN, "N"), (L.PF, "F")):
        y[index] = supply if name in charged else atmosphere
    y[L.LOIL] = atmosphere
    y[L.LLINE] = supply
    return y
