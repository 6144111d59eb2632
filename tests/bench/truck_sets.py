"""Drawn sets of a truck's logs, healthy and with one fault, through `opc4 diagnose LOG...`.

By the plant, or, with $OPC4_LAYOUT (`LAYOUTS` of tests/support/truck_logs.py), by tests/reference, one log each.
"""

from __future__ import annotations

import json
import os
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
from tests.support.hidden_study import share
from tests.support.truck_logs import ALARMS, by_reference, drawn_cause, drawn_set


def one(seed: int, is_faulty: bool, layout: str = "") -> dict[str, Any]:
    """Draw a set, diagnose it, and return what was hidden and what was found."""
    hidden, cause = "", {}
    rng = np.random.default_rng([seed, 12])
    severity = float(rng.uniform()) if is_faulty else None
    with TemporaryDirectory() as folder:
        if layout:
            logs = [str(Path(folder) / "0.log")]
            shifts = int(rng.integers(3, 13))
            hidden, cause, _ = by_reference(Path(logs[0]), seed, shifts, severity, layout)
        else:
            if severity is not None:
                hidden, cause = drawn_cause(severity, rng)
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
        "noticed_from": [
            i["size"] for i in diagnosis["detectable"] if i["id"] == hidden and not layout
        ],
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
    yield share("healthy trucks with an alarm", falsely, len(clean))
    yield share("faulty trucks with an alarm", len(alarms), len(faulty))
    yield share(
        "the hidden cause among those reported",
        sum(r["hidden"] in r["causes"] for r in alarms),
        len(alarms),
    )
    yield f"faulty trucks: {', '.join(f'{n} {kind}' for kind, n in Counter(map(outcome, faulty)).most_common())}"
    for least, most in ((0.0, 0.0), (0.0, 1.0), (1.0, 2.0), (2.0, np.inf)):
        within = [r for r in faulty if least < (by := by_noticed(r)) <= most or by == least == most]
        title = f"{least:g} to {most:g} of the size stated" if most else "with no size stated"
        alarm = sum(row["verdict"] in ALARMS for row in within)
        yield share(f"alarms of faults {title}", alarm, len(within))
    yield share("a wrong cause above 0.8", len(wrong), len(rows))
    yield f"failing shifts without an alarm: {len(silent)}"
    yield f"CPU: median {seconds[len(seconds) // 2]} s, largest {seconds[-1]} s"


def measure(
    sets: int = 100, first: int = 3000, store: Path = Path("truck_sets.jsonl")
) -> Iterator[str]:
    """Judge so many healthy and so many faulty sets; results are added to `store` as they come."""
    layout = os.environ.get("OPC4_LAYOUT", "")
    for seed in range(first, first + sets):
        for is_faulty in (False, True):
            with store.open("a") as file:
                file.write(json.dumps(one(seed, is_faulty, layout)) + "\n")
    yield from table([json.loads(line) for line in store.read_text().splitlines()])
