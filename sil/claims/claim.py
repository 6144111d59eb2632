"""What a claim is, the list of them, and how one is checked."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from can_dbc.errors import InputError, nearest

CHAPTERS = ("equipment", "pneumatics", "oil", "verification", "truck", "trends")

MET, PARTLY, NOT_MET, OPEN = "met", "partly", "not met", "cannot be shown"


class Outcome(NamedTuple):
    """What the simulation gave: verdict, the figures in words, and the reason if it is not met."""

    verdict: str
    achieved: str
    reason: str = ""


@dataclass(frozen=True)
class Claim:
    """One claim: its number in the list of facts, section, wording, and what shows it."""

    id: str
    section: str
    text: str
    show: Callable[[], Outcome]
    command: str


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


_REGISTRY: dict[str, Claim] = {}


def claim(
    number: str, section: str, text: str, command: str | None = None
) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Register a function as what shows claim `number`; the command defaults to this list's own."""

    def register(show: Callable[[], Outcome]) -> Callable[[], Outcome]:
        if number in _REGISTRY:
            raise ValueError(f"claim {number} stands twice")
        _REGISTRY[number] = Claim(number, section, text, show, command or f"opc4 claims {number}")
        return show

    return register


def all_claims() -> list[Claim]:
    """Every claim, in the order of its number."""
    for chapter in CHAPTERS:
        importlib.import_module(f"sil.claims.{chapter}")
    return sorted(_REGISTRY.values(), key=lambda item: order(item.id))


def order(number: str) -> tuple[int, str]:
    """Sort key of a claim's number: F09 < F34 < F34b."""
    found = re.fullmatch(r"F(\d+)(\w*)", number)
    return (int(found[1]), found[2]) if found else (10_000, number)


def chosen(names: Iterable[str]) -> list[Claim]:
    """The claims of these numbers, all for none; InputError with the nearest for an unknown one."""
    known = {item.id: item for item in all_claims()}
    wanted = list(names)
    for name in wanted:
        if name not in known:
            near = nearest(name, known, cutoff=0.3) or list(known)[:3]
            raise InputError(f"claim {name!r}: no such claim; nearest: {', '.join(near)}")
    return [known[name] for name in wanted] or list(known.values())


def check(item: Claim) -> Finding:
    """Run what shows a claim."""
    outcome = item.show()
    return Finding(
        item.id,
        item.section,
        item.text,
        outcome.achieved,
        outcome.verdict,
        outcome.reason,
        item.command,
    )


def judged(good: bool, achieved: str, reason: str = "") -> Outcome:
    """Met, or not met with the reason."""
    return Outcome(MET if good else NOT_MET, achieved, "" if good else reason)
