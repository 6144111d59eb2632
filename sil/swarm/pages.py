"""What a swarm hands over: failing scenarios with their pictures, swarm.json, and a page."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.errors import RunError
from controller.shift import TRANSITIONS
from sil.files.atomic import write_atomically
from sil.files.output_folder import finite
from sil.files.quantity import counted
from sil.report.picture import save
from sil.report.run_figure import run_figure
from sil.report.shell import Head, Picture, render
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
from sil.simulation.scenario import scenario_toml
from sil.swarm.hunt import Failure, Hunt, size_of


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()


def write_failures(hunt: Hunt, folder: Path) -> dict[str, Failure]:
    """Write a scenario file for each failure into failures/; return the failures by name of file."""
    _empty(folder / "failures")
    failures: dict[str, Failure] = {}
    for failure in (each for generation in hunt.generations for each in generation.failures):
        number = 1 + sum(each.rule == failure.rule for each in failures.values())
        name = f"{failure.rule}_{number}"
        scenario = from_table({**failure.table, "name": name}, name).scenario
        sentence = f"# {failure.rule}: {failure.text} at {failure.time_s:.3f} s.\n"
        text = sentence + scenario_toml(scenario) + "\n[expect]\nunfinished = true\n"
        write_atomically(folder / "failures" / f"{name}.toml", text)
        failures[f"{name}.toml"] = failure
    return failures


def _write_transitions(hunt: Hunt, folder: Path) -> dict[str, int]:
    """Write the simplest scenario that takes each change of state; return how often each was taken."""
    simplest: dict[str, dict[str, Any]] = {}
    taken: Counter[str] = Counter()
    for generation in hunt.generations:
        taken.update(generation.transitions)
        for name in generation.transitions:
            table = hunt.table(generation.number, generation.shortest[name])
            if name not in simplest or size_of(table) < size_of(simplest[name]):
                simplest[name] = table
    _empty(folder / "transitions")
    for name, table in simplest.items():
        stem = name.replace(" -> ", "_")
        text = scenario_toml(from_table({**table, "name": stem}, stem).scenario)
        write_atomically(folder / "transitions" / f"{stem}.toml", text)
    return taken


def write_page(hunt: Hunt, failures: Mapping[str, Failure], folder: Path) -> dict[str, Any]:
    """Write swarm.json, the pictures and report.html; return the content of swarm.json."""
    possible = {f"{a.name} -> {b.name}" for (a, _), b in TRANSITIONS.items() if a is not b}
    counts = _write_transitions(hunt, folder)
    # an impossible one: a report was lost
    taken = {name: times for name, times in counts.items() if name in possible}
    result = {
        "runs": sum(generation.runs for generation in hunt.generations),
        "refused": sum(generation.refused for generation in hunt.generations),
        "wall_s": sum(generation.wall_s for generation in hunt.generations),
        "failures": {name: msgspec.to_builtins(each) for name, each in failures.items()},
        "transitions": dict(sorted(taken.items(), key=lambda item: -item[1])),
        "never_taken": sorted(possible - set(taken)),
    }
    write_atomically(folder / "swarm.json", json.dumps(finite(result), indent=1) + "\n")
    pictures = {name: _picture(name, failure, folder) for name, failure in failures.items()}
    runs, count = result["runs"], len(failures)
    share = f"{len(taken)} of {len(possible)}"
    tiles = [(f"{runs:,}", "runs"), (share, "transitions taken"), (str(count), "failures")]
    verdict = counted(count, "failure") if count else "no rule broken"
    head = Head(command="swarm", name="swarm", verdict=verdict, good=not count, tiles=tiles)
    rows = [(name, failure, pictures[name]) for name, failure in failures.items()]
    page = render("swarm.html", head, failures=rows, transitions=result["transitions"], never=result["never_taken"])  # fmt: skip
    write_atomically(folder / "report.html", page)
    return result


def _picture(name: str, failure: Failure, folder: Path) -> Picture | None:
    """Return the picture of a failing run; None if it did not run to the end."""
    try:
        run = run_in_memory(from_table(failure.table, name))
    except RunError:
        return None
    stem = name.removesuffix(".toml")
    figure = run_figure(run.record, run.shifts, f"{failure.rule} at {failure.time_s:.3f} s", failure.text)  # fmt: skip
    return Picture(save(figure, folder / "failures", stem), f"the run of {name}", f"{stem}.png")
