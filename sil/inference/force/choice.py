"""Which hypotheses about a body are acceptable, and which of them leads.

Checked by: tests/unit/sil/inference/force/test_rig.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sil.inference.force.fit import Bank, ForceFit, TermGroup, gain_in_errors, jackknife
from sil.inference.force.record import Recorded
from sil.inference.force.terms import CONDITIONS
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.verdict import Verdict, decide


@dataclass(frozen=True)
class ForceChoice:
    """The hypotheses about a record: tried, the plain body first; judged, the best first; the verdict."""

    bank: Bank
    tried: Sequence[ForceFit]
    judged: Sequence[ForceFit]
    verdict: Verdict[ForceFit]

    @property
    def leader(self) -> ForceFit:
        """The hypothesis accepted."""
        return self.verdict.leader

    @property
    def closest(self) -> ForceFit:
        """The hypothesis that leaves least, acceptable or not."""
        return min(self.tried, key=lambda item: item.rms_n)

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what the leader leaves."""
        return self.leader.rms_n <= LIMITS.max_residual_ratio * self.leader.noise_n


def choose(record: Recorded) -> ForceChoice:
    """Fit all hypotheses to a record and decide between those that are physical."""
    bank = Bank(record)
    tried = [bank.attempt(())] if bank.is_constant() else bank.all_tried()
    bank.calibrate(tried)
    by_names = {frozenset(item.names): item for item in tried}
    judged = [item for item in tried if acceptable(item, by_names)]
    judged.sort(key=lambda item: item.score)
    while True:
        verdict = decide(judged, len(tried[0].squares))
        if all(has_one_value(bank, verdict.leader, group) for group in verdict.leader.groups):
            return ForceChoice(bank, tried, judged, verdict)
        judged.remove(verdict.leader)


def has_one_value(bank: Bank, item: ForceFit, group: TermGroup) -> bool:
    """Return whether a cause has the same value in both halves of the samples, by each condition.

    A term that only makes up for one that is missing has another value where that acts more. Halves
    that determine the value poorly contradict nothing.
    """
    if group.id == UNNAMED:
        return True
    k = bank.columns_of(item.groups).index(group.columns[0])
    for condition in CONDITIONS.values():
        values = condition(bank.record.raw)[bank.record.judged]
        middle = np.median(values)
        for rows in (values < middle, values >= middle):
            if len(np.unique(bank.fold[rows])) < 2:
                continue
            half, without = bank.unbounded(item.groups, rows)
            ratio = half[k] / item.values[k]
            error = 2.0 * jackknife(without - half)[k] / abs(item.values[k])
            if (
                ratio + error < 1.0 / LIMITS.max_value_ratio
                or ratio - error > LIMITS.max_value_ratio
            ):
                return False
    return True


def acceptable(item: ForceFit, by_names: dict[frozenset[str], ForceFit]) -> bool:
    """Return whether a hypothesis is physical and gains by each of its causes."""
    if not item.groups:
        return True
    if not item.physical():
        return False
    for name in item.names:
        without = by_names[frozenset(item.names) - {name}]
        if gain_in_errors(item, without) < LIMITS.min_standard_errors:
            return False
        if without.groups and without.rms_n <= LIMITS.max_residual_ratio * without.noise_n:
            return False  # nothing is missing: the cause corrects the form of the other one
        if item.whole.excess > 0.5 * max(without.whole.excess, 0.0):
            return False
    return True
