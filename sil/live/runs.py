"""The finished and unfinished outputs in a folder, for the tab Runs.

Only what commands write there is read, and only in folders directly below the one chosen.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from can_dbc.user_file import parse_json
from sil.files.output_folder import INCOMPLETE
from sil.report.figure import MM, MS, Figure, Panel, Series, Stack
from sil.report.plots import content
from sil.studies.table import RESULTS, numbers_of


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return name, kind, state and figures of each output below a folder, newest first."""
    if not folder.is_dir():
        return []
    inside = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()]
    inside.sort(key=lambda path: (-path.stat().st_mtime, path.name))
    return [entry for path in inside for entry in _entry(path)]


def _entry(path: Path) -> Iterator[dict[str, Any]]:
    kinds = {
        "result.json": "run",
        "diagnosis.json": "diagnosis",
        "summary.json": "study",
        RESULTS: "study",
        "diff.json": "replay",
    }
    kind = next((kind for name, kind in kinds.items() if (path / name).is_file()), None)
    unfinished = (path / INCOMPLETE).is_file()
    if kind is None and not unfinished:
        return
    state = (path / INCOMPLETE).read_text(encoding="utf-8").strip() if unfinished else "complete"
    entry: dict[str, Any] = {
        "name": path.name,
        "kind": kind or "in progress",
        "state": state or "in progress",
        "page": (path / "report.html").is_file(),
    }
    if kind == "run":
        result = _json(path / "result.json")
        metrics = result.get("metrics") or {}
        entry["state"] = "passed" if result.get("passed") else result.get("why") or "failed"
        names = ("shift_time_s", "impact_speed_m_s", "air_used_kg")
        entry["figures"] = {name: metrics.get(name) for name in names}
        entry["trace"] = (path / "trace.csv").is_file()
    elif kind == "study" and (path / RESULTS).is_file():
        with (path / RESULTS).open("rb") as rows:
            entry["rows"] = max(0, sum(1 for _ in rows) - 1)
        entry["trace"] = entry["rows"] > 0
    elif kind == "diagnosis":
        entry["state"] = _json(path / "diagnosis.json").get("verdict", "")
    yield entry


def _json(path: Path) -> dict[str, Any]:
    try:
        table = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # being written, or damaged: shown without figures
        return {}
    return table if isinstance(table, dict) else {}


def inside(folder: Path, name: str) -> Path:
    """Return the folder of one output. Raises InputError for a name that is not one of them."""
    if name not in {entry["name"] for entry in listed(folder)}:
        raise InputError(f"runs: no output {name!r} in {folder}; expected one that is listed")
    return folder / name


def compared(folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """Return runs over each other, or a study so far, for plots.js. Raises InputError without traces."""
    if not 1 <= len(names) <= 6:
        raise InputError(f"runs: {len(names)} chosen; expected 1 to 6")
    if len(names) == 1 and (inside(folder, names[0]) / RESULTS).is_file():
        return content(_so_far(inside(folder, names[0]) / RESULTS).stacks[0])
    position, speed = [], []
    for number, name in enumerate(names):
        trace = inside(folder, name) / "trace.csv"
        if not trace.is_file():
            raise InputError(f"runs: {name} has no trace.csv; expected a finished run")
        time_s, position_m, speed_m_s = _columns(trace)
        role, at = f"series{number}", time_s * MS
        position.append(Series(name, at, position_m * MM, role))
        speed.append(Series(name, at, speed_m_s, role))
    upper = Panel("Position", "mm", position, height=240)
    lower = Panel("Speed of the stay", "m/s", speed)
    return content(Figure([Stack("simulated time, ms", [upper, lower])]).stacks[0])


def _so_far(results: Path) -> Figure:
    """Return the numbers of a study's rows in order; while it is written its last line may be a part."""
    with results.open(encoding="utf-8", newline="") as file:
        names, *cells = csv.reader(file)
    columns = zip(*(row for row in cells if len(row) == len(names)), strict=True)
    panels = []
    for name, column in zip(names, columns, strict=False):
        values = numbers_of(list(column))
        if name == "row" or values is None or len(np.unique(values[np.isfinite(values)])) < 2:
            continue
        series = Series(name, np.arange(len(values), dtype=float), values, "after", "dots")
        panels.append(Panel(name, "", [series], height=110))
    return Figure([Stack("row", panels[:8] or [Panel("No numbers yet")])])


def _columns(trace: Path) -> np.ndarray:
    with trace.open(encoding="utf-8") as lines:
        names = lines.readline().strip().split(",")
        wanted = [names.index(name) for name in ("time_s", "position_m", "velocity_m_s")]
        return np.loadtxt(lines, delimiter=",", usecols=wanted, unpack=True, ndmin=2)
