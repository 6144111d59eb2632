"""None of the named: when the best named hypothesis leaves structure, try terms in its place.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sil.diagnosis.floor import strained
from sil.diagnosis.judge import Judged
from sil.diagnosis.search import Found, Search, Task
from sil.diagnosis.terms import term_candidates
from sil.diagnosis.verdict import Verdict
from sil.fitting.hypotheses import compatible

TERM_ITERATIONS = 6
TERMS_KEPT = 2

SMALL = 1e-3
"""A misfit beyond noise of this share of the healthy model's is a detail of the cause's form."""


def try_terms(
    search: Search,
    found: Found,
    verdict: Verdict,
    judged: Sequence[Judged],
    told: Callable[[str], None],
) -> bool:
    """Fit non-parametric terms alone and beside the best single; True if any was tried.

    Only if the leading hypothesis leaves more than the band of a clean campaign and a detail, or
    owes its agreement to scatter that healthy strokes do not have.
    """
    best = min(judged, key=lambda item: item.score)
    detail = SMALL * max(1.0, verdict.healthy.whole.excess) + 0.02 * best.whole.count
    if best.whole.beyond > detail:
        told(
            f"the best named hypothesis, {best.name}, leaves {best.whole.rms:.3g} of the expected "
            "scatter: terms"
        )
    elif strained(best.training):
        told(f"the best named hypothesis, {best.name}, takes strokes that differ too much: terms")
    else:
        return False
    tasks = []
    singles = found.of_size(1)
    parents = [found.healthy]
    if singles and singles[0].cost < 0.5 * found.healthy.cost:
        parents.append(singles[0])
    for _place, candidate in term_candidates():
        for parent in parents:
            if not compatible(candidate, parent.candidates):
                continue
            own = tuple(
                tuple(table[p.name] for p in item.parameters)
                for item, table in zip(parent.candidates, parent.values, strict=True)
            )
            tasks.append(
                Task(
                    (*parent.candidates, candidate),
                    tuple((*own, start) for start in candidate.starts),
                    (parent.shared, parent.stroke),
                    TERM_ITERATIONS,
                )
            )
    done = search.run_tasks(tasks)
    search.polish(found, done[:TERMS_KEPT])
    return bool(done)
