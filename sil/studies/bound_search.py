"""Search the softest worst-case arrival over the loads of a family.

A policy is a stem with a branch for each load, see `sil.studies.policies`. Here the stem is a row of
segments: segment k is timed from where the branch of the load before it begins, so a change of an
early segment moves all later ones along with the releases.

Two parts work together. The global one is evolutionary. Every policy of a population has a child:
one segment is drawn anew or moved, or the later segments of another policy are taken. With the stem
given each load has a problem of its own, so each load takes the best of several branches: its own,
near ones, those of other policies and new ones. A child that is softer replaces its parent. The
population becomes smaller as the budget is spent. New pulses are long enough to move a plunger and
few, because each one costs time. Several populations are searched one after the other, because a
single one may end far above the best; a last one begins with their best. The local part is a sequential linear programme: slopes of every
impact and arrival by finite differences, then the step that lowers the worst load most while all
arrive in time. Every value found belongs to a policy that exists: it is an upper estimate of the true
bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sil.studies.minimax import DIFFERENCE, MEAN_WEIGHT, merits, programme
from sil.studies.policies import Arrivals, Bools, FamilyModel, Floats, Ints, Layout
from sil.studies.pulses import changes, stem_spans

UNITS_PER_S = 100.0
ABSENT = -0.2
"""Length of a pulse that is not there, in 10 ms."""
LONGER = 1.002
"""Length of the shortest new pulse, as a share of the delay of its valve."""
POPULATIONS, LARGE = 8, 300_000
"""Populations of a search at most, and simulations for each of them."""
LAST_SHARE = 0.2
"""Share of the simulations for the last population, which begins with the best of the others."""
FEWEST = 4
"""Policies of a population at its end."""
BATCH = 24
"""Least number of new policies of a generation."""
A_POLICY = 2000
"""Simulations for each policy with which a population begins."""
FIRST_TRIES = 12
TRIES = 8
"""Branches tried for each load of a first policy, and of a new one."""
SHARE = 0.25, 0.5, 0.65
"""New policies: up to the first share by crossing, up to the next with a new segment, then with a new
valve of a segment; of the others one segment is moved."""
PULSES = 0.1, 0.55, 0.25, 0.1
"""How often a new segment has no pulse, one, two and three."""
REFINED = 16
"""Of this many policies of a population, one is refined in each generation."""
STEPS = 3
"""Steps of a refinement."""
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
class Member:
    """A policy of a population: segments [k, valves, ...], branches [loads, valves, ...], cost [loads]."""

    segments: Floats
    branches: Floats
    cost_m_s: Floats

    @property
    def merit_m_s(self) -> float:
        """The worst load, and a little of the others."""
        return float(self.cost_m_s.max() + MEAN_WEIGHT * self.cost_m_s.sum())


class Search:
    """One search for a family, reproducible by its seed; `best` is the best policy so far.

    branch: pulses of each valve in a branch, 0 for no branches; pulses: of each valve in a segment.
    """

    def __init__(
        self, model: FamilyModel, valves: str, pulses: int, branch: int, seed: int
    ) -> None:
        self.model = model
        self.order = model.order
        self.rank = np.argsort(self.order)
        self.count = model.loads if branch else 1
        self.pulses = pulses
        self.layout = Layout(valves, self.count * pulses, branch)
        self.rng = np.random.default_rng(seed)
        self.best = Policy(np.inf, np.zeros(0), np.zeros(0), self.layout)
        revealed_s = UNITS_PER_S * model.begin_s(model.plain.revealed_s[0, 0])[self.order]
        self.spans = np.diff(revealed_s[: self.count], prepend=0.0)
        if not branch:
            self.spans = UNITS_PER_S * model.limit_s.max(keepdims=True)
        rise_s, fall_s = model.valve_s
        self.lead = UNITS_PER_S * np.array([fall_s if v == "B" else rise_s for v in valves])

    def stems(
        self,
        segments: Floats,
        first: Ints | None = None,
        known_s: Floats | None = None,
        last: int | None = None,
    ) -> tuple[Floats, Floats]:
        """Return stems [n, valves, variables] of segments, and when they reveal each load [n, loads].

        first: [n], the first segment that differs from those whose loads are revealed at known_s.
        """
        n = len(segments)
        revealed_s = np.full((n, self.model.loads), np.inf)
        if known_s is not None:
            revealed_s[:] = known_s
        timed = segments.copy()
        for k in range(self.count):
            if k:
                begin_s = self.model.begin_s(revealed_s)[:, self.order[k - 1]]
                timed[:, k, :, 0::2] += UNITS_PER_S * begin_s[:, None, None]
            if self.layout.branch and n and k < (last or self.count):
                changed = np.ones(n, dtype=np.bool_) if first is None else first <= k
                if not changed.any():
                    continue
                stems = joined(timed[changed, : k + 1])
                load = int(self.order[k])
                revealed_s[changed, load] = self.model.reveals_s(stems, self.layout, load)
        return joined(timed), revealed_s

    def fly(self, segments: Floats, branches: Floats) -> Arrivals:
        """Simulate segments [n, k, valves, ...] with tries of branches [n, tries, loads, valves, ...]."""
        stems, revealed_s = self.stems(segments)
        if not self.layout.branch:
            return self.model.fly(stems, None, self.layout)
        return self.model.branched(stems, branches, self.layout, revealed_s)

    def members(self, segments: Floats, branches: Floats) -> list[Member]:
        """Return members of segments [n, ...] and branches [n, loads, ...]."""
        cost_m_s = merits(self.fly(segments, branches[:, None]))[:, 0]
        return [Member(*each) for each in zip(segments, branches, cost_m_s, strict=True)]

    def best_tries(self, segments: Floats, branches: Floats) -> list[Member]:
        """Return members of segments [n, ...], each load with the best of its branches [n, tries, ...].

        Branches of different tries may need the same coil at the same time, so they are tried together.
        """
        tries = merits(self.fly(segments, branches)).argmin(axis=1)
        rows, loads = np.arange(len(segments))[:, None], np.arange(self.model.loads)
        return self.members(segments, branches[rows, tries, loads])

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
        """Return random branches [n, tries, loads, valves, variables]; they cut the stem's pulses."""
        rng = self.rng
        shape = n, tries, self.model.loads, len(self.lead), self.layout.branch
        start = np.where(rng.random(shape) < 0.3, 0.0, rng.uniform(0.0, 1.5, shape))
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

    def children(self, population: list[Member], parents: Ints) -> list[Member]:
        """Return a new policy of each of the parents [n], numbers in the population."""
        rng, n, loads = self.rng, len(parents), np.arange(self.model.loads)
        all_segments = np.array([member.segments for member in population])
        all_branches = np.array([member.branches for member in population])
        worst = np.array([population[number].cost_m_s.argmax() for number in parents])
        segments, branches = all_segments[parents], all_branches[parents]
        fresh, width = self.random_segments(n), 10.0 ** rng.uniform(-2.0, 0.3, n)
        rank = np.minimum(self.rank[worst], self.count - 1)
        near = np.maximum(rank - (rng.random(n) < 0.3), 0)
        chosen = np.where(rng.random(n) < 0.6, near, rng.integers(self.count, size=n))
        for child, kind in enumerate(rng.random(n)):
            k = int(chosen[child])
            if kind < SHARE[0] and self.count > 1:
                other, cut = rng.integers(len(population)), rng.integers(1, self.count)
                segments[child, cut:] = all_segments[other, cut:]
                branches[child, self.rank >= cut] = all_branches[other, self.rank >= cut]
                if rng.random() < 0.5:
                    continue
            elif kind < SHARE[1]:
                segments[child, k] = fresh[child, k]
            elif kind < SHARE[2]:
                valve = rng.integers(len(self.lead))
                segments[child, k, valve] = fresh[child, k, valve]
            moved = (k, int(rng.integers(self.count))) if rng.random() < 0.3 else (k,)
            for part in (segments[child, each] for each in moved):
                part += width[child] * rng.standard_normal(part.shape) * (part > ABSENT)
        if not self.layout.branch:
            return self.members(segments, branches)
        tries = np.repeat(branches[:, None], TRIES, axis=1)
        step = width[:, None, None, None, None] * rng.standard_normal(tries[:, 1:3].shape)
        step[..., -1] = 0.0
        tries[:, 1:3] += step * (rng.random(step.shape) < 0.5)
        for number in (3, 4, 5):  # the last one: of any load
            others = rng.integers(len(population), size=(n, len(loads)))
            whose = loads if number < 5 else rng.integers(len(loads), size=others.shape)
            tries[:, number] = all_branches[others, whose]
        tries[:, 6:] = self.random_branches(n, TRIES - 6)
        return self.best_tries(segments, tries)

    def slopes(self, member: Member) -> tuple[Ints, Arrivals, Arrivals]:
        """Return the segments' variables that act, and arrivals after a step in each variable.

        Variables [n, 2]: segment and index in it; a step is `DIFFERENCE` in 10 ms.
        The first arrivals are after steps of the segments' variables, the second after none and after
        steps of the variables of all branches.
        """
        flat = member.segments.reshape(self.count, -1)
        acts = np.repeat(member.segments[..., 1::2] > 0.0, 2, axis=-1).reshape(flat.shape)
        active = np.argwhere(acts)
        n = len(active)
        stems, revealed_s = self.stems(member.segments[None])
        moved = np.repeat(flat[None], n, axis=0)
        moved[np.arange(n), active[:, 0], active[:, 1]] += DIFFERENCE
        moved = moved.reshape(n, *member.segments.shape)
        if not self.layout.branch:
            base = self.model.fly(stems, None, self.layout)
            return active, self.model.fly(joined(moved), None, self.layout), base
        branches = member.branches[None, None]
        near, near_s = self.stems(moved, active[:, 0], revealed_s)
        begin = UNITS_PER_S * self.model.begin_s(revealed_s[0])
        starts = flat[:, active[:, 1] - active[:, 1] % 2][active[:, 0], np.arange(n)]
        starts += np.where(active[:, 0] > 0, begin[self.order[active[:, 0] - 1]], 0.0)
        which: Bools = self.rank >= active[:, :1]
        which |= starts[:, None] < begin + member.branches[..., -1].max(axis=1) + 0.1
        first = self.model.branched(
            near, np.repeat(branches, n, axis=0), self.layout, near_s, which
        )
        size = int(np.prod(self.layout.branch_shape))
        steps = np.concatenate([np.zeros((1, size)), DIFFERENCE * np.eye(size)])
        stepped = branches + steps.reshape(-1, 1, 1, *self.layout.branch_shape)
        n = len(stepped)
        second = self.model.branched(
            np.repeat(stems, n, axis=0), stepped, self.layout, np.repeat(revealed_s, n, axis=0)
        )
        return active, first, second

    def refine(self, member: Member, steps: int) -> Member:
        """Return a member after some steps of the sequential linear programme."""
        reach = 0.1
        for _step in range(steps):
            if not (member.segments[..., 1::2] > 0.0).any():
                return member
            active, first, second = self.slopes(member)
            if not np.isfinite(second.late_s[0]).all():
                return member
            step = programme(active, first, second, reach)
            if step is None:
                return member
            scales = np.array([2.0, 1.0, 0.4, 0.1])[:, None]
            segments = np.repeat(member.segments[None], len(scales), axis=0)
            flat = segments.reshape(len(scales), self.count, -1)
            flat[:, active[:, 0], active[:, 1]] += scales * step[: len(active)]
            branches = np.repeat(member.branches[None], len(scales), axis=0)
            if self.layout.branch:
                branches += (scales * step[len(active) :]).reshape(branches.shape)
            found = self.members(segments, branches)
            k = min(range(len(found)), key=lambda k: found[k].merit_m_s)
            gain = member.merit_m_s - found[k].merit_m_s
            if gain > 1e-5:
                member = found[k]
            reach *= float(scales[k, 0]) if gain > 0.0 else 0.05
            if reach < 1e-3:
                break
        return member

    def run(self, budget: int) -> list[float]:
        """Search with a number of simulations; return the best in m/s at parts of it, the whole last.

        Some populations one after the other, then one of the best of them all.
        """
        history: list[float] = []
        parts = [budget >> k for k in range(HALVINGS - 1, -1, -1)]
        begin, spent = self.model.runs, 0
        count = min(POPULATIONS, max(1, budget // LARGE))
        each = int((1.0 - LAST_SHARE) * budget / count)
        most = max(2 * FEWEST, each // A_POLICY)
        best: list[Member] = []
        for number in range(count + 1):
            population = self.first(most) if number < count else best
            start, until = spent, each * (number + 1) if number < count else budget
            size = len(population)
            while spent < until:
                share = (spent - start) / (until - start)
                population = self.generation(population, round(size * (1.0 - 1.3 * share)))
                spent = self.model.runs - begin
                while len(history) < HALVINGS and spent >= parts[len(history)]:
                    history.append(self.best.cost_m_s)
            best += sorted(population, key=lambda member: member.merit_m_s)[:FEWEST]
        return history

    def generation(self, population: list[Member], allowed: int) -> list[Member]:
        """Return the best policies of a population, of them and their children the softer ones."""
        population = sorted(population, key=lambda member: member.merit_m_s)[: max(FEWEST, allowed)]
        parents = np.resize(np.arange(len(population)), max(len(population), BATCH))
        for number, child in zip(parents, self.children(population, parents), strict=True):
            population[number] = min(population[number], child, key=lambda m: m.merit_m_s)
        for _time in range(max(1, len(population) // REFINED)):
            k = int(self.rng.integers(len(population)) * self.rng.random())
            new = self.refine(population[k], STEPS)
            population[k] = min(population[k], new, key=lambda m: m.merit_m_s)
            self.note(population[k])
        self.note(min(population, key=lambda member: member.merit_m_s))
        return population

    def first(self, count: int) -> list[Member]:
        """Return the first population: the best of many random policies."""
        n = 4 * count
        found = self.best_tries(self.random_segments(n), self.random_branches(n, FIRST_TRIES))
        return sorted(found, key=lambda member: member.merit_m_s)[:count]


def joined(segments: Floats) -> Floats:
    """Return the stems [n, valves, variables] of segments [n, k, valves, ...]."""
    return np.moveaxis(segments, 1, 2).reshape(
        len(segments), segments.shape[2], segments.shape[1] * segments.shape[3]
    )


def arrivals_of(model: FamilyModel, policy: Policy) -> Arrivals:
    """Return how a policy arrives, each figure [1, 1, loads]."""
    branches = policy.branches[None, None] if policy.layout.branch else None
    return model.fly(policy.stem[None], branches, policy.layout)


def stem_switches(policy: Policy) -> int:
    """Return how often the commands of a stem change, the start of the push not counted."""
    return int(np.isfinite(changes(*stem_spans(policy.stem))).sum())
