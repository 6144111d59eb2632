"""The study's own bookkeeping: scores, intervals, tables, resuming; shuffled answers score badly."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from tests.support.hidden_study import Row, interval, read_rows, tables
from tests.support.instruments import outcome


def row(names: tuple[str, ...], found: tuple[tuple[str, str, float], ...], **more) -> Row:
    usual = {
        "number": 1,
        "case": "one" if names else "none",
        "level": "easy",
        "names": names,
        "classes": tuple("friction" for _ in names),
        "verdict": "named" if found else "consistent",
        "found": found,
        "rivals": (),
        "before": 3.0,
        "after": 1.0,
        "seconds": 1.0,
    }
    return Row(**{**usual, **more})


LEAK = (("piston_leak", "leak", 0.98),)
RIVALS = (("inlet_clog", "flow restriction", 0.5), ("supply_low", "supply", 0.45))


def test_a_row_counts_what_was_right() -> None:
    assert row(("piston_leak",), LEAK).right_first == 1.0
    assert row(("stribeck",), LEAK).right_first == 0.0
    assert row(("stribeck",), LEAK).wrong_name == 0.98
    assert row(("piston_leak",), LEAK).on_truth == 0.98
    group = row(("supply_low",), RIVALS, rivals=(("inlet_clog", "supply_low"),))
    assert group.right_first == 0.5
    assert row(("piston_leak",), ()).right_first == 0.0


def test_shuffled_answers_score_badly() -> None:
    rows = [row((name,), ((name, "x", 0.9),)) for name in ("a", "b", "c", "d")]
    assert sum(r.right_first for r in rows) == 4.0
    shuffled = [
        replace(r, names=other.names) for r, other in zip(rows, rows[1:] + rows[:1], strict=True)
    ]
    assert sum(r.right_first for r in shuffled) == 0.0
    assert "right cause first: 0 of 4" in "\n".join(tables(rows))
    text = "\n".join(tables(shuffled))
    assert "right cause first, one: 0 of 4" in text
    assert "0.90: 0 of 4" in text


def test_wilson_intervals() -> None:
    low, high = interval(0, 100)
    assert low == 0.0 and high == pytest.approx(0.037, abs=0.001)
    low, high = interval(95, 100)
    assert low == pytest.approx(0.888, abs=0.001) and high == pytest.approx(0.978, abs=0.001)


def test_tables_say_what_there_is() -> None:
    rows = [
        row((), ()),
        row((), LEAK),
        row(("piston_leak",), LEAK),
        row(("drag of speed squared",), (("unnamed", "friction", 0.7),), case="foreign"),
    ]
    text = "\n".join(tables(rows))
    assert "false alarms on clean campaigns: 1 of 2" in text
    assert "detected, easy: 1 of 1" in text
    assert "unnamed first, in the right class: 1 of 1" in text
    assert "nothing -> leak: 1" in text


def test_rows_come_back_from_disk(tmp_path) -> None:
    path = tmp_path / "results.jsonl"
    assert read_rows(path) == []
    stored = row(("supply_low",), RIVALS, rivals=(("inlet_clog", "supply_low"),))
    path.write_text(json.dumps(asdict(stored)) + "\n", encoding="utf-8")
    assert read_rows(path) == [stored]


@pytest.mark.parametrize(
    ("verdict", "found", "rivals", "expected"),
    [
        ("named", [("free_play", 0.98)], [], "right"),
        ("ambiguous", [("detent", 0.6), ("free_play", 0.4)], [["detent", "free_play"]], "unable"),
        ("unnamed", [("unnamed", 0.98)], [], "unable"),
        ("cannot_tell", [], [], "unable"),
        ("named", [("detent", 0.98)], [], "wrong"),
        ("consistent", [], [], "wrong"),
    ],
)
def test_an_answer_with_other_instruments_is_right_unable_or_wrong(
    verdict, found, rivals, expected
) -> None:
    def cause(name: str, p: float = 1.0) -> dict:
        value = {"travel_m": {"value": 2e-4}}
        return {"id": name, "class": "mechanics", "probability": p, "parameters": value}

    limit = {"id": "free_play", "parameter": "travel_m", "size": 1e-4, "neutral": 0.0}
    answer = {"verdict": verdict, "rivals": rivals, "causes": [cause(*item) for item in found]}
    hidden = [cause("free_play")]
    assert outcome(hidden, answer | {"detectable": [limit]}) == expected
    other = limit | {"others": {"travel_m": 1e-3}}  # stated for another value than the hidden one's
    unsaid = "unable" if verdict == "consistent" else expected
    assert outcome(hidden, answer | {"detectable": [other]}) == unsaid
    small = answer | {"detectable": [limit | {"size": 3e-4}]}
    assert outcome(hidden, small) == ("unable" if verdict == "consistent" else expected)
    assert (outcome([], answer) == "wrong") == bool(found)
