"""Improve the whole policies of short hunts, by passes with closer limits and by moves.

A move changes a policy at one segment or load: pulses come, go and change, branches, too. Then every
load takes the softest of some branches near its own. The best of a generation are refined by linear
programmes, and replace the hardest of the policies so far. So what a level of
`sil.studies.bound_search` drops early, because it suits only the loads that come later, is still
found. A late arrival costs more here: at the price of the hunts the softest policy may be some
microseconds late, which makes it none.
"""

from __future__ import annotations

import numpy as np

from sil.studies.bound_search import HALVINGS, HUNTS, PASSES, Search
from sil.studies.minimax import LATE_M_S_PER_S, merits
from sil.studies.policies import FamilyModel, Floats, Ints
from sil.studies.segments import ABSENT, Member

CHANGED, REFINED = 24, 2
"""Policies of a generation, and groups of them; the best of each is refined."""
ELITES, APART_M_S = 10, 0.003
"""Policies from which moves begin, and by how much one is harder than the next, at least."""
SAME_M_S = 1e-4
"""A move that changes no load by more than this is not followed."""
TRIES = 4
"""Branches that each load tries: its own, others near it, a random one."""
FIRST_STEPS, MORE_STEPS = 4, 8
"""Steps of a refinement, and of one that comes near the best."""
NEAR_M_S = 0.04
"""How near that is."""
KINDS = 0.3, 0.1, 0.25, 0.2, 0.15
"""How often a pulse is drawn anew, removed or moved, a branch drawn anew, another policy continued."""
EARLY = 0.5
"""How often a segment is changed on which the hardest load depends."""
AGAIN = 0.4
"""How often one more move follows."""
GREEDY = 2.0
"""Power by which the best policies are preferred as parents."""
FIRST_PRICE_M_S_PER_S = 50.0
"""What a late arrival costs at first, so that a move which softens a load may cost time."""
PRICE_M_S_PER_S, LATE_M_S = 3000.0, 1.0
"""What a late arrival costs: more than a later stop ever gains, and more than other loads have."""
ROUNDS, PASS = 8, 0.6
"""Rounds of a pass and of moves, and the share of the pass."""
ROUND_LIMITS = 0.6, 0.8, 0.92
"""Limits of the impact in these passes, see `sil.studies.bound_search.LIMITS`."""


