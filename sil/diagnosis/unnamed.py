"""None of the named: when the best named hypothesis leaves structure, try terms in its place.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .hypotheses import compatible
from .judge import Judged
from .search import Found, Search, Task
from .terms import term_candidates
from .verdict import Verdict

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

    Only if the leading hypothesis leaves more than the band of a clean campaign and a detail.
    """
    best = min(judged, key=lambda item: item.score)
    if best.whole.beyond <= SMALL * max(1.0, verdict.healthy.whole.excess) + 0.02 * best.whole.count:
        return False
    told(
        f"the best named hypothesis, {best.name}, leaves {best.whole.rms:.3g} of the expected "
        "scatter: terms"
    )
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
                    ((*own, candidate.starts[0]),),
                    (parent.shared, parent.stroke),
                    TERM_ITERATIONS,
                )
            )
    done = search.run_tasks(tasks)
    search.polish(found, done[:TERMS_KEPT])
    return bool(done)
