"""Drawn sets of a truck's logs, healthy and with one fault, through `opc4 diagnose LOG...`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from sil.cli import main
from tests.support.truck_logs import ALARMS, drawn_cause, share
from tests.support.truck_sets import drawn_set


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