class MovingSearch(Search):
    """A search of which a share of the simulations goes to passes and moves after its hunts."""

    def __init__(
        self, model: FamilyModel, valves: str, pulses: int, branch: int, seed: int, moves: float
    ) -> None:
        super().__init__(model, valves, pulses, branch, seed)
        self.moves = moves

    def run(self, budget: int, hunts: int = HUNTS) -> list[float]:
        """Search with a number of simulations; return the best in m/s at parts of it, the whole last."""
        begin, spent = self.model.runs, 0.0
        passes = [(1.0 - self.moves) / hunts * share / sum(PASSES) for share in PASSES]
        history: list[float] = []
        best: list[Member] = []

        def until(share: float) -> int:
            nonlocal spent
            spent += share
            while 2.0 ** (len(history) + 1 - HALVINGS) < 0.999 * spent:
                history.append(self.best.cost_m_s)
            return begin + int(budget * spent)

        for _hunt in range(hunts):
            found: list[Member] = []
            for share in passes:
                end = until(share)
                if self.model.runs < end or not (best or found):
                    found = self.one_pass(found, end)
            best += found
        self.limits = ROUND_LIMITS
        for _round in range(ROUNDS):
            self.price_m_s_per_s, self.late_m_s = LATE_M_S_PER_S, 0.0
            if self.model.runs < (end := until(PASS * self.moves / ROUNDS)):
                best = self.one_pass(self.elites(best), end)
            self.price_m_s_per_s, self.late_m_s = PRICE_M_S_PER_S, LATE_M_S
            best = [self.members(each.segments[None], each.branches[None])[0] for each in best]
            best = self.improved(self.distinct(best), until((1.0 - PASS) * self.moves / ROUNDS))
        return [*history, self.best.cost_m_s]

    def improved(self, elites: list[Member], until: int) -> list[Member]:
        """Return the best whole policies after moves up to a number of simulations, the best first."""
        while self.model.runs < until:
            found = []
            parents = self.rng.random(CHANGED) ** GREEDY * len(elites)
            self.price_m_s_per_s, self.late_m_s = FIRST_PRICE_M_S_PER_S, 0.0
            first = self.answered(elites, [elites[int(k)] for k in parents])
            first = [self.refine(member, FIRST_STEPS) for member in first]
            self.price_m_s_per_s, self.late_m_s = PRICE_M_S_PER_S, LATE_M_S
            for member in first:
                if member.merit_m_s < elites[0].merit_m_s + NEAR_M_S:
                    strict = self.members(member.segments[None], member.branches[None])[0]
                    found.append(self.refine(strict, MORE_STEPS))
            elites = self.distinct(elites + found)
            self.note(elites[0])
        return elites

    def distinct(self, members: list[Member]) -> list[Member]:
        """Return the best policies, none nearly as hard as a better one, the best first.

        Two equally hard ones mostly differ in pulses that do nothing for the hardest load.
        """
        found: list[Member] = []
        for member in sorted(members, key=lambda member: member.cost_m_s.max()):
            if not found or member.cost_m_s.max() > found[-1].cost_m_s.max() + APART_M_S:
                found.append(member)
        return found[:ELITES]

    def changed(self, elites: list[Member], parents: list[Member]) -> tuple[Floats, Floats]:
        """Return segments [n, k, ...] and branches [n, loads, ...] a few moves from their parents."""
        segments = np.array([parent.segments for parent in parents])
        branches = np.array([parent.branches for parent in parents])
        for parent, own, answers in zip(parents, segments, branches, strict=True):
            hardest = int(parent.cost_m_s.argmax())
            self.move(elites, hardest, own, answers)
            while self.rng.random() < AGAIN:
                self.move(elites, hardest, own, answers)
        return segments, branches

    def move(self, elites: list[Member], hardest: int, segments: Floats, branches: Floats) -> None:
        """Change a policy's segments [k, valves, ...] and branches [loads, valves, ...] by one move.

        hardest: the load that is the hardest before.
        """
        rng = self.rng
        k, valve = rng.integers(self.count), rng.integers(len(self.lead))
        if rng.random() < EARLY and self.layout.branch:
            k = rng.integers(self.rank[hardest] + 1)
        kind = rng.choice(len(KINDS), p=KINDS)
        if kind == 0:
            segments[k, valve] = self.random_segments(1)[0, k, valve]
        elif kind == 1:
            segments[k, valve, 1::2] = ABSENT
        elif kind == 2 or not self.layout.branch:
            step = 10.0 ** rng.uniform(-1.5, 0.2) * rng.standard_normal(segments[k].shape)
            step[np.repeat(segments[k, :, 1::2] <= ABSENT, 2, axis=-1)] = 0.0
            segments[k] += step * (rng.random(step.shape) < 0.5)
        elif kind == 3:
            branches[self.order[k], valve] = self.random_branches(1, 1)[0, 0, valve]
        else:
            other, later = elites[rng.integers(len(elites))], self.order[k:]
            segments[k:], branches[later] = other.segments[k:], other.branches[later]

    def answered(self, elites: list[Member], parents: list[Member]) -> list[Member]:
        """Return policies a few moves from their parents, each load with the softest branch tried."""
        segments, branches = self.changed(elites, parents)
        before = np.array([parent.cost_m_s for parent in parents])
        if not self.layout.branch:
            members = self.members(segments, branches)
            cost_m_s = np.array([member.cost_m_s for member in members])[:, None]
            return [members[k] for k in chosen(cost_m_s, before)]
        rng, loads = self.rng, branches.shape[1]
        tried = np.repeat(branches[:, None], TRIES, axis=1)
        near = tried[:, 1:-1]
        width = 10.0 ** rng.uniform(-2.0, 0.2, (*near.shape[:3], 1, 1))
        near += width * rng.standard_normal(near.shape) * (rng.random(near.shape) < 0.5)
        tried[:, -1] = self.random_branches(len(branches), loads)
        stems, revealed_s = self.stems(segments)
        arrivals = self.model.branched(stems, tried, self.layout, revealed_s)
        cost_m_s = merits(arrivals, self.price_m_s_per_s)
        best = chosen(cost_m_s, before)
        answers = tried[best[:, None], cost_m_s.argmin(axis=1)[best], np.arange(loads)]
        return self.members(segments[best], answers)


def chosen(cost_m_s: Floats, before_m_s: Floats) -> Ints:
    """Return the best of each group, by costs [n, tries, loads], of policies that are not as before.

    The first group is judged by the worst load, the others by the mean of all loads.
    """
    softest = cost_m_s.min(axis=1)
    worst = softest.mean(axis=1)
    worst[: len(worst) // REFINED] = softest.max(axis=1)[: len(worst) // REFINED]
    worst[np.abs(cost_m_s[:, 0] - before_m_s).max(axis=1) < SAME_M_S] = np.inf
    groups = np.arange(len(worst)).reshape(REFINED, -1)
    best: Ints = groups[np.arange(REFINED), worst[groups].argmin(axis=1)]
    return best
