"""Certified lower bound of the hardest stop over the loads, for braking by valve N.

Branch and bound over the instants at which the plunger of valve N moves. For a set of such instants
the pressures of the held actuator are enclosed, from these the release of each load, and from these
the speed of its stop from below. Steps are enclosed by monotony of the flow maps; every
quantity is widened by more than its rounding. Proof: docs/explanation/lower_bound.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.batch.batch import Strokes, simulate_batch
from plant.kernel.compiled import plain
from plant.kernel.layout import EventRow, FlowMap, LengthState, Parameters
from plant.kernel.packing import flow_coefficients
from plant.parameters import ParameterSet
from plant.parts.flow import discharge
from plant.systems.setup import make_setup
from sil.studies.lower_bound_enclosures import (
    SLACK_N,
    STEP_S,
    chamber_bounds,
    check_maps,
    stop_speed,
)
from sil.studies.policies import GEARBOX, FamilyModel

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

Cells = tuple[tuple[int, int], ...]

STEP_M = 5e-5
START_S = 1e-4
"""Begin after the stay rests at the synchronizer, at least."""
SLACK_N_S = 1e-3
"""Widening of impulses, far above rounding."""
LATE_S = 2e-5
"""Widening of the time allowed: tolerance of the simulated plain push."""
WIDE, FINE = 16, 1
"""Widest cell that gets a successor, narrowest cell, in steps."""

CONDITIONS = (
    "valve B pushes until each stop, valve F vents",
    "valve N vents until the stay rests at the synchronizer; then it opens and closes at any "
    "instants that coil and plunger allow",
    "piston 1 stays on its collar from then until the stop",
    "a load's commands are the same as those of all larger loads until its release and the delay",
)


@dataclass(frozen=True)
class Node:
    """A set of commands: cells (first, last step) of the moves of valve N, which opens first.

    ended: whether further moves are excluded.
    """

    cells: Cells = ()
    ended: bool = False


@dataclass(frozen=True)
class Leaf:
    """A node and why all its commands stop harder than L: load that does, and its speed in m/s.

    An infinite speed: the load arrives too late.
    """

    node: Node
    load: int
    speed_m_s: float


class HeldModel:
    """The held actuator of the gearbox's loads, for enclosures; delay_s: of the information, from 0.

    extra_s: how much later than the plain push a load may arrive. Raises InputError for a model that
    the proof does not cover.
    """

    def __init__(self, parameters: ParameterSet, delay_s: float, extra_s: float) -> None:
        if parameters.effects:
            raise InputError("bound: expected a model without effects, which the proof covers")
        alpha_1, alpha_2 = (parameters.value(f"alpha.alpha_{k}") for k in (1, 2))
        if not 0.0 < alpha_1 <= alpha_2:
            raise InputError("alpha: expected 0 < alpha_1 <= alpha_2, as the lower bound needs")
        self.parameters = parameters
        self.delay_s = delay_s
        model = FamilyModel(parameters, GEARBOX, delay_s, extra_s)
        setups = [make_setup(parameters, case) for case in GEARBOX.cases]
        p = setups[-1].p
        flow = flow_coefficients(parameters)
        check_maps(FlowMap(flow), p.p_supply, p.p_atm)
        self.air = p.p_supply, p.p_atm, flow
        self.impulse_n_s = [setup.p.sync_impulse for setup in setups]
        self.limit_s = model.limit_s + LATE_S
        delays_s = parameters.value("valve.D_fall"), parameters.value("valve.D_rise")
        self.least = tuple(int(np.floor(least_s / STEP_S + 1e-9)) for least_s in delays_s)
        self.own = int(np.ceil(delay_s / STEP_S - 1e-9))
        strokes = Strokes.from_setups(setups[-1:], 0.5)
        found = simulate_batch(strokes, event_room=96, lanes=False, tolerance=1e-9)
        events = found.events[0]
        at_block = events[events[:, EventRow.at_block] == 1.0]
        self.begin_s = STEP_S * np.ceil((at_block[-1, EventRow.time] + START_S) / STEP_S)
        begin = np.array([self.begin_s])
        at_begin = simulate_batch(strokes, sample_s=begin, lanes=False, tolerance=1e-9)
        self.state = at_begin.samples[0, 0]
        self.steps = int(np.ceil((self.limit_s[-1] - self.begin_s) / STEP_S)) + 8
        self._enclose_motion(p)

    def _enclose_motion(self, p: Parameters) -> None:
        """Prepare volumes, barrier and the fastest motion over the position."""
        held_m = p.x_block
        counts = [round((b - a) / STEP_M) for a, b in ((held_m, p.x_mesh), (p.x_mesh, p.stroke))]
        to_mesh = np.linspace(held_m, p.x_mesh, counts[0] + 1)
        x = np.append(to_mesh, np.linspace(p.x_mesh, p.stroke, counts[1] + 1)[1:])
        volume_b = p.vol_b + p.area_p * (x + p.x_free) + p.area_s * x
        volume_n = p.vol_n - p.area_p * (x + p.x_free)
        gas, gas_out = p.r_air * p.alpha_m1, p.r_air * p.alpha_m2
        self.rates = gas / volume_n[0], gas_out / volume_n[0]
        u = np.clip((x - p.x_mesh) / p.w_mesh, -1.0, 1.0)
        barrier = p.mesh_force * np.cos(0.5 * np.pi * u) ** 2
        area, mass = p.area_p + p.area_s, p.m_s + p.m_p
        run_n = p.f_run_s + p.f_run_p + p.f_linkage
        static_n = max(p.f_static_s, p.f_run_s) + max(p.f_static_p, p.f_run_p) + p.f_linkage
        always = np.ones(self.steps, np.bool_)
        rates = gas / volume_b[0], gas_out / volume_b[0]
        self.low_b, self.high_b = self._chamber(always, always, LengthState.p_b, rates)
        force = area * (self.high_b[-1] - p.p_atm) - run_n
        energy = np.cumsum((force - np.minimum(barrier[1:], barrier[:-1])) * np.diff(x))
        speed = np.sqrt(2.0 * np.concatenate([[0.0], energy]) / mass) * (1.0 + 1e-9)
        fastest = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(x) / (speed[1:] + speed[:-1]))])
        self.travel_s = float(fastest[-1]) * (1.0 - 1e-9)
        self.path = np.array(
            [
                x,
                (volume_b[0] / volume_b) ** max(p.alpha_1, 1.0),
                (volume_n[0] / volume_n) ** p.alpha_2,
                np.append(np.maximum(barrier[1:], barrier[:-1]) + SLACK_N, 0.0),
                fastest * (1.0 - 1e-9),
            ]
        )
        p_f = float(self.state[LengthState.p_f]) + 1.0
        squeezed, flow = p.alpha_2 * p.area_s * speed.max(), FlowMap(self.air[2])
        while gas_out * plain(discharge)(p_f, p.p_atm, flow) < squeezed * p_f:
            p_f += 100.0
        self.body = (area, p.area_p, p.area_s, mass, run_n, p.beta_s + p.beta_p, static_n, p_f)

    def _chamber(
        self, surely: Bools, possibly: Bools, index: int, rates: tuple[float, float]
    ) -> tuple[Floats, Floats]:
        low, high = np.empty(self.steps + 1), np.empty(self.steps + 1)
        pressure_pa = float(self.state[index])
        atmosphere = max(self.air[1], pressure_pa - 10.0)
        high_pa = pressure_pa + 10.0
        chamber_bounds(surely, possibly, atmosphere, high_pa, *rates, self.air, low, high)
        return low, high

    def _opened(self, node: Node) -> tuple[Bools, Bools]:
        """Return in which steps valve N is surely open, is possibly open."""
        cells = node.cells
        surely, possibly = np.zeros(self.steps, np.bool_), np.zeros(self.steps, np.bool_)
        for k in range(0, len(cells), 2):
            begin = cells[k]
            if k + 1 < len(cells):
                surely[begin[1] : cells[k + 1][0]] = True
                possibly[begin[0] : cells[k + 1][1]] = True
            else:
                possibly[begin[0] :] = True
                surely[begin[1] : self.steps if node.ended else begin[0] + self.least[0]] = True
        if len(cells) % 2 == 0 and not node.ended:
            possibly[self._next_step(cells) :] = True
        return surely, possibly

    def hardest(self, node: Node) -> tuple[float, int]:
        """Return what the hardest stop of a set of commands is at least, in m/s, and its load."""
        low_b, high_b = self.low_b, self.high_b
        low_n, high_n = self._chamber(*self._opened(node), LengthState.p_n, self.rates)
        area, area_p, area_s = self.body[:3]
        most = area * np.maximum(high_b[1:], high_b[:-1])
        most -= area_p * np.minimum(low_n[1:], low_n[:-1]) + area_s * self.air[1]
        least = area * np.minimum(low_b[1:], low_b[:-1])
        least -= area_p * np.maximum(high_n[1:], high_n[:-1]) + area_s * self.body[7]
        impulse = float(self.state[LengthState.impulse])
        high = impulse + SLACK_N_S + STEP_S * np.cumsum(np.maximum(most, 0.0))
        low = impulse - SLACK_N_S + STEP_S * np.cumsum(np.maximum(least, 0.0))
        worst, which = 0.0, -1
        for load, needed in enumerate(self.impulse_n_s):
            begin = int(np.searchsorted(high, needed))
            latest_s = self.limit_s[load] - self.travel_s - self.begin_s
            if begin >= self.steps or begin * STEP_S > latest_s:
                return np.inf, load
            end = int(np.searchsorted(low, needed)) + 1
            end = max(begin, min(end, int(latest_s / STEP_S) + 1, self.steps))
            last = load == len(self.impulse_n_s) - 1
            own = 0 if last else min(self.own, self.steps)
            fixed = self.rates[0], self.air, self.path, self.body
            speed = stop_speed(low_b, high_n, begin, end, own, *fixed)
            if speed > worst:
                worst, which = speed, load
        return worst, which

    def children(self, node: Node) -> list[Node]:
        """Return nodes that together hold all commands of a node; none for one that is as fine as it gets."""
        cells, next_step = node.cells, self._next_step(node.cells)
        wide = [(begin, k) for k, (begin, end) in enumerate(cells) if end - begin > WIDE]
        if not node.ended and (not wide or next_step <= min(wide)[0]):
            more = [Node((*cells, (next_step, self.steps)))] if next_step < self.steps else []
            return [Node(cells, True), *more]
        if wide:
            _, k = min(wide)
        else:
            width, _, k = max(((b - a, a, k) for k, (a, b) in enumerate(cells)), default=(0, 0, 0))
            if width <= FINE:
                return []
        begin, end = cells[k]
        middle = (begin + end) // 2
        halves = [(*cells[:k], half, *cells[k + 1 :]) for half in ((begin, middle), (middle, end))]
        return [Node(half, node.ended) for half in halves if self._possible(half)]

    def _next_step(self, cells: Cells) -> int:
        """Return the first step at which the valve can move next."""
        return cells[-1][0] + self.least[(len(cells) + 1) % 2] if cells else 0

    def _possible(self, cells: Cells) -> bool:
        """Return whether coil and plunger allow any move in each of the cells."""
        return all(
            cells[k][1] >= cells[k - 1][0] + self.least[(k + 1) % 2] for k in range(1, len(cells))
        )

    def prove(self, bound_m_s: float, most: int = 400_000) -> list[Leaf] | None:
        """Return leaves that prove a bound, or None if it cannot be proven within `most` nodes."""
        leaves: list[Leaf] = []
        stack = [Node()]
        for _ in range(most):
            if not stack:
                return leaves
            node = stack.pop()
            speed, load = self.hardest(node)
            if speed > bound_m_s:
                leaves.append(Leaf(node, load, speed))
                continue
            children = self.children(node)
            if not children:
                return None
            stack += children
        return None


def best_proof(held: HeldModel, most: int) -> tuple[float, list[Leaf]]:
    """Return the greatest bound in steps of 0.01 m/s that is proven, in m/s, with its leaves; 0 and none."""
    low, high, leaves = 0, 150, list[Leaf]()
    while high - low > 1:
        middle = (low + high) // 2
        found = held.prove(round(0.01 * middle, 2), most)
        if found is None:
            high = middle
        else:
            low, leaves = middle, found
    return round(0.01 * low, 2), leaves


def certificate(held: HeldModel, bound_m_s: float, leaves: list[Leaf]) -> dict[str, Any]:
    """Return a certificate as JSON takes it: what is proven, and every leaf of the proof."""
    return {
        "claim": "the hardest stop over the loads is at least bound_m_s under all commands that "
        "the conditions allow",
        "conditions": list(CONDITIONS),
        "bound_m_s": bound_m_s,
        "valves": "N",
        "step_s": STEP_S,
        "begin_s": held.begin_s,
        "begin_impulse_n_s": float(held.state[LengthState.impulse]),
        "state_pa": [
            float(held.state[k]) for k in (LengthState.p_b, LengthState.p_n, LengthState.p_f)
        ],
        "steps": held.steps,
        "widest_cell": WIDE,
        "own_commands_after_steps": held.own,
        "least_steps": {"n_open": held.least[0], "n_closed": held.least[1]},
        "impulse_n_s": held.impulse_n_s,
        "limit_s": [float(limit) for limit in held.limit_s],
        "leaves": [
            {
                "n": leaf.node.cells,
                "b": (),
                "ended": (leaf.node.ended, True),
                "load": leaf.load,
                "speed_m_s": leaf.speed_m_s if np.isfinite(leaf.speed_m_s) else None,
            }
            for leaf in leaves
        ],
    }
