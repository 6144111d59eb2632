"""watch.json and report.html of trucks that are watched: what changed, when, how sure, what next.

Checked by: tests/unit/sil/shift_diagnosis/test_watch.py
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from can_dbc.errors import InputError, unknown_name
from plant.effects import CATALOGUE
from sil.files.atomic import write_atomically
from sil.files.output_folder import finite
from sil.files.quantity import counted, noun
from sil.report.figure import Band, Figure, Panel, Rule, Series, Stack
from sil.report.plots import plots
from sil.report.shell import Head, render
from sil.shift_diagnosis.cells import BLOCK
from sil.shift_diagnosis.page import MEASURE
from sil.shift_diagnosis.store import ABSOLUTE_S, Watched
from sil.shift_diagnosis.track import CHANGED, FEWEST_SHIFTS, FEWEST_TRIPS, THRESHOLD
from sil.shift_diagnosis.watch_json import as_json

MOST_DRAWN: Final = 12
"""Trucks with changes whose parameters are drawn."""
MOST_FAULTS: Final = 3
"""Logs of a truck of which is said what is not whole; watch.json has more."""
BASIS: Final = (
    f"a change is reported from {THRESHOLD:g} standard deviations on; simulated with shifts, and trips, of "
    "normal scatter; not shown for trips that differ otherwise (docs, truck-diagnosis)"
)


def write_watch(
    trucks: Iterable[Watched], limits: dict[str, float], folder: Path, again: str
) -> dict[str, Any]:
    """Write watch.json and report.html; return what watch.json holds.

    Raises InputError for a limit of a parameter that no truck has.
    """
    found, figures, known = [], list[Stack](), set[str]()
    for watched in trucks:  # one at a time: a fleet may not fit into memory
        found.append(as_json(watched, limits))
        known.update(watched.track.names)
        if watched.track.changes and len(figures) < MOST_DRAWN:
            figures.append(_figure(watched))
    for name in limits:
        if name not in known:
            raise InputError(f"--limit {name}: {unknown_name(name, sorted(known))}")
    values: dict[str, Any] = {
        "format": 1,
        "false_alarm": {"per_shifts": 100_000, "at_most": 1, "basis": BASIS},
        "block_shifts": BLOCK,
        "trucks": found,
    }
    for truck in found:
        truck["lines"] = list(_lines(truck))
    text = json.dumps(finite(values), indent=1, ensure_ascii=False)
    write_atomically(folder / "watch.json", text + "\n")
    changed = sum(t["verdict"] in CHANGED for t in found)
    shifts, changes = sum(t["shifts"] for t in found), sum(len(t["changes"]) for t in found)
    unknown = sum(t["verdict"] == "cannot_tell" for t in found)
    few = f"no change found; {unknown} of {len(found)} trucks have too few shifts to tell"
    head = Head(
        command="watch",
        name=folder.name,
        verdict=f"{changed} of {len(found)} trucks have changed"
        if changed
        else few
        if unknown
        else "steady",
        good=not changed and not unknown,
        tiles=[
            (str(len(found)), noun(len(found), "truck")),
            (str(shifts), noun(shifts, "shift")),
            (str(changes), noun(changes, "change")),
            ("1e-5", "false alarms a shift, at most"),
        ],
        again=again,
    )
    page = render("watch.html", head, plots(Figure(figures)) if figures else [], values=values)
    write_atomically(folder / "report.html", page)
    return values


def _lines(truck: dict[str, Any]) -> list[str]:
    """Return what happened to a truck, and what to do next."""
    lines = []
    if truck["verdict"] == "cannot_tell":
        lines.append(
            f"a change can be found from {FEWEST_SHIFTS} shifts on"
            if truck["shifts"] < FEWEST_SHIFTS
            else f"a change can be found from {FEWEST_TRIPS} trips on: how trips differ must be known"
        )
    for change in truck["changes"]:
        before, after = change["before"], change["after"]
        when = f"shift {change['shift']} [{change['low']}, {change['high']}], {_when(change)}"
        unit = "" if after["unit"] == "-" else f" {after['unit']}"
        if change["kind"] == "drift":
            lines.append(f"{change['name']} drifts from {when} on ({change['sigma']:.1f} sigma)")
        else:
            lines.append(
                f"{change['name']}: {_text(before)} to {_text(after)}{unit} at {when} "
                f"({change['sigma']:.1f} sigma)"
            )
        if change["alike"]:
            lines.append(f"  these shifts cannot distinguish it from {', '.join(change['alike'])}")
        ids = [change["name"], *change["alike"]]
        kinds = {CATALOGUE[name].cause_class for name in ids if name in CATALOGUE}
        for kind in sorted(kinds & MEASURE.keys()):
            lines.append(f"  next: measure {MEASURE[kind]}")
    for item in truck["forecast"]:
        goal = f"{item['name']} reaches {item['limit']:.4g}"
        if item["why"]:
            lines.append(f"{goal}: {item['why']}")
        else:
            lines.append(
                f"{goal} in {counted(item['shifts_left'], 'shift')} [{item['low']}, {item['high']}]"
            )
    if truck["odd_shifts"]:
        odd = counted(len(truck["odd_shifts"]), "odd shift")
        lines.append(f"{odd} among the latest, not tracked")
    lines += [f"{item['log']}: {item['fault']}" for item in truck["faulty_logs"][:MOST_FAULTS]]
    if late := truck["late_logs"]:
        begin = f"{late[0]} begins" if len(late) == 1 else f"{len(late)} logs, as {late[0]}, begin"
        lines.append(
            f"{begin} before the log taken before ends: shifts count in the order in which they "
            "were taken; for one by time, take all logs anew into another --out"
        )
    return lines


def _text(item: dict[str, Any]) -> str:
    if item["value"] is None:
        return "unknown"
    return f"{item['value']:.4g} [{item['low']:.4g}, {item['high']:.4g}]"


def _when(change: dict[str, Any]) -> str:
    """Return the log that a change is in, and its date where the log has the time of day."""
    if change["time_s"] < ABSOLUTE_S:
        return str(change["log"])
    date = datetime.fromtimestamp(change["time_s"], UTC)
    return f"{date:%Y-%m-%d %H:%M} UTC in {change['log']}"


def _figure(watched: Watched) -> Stack:
    """Return the changed parameters of a truck over its shifts, in typical sizes."""
    track, panels = watched.track, []
    at = track.first + 0.5 * track.count
    for name in dict.fromkeys(change.name for change in track.changes):
        k = track.names.index(name)
        size, deviation = track.estimates(k)
        rules = [
            Rule(float(c.shift), c.kind, style="dashed") for c in track.changes if c.name == name
        ]
        line = Series(name, at, size, "measured", "dots")
        band = Band(at, size - 1.96 * deviation, size + 1.96 * deviation, "measured")
        panels.append(Panel(name, "typical sizes", [line], bands=[band], rules=rules, height=140))
    return Stack("shift", panels, watched.name, width=12.0)
