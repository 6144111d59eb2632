"""Rules from a user's file: whatever they do is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.rules.shipped import RULES
from sil.rules.user_file import load_rules

FILE = """\
import os, sys
from sil.rules import Rule
{load}
def own(record, circumstances):
    {run}

RULES = [Rule("own", "A sentence.", "us", own)]
"""


def rules(folder: Path, load: str = "", run: str = "return None"):
    """Return the rules of a file with these statements."""
    path = folder / "own.py"
    path.write_text(FILE.format(load=load, run=run))
    return load_rules(str(path))


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("sys.exit(0)", "SystemExit: 0"),
        ("os._exit(0)", r"ProcessExit: os._exit\(0\)"),
        ("def f(): f()\nf()", "RecursionError: maximum recursion depth exceeded"),
    ],
)
def test_a_file_that_cannot_be_loaded(tmp_path: Path, statement: str, error: str) -> None:
    with pytest.raises(InputError, match=rf"own\.py:3: {error}.*; expected a list RULES of rules$"):
        rules(tmp_path, load=statement)


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("sys.exit(0)", "SystemExit: 0"),
        ("os._exit(0)", r"ProcessExit: os._exit\(0\)"),
        ("own(record, circumstances)", "RecursionError"),
        ("return 'broken'", "ValueError"),
    ],
)
def test_a_rule_that_fails_on_a_run(tmp_path: Path, statement: str, error: str) -> None:
    *shipped, own = rules(tmp_path, run=statement)
    assert tuple(shipped) == RULES
    with pytest.raises(InputError, match=rf"own\.py:\d: {error}.*, of rule 'own'$"):
        own.first(None, None)  # type: ignore[arg-type]


def test_what_a_rule_returns_is_kept(tmp_path: Path) -> None:
    assert rules(tmp_path)[-1].first(None, None) is None  # type: ignore[arg-type]
    broken = rules(tmp_path, run="return 1, 'hard'")[-1].first(None, None)  # type: ignore[arg-type]
    assert broken == (1.0, "hard")
