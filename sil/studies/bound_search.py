"""Search the softest worst-case arrival over the loads of a family.

A policy is a stem of segments with a branch for each load, see `sil.studies.segments`.
The search goes from load to load, in the order in which they are revealed. Level k adds segment k and
the branch of load k to partial policies of the level before. Two figures say how good one is: the
hardest impact of its loads so far, and the release of the last load, because all may lose only so
much time. A level retains those with the earliest release for some limits of the impact, and only a
few of each topology (which pulses there are), as what suits the next load is not known yet.
The best whole policies are refined by a sequential linear programme: slopes of every impact and
arrival by finite differences, then the step that lowers the worst load most while all arrive in time.
The next pass starts from them, with lower limits. Several hunts begin without any policy, as each may
end in another topology, some far softer than others; the last pass starts from the best of all. Every value found belongs to a policy that exists: it is an upper
estimate of the true bound.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from sil.studies.minimax import merits
from sil.studies.policies import Arrivals, FamilyModel, Floats, Ints, Layout
from sil.studies.pulses import changes, stem_spans
from sil.studies.segments import ABSENT, UNITS_PER_S, Member, SegmentModel

LONGER = 1.002
"""Length of the shortest new pulse, as a share of the delay of its valve."""
HUNTS, PASSES = 2, (0.06, 0.14, 0.2)
"""Hunts where no other number is asked for, and the passes of each as shares of all simulations; with
more hunts they are shorter. The last pass gets what remains."""
LIMITS = 0.3, 0.6, 0.9
"""Limits of the impact, as shares of the hardest of the best policy; at first of half the plain push."""
RETAINED, ALIKE = 32, 3
"""Partial policies that a level retains for each limit, and how many of them of one topology."""
PRICE_S_PER_M_S = 0.1
"""What an impact above the limit costs, in time."""
FIRST_SHARE, FIRST_TRIES = 0.25, 10
"""Share of a level's simulations for random pulses, and branches tried with each."""
NEW, TRIES = 64, 6
"""New partial policies of a generation, and branches tried with each."""
ELITES, USES = 8, 12
"""Whole policies from which a pass starts, and how often a level uses their pulses."""
NEW_VALVE, NEW_PARENT = 0.2, 0.4
"""Partial policies up to the first share: new pulses of one valve; up to the next: another parent."""
PULSES = 0.1, 0.55, 0.25, 0.1
"""How often a new segment has no pulse, one, two and three."""
REFINED = 0.15
"""Share of a pass for refinement."""
STEPS, MORE_STEPS = 8, 20
"""Steps of the refinement of each policy, and of the best two."""
HALVINGS = 5
"""Budgets at which the best so far is reported: the whole, a half, a quarter ..."""


@dataclass(frozen=True)
class Policy:
    """A policy and its worst impact in m/s: stem [valves, variables], branches [loads, valves, ...]."""

    cost_m_s: float
    stem: Floats
    branches: Floats
    layout: Layout


