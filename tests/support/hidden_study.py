"""Hidden effects: how often the diagnosis finds what an independent implementation hid.

Rows are stored one by one in $OPC4_STUDY, so that a stopped study goes on; $OPC4_STUDY_CAMPAIGNS: how many,
$OPC4_FIRST: from which number on, $OPC4_CASES: only such as "none,foreign".
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from math import sqrt
from pathlib import Path
from typing import Any

STROKES = 10
BINS = (0.0, 0.3, 0.6, 0.9, 1.0)


@dataclass(frozen=True)
class Row:
    """What was hidden and found: (id, class, probability); residuals held out, standardised."""

    number: int
    case: str
    level: str
    names: tuple[str, ...]
    classes: tuple[str, ...]
    verdict: str
    found: tuple[tuple[str, str, float], ...]
    rivals: tuple[tuple[str, ...], ...]
    before: float
    after: float
    seconds: float

    @property
    def right_first(self) -> float:
        """1 if the first cause is one that was hidden, a rival group counting as its share."""
        if not self.found:
            return 0.0
        first = self.found[0][0]
        if first in self.names:
            return 1.0
        for group in self.rivals:
            if first in group and set(group) & set(self.names):
                return 1.0 / len(group)
        return 0.0

    @property
    def on_truth(self) -> float:
        """Mean probability given to what was hidden."""
        stated = {name: p for name, _class, p in self.found}
        return sum(stated.get(name, 0.0) for name in self.names) / max(1, len(self.names))

    @property
    def wrong_name(self) -> float:
        """Largest probability given to a named cause that was not hidden."""
        return max(
            (p for n, _class, p in self.found if n not in self.names and n != "unnamed"),
            default=0.0,
        )


def row_of(number: int, case: str, hidden: Any, plain: dict[str, Any], seconds: float) -> Row:
    """A row from what was hidden and diagnosis.json's object."""
    return Row(
        number,
        case,
        hidden.level,
        tuple(hidden.names),
        tuple(hidden.classes),
        plain["verdict"],
        tuple((c["id"], c["class"], c["probability"]) for c in plain["causes"]),
        tuple(tuple(group) for group in plain["rivals"]),
        plain["gain"]["standardised"]["before"],
        plain["gain"]["standardised"]["after"],
        seconds,
    )


def one(number: int, folder: Path) -> Row | str:
    """Make campaign `number` and diagnose it; return why, if it cannot be made."""
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.inference.campaign.diagnosis import diagnose
    from tests.hidden_effects.campaign import drawn, write_campaign

    case, hidden = drawn(number)
    try:
        campaign = write_campaign(folder / f"campaign_{number:04d}", hidden, number, STROKES)
    except (AssertionError, ValueError) as error:
        return str(error)
    begun = time.perf_counter()
    plain = diagnose(load_campaign(campaign), load(), workers=1).as_json()
    seconds = time.perf_counter() - begun
    shutil.rmtree(campaign)
    return row_of(number, case, hidden, plain, seconds)


def read_rows(path: Path) -> list[Row]:
    """Rows stored so far."""
    rows = []
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            stated = json.loads(line)
            stated["found"] = tuple(tuple(item) for item in stated["found"])
            stated["rivals"] = tuple(tuple(item) for item in stated["rivals"])
            for key in ("names", "classes"):
                stated[key] = tuple(stated[key])
            rows.append(Row(**stated))
    return rows


