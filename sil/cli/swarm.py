"""Draw scenarios, hold every run to the rules, and hand over the shortest scenario that breaks one.

TARGET is a scenario (file or shipped name) around which to draw, or a firmware of one's own. Exit
code 1 if a rule was broken.

example: opc4 swarm own.py --runs 2048 --workers 2 --out night/
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError
from sil.cli.options import JSON, OWN_RULES, argument, out
from sil.files.output_folder import close_folders, prepare_folder, reopen_folder
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.swarm.hunt import Hunt

ARGUMENTS = (
    argument("target", "scenario, or firmware of one's own", "TARGET"),
    argument("--runs", "number of runs, in whole generations of 256", "N", type=int),
    argument("--hours", "time to spend; the generation under way is finished", "H", type=float),
    argument("--seed", "seed of everything drawn [1]", "N", type=int, default=1),
    argument("--workers", "processes [1]", "N", type=int, default=1),
    argument("--cluster", "dask.distributed scheduler", "ADDRESS"),
    OWN_RULES,
    argument("--resume", "continue the swarm in DIR"),
    *(*out("runs/swarm-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Hunt until time or runs are over; return the exit code. Raises InputError and RunError."""
    import msgspec

    from sil.files.progress import Progress
    from sil.files.worker import in_turn
    from sil.rules.user_file import load_rules
    from sil.swarm.hunt import SWARM_FILE, Hunt
    from sil.swarm.pages import write_failures, write_page

    hunt = Hunt(_base(arguments), arguments.seed, load_rules(arguments.rules))
    folder = _folder(hunt, arguments)
    runner = partial(in_turn, workers=arguments.workers, cluster=arguments.cluster)
    most_runs = math.inf if arguments.runs is None else arguments.runs
    until_s = time.monotonic() + 3600.0 * (arguments.hours or math.inf)
    begun_s = time.monotonic()
    with Progress("swarm", "runs" if arguments.hours is None else "s") as progress:
        progress(0.0, 1.0)
        for generation in hunt.run(runner, most_runs, until_s):
            with open(folder / SWARM_FILE, "ab") as file:
                file.write(msgspec.json.encode(generation) + b"\n")
                file.flush()
                os.fsync(file.fileno())
            if arguments.hours is None:
                runs = sum(each.runs for each in hunt.generations)
                progress(runs, max(arguments.runs, runs), news(hunt))
            else:
                progress(time.monotonic() - begun_s, 3600.0 * arguments.hours, news(hunt))
    files = write_failures(hunt, folder)
    result = write_page(hunt, files, folder)
    if arguments.json:
        print(json.dumps({"out": str(folder), **result}))
    else:
        _print(hunt, files, result)
        print(f"{folder}: swarm.json report.html")
    close_folders(None)
    return 1 if files else 0


def _base(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the table that every scenario is drawn around. Raises InputError."""
    from controller.config import FirmwareConfig
    from sil.firmware.load import absolute, firmware_node, is_program
    from sil.simulation import load_scenario

    if arguments.runs is None and arguments.hours is None:
        raise InputError("neither --runs nor --hours; expected one of them")
    for name, value in (("--runs", arguments.runs), ("--hours", arguments.hours)):
        if value is not None and value <= 0:
            raise InputError(f"{name} {value}: expected more than 0")
    if arguments.workers < 1:
        raise InputError(f"--workers {arguments.workers}: expected 1 or more")
    target = Path(arguments.target.partition(":")[0])
    if is_program(arguments.target) or target.is_dir():
        firmware = absolute(arguments.target, Path())
        if arguments.target != "c" and not target.exists():
            raise InputError(f"{target}: no such file; expected a scenario, or a firmware")
        firmware_node(firmware, FirmwareConfig()).close()  # refused here, not in each run
        return {"name": "swarm", "duration_s": 1.0, "request": [], "firmware": firmware}
    loaded = load_scenario.load(arguments.target)
    table, _ = load_scenario.read(arguments.target)
    if loaded.scenario.firmware:
        table["firmware"] = loaded.scenario.firmware
        firmware_node(loaded.scenario.firmware, loaded.scenario.controller).close()
    table.pop("expect", None)
    table["name"] = "swarm"
    return table


def _folder(hunt: Hunt, arguments: argparse.Namespace) -> Path:
    """Return the folder to write; with --resume, the generations in it are taken over."""
    from sil.files.atomic import write_atomically
    from sil.swarm.hunt import SWARM_FILE, stored_generations

    if arguments.resume:
        if arguments.out is None:
            raise InputError("--resume: no folder; expected --out DIR of a swarm")
        for generation in stored_generations(arguments.out, hunt.digest):
            hunt.add(generation)
        return reopen_folder(arguments.out)
    folder = prepare_folder(arguments.out, "swarm", arguments.force)
    write_atomically(folder / SWARM_FILE, json.dumps({"sha256": hunt.digest}) + "\n")
    return folder


def news(hunt: Hunt) -> str:
    """Return runs, rate, what was new in the last ten minutes, and failures so far."""
    generations, recent_s = hunt.generations, 0.0
    recent: set[str] = set()
    before: set[str] = set()
    for generation in reversed(generations):
        (recent if recent_s < 600.0 else before).update(generation.transitions)
        recent_s += generation.wall_s
    new = len(recent - before)
    runs, wall_s = (sum(getattr(g, name) for g in generations) for name in ("runs", "wall_s"))
    failures = sum(len(generation.failures) for generation in generations)
    text = f"{counted(runs, 'run')}, {runs / max(wall_s, 1e-9):.1f} a second, {new} new transitions"
    minutes = min(recent_s, 600.0) / 60.0
    return f"{text} in the last {minutes:.0f} min, {counted(failures, 'failure')}"


def _print(hunt: Hunt, files: dict[str, Any], result: dict[str, Any]) -> None:
    runs, never = result["runs"], result["never_taken"]
    rate = runs / max(result["wall_s"], 1e-9)
    print(f"{counted(runs, 'run')}, {rate:.1f} a second, {counted(len(files), 'failure')}")
    for name, failure in files.items():
        print(f"  {name}: {failure.rule}: {failure.text} at {failure.time_s:.3f} s")
    taken = len(result["transitions"])
    print(f"transitions of the shift sequence taken: {taken} of {taken + len(never)}")
    if never:
        print(f"  never: {', '.join(never)}")
