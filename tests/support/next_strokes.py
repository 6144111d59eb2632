"""Worth of strokes that `opc4 diagnose --next` proposes, against repeats and random ones: four and four, one hidden cause."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from sil.campaign.campaign import Campaign, CampaignStroke, campaign_toml, joined, load_campaign
from sil.inference.campaign.designs import designs, imagined
from sil.inference.campaign.diagnosis import Diagnosis, diagnose
from tests.hidden_effects import effects
from tests.hidden_effects.campaign import Hidden, hide, measure_next

STROKES = 4
SUPPLY_PA = 9e5
DRIVES = {"fixed": "1", "N-B": "B", "B-N": "N", "N-F": "F"}
WAYS = ("proposed", "repeated", "random")
SURE = 0.7


@dataclass(frozen=True)
class Outcome:
    """Verdict of a diagnosis, and the probability of what was hidden and of the likeliest other cause."""

    verdict: str
    true: float
    wrong: float

    @property
    def solved(self) -> bool:
        """Whether what was hidden is named, surely and first."""
        return self.verdict == "named" and self.true >= SURE and self.true > self.wrong

    @classmethod
    def of(cls, found: Diagnosis, hidden: Hidden) -> Outcome:
        """Return the outcome of a diagnosis."""
        stated = {cause.id: cause.probability for cause in found.causes}
        others = [p for name, p in stated.items() if name not in hidden.names]
        return cls(found.verdict.kind, stated.get(hidden.names[0], 0.0), max(others, default=0.0))


def first_campaign(folder: Path, kinds: Sequence[str], hidden: Hidden, seed: int) -> Path:
    """Measure strokes of these kinds at one supply."""
    folder.mkdir()
    entries = []
    for number, kind in enumerate(kinds, start=1):
        commands = ((0.01, DRIVES[kind], 0.98), (0.2, DRIVES[kind], 0.0))
        conditions = StrokeConditions(kind, SUPPLY_PA, commands, rest_s=30.0)
        entries.append(CampaignStroke(f"stroke_{number:03d}.csv", kind, conditions))
    made = Campaign(folder, "first", "both", 101325.0, 293.15, 10000.0, tuple(entries))
    (folder / "campaign.toml").write_text(campaign_toml(made, entries), encoding="utf-8")
    return measure_next(folder, hidden, seed, day=4)


def planned(way: str, found: Diagnosis, rng: np.random.Generator) -> tuple[CampaignStroke, ...]:
    """Return as many strokes as were proposed, chosen in another way."""
    assert found.next_experiment is not None
    proposed = tuple(found.next_experiment.entries)
    if way == "proposed":
        return proposed
    choice: Sequence[CampaignStroke] = found.campaign.strokes
    if way == "random":
        entries, rate_hz = designs(found.model.strokes, "next"), found.campaign.sample_rate_hz
        possible = imagined(entries, found.model.strokes, load(), rate_hz)
        choice = [stroke.entry for stroke in possible]
    picked = rng.choice(len(choice), len(proposed), replace=len(choice) < len(proposed))
    return tuple(
        replace(choice[k], file=f"stroke_{number:03d}.csv")
        for number, k in enumerate(picked, start=1)
    )


def measured_again(
    campaign: Campaign, strokes: Sequence[CampaignStroke], folder: Path, hidden: Hidden, seed: int
) -> Campaign:
    """Measure strokes on the unit of a campaign, and return both campaigns as one."""
    folder.mkdir()
    text = campaign_toml(replace(campaign, name="next"), strokes)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return joined([campaign, load_campaign(measure_next(folder, hidden, seed))])


def one(seed: int, folder: Path, ways: Sequence[str] = WAYS) -> dict[str, Any]:
    """Hide a cause, diagnose, and measure again where it is not named."""
    rng = np.random.default_rng([seed, 7])
    visible = [name for name, row in effects.SIZES.items() if row[0] != "damper"]
    name = str(rng.choice(visible))
    hidden = hide((name,), str(rng.choice(("medium", "easy"))), seed)
    kind = str(rng.choice(list(DRIVES)))
    campaign = load_campaign(first_campaign(folder / "first", [kind] * STROKES, hidden, seed))
    first = diagnose(campaign, load(), workers=1, plan=True)
    row: dict[str, Any] = {"seed": seed, "hidden": name, "level": hidden.level, "kind": kind}
    row["first"] = vars(Outcome.of(first, hidden))
    if Outcome.of(first, hidden).solved or first.next_experiment is None:
        return row
    row["strokes"] = len(first.next_experiment.strokes)
    row["expected"] = first.next_experiment.separated
    for way in ways:
        strokes = planned(way, first, rng)
        both = measured_again(campaign, strokes, folder / way, hidden, seed)
        row[way] = vars(Outcome.of(diagnose(both, load(), workers=1), hidden))
        shutil.rmtree(folder / way)
    return row


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield what came of it."""
    asked = [row for row in rows if "proposed" in row]
    yield f"{len(rows)} campaigns of {STROKES} strokes of one kind; {len(asked)} measured again"
    yield "| strokes | named rightly | probability of what was hidden | wrong above 0.8 |"
    yield "|---|---|---|---|"
    for way in ("first", *WAYS):
        found = [Outcome(**row[way]) for row in asked if way in row]
        if not found:
            continue
        right = sum(item.solved for item in found)
        mean = float(np.mean([item.true for item in found]))
        wrong = sum(item.wrong > 0.8 for item in found)
        yield f"| {way} | {right} of {len(found)} | {mean:.2f} | {wrong} |"


def measure(
    campaigns: int = 40, first: int = 1, store: Path = Path("next_experiment.jsonl")
) -> Iterator[str]:
    """Judge drawn campaigns; results are added to `store` as they come."""
    for seed in range(first, first + campaigns):
        try:
            with TemporaryDirectory() as folder:
                row = one(seed, Path(folder))
        except (AssertionError, ValueError):  # the judge cannot make this campaign
            continue
        with store.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    yield from table([json.loads(line) for line in store.read_text().splitlines()])