def measure() -> Iterator[str]:
    """Run what is missing, then print the tables."""
    from tests.hidden_effects.campaign import drawn

    folder = Path(os.environ.get("OPC4_STUDY", "runs/hidden_effects"))
    count = int(os.environ.get("OPC4_STUDY_CAMPAIGNS", "200"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.jsonl"
    rows = read_rows(path)
    done = {row.number for row in rows}
    first = int(os.environ.get("OPC4_FIRST", "0"))
    cases = os.environ.get("OPC4_CASES", "")
    for number in range(first, first + count):
        if number in done or (cases and drawn(number)[0] not in cases.split(",")):
            continue
        row = one(number, folder)
        if isinstance(row, str):
            yield f"{number}: cannot be made: {row}"
            continue
        rows.append(row)
        with path.open("a", encoding="utf-8") as out:
            out.write(json.dumps(asdict(row)) + "\n")
        hidden = " + ".join(row.names) or "nothing"
        found = ", ".join(f"{name} {p:.2f}" for name, _class, p in row.found) or "nothing"
        yield f"{number}: {row.case} {row.level}: {hidden} -> {row.verdict}: {found}"
    yield from tables(rows)


def interval(hits: float, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if count == 0:
        return 0.0, 1.0
    z = 1.96
    share = hits / count
    mid = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z * sqrt(share * (1 - share) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    return max(0.0, mid - half), min(1.0, mid + half)


def share(name: str, hits: float, count: int) -> str:
    """A share with its interval as a line."""
    if count == 0:
        return f"{name}: none"
    low, high = interval(hits, count)
    return f"{name}: {hits:g} of {count} = {hits / count:.3f} [{low:.3f}, {high:.3f}]"


def tables(rows: Sequence[Row]) -> Iterator[str]:
    """Detection, false alarms, right cause, probabilities, unnamed effects, confusion."""
    of = {
        case: [r for r in rows if r.case == case]
        for case in ("none", "one", "two", "foreign", "small")
    }
    yield f"{len(rows)} campaigns of {STROKES} strokes"
    judged = [r for case in ("one", "two") for r in of[case]]
    alarms = [r for r in of["none"] if r.verdict != "consistent"]
    yield share("false alarms on clean campaigns", len(alarms), len(of["none"]))
    yield share(
        "claims on effects too small",
        sum(r.verdict != "consistent" for r in of["small"]),
        len(of["small"]),
    )
    for level in ("easy", "medium"):
        some = [r for r in judged if r.level == level]
        yield share(f"detected, {level}", sum(r.verdict != "consistent" for r in some), len(some))
    for case in ("one", "two"):
        yield share(
            f"right cause first, {case}", sum(r.right_first for r in of[case]), len(of[case])
        )
    if judged:
        yield f"mean probability on the true cause: {sum(r.on_truth for r in judged) / len(judged):.3f}"
        # a score that another campaign's answer reaches too would measure nothing
        handed_on = [
            replace(r, names=other.names)
            for r, other in zip(judged, judged[1:] + judged[:1], strict=True)
        ]
        yield share(
            "control, answers handed to the next campaign: right cause first",
            sum(r.right_first for r in handed_on),
            len(handed_on),
        )
    alone = [r for r in of["one"] if r.right_first == 1.0]
    yield share(
        "held-out residual below 1.1 where the cause is right and alone",
        sum(r.after < 1.1 for r in alone),
        len(alone),
    )
    foreign = of["foreign"]
    right = sum(any(n == "unnamed" and k in r.classes for n, k, _p in r.found[:1]) for r in foreign)
    yield share("not in the catalogue: unnamed first, in the right class", right, len(foreign))
    yield share(
        "not in the catalogue: a wrong name above 0.5",
        sum(r.wrong_name > 0.5 for r in foreign),
        len(foreign),
    )
    yield "reliability: stated -> true"
    for low, high in pairwise(BINS):
        pairs = [
            (p, name in r.names)
            for r in rows
            for name, _class, p in r.found
            if name != "unnamed" and low < p <= high
        ]
        if pairs:
            mean = sum(p for p, _hit in pairs) / len(pairs)
            yield "  " + share(f"{mean:.2f}", sum(hit for _p, hit in pairs), len(pairs))
    yield "confusion: hidden class -> class named first"
    counts = Counter(
        ("+".join(r.classes) or "nothing", r.found[0][1] if r.found else "nothing") for r in rows
    )
    for (hidden, stated), n in sorted(counts.items()):
        yield f"  {hidden} -> {stated}: {n}"
