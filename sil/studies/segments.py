"""Policies whose stem is a row of segments, one for each load: simulated, and refined.

Segment k is timed from where the branch of the load before it begins, so a change of an early segment
moves all later ones along with the releases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sil.studies.minimax import DIFFERENCE, LATE_M_S_PER_S, MEAN_WEIGHT, merits, programme
from sil.studies.policies import Arrivals, Bools, FamilyModel, Floats, Ints, Layout

UNITS_PER_S = 100.0
ABSENT = -0.2
"""Length of a pulse that is not there, in 10 ms."""


@dataclass(frozen=True)
class Member:
    """A whole policy: segments [k, valves, ...], branches [loads, valves, ...], cost [loads]."""

    segments: Floats
    branches: Floats
    cost_m_s: Floats

    @property
    def merit_m_s(self) -> float:
        """The worst load, and a little of the others."""
        return float(self.cost_m_s.max() + MEAN_WEIGHT * self.cost_m_s.sum())


class SegmentModel:
    """Policies of segments for a family: stems, simulation, slopes, refinement.

    branch: pulses of each valve in a branch, 0 for no branches; pulses: of each valve in a segment.
    """

    def __init__(self, model: FamilyModel, valves: str, pulses: int, branch: int) -> None:
        self.model = model
        self.order = model.order
        self.rank = np.argsort(self.order)
        self.count = model.loads if branch else 1
        self.pulses = pulses
        self.price_m_s_per_s, self.late_m_s = LATE_M_S_PER_S, 0.0
        self.layout = Layout(valves, self.count * pulses, branch)
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

    def members(self, segments: Floats, branches: Floats) -> list[Member]:
        """Return members of segments [n, ...] and branches [n, loads, ...]."""
        stems, revealed_s = self.stems(segments)
        if self.layout.branch:
            found = self.model.branched(stems, branches[:, None], self.layout, revealed_s)
        else:
            found = self.model.fly(stems, None, self.layout)
        cost_m_s = merits(found, self.price_m_s_per_s, self.late_m_s)[:, 0]
        return [Member(*each) for each in zip(segments, branches, cost_m_s, strict=True)]

    def topology(self, segments: Floats) -> Floats:
        """Return a number [n] for which pulses of segments [n, k, valves, ...] move a plunger."""
        moves = (segments[..., 1::2] > self.lead[:, None]).reshape(len(segments), -1)
        found: Floats = moves @ 2.0 ** np.arange(moves.shape[1])
        return found

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
            step = programme(active, first, second, reach, self.price_m_s_per_s)
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


def joined(segments: Floats) -> Floats:
    """Return the stems [n, valves, variables] of segments [n, k, valves, ...]."""
    return np.moveaxis(segments, 1, 2).reshape(
        len(segments), segments.shape[2], segments.shape[1] * segments.shape[3]
    )
