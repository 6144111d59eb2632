"""Search the softest worst-case arrival over the loads of a family.

A policy is a stem with a branch for each load, see `sil.studies.policies`. Here the stem is a row of
segments: segment k is timed from where the branch of the load before it begins, so a change of an
early segment moves all later ones along with the releases.

Two parts work together. The global one is evolutionary: new policies join the segments and branches
up to some load of one parent with those after it of another, then change one segment. The local one
is a sequential linear programme: slopes of every impact and arrival by finite differences, then the
step that lowers the worst load most while all arrive in time. Every value found belongs to a policy
that exists: it is an upper estimate of the true bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sil.studies.minimax import DIFFERENCE, MEAN_WEIGHT, merits, programme, screened
from sil.studies.policies import Arrivals, Bools, FamilyModel, Floats, Ints, Layout
from sil.studies.pulses import changes, stem_spans

UNITS_PER_S = 100.0
ABSENT = -0.2
"""Length of a pulse that is not there, in 10 ms."""
NO_CUT = 30.0
"""Time, in 10 ms after a branch begins, that is later than any arrival."""
POPULATION = 12
CHILDREN = 60
KEPT = 8
"""New policies of a generation."""
TRIES = 12
"""Branches tried for each load of a new policy."""
NEAR_M_S = 0.05
"""A new policy that is harder than its parent by more than this is not refined further."""
LEAST_LINES = 2
"""Policies with descendants at the end of a search."""
STEPS = 5
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

    @property
    def screened_m_s(self) -> float:
        """A smooth mean near the worst load."""
        return float(screened(self.cost_m_s))


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

    def best_members(self, segments: Floats, branches: Floats, count: int) -> list[Member]:
        """Return the best of segments [n, ...], each load with the best of its branches [n, tries, ...].

        Branches of different tries may need the same coil at the same time, so they are tried together.
        """
        cost_m_s = merits(self.fly(segments, branches))
        chosen = np.argsort(screened(cost_m_s.min(axis=1)))[:count]
        rows, loads = chosen[:, None], np.arange(self.model.loads)
        tries = cost_m_s.argmin(axis=1)[chosen]
        return self.members(segments[chosen], branches[rows, tries, loads])

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
        """Return random segments [n, k, valves, variables]."""
        shape = n, self.count, len(self.lead), self.pulses
        start = self.rng.uniform(0.0, 1.0, shape) * (self.spans[:, None, None] + 0.5)
        length = self.rng.exponential(1.2, shape)
        length = np.where(self.rng.random(shape) < 0.6 / self.pulses, length, ABSENT)
        early = self.rng.random(shape) * self.lead[:, None]
        start[:, 1:] -= early[:, 1:]
        return np.stack([start, length], axis=-1).reshape(*shape[:-1], -1)

    def random_branches(self, n: int) -> Floats:
        """Return random branches [n, loads, valves, variables]; half of the pulses are armed."""
        shape = n, self.model.loads, len(self.lead), max(self.layout.branch, 0)
        start = self.rng.uniform(0.0, 1.0, shape)
        length = np.where(self.rng.random(shape) < 0.6, self.rng.exponential(1.2, shape), ABSENT)
        early = self.lead[:, None] * self.rng.uniform(0.2, 1.0, shape)
        armed = self.rng.random(shape) < 0.6
        start = np.where(armed, -early, start)
        length = np.where(armed & (length > 0.0), length + early, length)
        cut = np.where(
            self.rng.random(shape[:3]) < 0.5, self.rng.uniform(0, 1.5, shape[:3]), NO_CUT
        )
        return np.concatenate(
            [np.stack([start, length], axis=-1).reshape(*shape[:3], -1), cut[..., None]], axis=-1
        )

    def crossed(self, one: Member, other: Member) -> Member:
        """Return a policy of one's segments and branches up to some load, and the other's after it."""
        cut = self.rng.integers(1, self.count)
        later = (self.rank >= cut)[:, None, None]
        (member,) = self.members(
            np.concatenate([one.segments[:cut], other.segments[cut:]])[None],
            np.where(later, other.branches, one.branches)[None],
        )
        return member

    def changed(self, member: Member, k: int) -> tuple[Floats, Floats]:
        """Return segments [n, k, ...] of which the k-th is changed, and how far [n, 1, 1], in 10 ms."""
        rng, n = self.rng, CHILDREN
        segments = np.repeat(member.segments[None], n, axis=0)
        width = 10.0 ** rng.uniform(-2.0, 0.3, (n, 1, 1))
        fresh = rng.random((n, len(self.lead), self.pulses)) < rng.uniform(0.0, 0.6, (n, 1, 1))
        part = np.where(np.repeat(fresh, 2, axis=2), self.random_segments(n)[:, k], segments[:, k])
        segments[:, k] = part + width * rng.standard_normal(part.shape) * (part > ABSENT)
        return segments, width

    def children(self, member: Member) -> list[Member]:
        """Return new policies with another segment, and another branch of the load that it serves.

        Half of the time that is the worst load. They are chosen by that load alone.
        """
        rng, n = self.rng, CHILDREN
        worst = int(member.cost_m_s.argmax())
        load = worst if rng.random() < 0.5 else int(rng.integers(self.model.loads))
        rank = int(self.rank[load]) if self.layout.branch else 0
        k = max(0, rank - int(rng.random() < 0.25))
        segments, width = self.changed(member, k)
        if not self.layout.branch:
            return self.best_members(segments, member.branches[None, None].repeat(n, axis=0), KEPT)
        branches = np.repeat(member.branches[None, None], TRIES, axis=1).repeat(n, axis=0)
        near = width * rng.standard_normal((n, TRIES, *self.layout.branch_shape))[:, :, None]
        branches[:, 1 : TRIES // 2, load] += near[:, 1 : TRIES // 2, 0]
        branches[:, TRIES // 2 :, load] = self.random_branches(n * TRIES).reshape(
            n, TRIES, self.model.loads, *self.layout.branch_shape
        )[:, TRIES // 2 :, load]
        _stem, known_s = self.stems(member.segments[None])
        stems, revealed_s = self.stems(segments, np.full(n, k), known_s, rank + 1)
        which = np.zeros((n, self.model.loads), dtype=np.bool_)
        which[:, load] = True
        found = self.model.branched(stems, branches, self.layout, revealed_s, which)
        cost_m_s = merits(found)[:, :, load]
        tries = cost_m_s.argmin(axis=1)
        chosen = cost_m_s.min(axis=1).argsort()[:KEPT]
        return self.members(segments[chosen], branches[chosen, tries[chosen]])

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
        """Search with a number of simulations; return the best in m/s at parts of it, the whole last."""
        history: list[float] = []
        parts = [budget >> k for k in range(HALVINGS - 1, -1, -1)]
        begin = self.model.runs
        population = self.first()
        turn = 0
        while len(history) < HALVINGS:
            spent = self.model.runs - begin
            allowed = max(LEAST_LINES, round(POPULATION * (1.0 - 1.5 * spent / budget)))
            population = sorted(population, key=lambda m: m.merit_m_s)[:allowed]
            turn = (turn + 1) % len(population)
            parent = population[turn]
            if self.count > 1 and self.rng.random() < 0.1:
                other = population[self.rng.integers(len(population))]
                found = [self.crossed(parent, other), self.crossed(other, parent)]
            else:
                found = sorted(self.children(parent), key=lambda m: m.screened_m_s)
            for k in (0, int(self.rng.integers(1, len(found)))):
                new = self.refine(found[k], 2)
                if new.merit_m_s < population[turn].merit_m_s + NEAR_M_S:
                    new = self.refine(new, STEPS)
                self.note(new)
                if new.merit_m_s < population[turn].merit_m_s:
                    population[turn] = new
            spent = self.model.runs - begin
            while len(history) < HALVINGS and spent >= parts[len(history)]:
                history.append(self.best.cost_m_s)
        return history

    def first(self) -> list[Member]:
        """Return the first population: the best of many random policies."""
        n = 6 * POPULATION
        branches = self.random_branches(n * TRIES).reshape(
            n, TRIES, self.model.loads, *self.layout.branch_shape
        )
        return self.best_members(self.random_segments(n), branches, POPULATION)


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
