"""The loads and the scatter under which policies are judged, many policies in one batch.

Checked by: tests/unit/sil/studies/bounds/test_judge.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from plant.batch.batch import simulate_batch
from plant.effects.tolerances import shift
from plant.kernel.layout import LengthState, Parameters
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.simulation.impacts import HOLD_S
from sil.studies.bounds.policy import STEM_SIZE, Edges, Timing, edges_of, in_order, switches_of
from sil.studies.policies import GEARBOX, Floats, Ints, LoadModel

LATER_S = 0.03
"""By how much an arrival may be later than that of the plain push under the same load."""
HELD_STEP_S = 2e-4
PLAIN = np.full((1, STEM_SIZE), -100.0)
"""The plain push as a policy: no pulse is longer than nothing."""


@dataclass(frozen=True)
class Scatter:
    """What differs in one shift from the nominal one.

    shift_s: of all commands; rise_s, fall_s: of the plungers of B, N and F; factors: logarithms of
    those on quantities of `plant.effects.tolerances`.
    """

    shift_s: float = 0.0
    rise_s: Sequence[float] = (0.0, 0.0, 0.0)
    fall_s: Sequence[float] = (0.0, 0.0, 0.0)
    factors: dict[str, float] = field(default_factory=dict)


NOMINAL = (Scatter(),)
SHIFTED = tuple(Scatter(shift_s) for shift_s in (-0.0003, 0.0, 0.0003))


def drawn(parameters: ParameterSet, size: int = 32) -> tuple[Scatter, ...]:
    """Return fixed draws: plungers, flow and friction as `[repeatability]` states, supply within 2 %."""
    rng, draws = np.random.default_rng(20261128), []
    names = ("valve_delay", "unit_flow", "friction", "unit_friction")
    delay, flow, *friction = (parameters.value(f"repeatability.{name}_sd") for name in names)
    for _ in range(size):
        rise_s, fall_s = (delay * rng.standard_normal((2, 3))).tolist()
        factors = {
            "supply": float(np.log(rng.uniform(0.98, 1.02))),
            "flow_in": float(flow * rng.standard_normal()),
            "flow_out": float(flow * rng.standard_normal()),
            "friction": math.hypot(*friction) * float(rng.standard_normal()),
        }
        draws.append(Scatter(0.0, rise_s, fall_s, factors))
    return tuple(draws)


@dataclass(frozen=True)
class Judgement:
    """How policies arrive, each [policies, scatter, mesh forces, loads].

    impact_m_s: hardest impact in m/s; late_s: later than the plain push under the same load, in s.
    Both are infinite if the stay is not in gear at the end.
    """

    impact_m_s: Floats
    late_s: Floats

    @property
    def worst_m_s(self) -> Floats:
        """The hardest stop [policies] in m/s, infinite if one is too late or does not last."""
        allowed = np.where(self.late_s <= LATER_S, self.impact_m_s, np.inf)
        worst: Floats = allowed.max(axis=(1, 2, 3))
        return worst


class Judge:
    """Loads and scatter, and when the plain push arrives under each.

    impulses_n_s [impulses] in N s, ascending; mesh_n: forces in N, unknown to a policy.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        timing: Timing,
        impulses_n_s: Floats,
        mesh_n: Sequence[float],
        scatter: Sequence[Scatter],
    ) -> None:
        self.timing, self.scatter = timing, tuple(scatter)
        self.impulses_n_s, self.mesh_n = impulses_n_s, tuple(mesh_n)
        self.shape = len(scatter), len(mesh_n), len(impulses_n_s)
        setups = []
        for each in scatter:
            for force_n in mesh_n:
                case = replace(GEARBOX.cases[0], mesh_force_n=force_n, sync_impulse_n_s=1e6)
                setups.append(make_setup(parameters, case))
                for name, amount in each.factors.items():
                    shift(setups[-1], name, amount)
        self._model = LoadModel(setups)
        self._rise_s = timing.rise_s + np.array([each.rise_s for each in scatter])
        self._fall_s = timing.fall_s + np.array([each.fall_s for each in scatter])
        self._plain_s, self._end_s = np.full(self.shape, 0.5), 0.5
        self.plain = self.judge(PLAIN, (), 1.0)
        self._plain_s = self._plain_s + self.plain.late_s[0]
        self._end_s = float(self._plain_s.max()) + LATER_S

    def shifted(self, edges: Edges, scatter: Ints) -> Edges:
        """Return commands as the scatter of a number [strokes] shifts them, in s; none before 0."""
        shift_s = np.array([each.shift_s for each in self.scatter])[scatter, None]
        return {valve: np.maximum(each + shift_s, 0.0) for valve, each in edges.items()}

    def _switches(self, edges: Edges, scatter: Ints) -> Floats:
        """Return the plungers' moves [strokes, k, 4]; scatter: its number for each stroke."""
        return switches_of(
            self.shifted(edges, scatter), self._rise_s[scatter], self._fall_s[scatter]
        )

    def held(self, values: Floats) -> tuple[Floats, Floats]:
        """Simulate the stems of policies [policies, size] against synchronizers that never let go.

        Returns [policies, *shape] in s when the impulse of a load is reached, the end if never, and the
        states [policies and scatter, samples, states], in SI units, every HELD_STEP_S.
        """
        size, policies = len(self.scatter), len(values)
        scatter = np.tile(np.arange(size), policies)
        never_s = np.full((policies, size), 10.0)
        switches = self._switches(edges_of(values, (), never_s, 0.0, self.timing), scatter)
        time_s = np.arange(0.0, self._end_s, HELD_STEP_S)
        end_s = np.full(len(scatter), self._end_s)
        strokes = self._model.take(scatter * self.shape[1], switches, end_s)
        states = simulate_batch(strokes, sample_s=time_s, lanes=False, tolerance=1e-6).samples
        given = states[:, :, LengthState.impulse]
        release_s = [np.interp(self.impulses_n_s, x, time_s, right=self._end_s) for x in given]
        shape = (policies, size, 1, len(self.impulses_n_s))
        return np.repeat(np.reshape(release_s, shape), self.shape[1], axis=2), states

    def judge(
        self, values: Floats, knots_s: Sequence[float], delay_s: float, releases: int = 0
    ) -> Judgement:
        """Judge policies [policies, size], which know of the release delay_s later.

        releases: instead of the impulses, the loads that let go at so many instants, evenly spread: a
        dip of the push is long in time and short in impulse, and a grid of impulses misses it. These
        strokes begin shortly before the release, as a search has to be quick; what the pistons did
        until then does not count.
        """
        (release_s, states), (size, meshes, impulses) = self.held(values), self.shape
        shape = (len(values), size, meshes, releases or impulses)
        case = np.broadcast_to(np.arange(size * meshes).reshape(size, meshes, 1), shape).ravel()
        shown = (len(values), *self.shape)
        impulse_n_s = np.broadcast_to(self.impulses_n_s, shown).ravel()
        plain_s = np.broadcast_to(self._plain_s, shown).ravel()
        row = np.arange(len(values) * size).repeat(meshes * shape[3])
        if releases:
            offset = np.linspace(0.0, 1.0, size * meshes).reshape(size, meshes, 1)
            part = np.minimum((np.arange(releases) + offset) / (releases - 1), 1.0)
            release_s = release_s[..., :1] + part * (release_s[..., -1:] - release_s[..., :1])
            at = release_s.ravel() / HELD_STEP_S
            before = np.clip(at.astype(np.int64) - 1, 0, states.shape[1] - 3)
            low, high = (states[row, before + k, LengthState.impulse] for k in (0, 2))
            impulse_n_s = np.maximum(low + 0.5 * (at - before) * (high - low), low + 1e-6)
            plain_s = np.empty(len(row))
            for k, arrival_s in enumerate(self._plain_s.reshape(-1, impulses)):
                of_case = impulse_n_s[case == k]
                plain_s[case == k] = np.interp(of_case, self.impulses_n_s, arrival_s)
        edges = edges_of(values, knots_s, release_s.reshape(len(values), -1), delay_s, self.timing)
        switches = self._switches(edges, case // meshes)
        end_s = plain_s + LATER_S + HOLD_S
        begin_s = np.zeros(len(row), dtype=np.float64)
        strokes = self._model.take(case, switches, end_s)
        if releases:
            begin_s = (HELD_STEP_S * before).astype(np.float64)
            switches, valves = _from(switches, begin_s)
            strokes = self._model.take(case, switches, np.maximum(end_s - begin_s, 1e-3))
            strokes = replace(strokes, initial=states[row, before], valves=valves)
        strokes.packed[:, Parameters.sync_impulse] = impulse_n_s
        arrivals = self._model.arrivals(strokes, bool(releases), 1e-5 if releases else 1e-6)
        late_s = arrivals.arrival_s + begin_s - plain_s
        return Judgement(arrivals.impact_worst_m_s.reshape(shape), late_s.reshape(shape))


def _from(switches: Floats, begin_s: Floats) -> tuple[Floats, Floats]:
    """Return switches [strokes, k, 4] from begin_s [strokes] on, and the valves [strokes, 3] there."""
    before = switches[:, :, 0] <= begin_s[:, None]
    sign = np.where(switches[:, :, 2] > 0.5, 1.0, -1.0) * before
    valves = np.stack([(sign * (switches[:, :, 1] == k)).sum(axis=1) for k in range(3)], axis=1)
    switches[:, :, 0] -= begin_s[:, None]
    switches[before, 0] = np.inf
    return in_order(switches), valves
