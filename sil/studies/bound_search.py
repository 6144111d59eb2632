"""Search the softest worst-case arrival over the loads of a family.

(a) Known: the load is known in advance, so each load has commands of its own.
(b) Not known: a policy is a stem with a branch for each load, see `sil.studies.policies`.

Differential evolution varies the stem. For each stem several branches of each load are tried; as the
loads do not share branches, the best of each load is taken. CMA-ES then refines stem and branches
together. Every value found belongs to a policy that exists: it is an upper estimate of the true bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sil.studies.policies import Arrivals, FamilyModel, Floats, Layout, changes, stem_spans

TRIES = 6
"""Branches that are tried with each stem."""
ABSENT = -0.2
"""Length of a pulse that is not there, in 10 ms."""
POPULATION = 14
"""Candidates of a generation of CMA-ES."""
PARENTS = 5
"""Candidates of a generation of differential evolution for each variable."""
SHARPNESS = 6.0
"""Exponent of the mean over the loads that replaces the worst of them while a search is wide."""
UNITS_PER_S = 100.0


@dataclass(frozen=True)
class Policy:
    """A policy and its worst impact in m/s: stem [valves, variables], branches [loads, valves, ...]."""

    cost_m_s: float
    stem: Floats
    branches: Floats
    layout: Layout


class Search:
    """One search for a family, reproducible by its seed; `best` is the best policy so far."""

    def __init__(self, model: FamilyModel, layout: Layout, seed: int) -> None:
        self.model = model
        self.layout = layout
        self.rng = np.random.default_rng(seed)
        self.best = Policy(np.inf, np.zeros(0), np.zeros(0), layout)

    def drawn(self, count: int) -> Floats:
        """Return random stems [count, valves, variables], two pulses for each valve on average."""
        span = UNITS_PER_S * float(self.model.limit_s.max())
        return self._pulses((count, len(self.layout.valves), self.layout.stem), span, 0.4)

    def _pulses(self, shape: tuple[int, ...], span: float, present: float) -> Floats:
        start = self.rng.uniform(0.0, span, shape)
        length = np.where(
            self.rng.random(shape) < present, self.rng.exponential(1.5, shape), ABSENT
        )
        return np.stack([start, length], axis=-1).reshape(*shape[:-1], -1)

    def branches(self, count: int) -> Floats:
        """Return branches to try [count, TRIES, loads, valves, variables].

        The stem as it is, the best so far, two near it, and random ones.
        """
        layout = self.layout
        shape = count, TRIES, self.model.loads, len(layout.valves)
        pulses = self._pulses((*shape, layout.branch), 1.0, 0.5)
        rise_s, fall_s = self.model.valve_s
        for which, valve in enumerate(layout.valves):
            lead = UNITS_PER_S * (fall_s if valve == "B" else rise_s)
            armed = self.rng.random((*shape[:3], layout.branch)) < 0.5
            pulses[..., which, 0::2][armed] = -lead * self.rng.uniform(0.3, 1.0, armed.sum())
            pulses[..., which, 1::2][armed] += lead
        cut = np.where(self.rng.random(shape) < 0.5, self.rng.uniform(0.0, 2.0, shape), 30.0)
        found = np.concatenate([pulses, cut[..., None]], axis=-1)
        found[:, 0, ..., 1:-1:2], found[:, 0, ..., -1] = ABSENT, 30.0
        if np.isfinite(self.best.cost_m_s):
            found[:, 1:4] = self.best.branches
            found[:, 2:4] += 0.3 * self.rng.standard_normal(found[:, 2:4].shape)
        return found

    def cost(self, stems: Floats, branches: Floats | None) -> Floats:
        """Return the cost [n, loads] in m/s of stems with the best of the branches of each load."""
        cost = self.model.fly(stems, branches, self.layout).cost_m_s
        least: Floats = cost.min(axis=1)
        k = int(least.max(axis=1).argmin())
        if least[k].max() < self.best.cost_m_s:
            loads = np.arange(self.model.loads)
            chosen = np.zeros((len(loads), *self.layout.branch_shape))
            if branches is not None:
                chosen = branches[k, cost[k].argmin(axis=0), loads]
                together = self.model.fly(stems[k : k + 1], chosen[None, None], self.layout)
                least[k] = together.cost_m_s[0, 0]
            if least[k].max() < self.best.cost_m_s:
                self.best = Policy(float(least[k].max()), stems[k].copy(), chosen, self.layout)
        return least

    def stem_cost(self, vectors: Floats) -> Floats:
        """Return the cost [n, loads] in m/s of stems [n, size] with branches that are tried."""
        stems = vectors.reshape(-1, *self.layout.stem_shape)
        return self.cost(stems, self.branches(len(stems)) if self.layout.branch else None)

    def joint_cost(self, vectors: Floats) -> Floats:
        """Return the cost [n, loads] in m/s of vectors [n, size] of a stem and its branches."""
        cut = int(np.prod(self.layout.stem_shape))
        stems = vectors[:, :cut].reshape(-1, *self.layout.stem_shape)
        shape = len(stems), 1, self.model.loads, *self.layout.branch_shape
        return self.cost(stems, vectors[:, cut:].reshape(shape) if self.layout.branch else None)

    def descend(
        self, cost: Callable[[Floats], Floats], start: Floats, step: float, rounds: int, sharp: bool
    ) -> None:
        """Minimise a cost by CMA-ES from a point [size], with a first step in 10 ms."""
        import cma

        options = {"seed": int(self.rng.integers(1, 2**31)), "verbose": -9, "popsize": POPULATION,
                   "tolfun": 3e-4, "tolfunhist": 3e-4, "maxiter": rounds}  # fmt: skip
        strategy = cma.CMAEvolutionStrategy(start, step, options)
        while not strategy.stop():
            points = strategy.ask()
            strategy.tell(points, list(over_loads(cost(np.array(points)), sharp)))

    def refine(self, rounds: int) -> None:
        """Minimise over stem and branches together, from the best policy."""
        for step in (0.3, 0.05):
            vector = np.hstack([self.best.stem.ravel(), self.best.branches.ravel()])
            if not self.layout.branch:
                vector = self.best.stem.ravel()
            self.descend(self.joint_cost, vector, step, rounds, sharp=True)


def over_loads(cost: Floats, sharp: bool) -> Floats:
    """Return one cost [n] of those [n, loads] in m/s: nearly the worst, or a smooth mean near it."""
    worst: Floats = cost.max(axis=1) + 0.01 * cost.mean(axis=1)
    smooth: Floats = np.mean(cost**SHARPNESS, axis=1) ** (1.0 / SHARPNESS)
    return worst if sharp else smooth


def softest(model: FamilyModel, layout: Layout, generations: int, seed: int) -> Policy:
    """Return the best policy of differential evolution over stems, refined by CMA-ES."""
    from scipy.optimize import differential_evolution

    search = Search(model, layout, seed)
    size = int(np.prod(layout.stem_shape))
    span = UNITS_PER_S * float(model.limit_s.max())

    def cost(stems: Floats) -> Floats:
        return over_loads(search.stem_cost(np.ascontiguousarray(stems.T)), sharp=False)

    differential_evolution(
        cost,
        [(0.0, span), (-3.0, 6.0)] * (size // 2),
        vectorized=True,
        updating="deferred",
        init=search.drawn(PARENTS * size).reshape(PARENTS * size, -1),
        mutation=(0.4, 0.9),
        maxiter=generations,
        tol=1e-4,
        polish=False,
        rng=seed,
    )
    if layout.branch:
        search.descend(search.stem_cost, search.best.stem.ravel(), 0.3, generations, sharp=True)
    search.refine(2 * generations)
    return search.best


def arrivals_of(model: FamilyModel, policy: Policy) -> Arrivals:
    """Return how a policy arrives, each figure [1, 1, loads]."""
    branches = policy.branches[None, None] if policy.layout.branch else None
    return model.fly(policy.stem[None], branches, policy.layout)


def stem_switches(policy: Policy) -> int:
    """Return how often the commands of a stem change, the start of the push not counted."""
    return int(np.isfinite(changes(*stem_spans(policy.stem))).sum())
