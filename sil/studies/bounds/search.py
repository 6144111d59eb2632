"""Two unlike searches for the policy whose hardest stop is softest: CMA-ES and sequential linear programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np

from plant.parameters import ParameterSet
from sil.studies.bounds.judge import LATER_S, SHIFTED, Judge, Judgement, Scatter
from sil.studies.bounds.policy import (
    ANSWER,
    NO_PULSE,
    STEM,
    STEM_SIZE,
    SwitchingDelays,
    at_releases,
    places_of,
)
from sil.studies.policies import Floats, Ints

ATTEMPT_STAGES = ((5, 6, 0.4), (8, 4, 0.35), (12, 1, 0.25))
"""Knots, from load to load, and share of the evaluations of an attempt's stages."""
BEGINNINGS = 60  # random stems, of which the softest begins an attempt


class SearchProgress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one of the searches has done, as it is stored.

    knots_s, values [size]: its best policy; history: after each attempt the evaluations so far and the
    hardest stop in m/s of the best, if one arrives in time under all loads.
    """

    knots_s: list[float] = []
    values: list[float] = []
    history: list[Annotated[list[float], msgspec.Meta(min_length=1, max_length=2)]] = []

    @property
    def policy(self) -> Floats:
        """The values [1, size] of the best policy, without unit."""
        return np.array([self.values])

    @property
    def worst_m_s(self) -> float:
        """The hardest stop of the best policy in m/s."""
        return self.worst_after(1.0)

    def worst_after(self, share: float) -> float:
        """Return the hardest stop in m/s of the best policy after a share of the evaluations."""
        until = share * (self.history[-1][0] if self.history else 0.0)
        stops = [stop for spent, *stops in self.history if spent <= until for stop in stops]
        return min(stops, default=math.inf)


def cost_m_s(judgement: Judgement) -> Floats:
    """Return a cost [policies] in m/s: the hardest stop, smoothed, and a little of all above 0.6 m/s.

    Smooth: T ln mean exp(v / T), T = 0.003 m/s. Not in gear at the end is a stop with 2.5 m/s; the
    latest arrival costs 0.1 m/s for 1 ms too late.
    """
    shape = (len(judgement.late_s), -1)
    late_s, stop_m_s = judgement.late_s.reshape(shape), judgement.impact_m_s.reshape(shape)
    arrived = np.isfinite(late_s)
    stop_m_s = np.where(arrived, stop_m_s, 2.5)
    latest_s = np.where(arrived, late_s, 0.0).max(axis=1)
    worst = stop_m_s.max(axis=1)
    smooth = worst + 0.003 * np.log(np.exp((stop_m_s - worst[:, None]) / 0.003).mean(axis=1))
    smooth += 0.1 * np.maximum(stop_m_s - 0.6, 0.0).mean(axis=1)
    cost: Floats = smooth + 100.0 * np.maximum(latest_s - (LATER_S - 1e-4), 0.0)
    return cost


def random_stem(rng: np.random.Generator) -> Floats:
    """Return a policy [size], without unit, with a few pulses of the stem and no answer."""
    parts = []
    for n in STEM.values():
        length = np.where(rng.random(n) < 0.5, rng.exponential(1.0, n), NO_PULSE)
        parts += [rng.uniform(2.0, 22.0, n), length]
    return np.concatenate(parts)


class BoundProblem:
    """What a policy is searched for; b_with_f: F may open while B pushes; impulses_n_s: least and greatest."""

    def __init__(
        self,
        parameters: ParameterSet,
        timing: SwitchingDelays,
        delay_s: float,
        mesh_n: Sequence[float],
        b_with_f: bool = False,
        impulses_n_s: tuple[float, float] = (18.0, 250.0),
    ) -> None:
        self.parameters, self.timing, self.delay_s = parameters, timing, delay_s
        self._mesh_n, self._valves = tuple(mesh_n), "BNF" if b_with_f else "BN"
        self._impulses_n_s = impulses_n_s
        self.judge = self.judge_of(SHIFTED)

    def judge_of(
        self,
        scatter: Sequence[Scatter],
        step_n_s: float = 1.0,
        load: Literal["none", "damper"] = "none",
    ) -> Judge:
        """Return the judge of the impulses, every step_n_s."""
        low, high = self._impulses_n_s
        impulses_n_s = np.linspace(low, high, round((high - low) / step_n_s) + 1)
        return Judge(self.parameters, self.timing, impulses_n_s, self._mesh_n, scatter, load)

    def judged(self, policy: SearchProgress, judge: Judge, loads: slice = slice(None)) -> Judgement:
        """Return how a policy arrives."""
        return judge.judge(policy.policy, policy.knots_s, self.delay_s, loads)

    def answering(self, policy: SearchProgress, knots: int) -> tuple[SearchProgress, Ints]:
        """Return a policy with knots over its releases, and places [n] of values that may change.

        One that has no answer gets pulses of no length; of a valve that may not move it has none.
        """
        release_s = self.judge.release_s(policy.policy)
        knots_s = np.linspace(release_s.min(), release_s.max(), knots)
        values = np.full(STEM_SIZE + 2 * knots * sum(ANSWER.values()), NO_PULSE)
        values[:STEM_SIZE] = policy.values[:STEM_SIZE]
        for valve in self._valves if policy.knots_s else "":
            (_, before), (_, after) = (places_of(valve, n) for n in (len(policy.knots_s), knots))
            answer = policy.policy[:, before]
            values[after] = at_releases(answer, policy.knots_s, knots_s[None])[0]
        stem, places = places_of(self._valves, knots)
        values[np.setdiff1d(np.arange(STEM_SIZE), stem)] = NO_PULSE
        changing = np.concatenate([stem, places.ravel()])
        return SearchProgress(knots_s.tolist(), values.tolist()), changing

    def after(
        self, progress: SearchProgress, attempt: SearchProgress, evaluations: int
    ) -> SearchProgress:
        """Return the progress after an attempt that ended in a policy."""
        worst_m_s = float(self.judged(attempt, self.judge).worst_m_s[0])
        spent = (progress.history[-1][0] if progress.history else 0) + evaluations
        least_m_s = min(worst_m_s, progress.worst_m_s)
        history = [*progress.history, [spent, least_m_s] if least_m_s < math.inf else [spent]]
        better = worst_m_s < progress.worst_m_s or not progress.values
        return msgspec.structs.replace(attempt if better else progress, history=history)

    def begin(
        self, rng: np.random.Generator, others: Sequence[SearchProgress] = (), size: int = 1
    ) -> list[SearchProgress]:
        """Return the softest of other policies and of random stems, ascending."""
        stems = [SearchProgress(values=random_stem(rng).tolist()) for _ in range(BEGINNINGS)]
        starts = [each for each in (*others, *stems) if each.values]
        few = slice(None, None, 8)
        return sorted(starts, key=lambda x: cost_m_s(self.judged(x, self.judge, few))[0])[:size]

    def costs(self, policy: SearchProgress, values: Floats, step: int) -> Floats:
        """Return the costs of the values [policies, size] in place of a policy's, from load to load."""
        some = slice(None, None, step)
        return cost_m_s(self.judge.judge(values, policy.knots_s, self.delay_s, some))

    def cma(
        self, progress: SearchProgress, evaluations: int, others: Sequence[SearchProgress] = ()
    ) -> SearchProgress:
        """Return the progress after one more attempt of CMA-ES, the best of four starts going on.

        others: policies of other problems, to begin with if they are better than random stems.
        """
        import cma

        rng = np.random.default_rng(1000 + len(progress.history))

        def randn(*shape: int) -> Floats:
            return rng.standard_normal(shape)

        ends = [(0.0, start) for start in self.begin(rng, others, 4)]
        for (knots, step, share), size, sigma in zip(
            ATTEMPT_STAGES, (24, 20, 16), (0.6, 0.3, 0.15), strict=True
        ):
            starts = [start for _, start in ends]
            generations, ends = max(1, int(share * evaluations / len(starts)) // size), []
            for start in starts:
                best, places = self.answering(start, knots if self.judge.shape[2] > 1 else 0)
                options = {"popsize": size, "seed": np.nan, "randn": randn, "verbose": -9}
                search = cma.CMAEvolutionStrategy(best.policy[0, places], sigma, options)
                for _ in range(generations):
                    policies = np.repeat(best.policy, size, axis=0)
                    policies[:, places] = asked = search.ask()
                    cost = self.costs(best, policies, step)
                    search.tell(asked, cost.tolist())
                    k = int(np.argmin(cost))
                    end = msgspec.structs.replace(best, values=policies[k].tolist())
                    ends.append((float(cost[k]), end))
            ends = [min(ends, key=lambda end: end[0])]
        return self.after(progress, ends[0][1], evaluations)

    def linear(self, progress: SearchProgress, evaluations: int) -> SearchProgress:
        """Return the progress after one more attempt of sequential linear programs, with a start of its own.

        Each lowers the hardest of the stops, linear in the values within a trust region [Madsen, 1975].
        """
        rng = np.random.default_rng(len(progress.history))
        best, spent = self.begin(rng)[0], BEGINNINGS
        for knots, step, share in ATTEMPT_STAGES:
            begun = bool(best.knots_s)
            best, places = self.answering(best, knots)
            values = best.policy[0]
            if not begun:  # a pulse that is not there has no derivative
                answer, policies = places[places >= STEM_SIZE], np.repeat(best.policy, 24, axis=0)
                policies[:, answer] = rng.uniform(0.0, 1.0, (24, len(answer)))
                values = policies[int(np.argmin(self.costs(best, policies, step)))]
                spent += 24
            radius, until = 0.4, spent + share * evaluations
            while spent < until and radius > 0.004:
                change = rng.choice([0.02, 0.05, 0.1]) * rng.choice([-1.0, 1.0])
                radii = radius * np.array([2.0, 1.0, 0.3, 0.1])
                steps = self._programs(best, values, places, step, change, radii)
                policies = np.repeat(values[None], len(radii) + 1, axis=0)
                policies[1:, places] += steps
                costs = self.costs(best, policies, step)
                k = int(np.argmin(costs))
                values = policies[k]
                radius = radius / 2.0 if k == 0 else float(radii[k - 1])
                spent += len(places) + 2 + len(radii)
            best = msgspec.structs.replace(best, values=values.tolist())
        return self.after(progress, best, spent)

    def _programs(
        self,
        policy: SearchProgress,
        values: Floats,
        places: Ints,
        step: int,
        change: float,
        radii: Floats,
    ) -> Floats:
        """Return steps [radii, places] that soften the hardest stop; change: of a value, for its derivatives."""
        from scipy.optimize import linprog

        n = len(places)
        policies = np.repeat(values[None], n + 1, axis=0)
        policies[np.arange(n), places] += change
        some = slice(None, None, step)
        judgement = self.judge.judge(policies, policy.knots_s, self.delay_s, some)
        stop_m_s, late_s = (x.reshape(n + 1, -1) for x in (judgement.impact_m_s, judgement.late_s))
        arrives = np.isfinite(late_s).all(axis=0)
        stop_m_s, late_s = stop_m_s[:, arrives], late_s[:, arrives]
        stops = np.clip((stop_m_s[:n] - stop_m_s[n]) / change, -5.0, 5.0).T
        lates = np.clip(100.0 * (late_s[:n] - late_s[n]) / change, -5.0, 5.0).T
        hardest, latest = np.eye(2)[:, None].repeat(len(stops), axis=1)
        matrix = np.block([[stops, -hardest], [lates, -latest]])
        room = np.concatenate([-stop_m_s[n], 100.0 * (LATER_S - 1e-4 - late_s[n])])
        goal = np.array([*(0.05 * stops.sum(axis=0) / max(len(stops), 1)), 1.0, 1.0])
        free = [(0.0, None)] * 2
        programs = [linprog(goal, matrix, room, bounds=[*[(-r, r)] * n, *free]) for r in radii]
        return np.array([program.x[:n] for program in programs])


def softest_alone(
    parameters: ParameterSet,
    timing: SwitchingDelays,
    mesh_n: float,
    impulse_n_s: float,
    evaluations: int,
    others: Sequence[SearchProgress] = (),
) -> SearchProgress:
    """Return the softest policy that CMA-ES finds under one load, known in advance; others: to begin with."""
    ends_n_s = impulse_n_s, impulse_n_s
    problem = BoundProblem(parameters, timing, 1.0, [mesh_n], impulses_n_s=ends_n_s)
    progress = SearchProgress()
    for _ in range(4):
        progress = problem.cma(progress, evaluations // 4, [progress, *others])
    return progress
