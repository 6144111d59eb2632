"""The scores of the study of rivals: python -m tests.bench rivals."""

from __future__ import annotations

import pytest

from tests.bench.rivals import NONE, WAYS, brier, table


@pytest.mark.parametrize(
    ("stated", "expected"),
    [({"a": 1.0}, 0.0), ({"b": 1.0}, 2.0), ({}, 1.0), ({"a": 0.5, NONE: 0.5}, 0.5)],
)
def test_brier_score_of_a_cause(stated, expected) -> None:
    assert brier(stated, "a") == pytest.approx(expected)


def test_only_what_exceeds_every_clean_campaign_counts_as_detected() -> None:
    def row(true, stated, score):
        return {"true": true, "found": {way: [stated, score, 1.0] for way in WAYS}}

    rows = [
        row(NONE, {NONE: 1.0}, 2.0),
        row("a", {"a": 1.0}, 1.0),
        row("b", {"c": 1.0}, 3.0),
    ]
    lines = list(table(rows))
    assert lines[0].startswith("3 campaigns") and len(lines) == 3 + len(WAYS)
    assert all(line.endswith("| 0.67 | 1 of 2 | 1 of 2 | 1 of 1 | 1 |") for line in lines[3:])
