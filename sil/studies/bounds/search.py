"""Two unlike searches for the policy whose hardest stop is softest: CMA-ES and differential evolution.

Checked by: tests/unit/sil/studies/bounds/test_search.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import msgspec
import numpy as np

from plant.parameters import ParameterSet
from sil.studies.bounds.judge import LATER_S, SHIFTED, Judge, Judgement, Scatter
from sil.studies.bounds.policy import ANSWER, NO_PULSE, STEM, STEM_SIZE, Timing, at_releases
from sil.studies.policies import Floats

Costs = Callable[[Floats], Floats]
"""Costs [policies] in m/s of policies [policies, size]."""
LATEST_START = 22.0
"""Of a pulse of the stem, in units of a policy."""
KNOTS = (1, 3, 6)


class Progress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one of the searches has done, as it is stored.

    knots_s, values [size]: its best policy; waits_s: how long that lets the information lie; history:
    after each attempt the evaluations so far and, if a policy arrives in time under all loads, the
    hardest stop in m/s of the best.
    """

    waits_s: float = 0.0
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
    """Return a cost [policies] in m/s: the hardest stop, smoothed, and the latest arrival.

    Stops v are taken together as T ln mean exp(v / T), T = 0.003 m/s. Late: 0.2 m/s for 10 ms; not in
    gear at the end: 1 m/s, and 0.5 m/s if it is so under all loads.
    """
    arrived = np.isfinite(judgement.late_s).reshape(len(judgement.late_s), -1)
    speed = np.where(arrived, judgement.impact_m_s.reshape(arrived.shape), 0.0)
    late_s = np.where(arrived, judgement.late_s.reshape(arrived.shape), LATER_S + 0.05)
    excess_s = np.maximum(late_s - (LATER_S - 2e-4), 0.0)
    worst = speed.max(axis=1)
    smooth = worst + 0.003 * np.log(np.exp((speed - worst[:, None]) / 0.003).mean(axis=1))
    cost: Floats = smooth + 20.0 * excess_s.max(axis=1) + 10.0 * excess_s.mean(axis=1)
    return cost


def random_stem(rng: np.random.Generator) -> Floats:
    """Return a policy [size], without unit, with a few pulses of the stem and no answer."""
    parts = []
    for n in STEM.values():
        length = np.where(rng.random(n) < 0.5, rng.exponential(1.0, n), NO_PULSE)
        parts += [rng.uniform(2.0, LATEST_START, n), length]
    return np.concatenate(parts)


def with_knots(policy: Progress, knots_s: list[float]) -> Floats:
    """Return the same policy [size], without unit, with other knots; with none so far, no answer."""
    values, begin = policy.policy, STEM_SIZE
    parts = [values[0, :STEM_SIZE]]
    for n in ANSWER.values():
        size = 2 * n * len(policy.knots_s)
        if size:
            knots = values[:, begin : begin + size].reshape(1, len(policy.knots_s), -1)
            begin += size
            parts.append(at_releases(knots, policy.knots_s, np.array([knots_s])).ravel())
        else:
            parts.append(np.tile([0.5] * n + [NO_PULSE] * n, len(knots_s)))
    return np.concatenate(parts)


