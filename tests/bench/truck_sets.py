"""Drawn sets of a truck's logs, healthy and with one fault, through `opc4 diagnose LOG...`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from plant.effects import CATALOGUE
from sil.cli import main
from sil.inference.candidate import scaled_of
from tests.support.truck_logs import ALARMS, drawn_cause, drawn_set, share


def one(seed: int, is_faulty: bool) -> dict[str, Any]:
    """Draw a set, diagnose it, and return what was hidden and what was found."""
    hidden, cause = "", {}
    if is_faulty:
        rng = np.random.default_rng([seed, 12])
        hidden, cause = drawn_cause(float(rng.uniform()), rng)
    with TemporaryDirectory() as folder:
        logs = drawn_set(Path(folder), seed, cause)
        began = process_time()
        out = Path(folder) / "out"
        main(["diagnose", *logs, "--out", str(out), "--quiet", "--workers", "1"])
        diagnosis = json.loads((out / "diagnosis.json").read_text())
    return {
        "seed": seed,
        "hidden": hidden,
        "size": next(iter(cause.values()), None),
        "verdict": diagnosis["verdict"],
        "causes": {item["id"]: item["probability"] for item in diagnosis["causes"]},
        "noticed_from": [i["size"] for i in diagnosis["detectable"] if i["id"] == hidden],
        "shifts": diagnosis["shifts"],
        "failed": any("did not reach" in line for line in diagnosis["findings"]),
        "cpu_s": round(process_time() - began, 1),
    }


def by_noticed(row: dict[str, Any]) -> float:
    """Return the size hidden, by the one that the diagnosis states as noticed; 0 if it states none."""
    parameter = CATALOGUE[row["hidden"]].parameters[0]
    sizes = [abs(scaled_of(parameter, value)) for value in row["noticed_from"]]
    return abs(scaled_of(parameter, row["size"])) / min(sizes) if sizes else 0.0


def outcome(row: dict[str, Any]) -> str:
    """Return the verdict on a faulty truck, and whether the hidden cause is the first named."""
    if not row["causes"]:
        return str(row["verdict"])
    return f"{row['verdict']} {'right' if next(iter(row['causes'])) == row['hidden'] else 'wrong'}"


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what the rows of `one` say."""
    clean = [row for row in rows if not row["hidden"]]
    faulty = [row for row in rows if row["hidden"]]
    alarms = [row for row in faulty if row["verdict"] in ALARMS]
    falsely = sum(row["verdict"] in ALARMS for row in clean)
    wrong = [r for r in rows if any(p > 0.8 and n != r["hidden"] for n, p in r["causes"].items())]
    silent = [r for r in rows if r["failed"] and r["verdict"] not in ALARMS]
    seconds = sorted(row["cpu_s"] for row in rows)
    yield f"healthy trucks with an alarm: {share(falsely, len(clean))}"
    yield f"faulty trucks with an alarm: {share(len(alarms), len(faulty))}"
    yield f"the hidden cause among those reported: {share(sum(r['hidden'] in r['causes'] for r in alarms), len(alarms))}"
    yield f"faulty trucks: {', '.join(f'{n} {kind}' for kind, n in Counter(map(outcome, faulty)).most_common())}"
    for least, most in ((0.0, 0.0), (0.0, 1.0), (1.0, 2.0), (2.0, np.inf)):
        within = [r for r in faulty if least < (by := by_noticed(r)) <= most or by == least == most]
        title = f"{least:g} to {most:g} of the size stated" if most else "with no size stated"
        alarm = sum(row["verdict"] in ALARMS for row in within)
        yield f"alarms of faults {title}: {share(alarm, len(within))}"
    yield f"a wrong cause above 0.8: {share(len(wrong), len(rows))}"
    yield f"failing shifts without an alarm: {len(silent)}"
    yield f"CPU: median {seconds[len(seconds) // 2]} s, largest {seconds[-1]} s"


def measure(
    sets: int = 100, first: int = 3000, store: Path = Path("truck_sets.jsonl")
) -> Iterator[str]:
    """Judge so many healthy and so many faulty sets; results are added to `store` as they come."""
    for seed in range(first, first + sets):
        for is_faulty in (False, True):
            with store.open("a") as file:
                file.write(json.dumps(one(seed, is_faulty)) + "\n")
    yield from table([json.loads(line) for line in store.read_text().splitlines()])
