"""The list of claims, and the check of each.

claims.toml holds the wording; the modules named in `CHAPTERS` hold a function for each claim, marked
with `shows`. To add a claim: its table in claims.toml, and a function in the module of its chapter.
"""

from __future__ import annotations

import importlib
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from can_dbc.errors import InputError, nearest

CHAPTERS = ("equipment", "pneumatics", "oil", "verification", "truck", "trends")

MET, PARTLY, NOT_MET, OPEN = "met", "partly", "not met", "cannot be shown"


class Outcome(NamedTuple):
    """What the simulation gave: verdict, the figures in words, and the reason if it is not met."""

    verdict: str
    achieved: str
    reason: str = ""


class Claim(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One claim: number in the list of facts, section, wording, and the command that shows it.

    outcome: given where no simulation can decide the claim.
    """

    section: str
    text: str
    command: str = ""
    outcome: Outcome | None = None
    id: str = ""


@dataclass(frozen=True)
class Finding:
    """A checked claim."""

    id: str
    section: str
    claimed: str
    achieved: str
    verdict: str
    reason: str
    command: str


Show = Callable[[], Outcome]
_SHOWN: dict[str, Show] = {}


def shows(number: str) -> Callable[[Show], Show]:
    """Register a function as the check of claim `number`."""

    def register(show: Show) -> Show:
        _SHOWN[number] = show
        return show

    return register


def all_claims() -> list[Claim]:
    """Return every claim, in the order of its number."""
    text = Path(__file__).with_name("claims.toml").read_text(encoding="utf-8")
    tables = msgspec.convert(tomllib.loads(text), dict[str, Claim])
    return [
        msgspec.structs.replace(item, id=number, command=item.command or f"opc4 claims {number}")
        for number, item in sorted(tables.items(), key=lambda pair: order(pair[0]))
    ]


def order(number: str) -> tuple[int, str]:
    """Return the sort key of a claim's number: F09 < F34 < F34b."""
    found = re.fullmatch(r"F(\d+)(\w*)", number)
    return (int(found[1]), found[2]) if found else (10_000, number)


def chosen(names: Iterable[str]) -> list[Claim]:
    """Return the claims of these numbers, all if there are none.

    Raises InputError, with the nearest numbers, for an unknown one.
    """
    known = {item.id: item for item in all_claims()}
    wanted = list(names)
    for name in wanted:
        if name not in known:
            near = nearest(name, known, cutoff=0.3) or list(known)[:3]
            raise InputError(f"claim {name!r}: no such claim; nearest: {', '.join(near)}")
    return [known[name] for name in wanted] or list(known.values())


def check(item: Claim) -> Finding:
    """Run the simulation that shows a claim."""
    for chapter in CHAPTERS:
        importlib.import_module(f"sil.claims.{chapter}")
    verdict, achieved, reason = item.outcome or _SHOWN[item.id]()
    return Finding(item.id, item.section, item.text, achieved, verdict, reason, item.command)


def judged(good: bool, achieved: str, reason: str = "") -> Outcome:
    """Return met, or not met with the reason."""
    return Outcome(MET if good else NOT_MET, achieved, "" if good else reason)