def evolve(
    costs: Costs, start: Floats, sigma: float, evaluations: int, popsize: int, seed: int
) -> Floats:
    """Return the best policy [size], without unit, of CMA-ES (library `cma`) from a start [size]."""
    import cma

    rng = np.random.default_rng(seed)
    options = {
        "popsize": popsize,
        "maxfevals": evaluations,
        "tolfun": 1e-4,
        "tolx": 1e-4,
        "seed": np.nan,
        "randn": lambda *shape: rng.standard_normal(shape),
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(start, sigma, options)
    best, least = start, float(costs(start[None])[0])
    while not strategy.stop():
        points = strategy.ask()
        values = costs(np.array(points))
        if values.min() < least:
            best, least = points[int(np.argmin(values))], float(values.min())
        strategy.tell(points, list(values))
    return best


class Problem:
    """What a policy is searched for: valves, delay of the information, mesh forces that may occur."""

    def __init__(
        self, parameters: ParameterSet, timing: Timing, delay_s: float, mesh_n: Sequence[float]
    ) -> None:
        self.parameters, self.timing, self.delay_s = parameters, timing, delay_s
        self.mesh_n = tuple(mesh_n)
        self.judge = self.judge_of(SHIFTED)
        ends = sorted({min(mesh_n), max(mesh_n)})
        self._training = self.judge_of((SHIFTED[0], SHIFTED[-1]), 4.0, ends)

    def judge_of(
        self, scatter: Sequence[Scatter], step_n_s: float = 1.0, mesh_n: Sequence[float] = ()
    ) -> Judge:
        """Return the judge of impulses from 18 to 250 N s, every step_n_s."""
        impulses_n_s = np.linspace(18.0, 250.0, round(232.0 / step_n_s) + 1)
        return Judge(self.parameters, self.timing, impulses_n_s, mesh_n or self.mesh_n, scatter)

    def costs(self, knots_s: Sequence[float], waits_s: float = 0.0) -> Costs:
        """Return the costs of the searches: commands early and late, ends of the mesh forces."""
        judge, delay_s = self._training.judge, self.delay_s + waits_s
        return lambda values: cost_m_s(judge(values, knots_s, delay_s, 30))

    def judged(self, progress: Progress, judge: Judge) -> Judgement:
        """Return how the best policy of a search arrives."""
        return judge.judge(progress.policy, progress.knots_s, self.delay_s + progress.waits_s)

    def answering(self, policy: Progress, knots: int) -> tuple[Floats, list[float]]:
        """Return the same policy [size], without unit, with knots over the releases that it has."""
        release_s = self._training.held(policy.policy)[0]
        knots_s = np.linspace(release_s.min(), release_s.max(), knots).tolist()
        return with_knots(policy, knots_s), knots_s

    def after(self, progress: Progress, attempt: Progress, evaluations: int) -> Progress:
        """Return the progress after an attempt that ended in a policy."""
        worst_m_s = float(self.judged(attempt, self.judge).worst_m_s[0])
        spent = (progress.history[-1][0] if progress.history else 0) + evaluations
        least_m_s = min(worst_m_s, progress.worst_m_s)
        history = [*progress.history, [spent, least_m_s] if least_m_s < math.inf else [spent]]
        better = worst_m_s < progress.worst_m_s or not progress.values
        return msgspec.structs.replace(attempt if better else progress, history=history)

    def cma(self, progress: Progress, others: Sequence[Progress], evaluations: int) -> Progress:
        """Return the progress after one more attempt of CMA-ES.

        Of five attempts one begins with a random stem, its population larger each time, one with the
        policy of another problem that is best here, three at the best so far. Knots become more.
        """
        k, size, left = len(progress.history), 24, evaluations
        sigma, start = (0.3, 1.0, 0.3, 0.1)[k % 4], progress
        others = [each for each in others if each.values]
        if k % 5 == 1 and others:
            start = min(others, key=lambda o: self.costs(o.knots_s, o.waits_s)(o.policy)[0])
        elif k % 5 == 0 or not start.values:
            sigma, size, left = 0.5, 16 * 2 ** (k // 5 % 3), evaluations // 2
            rng, stems = np.random.default_rng(1000 + k), self.costs([])
            points = np.array([random_stem(rng) for _ in range(3 * size)])
            stem = points[int(np.argmin(stems(points)))]
            stem = evolve(stems, stem, 2.0, evaluations - left, size, k)
            start = Progress(values=stem.tolist())
        values, knots_s = self.answering(start, KNOTS[min(k // 4, len(KNOTS) - 1)])
        values = evolve(self.costs(knots_s, start.waits_s), values, sigma, left, size, k)
        return self.after(progress, Progress(start.waits_s, knots_s, values.tolist()), evaluations)

    def differential(self, progress: Progress, evaluations: int) -> Progress:
        """Return the progress after one more attempt of scipy's differential evolution.

        Half of its first policies are near the best that this search has, all others are random.
        """
        from scipy.optimize import differential_evolution

        k, members = len(progress.history), 40
        rng, knots = np.random.default_rng(2000 + k), KNOTS[min(k // 3, len(KNOTS) - 1)]
        stems = [Progress(values=random_stem(rng).tolist()) for _ in range(members)]
        best, knots_s = self.answering(progress if progress.values else stems[0], knots)
        first = np.array([with_knots(stem, knots_s) for stem in stems])
        first[:, STEM_SIZE:] += rng.uniform(-0.5, 1.0, first[:, STEM_SIZE:].shape)
        near = best + 0.3 * rng.standard_normal((members // 2, len(best)))
        first[: members // 2], first[0] = near, best
        low = np.full(len(best), NO_PULSE - 0.5)
        high = np.where(np.arange(len(best)) < STEM_SIZE, LATEST_START, 4.0)
        costs = self.costs(knots_s)
        result = differential_evolution(
            lambda columns: costs(columns.T),
            np.stack([low, high], axis=1),
            vectorized=True,
            updating="deferred",
            init=np.clip(first, low, high),
            maxiter=evaluations // members,
            strategy="currenttobest1bin",
            tol=0.0,
            polish=False,
            rng=np.random.default_rng(k),
        )
        return self.after(progress, Progress(0.0, knots_s, result.x.tolist()), evaluations)


def softest_alone_m_s(
    parameters: ParameterSet, timing: Timing, mesh_n: float, impulse_n_s: float, evaluations: int
) -> float:
    """Return the softest stop in m/s that CMA-ES finds under one load, known in advance."""
    judge = Judge(parameters, timing, np.array([impulse_n_s]), (mesh_n,), SHIFTED)

    def costs(values: Floats) -> Floats:
        return cost_m_s(judge.judge(values, (), 1.0))

    rng, stops_m_s = np.random.default_rng(1), []
    for seed in range(2):
        points = np.array([random_stem(rng) for _ in range(96)])
        start = points[int(np.argmin(costs(points)))]
        best = evolve(costs, start, 1.0, evaluations // 2, 24, seed)
        stops_m_s.append(float(judge.judge(best[None], (), 1.0).worst_m_s[0]))
    return min(stops_m_s)
