"""Other instruments: campaigns re-sampled, noisier, without gauges (`python -m tests.bench instruments`).

Cells hold the campaigns of $OPC4_CAMPAIGNS and clean ones; results are stored in $OPC4_STUDY, so that a
stopped study continues. $OPC4_CELLS ("1000x2,100x1-", -: no gauges) and $OPC4_ONLY limit it.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

RATES_HZ = (1000, 250, 100)
NOISES = (1, 2, 4)
CLEAN = (901, 902, 903)
STROKES = 15
STORED = Path(__file__).resolve().parents[1] / "data" / "blind"
OUTCOMES = ("right", "unable", "wrong")


def resampled(source: Path, folder: Path, rate_hz: int, noise: float, gauges: bool) -> Path:
    """Write a campaign at another rate, with `noise` times its noise, with or without gauges."""
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign

    value = load().value
    sd = {"position": np.hypot(value("potentiometer.noise_sd"), 5e-5 / 12**0.5)}
    for medium in ("air", "oil"):
        step = value(f"gauge.range_{medium}") / 2 ** value("gauge.adc_bits")
        sd[medium] = np.hypot(value(f"gauge.noise_sd_{medium}"), step / 12**0.5)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    campaign = load_campaign(source)
    text = (source / "campaign.toml").read_text(encoding="utf-8")
    old = f"sample_rate_hz = {campaign.sample_rate_hz}"
    assert old in text
    text = text.replace(old, f"sample_rate_hz = {float(rate_hz)}")
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    every = round(campaign.sample_rate_hz / rate_hz)
    rng = np.random.default_rng([rate_hz, round(10 * noise)])
    for stroke in campaign.strokes:
        columns = {}
        for name, values in campaign.record(stroke).columns.items():
            taken = values[::every].copy()
            kind = "position" if name == "position_m" else "oil" if "oil2" in name else "air"
            if name.startswith("pressure") and not gauges:
                continue
            if name == "position_m" or name.startswith("pressure"):
                taken += sd[kind] * (noise**2 - 1.0) ** 0.5 * rng.standard_normal(len(taken))
            columns[name] = taken
        formats = ["%.1f" if name.startswith("pressure") else "%.6f" for name in columns]
        table = np.column_stack(list(columns.values()))
        header = ",".join(columns)
        np.savetxt(folder / stroke.file, table, formats, ",", header=header, comments="")
    return folder


def expected(name: str) -> list[dict[str, Any]]:
    """Return the causes of a campaign by its full instruments: id and class."""
    if name.startswith("clean"):
        return []
    if name == "example":
        return [{"id": "dynamic_friction", "class": "friction", "parameters": {}}]
    stored = json.loads((STORED / name / "diagnosis.json").read_text(encoding="utf-8"))
    return list(stored["causes"])


def outcome(causes: list[dict[str, Any]], found: dict[str, Any]) -> str:
    """Return right, unable (says so) or wrong, for what full instruments show and what was found."""
    true = {cause["id"] for cause in causes}
    classes = {cause["class"] for cause in causes}
    named = {cause["id"]: cause for cause in found["causes"]}
    verdict = found["verdict"]
    if verdict == "cannot_tell":
        return "unable"
    if verdict == "consistent":
        return (
            "wrong"
            if any(_noticeable(cause, found) for cause in causes)
            else ("unable" if true else "right")
        )
    if not true:
        return "wrong"
    wrong = {name: cause for name, cause in named.items() if name not in true}
    grouped = {other for group in found["rivals"] if set(group) & true for other in group}
    if any(
        c["probability"] > 0.5 and n not in grouped and n != "unnamed" for n, c in wrong.items()
    ):
        return "wrong"
    if set(named) <= true:
        return "right"
    if true & (set(named) | grouped) or named.get("unnamed", {}).get("class") in classes:
        return "unable"
    return "wrong"


def _noticeable(cause: dict[str, Any], found: dict[str, Any]) -> bool:
    """Return whether a cause should have been noticed by the limits, stated for like parameters."""
    limits = next((item for item in found["detectable"] if item["id"] == cause["id"]), None)
    if limits is None:
        return False
    for name, value in limits.get("others", {}).items():
        true = cause["parameters"].get(name, {"value": value})["value"]
        if not 0.7 <= true / value <= 1.4:
            return False
    own = cause["parameters"].get(limits["parameter"])
    if own is None:
        return bool(limits["typical_sizes"] < 1.0)
    return bool(abs(own["value"] - limits["neutral"]) > limits["size"])


def cells() -> list[tuple[int, int, bool]]:
    """Return rate, noise and gauges of every cell wanted."""
    known = [(rate, noise, g) for g in (True, False) for rate in RATES_HZ for noise in NOISES]
    wanted = os.environ.get("OPC4_CELLS", "")
    return [cell for cell in known if not wanted or name_of(*cell) in wanted.split(",")]


def name_of(rate: int, noise: int, gauges: bool) -> str:
    """Return a cell's name."""
    return f"{rate}x{noise}{'' if gauges else '-'}"


