"""Two unlike searches for the policy whose hardest stop is softest: CMA-ES and differential evolution.

Checked by: tests/unit/sil/studies/bounds/test_search.py
"""

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
    Timing,
    at_releases,
    places_of,
)
from sil.studies.policies import Bools, Floats, Ints

LATEST_START = 22.0
"""Of a pulse of the stem, in units of a policy."""


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
        parts += [rng.uniform(2.0, LATEST_START, n), length]
    return np.concatenate(parts)


class Problem:
    """What a policy is searched for: valves, delay of the information, mesh forces that may occur.

    b_with_f: F may open while B pushes, as the firmware forbids. impulses_n_s: the least and the greatest.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        timing: Timing,
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

    def judged(self, policy: Progress, judge: Judge, loads: slice = slice(None)) -> Judgement:
        """Return how a policy arrives."""
        delay_s = self.delay_s + policy.waits_s
        return judge.judge(policy.policy, policy.knots_s, delay_s, loads)

    def answering(self, policy: Progress, knots: int) -> tuple[Progress, Ints]:
        """Return the same policy with knots over its releases, and places [n] of unitless values that may change.

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
        return Progress(policy.waits_s, knots_s.tolist(), values.tolist()), changing

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

        The first begins with the policy of another problem that is best here; of the others one in four
        at random, its population larger each time, the rest at the best so far. Every other knot is
        searched for itself, under the releases between its neighbours, then those between; then the stem,
        then all values.
        """
        k, rng = len(progress.history), np.random.default_rng(1000 + len(progress.history))
        size, sigma = (12 + 4 * k, 0.5) if k % 4 == 3 else (16, (0.4, 0.2, 0.1)[k % 4])
        starts = [each for each in (progress, *others) if each.values][: 1 if k % 4 else None]
        if k % 4 == 3 or not starts:
            starts = [Progress(values=random_stem(rng).tolist()) for _ in range(40)]
        few = slice(None, None, 8)
        start = min(starts, key=lambda each: cost_m_s(self.judged(each, self.judge, few))[0])
        knots = min(6 * 2 ** (k // 4), 24) if self.judge.shape[2] > 1 else 0
        start, places = self.answering(start, knots)
        stem, answer = places_of(self._valves, knots)
        release_s = self.judge.release_s(start.policy).mean(axis=(0, 1, 2))
        ends_s = [-math.inf, *start.knots_s, math.inf]
        always = release_s > 0.0
        each = [
            (answer[i], (ends_s[i] < release_s) & (release_s < ends_s[i + 2])) for i in range(knots)
        ]
        for step, blocks in (
            (4, each[::2]), (4, each[1::2]), (4, [(stem, always)]), (2, [(places, always)]),
        ):  # fmt: skip
            start = self._evolve(start, blocks, step, sigma, (size, evaluations // 4), rng)
        return self.after(progress, start, evaluations)

    def _evolve(
        self, start: Progress, blocks: Sequence[tuple[Ints, Bools]], step: int, sigma: float,
        budget: tuple[int, int], rng: np.random.Generator,
    ) -> Progress:  # fmt: skip
        """Return a policy after CMA-ES (library `cma`) for each block: places, and loads that matter there.

        step: from load to load. budget: policies of a generation, and of all.
        """
        import cma

        def randn(*shape: int) -> Floats:
            return rng.standard_normal(shape)

        (size, evaluations), values = budget, start.policy[0]
        options = {"popsize": size, "seed": np.nan, "randn": randn, "verbose": -9}
        blocks = [(places, loads[::step]) for places, loads in blocks if loads[::step].any()]
        searches = [
            cma.CMAEvolutionStrategy(values[places], sigma, options) for places, _ in blocks
        ]
        delay_s = self.delay_s + start.waits_s
        for _ in range(evaluations // size if blocks else 0):
            policies = np.repeat(values[None], size + 1, axis=0)
            for search, (places, _) in zip(searches, blocks, strict=True):
                policies[:size, places] = search.ask()
            some = slice(None, None, step)
            judgement = self.judge.judge(policies, start.knots_s, delay_s, some)
            for search, (places, loads) in zip(searches, blocks, strict=True):
                cost = cost_m_s(judgement.under(loads))
                search.tell(list(policies[:size, places]), list(cost[:size]))
                values[places] = policies[int(np.argmin(cost)), places]
        return msgspec.structs.replace(start, values=values.tolist(), history=[])

    def differential(self, progress: Progress, evaluations: int) -> Progress:
        """Return the progress after one more attempt of scipy's differential evolution.

        The first begins with random policies, the others with the best of this search among them.
        """
        from scipy.optimize import differential_evolution

        k, few = len(progress.history), slice(None, None, 6)
        start = progress if progress.values else Progress(values=[NO_PULSE] * STEM_SIZE)
        start, places = self.answering(start, 1 + min(k, 5))
        high = np.where(places < STEM_SIZE, LATEST_START, 4.0)
        limits = np.stack([np.full(len(places), NO_PULSE - 0.5), high], axis=1)

        def policies(columns: Floats) -> Floats:
            values = np.repeat(start.policy, columns.shape[1], axis=0)
            values[:, places] = columns.T
            return values

        result = differential_evolution(
            lambda x: cost_m_s(self.judge.judge(policies(x), start.knots_s, self.delay_s, few)),
            limits,
            x0=start.policy[0, places].clip(*limits.T),
            vectorized=True,
            updating="deferred",
            init="sobol",
            popsize=max(1, 40 // len(places)),
            maxiter=evaluations // 64,
            strategy="currenttobest1bin",
            tol=0.0,
            polish=False,
            rng=np.random.default_rng(k),
        )
        values = policies(result.x[:, None])[0].tolist()
        return self.after(progress, Progress(0.0, start.knots_s, values), evaluations)


def softest_alone(
    parameters: ParameterSet,
    timing: Timing,
    mesh_n: float,
    impulse_n_s: float,
    evaluations: int,
    others: Sequence[Progress] = (),
) -> Progress:
    """Return the softest policy that CMA-ES finds under one load, known in advance.

    others: policies of other loads, to begin with.
    """
    problem = Problem(parameters, timing, 1.0, [mesh_n], impulses_n_s=(impulse_n_s, impulse_n_s))
    progress = Progress()
    for _ in range(4):
        progress = problem.cma(progress, others, evaluations // 4)
    return progress
