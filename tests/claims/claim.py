"""The list of claims (words: claims.toml), and the check of each: a function `_f07_...` in its chapter's module."""

from __future__ import annotations

import importlib
import re
import tomllib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec

CHAPTERS = ("equipment", "pneumatics", "oil", "verification", "truck", "trends", "optimal")

MET, PARTLY, NOT_MET, OPEN = "met", "partly", "not met", "cannot be shown"
GIVEN = "given"
"""The verdict where the simulation was given what is claimed, so that it shows nothing."""


class Outcome(NamedTuple):
    """What the simulation gave: verdict, figures, and a reason other than the usual one."""

    verdict: str
    figures: tuple[object, ...]
    reason: str = ""


class Claim(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One claim of the thesis: its number, section, wording, and a command that shows it, if there is one.

    achieved, reason: what the simulation gives, and why the claim is not met; format strings of
    figures until the claim is checked. verdict: empty until then, but where no simulation can decide.
    changed: how the judgement differs from the one of earlier releases, if it does.
    """

    id: str = ""
    section: str
    claimed: str
    achieved: str
    verdict: str = ""
    reason: str = ""
    changed: str = ""
    command: str = ""


def all_claims() -> list[Claim]:
    """Return every claim, in the order of its number."""
    text = Path(__file__).with_name("claims.toml").read_text(encoding="utf-8")
    tables = msgspec.convert(tomllib.loads(text), dict[str, Claim])
    return [msgspec.structs.replace(item, id=number) for number, item in sorted(tables.items())]


def check(item: Claim) -> Claim:
    """Run the simulation that shows a claim and fill in what it gives."""
    outcome = Outcome(item.verdict, ()) if item.verdict else _measurements()[item.id]()
    reason = "" if outcome.verdict == MET else outcome.reason or item.reason
    return msgspec.structs.replace(
        item,
        achieved=item.achieved.format(*outcome.figures),
        verdict=outcome.verdict,
        reason=reason.format(*outcome.figures),
    )


@cache
def _measurements() -> dict[str, Callable[[], Outcome]]:
    """Return the function that measures each claim, by its number."""
    modules = [importlib.import_module(f"tests.claims.{chapter}") for chapter in CHAPTERS]
    functions = [pair for module in modules for pair in vars(module).items()]
    named = re.compile(r"_f(\d\d\w*?)_")
    return {f"F{found[1]}": f for name, f in functions if (found := named.match(name))}


def judged(good: bool, *figures: object, verdict: str = MET, otherwise: str = NOT_MET) -> Outcome:
    """Return a verdict, met where no other is named, or the opposite one, with its figures."""
    return Outcome(verdict if good else otherwise, figures)


def markdown(findings: Iterable[Claim]) -> str:
    """Return checked claims as one page."""
    lines = [
        "# The thesis's claims",
        "",
        "Each claim of the thesis, and what the simulation gives. Written by `python -m tests.claims`.",
        "",
        "| claim | section | the thesis | here | verdict |",
        "|---|---|---|---|---|",
    ]
    for item in findings:
        why = f" ({item.reason})" if item.reason else ""
        why += f" *Judged anew: {item.changed}*" if item.changed else ""
        shown = f" `{item.command}`" if item.command else ""
        cells = [item.id, item.section, item.claimed, item.achieved + why + shown, item.verdict]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