def judged(source: Path, folder: Path, cell: tuple[int, int, bool]) -> dict[str, Any]:
    """Diagnose a campaign in a cell; return a row of the study."""
    from can_dbc.errors import InputError
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.inference.campaign.diagnosis import diagnose

    campaign = resampled(source, folder / "resampled", *cell)
    begun = time.perf_counter()
    try:
        found = diagnose(load_campaign(campaign), load(), workers=1).as_json()
    except InputError as error:
        found = {"verdict": "cannot_tell", "causes": [], "rivals": []}
        found["gain"] = {"standardised": str(error)}
    causes = expected(source.name)
    return {
        "campaign": source.name,
        "cell": name_of(*cell),
        "outcome": outcome(causes, found),
        "true": [cause["id"] for cause in causes],
        "verdict": found["verdict"],
        "causes": [(c["id"], round(c["probability"], 2), c["evidence"]) for c in found["causes"]],
        "rivals": found["rivals"],
        "gain": found["gain"]["standardised"],
        "seconds": round(time.perf_counter() - begun, 1),
    }


def measure() -> Iterator[str]:
    """Run what is missing; yield what is wrong, then the table."""
    from tests.hidden_effects.campaign import hide, write_campaign

    folder = Path(os.environ.get("OPC4_STUDY", "runs/instruments"))
    measured = Path(os.environ.get("OPC4_CAMPAIGNS", "campaigns"))
    folders = sorted(path.parent for path in measured.glob("*/campaign.toml"))
    sources = [folder for folder in folders if folder.name != "reference"]
    folder.mkdir(parents=True, exist_ok=True)
    for seed in CLEAN:
        clean = folder / f"clean_{seed}"
        if not (clean / "campaign.toml").exists():
            write_campaign(clean, hide((), "easy", seed), seed, STROKES)
        sources.append(clean)
    only = os.environ.get("OPC4_ONLY", "")
    sources = [source for source in sources if not only or source.name in only.split(",")]
    path = folder / "results.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(row["campaign"], row["cell"]) for row in rows}
    for cell in cells():
        for source in sources:
            if (source.name, name_of(*cell)) in done:
                continue
            row = judged(source, folder, cell)
            rows.append(row)
            with path.open("a", encoding="utf-8") as out:
                out.write(json.dumps(row) + "\n")
            if row["outcome"] == "wrong":
                yield f"wrong: {row['cell']} {row['campaign']} {row['true']}: {row['verdict']} {row['causes']}"
    yield from table(rows)


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the table in Markdown: right, unable, wrong by cell."""
    yield "| rate | noise | gauges | hidden: right | unable, said so | wrong | clean: right | unable | wrong |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for rate, noise, gauges in cells():
        own = [row for row in rows if row["cell"] == name_of(rate, noise, gauges)]
        counts = Counter((bool(row["true"]), row["outcome"]) for row in own)
        figures = " | ".join(str(counts[true, what]) for true in (True, False) for what in OUTCOMES)
        yield f"| {rate} Hz | x{noise} | {'yes' if gauges else 'no'} | {figures} |"
