"""Rules of a user's own, from a Python file."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.user_file import before_running, error_text, exits_raise, read_user_file
from sil.recording.run_record import RunRecord
from sil.rules.rule import Broken, Circumstances, Rule
from sil.rules.shipped import RULES


def load_rules(file: str | None) -> tuple[Rule, ...]:
    """Return the shipped rules, and those that `RULES` in a file lists.

    Raises InputError naming the file, the line and what is wrong, also where a rule fails on a run.
    """
    if file is None:
        return RULES
    read_user_file(file, "a Python file with RULES")
    for prepare in before_running:
        prepare(file)
    try:
        with exits_raise():
            names = runpy.run_path(file)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        what = error_text(Path(file), 1, error)
        raise InputError(f"{what}; expected a list RULES of rules") from None
    rules = names.get("RULES")
    if not isinstance(rules, list | tuple) or not all(isinstance(rule, Rule) for rule in rules):
        raise InputError(f"{file}: RULES: not a list of sil.rules.Rule; expected one")
    taken = {rule.name for rule in RULES}
    for rule in rules:
        if rule.name in taken:
            raise InputError(f"{file}: RULES: {rule.name!r} is taken; expected another name")
        taken.add(rule.name)
    return (*RULES, *(_guarded(rule, Path(file)) for rule in rules))


def _guarded(rule: Rule, file: Path) -> Rule:
    """Return a rule whose errors on a run are of one line."""
    line = getattr(getattr(rule.first, "__code__", None), "co_firstlineno", 1)

    def first(record: RunRecord, circumstances: Circumstances) -> Broken:
        try:
            with exits_raise():
                answer = rule.first(record, circumstances)
                if answer is not None:
                    time_s, text = answer
                    answer = float(time_s), str(text)
                return answer
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | MemoryError):
                raise
            what = f"{error_text(file, line, error)}; expected None, or an instant in s and a text"
            raise InputError(f"{what}, of rule {rule.name!r}") from None

    return replace(rule, first=first)
