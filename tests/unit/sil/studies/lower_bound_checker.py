"""Independent check of a certificate of `opc4 whatif lower_bound`, in plain Python.

It shares no code with `sil.studies.lower_bound`: own splitting of the sets of commands, own flow maps,
own integration of the actuator (Runge-Kutta, piston joined to the stay).
"""

from __future__ import annotations

import functools
import math
from typing import Any

from plant.parameters import load

VALUE, VALUES = (functools.cache(f) for f in (load("nominal").value, load("nominal").values))
A_P, A_S = VALUE("length.A_p"), VALUE("length.A_s")
MASS = VALUE("length.m_s") + VALUE("length.m_p") + VALUE("truck.m_gearbox")
SUPPLY, ATMOSPHERE = 9e5, VALUE("gas.P_atm")
FREE, BLOCK = VALUE("length.x_free_total"), VALUE("synchronizer.x_block")

Cells = tuple[tuple[int, int], ...]


def uncovered(given: dict[str, Any]) -> tuple[Cells, bool] | None:
    """Return a set of commands of valve N that no leaf covers, None if all are covered."""
    leaves = {(tuple(map(tuple, leaf["n"])), leaf["ended"][0]) for leaf in given["leaves"]}
    least = given["least_steps"]["n_open"], given["least_steps"]["n_closed"]
    stack: list[tuple[Cells, bool]] = [((), False)]
    while stack:
        cells, ended = stack.pop()
        if (cells, ended) in leaves:
            continue
        next_step = cells[-1][0] + least[(len(cells) + 1) % 2] if cells else 0
        wide = [k for k, (a, b) in enumerate(cells) if b - a > given["widest_cell"]]
        if wide and (ended or cells[wide[0]][0] <= next_step):
            k = wide[0]
        elif not ended:
            stack.append((cells, True))
            if next_step < given["steps"]:
                stack.append(((*cells, (next_step, given["steps"])), False))
            continue
        else:
            k = max(
                range(len(cells)),
                key=lambda k: (cells[k][1] - cells[k][0], cells[k][0]),
                default=-1,
            )
            if k < 0 or cells[k][1] - cells[k][0] <= 1:
                return cells, ended
        a, b = cells[k]
        for half in ((a, (a + b) // 2), ((a + b) // 2, b)):
            new = (*cells[:k], half, *cells[k + 1 :])
            if all(new[j][1] >= new[j - 1][0] + least[(j + 1) % 2] for j in range(1, len(new))):
                stack.append((new, ended))
    return None


def polynomial(name: str, x: float) -> float:
    return sum(c * x**k for k, c in enumerate(VALUES(name)))


def flow_in(pressure: float) -> float:
    y = max(pressure / SUPPLY, VALUE("flow_charge.y_min"))
    name = "c_high" if y < VALUE("flow_charge.y_split") else "c_low"
    return SUPPLY * polynomial(f"flow_charge.{name}", min(y, 1.0))


def flow_out(pressure: float) -> float:
    z = max(pressure / ATMOSPHERE, 1.0)
    name = "c_low" if z < VALUE("flow_discharge.z_split") else "c_high"
    return ATMOSPHERE * polynomial(f"flow_discharge.{name}", z)


def rates(state: list[float], moving: bool, fills_n: bool) -> list[float]:
    """Return d/dt of position, speed, pressures B, N and F, and impulse, B being filled."""
    x, v, p_b, p_n, p_f, _spent = state
    gas = VALUE("gas.R_air")
    charging = VALUE("alpha.alpha_m1"), VALUE("alpha.alpha_1")
    vented = VALUE("alpha.alpha_m2"), VALUE("alpha.alpha_2")
    volume_n = VALUE("length.V_N0") - A_P * (x + FREE)
    area = A_P + A_S
    d_b = (charging[0] * gas * flow_in(p_b) - charging[1] * p_b * area * v) / (
        VALUE("length.V_B0") + A_P * (x + FREE) + A_S * x
    )
    if fills_n:
        d_n = (charging[0] * gas * flow_in(p_n) + charging[1] * p_n * A_P * v) / volume_n
    else:
        d_n = (-vented[0] * gas * flow_out(p_n) + vented[1] * p_n * A_P * v) / volume_n
    d_f = (-vented[0] * gas * flow_out(p_f) + vented[1] * p_f * A_S * v) / (
        VALUE("length.V_F0") - A_S * x
    )
    force = (p_b - p_f) * A_S + (p_b - p_n) * A_P
    if not moving:
        return [0.0, 0.0, d_b, d_n, d_f, force]
    u = (x - VALUE("synchronizer.x_mesh")) / VALUE("synchronizer.w_mesh")
    resists = 1300.0 * math.cos(0.5 * math.pi * u) ** 2 if abs(u) < 1.0 else 0.0
    resists += sum(VALUE(f"friction_length.{name}") for name in ("F_rf_s", "F_rf_p"))
    resists += VALUE("truck.F_gearbox")
    resists += v * sum(VALUE(f"friction_length.{name}") for name in ("beta_s", "beta_p"))
    return [v, (force - resists) / MASS, d_b, d_n, d_f, 0.0]


def arrival(given: dict[str, Any], moves_s: list[float], load: int) -> tuple[float, float]:
    """Return speed at the stop [m/s], 0 if it is not reached, and when [s].

    moves_s: instants at which valve N opens and closes, in turn. The state at begin_s is the
    certificate's.
    """
    state = [BLOCK, 0.0, *given["state_pa"], given["begin_impulse_n_s"]]
    time_s, step_s, moving = given["begin_s"], 5e-5, False
    while time_s < given["limit_s"][-1] + 0.05:
        fills_n = sum(move <= time_s + 1e-12 for move in moves_s) % 2 == 1
        moving = moving or state[5] >= given["impulse_n_s"][load]
        one = rates(state, moving, fills_n)
        middle = [y + 0.5 * step_s * d for y, d in zip(state, one, strict=True)]
        two = rates(middle, moving, fills_n)
        state = [y + step_s * d for y, d in zip(state, two, strict=True)]
        time_s += step_s
        if moving and state[1] <= 0.0:
            return 0.0, math.inf
        if state[0] >= VALUE("length.stroke"):
            return state[1], time_s
    return 0.0, math.inf