@dataclass(frozen=True)
class Partial:
    """Partial policies [n]: segments [n, k, valves, ...], branches [n, loads, valves, ...].

    cost_m_s [n]: the hardest of the loads so far; last_s [n]: release of the last load; parent [n]:
    number in the level before.
    """

    segments: Floats
    branches: Floats
    revealed_s: Floats
    cost_m_s: Floats
    last_s: Floats
    parent: Ints

    def take(self, which: Ints) -> Partial:
        """Return some of the policies, by number [chosen]."""
        return Partial(*(getattr(self, field.name)[which] for field in fields(self)))

    def joined(self, others: Partial) -> Partial:
        """Return these policies and others."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(self))
        return Partial(*map(np.concatenate, pairs))


class Search(SegmentModel):
    """One search for a family, reproducible by its seed; `best` is the best policy so far."""

    def __init__(
        self, model: FamilyModel, valves: str, pulses: int, branch: int, seed: int
    ) -> None:
        super().__init__(model, valves, pulses, branch)
        self.rng = np.random.default_rng(seed)
        self.limits = LIMITS
        self.best = Policy(np.inf, np.zeros(0), np.zeros(0), self.layout)
        revealed_s = UNITS_PER_S * model.begin_s(model.plain.revealed_s[0, 0])[self.order]
        self.spans = np.diff(revealed_s[: self.count], prepend=0.0)
        if not branch:
            self.spans = UNITS_PER_S * model.limit_s.max(keepdims=True)

    def note(self, member: Member) -> None:
        """Make a member the best policy if it is one, as `FamilyModel.fly` judges it."""
        if member.cost_m_s.max() >= self.best.cost_m_s - 1e-6:
            return
        stems, _revealed_s = self.stems(member.segments[None])
        policy = Policy(0.0, stems[0], member.branches, self.layout)
        cost_m_s = float(arrivals_of(self.model, policy).cost_m_s.max())
        if cost_m_s < self.best.cost_m_s:
            self.best = replace(policy, cost_m_s=cost_m_s)

    def random_segments(self, n: int) -> Floats:
        """Return random segments [n, k, valves, variables] of few pulses that move a plunger."""
        rng, shape = self.rng, (n, self.count, len(self.lead), self.pulses)
        start = rng.uniform(-0.1, 1.0, shape) * (self.spans[:, None, None] + 0.3)
        length = rng.exponential(0.8, shape) * (rng.random(shape) < 0.5)
        drawn = rng.random((n, self.count, len(self.lead) * self.pulses))
        rank = drawn.argsort(axis=2).argsort(axis=2).reshape(shape)
        number = rng.choice(len(PULSES), p=PULSES, size=(n, self.count, 1, 1))
        return self._pulses(start, np.where(rank < number, length, np.nan))

    def random_branches(self, n: int, tries: int) -> Floats:
        """Return random branches [n, tries, valves, variables] of a load; they cut the stem's pulses."""
        rng = self.rng
        shape = n, tries, len(self.lead), self.layout.branch
        ahead = UNITS_PER_S * max(-self.model.delay_s, 0.0)
        start = np.where(rng.random(shape) < 0.3, 0.0, rng.uniform(0.0, 1.5 + ahead, shape))
        length = np.where(rng.random(shape) < 0.6, rng.exponential(1.0, shape), np.nan)
        pulses = self._pulses(start, length)
        return np.concatenate([pulses, np.zeros((*shape[:-1], 1))], axis=-1)

    def _pulses(self, start: Floats, length: Floats) -> Floats:
        """Return pulses [..., variables] whose plungers leave at start [..., pulses], in 10 ms.

        length: by how much a pulse is longer than what moves a plunger, NaN for no pulse.
        """
        lead = self.lead[:, None]
        length = np.where(np.isnan(length), ABSENT, LONGER * lead + length)
        return np.stack([start - lead, length], axis=-1).reshape(*start.shape[:-1], -1)

    def run(self, budget: int, hunts: int = HUNTS) -> list[float]:
        """Search with a number of simulations; return the best in m/s at parts of it, the whole last."""
        history: list[float] = []
        begin, spent = self.model.runs, 0.0
        best: list[Member] = []
        shares = [HUNTS / hunts * share for share in PASSES]
        for hunt in range(hunts + 1):
            elites = [] if hunt < hunts else self.elites(best)
            for share in shares if hunt < hunts else [1.0 - HUNTS * sum(PASSES)]:
                spent += share
                while 2.0 ** (len(history) + 1 - HALVINGS) < 0.999 * spent:
                    history.append(self.best.cost_m_s)
                if self.model.runs - begin < budget * spent:
                    elites = self.one_pass(elites, begin + int(budget * spent))
            best += elites
        return [*history, self.best.cost_m_s]

    def one_pass(self, elites: list[Member], until: int) -> list[Member]:
        """Return the best whole policies after a pass up to a number of simulations."""
        budget = until - self.model.runs
        pool = self.levels(elites, int((1.0 - REFINED) * budget))
        _topologies, first = np.unique(self.topology(pool.segments), return_index=True)
        found = []
        for k in np.sort(first)[:ELITES]:
            member = self.members(pool.segments[k, None], pool.branches[k, None])[0]
            found.append(self.refine(member, STEPS))
            if self.model.runs >= until:
                break
        elites = self.elites(elites + found)
        elites[:2] = [self.refine(member, MORE_STEPS) for member in elites[:2]]
        elites = self.elites(elites)
        self.note(elites[0])
        return elites

    def elites(self, members: list[Member]) -> list[Member]:
        """Return the best policies, one of each topology, the best first."""
        found: dict[float, Member] = {}
        for member in sorted(members, key=lambda member: member.merit_m_s):
            found.setdefault(float(self.topology(member.segments[None])[0]), member)
        return list(found.values())[:ELITES]

    def levels(self, elites: list[Member], budget: int) -> Partial:
        """Return whole policies of a pass, the softest first, after a number of simulations."""
        loads, valves = self.model.loads, len(self.lead)
        nothing = Partial(
            np.zeros((1, self.count, valves, 2 * self.pulses)),
            np.zeros((1, loads, valves, 2 * self.layout.branch + 1)),
            np.full((1, loads), np.inf),
            np.zeros(1),
            np.zeros(1),
            np.zeros(1, dtype=np.int64),
        )
        nothing.segments[..., 1::2] = ABSENT
        nothing.branches[..., 1::2] = ABSENT
        pool = nothing
        aim_m_s = (
            elites[0].cost_m_s.max() if elites else 0.5 * self.model.plain.impact_stay_m_s.max()
        )
        limits_m_s = float(aim_m_s) * np.array(self.limits)
        for k in range(self.count):
            pool = pool.joined(self.begun(elites, nothing, k)) if elites and k else pool
            share = 2.0 * (k + 2) / (self.count * (self.count + 3))  # later levels are harder
            pool = self.level(k, pool, elites, limits_m_s, int(share * budget))
        return pool.take(np.argsort(pool.cost_m_s, kind="stable"))

    def begun(self, elites: list[Member], nothing: Partial, k: int) -> Partial:
        """Return the first k segments of whole policies, with the branches of the loads so far."""
        found, loads = nothing.take(np.zeros(len(elites), dtype=np.int64)), self.order[:k]
        segments = np.array([member.segments for member in elites])
        found.segments[:, :k] = segments[:, :k]
        found.branches[:, loads] = np.array([member.branches for member in elites])[:, loads]
        found.revealed_s[:, loads] = self.stems(segments)[1][:, loads]
        found.cost_m_s[:] = np.array([member.cost_m_s for member in elites])[:, loads].max(axis=1)
        return found

    def level(
        self, k: int, parents: Partial, elites: list[Member], limits_m_s: Floats, budget: int
    ) -> Partial:
        """Return partial policies with segment k, after a number of simulations, by limits [limits]."""
        until = self.model.runs + budget
        pool = self.first(k, parents, elites, int(FIRST_SHARE * budget))
        while self.model.runs < until:
            pool = self.retained(pool.joined(self.moved(k, parents, pool)), limits_m_s)
        return self.retained(pool, limits_m_s)

    def first(self, k: int, parents: Partial, elites: list[Member], budget: int) -> Partial:
        """Return partial policies with random pulses, an eighth of them with none; then those of elites."""
        n, load = max(NEW, budget // (FIRST_TRIES + 2)), int(self.order[k])
        parent = self.rng.integers(len(parents.parent), size=n)
        segments = self.random_segments(n)[:, k]
        segments[: n // 8, :, 0::2], segments[: n // 8, :, 1::2] = 0.0, ABSENT
        branches = self.random_branches(n, FIRST_TRIES)
        if elites:
            uses = np.arange(min(n // 3, USES * len(elites))) % len(elites)
            segments[-len(uses) :] = np.array([member.segments[k] for member in elites])[uses]
            branches[-len(uses) :, 0] = np.array([m.branches[load] for m in elites])[uses]
            parent[-len(elites) :] = np.arange(-len(elites), 0) % len(parents.parent) if k else 0
        return self.judged(k, parents, parent, segments, branches)

    def moved(self, k: int, parents: Partial, pool: Partial) -> Partial:
        """Return partial policies near those of a pool."""
        rng, load = self.rng, int(self.order[k])
        which = rng.integers(len(pool.parent), size=NEW)
        parent, segments = pool.parent[which], pool.segments[which, k]
        kind, width = rng.random(NEW), 10.0 ** rng.uniform(-2.5, 0.2, NEW)
        other = (kind >= NEW_VALVE) & (kind < NEW_PARENT)
        parent[other] = rng.integers(len(parents.parent), size=NEW)[other]
        step = width[:, None, None] * rng.standard_normal(segments.shape)
        step *= (segments > ABSENT) & (rng.random(segments.shape) < 0.5)
        moves = (kind >= NEW_PARENT) | (other & (rng.random(NEW) < 0.5))
        segments[moves] += step[moves]
        valve = rng.integers(len(self.lead), size=NEW)
        new = np.flatnonzero(kind < NEW_VALVE)
        segments[new, valve[new]] = self.random_segments(NEW)[new, k, valve[new]]
        branches = np.repeat(pool.branches[which, load][:, None], TRIES, axis=1)
        step = width[:, None, None, None] * rng.standard_normal(branches[:, 1:3].shape)
        step[..., -1] = 0.0
        branches[:, 1:3] += step * (rng.random(step.shape) < 0.5)
        branches[:, 3] = pool.branches[rng.integers(len(pool.parent), size=NEW), load]
        branches[:, 4:] = self.random_branches(NEW, TRIES - 4)
        return self.judged(k, parents, parent, segments, branches)

    def judged(
        self, k: int, parents: Partial, parent: Ints, segments: Floats, branches: Floats
    ) -> Partial:
        """Return partial policies of parents, segments k [n, valves, ...] and branches [n, tries, ...].

        Each has the softest of its branches.
        """
        n, load = len(parent), int(self.order[k])
        found = parents.take(parent)
        found.segments[:, k] = segments
        if not self.layout.branch:
            members = self.members(found.segments, found.branches)
            cost_m_s = np.array([member.cost_m_s.max() for member in members])
            return replace(found, cost_m_s=cost_m_s, parent=parent)
        stems, revealed_s = self.stems(
            found.segments, np.full(n, k), parents.revealed_s[parent], k + 1
        )
        tried = np.repeat(found.branches[:, None], branches.shape[1], axis=1)
        tried[:, :, load] = branches
        which = np.zeros((n, self.model.loads), dtype=np.bool_)
        which[:, load] = True
        arrivals = self.model.branched(stems, tried, self.layout, revealed_s, which)
        cost_m_s = merits(arrivals)[:, :, load]
        best = cost_m_s.argmin(axis=1)
        found.branches[:, load] = branches[np.arange(n), best]
        last_s = np.zeros(n)
        if k < self.count - 1:
            last_s = self.model.reveals_s(stems, self.layout, int(self.order[-1]))
            last_s[np.isinf(last_s)] = 1.0
        cost_m_s = np.maximum(found.cost_m_s, cost_m_s.min(axis=1))
        return Partial(found.segments, found.branches, revealed_s, cost_m_s, last_s, parent)

    def retained(self, pool: Partial, limits_m_s: Floats) -> Partial:
        """Return the partial policies with the earliest release for each limit [limits] of the impact."""
        topology, chosen = self.topology(pool.segments), set()
        for limit_m_s in limits_m_s:
            excess_m_s = np.maximum(pool.cost_m_s - limit_m_s, 0.0)
            loss_s = pool.last_s + PRICE_S_PER_M_S * excess_m_s
            last, count, alike = -1.0, 0, dict.fromkeys(topology, 0)
            for k in np.argsort(loss_s, kind="stable"):
                if alike[topology[k]] < ALIKE and loss_s[k] - last > 1e-6:
                    last, count = loss_s[k], count + 1
                    alike[topology[k]] += 1
                    chosen.add(int(k))
                if count == RETAINED:
                    break
        return pool.take(np.array(sorted(chosen)))


def arrivals_of(model: FamilyModel, policy: Policy) -> Arrivals:
    """Return how a policy arrives, each figure [1, 1, loads]."""
    branches = policy.branches[None, None] if policy.layout.branch else None
    return model.fly(policy.stem[None], branches, policy.layout)


def stem_switches(policy: Policy) -> int:
    """Return how often the commands of a stem change, the start of the push not counted."""
    return int(np.isfinite(changes(*stem_spans(policy.stem))).sum())
