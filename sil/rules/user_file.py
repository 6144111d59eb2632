"""Rules of a user's own, from a Python file."""

from __future__ import annotations

import runpy
import traceback

from can_dbc.errors import InputError
from can_dbc.user_file import exits_raise, read_user_file
from sil.rules.rule import Rule
from sil.rules.shipped import RULES


def load_rules(file: str | None) -> tuple[Rule, ...]:
    """Return the shipped rules, and those that `RULES` in a file lists.

    Raises InputError naming the file, the line and what is wrong.
    """
    if file is None:
        return RULES
    read_user_file(file, "a Python file with RULES")
    try:
        with exits_raise():
            names = runpy.run_path(file)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
        line = getattr(error, "lineno", None) or (lines[-1] if lines else 1)
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"{file}: line {line}: {what}; expected a list RULES of rules") from None
    rules = names.get("RULES")
    if not isinstance(rules, list | tuple) or not all(isinstance(rule, Rule) for rule in rules):
        raise InputError(f"{file}: RULES: not a list of sil.rules.Rule; expected one")
    taken = {rule.name for rule in RULES}
    for rule in rules:
        if rule.name in taken:
            raise InputError(f"{file}: RULES: {rule.name!r} is taken; expected another name")
        taken.add(rule.name)
    return (*RULES, *rules)
