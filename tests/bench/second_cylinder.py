"""Drawn cylinders of a simulator of their own: calibrated, then diagnosed, healthy and with a fault."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from sil.cli import main
from tests.support.hidden_study import share
from tests.support.second_cylinder import FAULTS, drawn, faulty, write_campaign, write_sheet
from tests.support.truck_logs import ALARMS


def one(seed: int) -> list[dict[str, Any]]:
    """Calibrate a unit, diagnose it with every fault; every other data sheet is wrong by 15 to 30 %."""
    rng = np.random.default_rng(seed)
    unit = drawn(rng)
    rows = []
    with TemporaryDirectory() as text:
        folder = Path(text)
        healthy = write_campaign(unit, folder / "calibration", rng)
        sheet = write_sheet(unit, folder / "sheet.toml", rng, 0.3 if seed % 2 else 0.1)
        model, began = folder / "mine.toml", process_time()
        calibrate = ["calibrate", str(healthy), "--model", str(sheet), "--out", str(model)]
        good = main([*calibrate, "--quiet"]) == 0
        cpu_s = process_time() - began
        for cause, sizes in FAULTS.items():
            changed, size = unit, 0.0
            if cause != "healthy":
                changed, size = faulty(unit, cause, float(rng.uniform(*sizes)))
            data = write_campaign(changed, folder / cause, rng)
            began, out = process_time(), folder / f"out_{cause}"
            if good:
                main(["diagnose", str(data), "--model", str(model), "--out", str(out), "--quiet"])
            diagnosis = json.loads((out / "diagnosis.json").read_text()) if good else {}
            rows.append(
                {
                    "seed": seed,
                    "hidden": "" if cause == "healthy" else cause,
                    "size": size,
                    "good": good,
                    "verdict": diagnosis.get("verdict"),
                    "causes": diagnosis.get("causes", []),
                    "calibration_s": round(cpu_s, 1),
                    "cpu_s": round(process_time() - began, 1),
                }
            )
    return rows


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what the rows of `one` say."""
    units = {row["seed"]: row for row in rows}.values()
    rows = [row for row in rows if row["good"]]
    sick = [row for row in rows if row["hidden"]]
    alarms = [row for row in sick if row["verdict"] in ALARMS]
    falsely = sum(row["verdict"] in ALARMS for row in rows if not row["hidden"])
    first = [row for row in sick if row["causes"] and row["causes"][0]["id"] == row["hidden"]]
    sized = [
        next(v for v in row["causes"][0]["parameters"].values() if v["low"] is not None)
        for row in first
    ]
    inside = sum(v["low"] <= row["size"] <= v["high"] for v, row in zip(sized, first, strict=True))
    seconds = sorted(row["cpu_s"] for row in rows)
    yield share("models good enough to diagnose with", sum(r["good"] for r in units), len(units))
    yield share("healthy units with an alarm", falsely, len(rows) - len(sick))
    yield share("faulty units with an alarm", len(alarms), len(sick))
    yield share("the hidden cause first", len(first), len(sick))
    yield share("its size inside the 95 % interval", inside, len(first))
    yield f"CPU: calibration at most {max(r['calibration_s'] for r in units)} s"
    yield f"CPU: diagnosis median {seconds[len(seconds) // 2]} s, largest {seconds[-1]} s"


def measure(units: int = 20, store: Path = Path("second_cylinder.jsonl")) -> Iterator[str]:
    """Judge so many units; results are added to `store` as they come."""
    for seed in range(units):
        with store.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in one(seed))
    yield from table([json.loads(line) for line in store.read_text().splitlines()])
