"""The loads and the scatter under which policies are judged, many policies in one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from plant.batch.batch import simulate_batch
from plant.effects.tolerances import shift
from plant.kernel.layout import LengthState, Parameters
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.simulation.impacts import HOLD_S
from sil.studies.bounds.policy import STEM_SIZE, Edges, SwitchingDelays, edges_of, switches_of
from sil.studies.policies import GEARBOX, Floats, Ints, LoadModel

LATER_S = 0.03
"""By how much an arrival may be later than that of the plain push under the same load."""


@dataclass(frozen=True)
class Scatter:
    """What differs in one shift: commands, plungers of B, N and F, logarithms of factors."""

    shift_s: float = 0.0
    rise_s: Sequence[float] = (0.0, 0.0, 0.0)
    fall_s: Sequence[float] = (0.0, 0.0, 0.0)
    factors: dict[str, float] = field(default_factory=dict)


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
    """How policies arrive, each [policies, scatter, mesh forces, loads]; infinite if not in gear at the end.

    impact_m_s: hardest impact in m/s; late_s: later than the plain push under the same load, in s.
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

    impulses_n_s [impulses] in N s, ascending; mesh_n: in N, unknown to a policy; load: of the stay.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        timing: SwitchingDelays,
        impulses_n_s: Floats,
        mesh_n: Sequence[float],
        scatter: Sequence[Scatter],
        load: Literal["none", "damper"] = "none",
    ) -> None:
        self.timing, self.scatter = timing, tuple(scatter)
        self.impulses_n_s, self.mesh_n = impulses_n_s, tuple(mesh_n)
        self.shape = len(scatter), len(mesh_n), len(impulses_n_s)
        case = replace(GEARBOX[0], load=load, sync_impulse_n_s=1e6)
        setups = []
        for each in scatter:
            for force_n in mesh_n:
                setups.append(make_setup(parameters, replace(case, mesh_force_n=force_n)))
                for name, amount in each.factors.items():
                    shift(setups[-1], name, amount)
        self._model = LoadModel(setups)
        self._rise_s = timing.rise_s + np.array([each.rise_s for each in scatter])
        self._fall_s = timing.fall_s + np.array([each.fall_s for each in scatter])
        self._plain_s, self._end_s = np.full(self.shape, 0.5), 0.5
        no_pulse = np.full((1, STEM_SIZE), -100.0)
        self.plain = self.judge(no_pulse, (), 1.0)
        self._plain_s = self._plain_s + self.plain.late_s[0]
        self._end_s = float(self._plain_s.max()) + LATER_S

    def shifted(self, edges: Edges, scatter: Ints) -> Edges:
        """Return commands as the scatter of a number [strokes] shifts them, in s; none before 0."""
        shift_s = np.array([each.shift_s for each in self.scatter])[scatter, None]
        return {valve: np.maximum(each + shift_s, 0.0) for valve, each in edges.items()}

    def _switches(self, edges: Edges, scatter: Ints) -> Floats:
        """Return the plungers' moves [strokes, k, 4]; scatter: its number for each stroke."""
        rise_s, fall_s = self._rise_s[scatter], self._fall_s[scatter]
        return switches_of(self.shifted(edges, scatter), rise_s, fall_s)

    def release_s(self, values: Floats, loads: slice = slice(None)) -> Floats:
        """Return when loads let go under stems of policies [policies, size], in s, the end if never.

        [policies, scatter, mesh forces, loads]; the synchronizer does not know the mesh force.
        """
        (size, meshes, _), policies = self.shape, len(values)
        scatter = np.tile(np.arange(size), policies)
        never_s = np.full((policies, size), 10.0)
        switches = self._switches(edges_of(values, (), never_s, 0.0, self.timing), scatter)
        time_s = np.arange(0.0, self._end_s, 2e-4)
        end_s = np.full(len(scatter), self._end_s)
        strokes = self._model.take(scatter * meshes, switches, end_s)
        column = int(LengthState.impulse)
        batch = simulate_batch(strokes, sample_s=time_s, columns=[column], lanes=False)
        impulses_n_s = self.impulses_n_s[loads]
        release_s = [
            np.interp(impulses_n_s, given, time_s, right=self._end_s)
            for given in batch.samples[..., 0]
        ]
        shape = (policies, size, 1, len(impulses_n_s))
        return np.repeat(np.reshape(release_s, shape), meshes, axis=2)

    def judge(
        self, values: Floats, knots_s: Sequence[float], delay_s: float, loads: slice = slice(None)
    ) -> Judgement:
        """Judge policies [policies, size], which know of the release delay_s later, under some loads."""
        release_s, meshes = self.release_s(values, loads), len(self.mesh_n)
        cases = np.arange(self.shape[0] * meshes).reshape(-1, meshes, 1)
        case = np.broadcast_to(cases, release_s.shape).ravel()
        impulse_n_s = np.broadcast_to(self.impulses_n_s[loads], release_s.shape).ravel()
        plain_s = np.broadcast_to(self._plain_s[..., loads], release_s.shape).ravel()
        edges = edges_of(values, knots_s, release_s.reshape(len(values), -1), delay_s, self.timing)
        switches = self._switches(edges, case // meshes)
        strokes = self._model.take(case, switches, plain_s + LATER_S + HOLD_S)
        strokes.packed[:, Parameters.sync_impulse] = impulse_n_s
        arrivals = self._model.arrivals(strokes)
        columns = arrivals.impact_worst_m_s, arrivals.arrival_s - plain_s
        return Judgement(*(each.reshape(release_s.shape) for each in columns))
