"""Run one scenario: plant and controller over CAN.

SCENARIO is a file, the name of a shipped scenario (see --list), or the result.json of an earlier
run, which then runs again as it was.

example:
  opc4 run full_shift --transport local --out first
  opc4 run lab_n_b --set controller.filter=false --set valve.D_fall=0.01
"""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError, RunError
from sil.cli.options import (
    EFFECTS,
    FIRMWARE,
    JSON,
    MODEL,
    NEW,
    OWN_RULES,
    SEED,
    SETTINGS,
    argument,
    out,
    say,
    write_draft,
)
from sil.files.atomic import write_atomically
from sil.files.output_folder import close_folders, prepare_folder

if TYPE_CHECKING:
    from sil.simulation.load_scenario import Loaded
    from sil.simulation.runner import Finished


ARGUMENTS = (
    argument("scenario", "file or shipped name", "SCENARIO", nargs="?"),
    argument("--list", "list the shipped scenarios"),
    NEW,
    argument(
        "--transport",
        "one process; processes on a local bus; processes on a CAN interface, with --realtime also "
        "on one of python-can, as pcan:PCAN_USBBUS1 [inproc]",
        "inproc|local[:NAME]|CHANNEL|INTERFACE:CHANNEL",
        default="inproc",
    ),
    argument(
        "--external",
        "do not start this participant: it joins from elsewhere",
        action="append",
        default=[],
        choices=("controller", "plant"),
    ),
    argument(
        "--realtime",
        "run by the wall clock: on a bus each node has its own clock and only messages of the DBC "
        "are sent; with --speed, or in one process, the lockstep run is slowed down to it",
    ),
    argument(
        "--speed", "pace the lockstep: simulated seconds per wall second", "FACTOR", type=float
    ),
    *(FIRMWARE, MODEL, EFFECTS, SETTINGS, SEED, OWN_RULES),
    argument(
        "--save-at", "save the state at this instant into DIR/state.opc4", "SECONDS", type=float
    ),
    argument(
        "--break-at",
        "write a step of a firmware in C: the steps up to it as a program for a debugger, and the "
        "state before it for --from",
        "TICK",
        type=int,
    ),
    argument("--from", "continue a saved state to its end", "FILE", type=Path, dest="state"),
    argument("--strict", "judge changed values of a shipped scenario by its expectations"),
    argument("--junit", "write the checks as JUnit XML", "FILE", type=Path),
    argument("--no-report", "no picture and no page"),
    *(*out("runs/SCENARIO-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario and print its result. Raises InputError and RunError as the runner does."""
    if arguments.list:
        return _list()
    if arguments.new is not None:
        return write_draft("run", arguments, f"opc4 run {arguments.new}")
    if arguments.state is not None:
        return _continue(arguments)
    if arguments.scenario is None:
        raise InputError("no SCENARIO; expected a file or a shipped name, see opc4 run --list")
    if arguments.junit is not None:
        _check_junit(arguments.junit)
    from sil.firmware.load import in_module
    from sil.rules.user_file import load_rules
    from sil.simulation import load_scenario
    from sil.simulation.compared import against_shipped, without_expectations
    from sil.simulation.results import write_result

    names = ("model", "settings", "effects", "seed")
    overrides: Any = {name: getattr(arguments, name) for name in names}
    loaded = load_scenario.load(arguments.scenario, **overrides)
    rules = load_rules(arguments.rules)
    shipped = None
    is_shipped = loaded.source == str(load_scenario.shipped().get(arguments.scenario))
    is_changed = bool(arguments.settings or arguments.model or arguments.effects)
    if is_shipped and is_changed and not arguments.strict:
        shipped = load_scenario.load(arguments.scenario, seed=arguments.seed)
        table, path = load_scenario.read(arguments.scenario)
        stated = load_scenario.from_table(table | {"expect": {}}, str(path), **overrides)
        loaded = without_expectations(loaded, shipped, stated.scenario.expect)
    paced = arguments.speed is not None or arguments.transport == "inproc"
    free_running = arguments.realtime and not paced
    speed = 1.0 if arguments.speed is None and arguments.realtime and paced else arguments.speed
    if arguments.save_at is not None:
        _check_instant(arguments, loaded)
    folder = prepare_folder(arguments.out, loaded.scenario.name, arguments.force)
    from sil.simulation import runner

    how = {"transport": arguments.transport, "external": arguments.external, "rules": rules}
    finished = runner.run(loaded, folder, speed=speed, free_running=free_running, say=say, **how)
    why = finished.result.why or ""
    failed_in_c = "controller failed" in why and in_module(loaded.scenario.firmware)
    if arguments.break_at is not None or failed_in_c:
        _write_steps(loaded, arguments.break_at, folder)
    if arguments.save_at is not None:
        from sil.simulation.loop import Loop, save

        loop = Loop(loaded)  # the same once more: what a run holds is in its processes and files
        loop.advance(arguments.save_at)
        save(loop, folder / "state.opc4")
    if shipped is not None and finished.result.complete:
        finished = against_shipped(finished, shipped)
        write_result(finished.result, folder)
    if free_running:
        from sil.simulation.free_run import jitter_lines

        say("\n".join(jitter_lines(finished.result.bus)))
    return _report(arguments, finished, folder)


def _write_steps(loaded: Loaded, tick: int | None, folder: Path) -> None:
    """Write step `tick` (None: the last) of a firmware in C: break_TICK.c, opc4.h, and the state before it."""
    from sil.firmware.contract import header
    from sil.simulation.build import firmware_in_c
    from sil.simulation.loop import Loop, save

    loop = Loop(loaded)
    node = firmware_in_c(loop.participants)
    if node is None:
        raise InputError("--break-at: the firmware is not in C; expected FILE.c")
    steps = node.steps = []
    with contextlib.suppress(RunError):  # the step that is looked at may be the one that fails
        loop.finish()
    tick = len(steps) - 1 if tick is None else tick
    if not 0 <= tick < len(steps):
        raise InputError(f"--break-at {tick}: expected 0 to {len(steps) - 1}")
    del steps[tick + 1 :]
    write_atomically(folder / f"break_{tick}.c", node.reproduction(f"break_{tick}"))
    write_atomically(folder / "opc4.h", header())
    again = Loop(loaded)
    again.lockstep.advance(steps[tick].now_ns - 1)
    save(again, folder / f"break_{tick}.opc4")


def _check_instant(arguments: argparse.Namespace, loaded: Loaded) -> None:
    """Raise InputError unless a state can be saved at that instant of such a run."""
    at_s, end_s = arguments.save_at, loaded.scenario.duration_s
    if not 0.0 <= at_s < end_s:
        raise InputError(f"--save-at {at_s:g}: expected 0 to before the end, {end_s:g} s")
    if arguments.transport != "inproc" or arguments.realtime:
        raise InputError("--save-at: only of a run in one process; expected --transport inproc")


def _continue(arguments: argparse.Namespace) -> int:
    """Run a saved state to its end. Raises InputError for another file, and with a scenario or values."""
    from sil.simulation.loop import load
    from sil.simulation.runner import resume

    given = (arguments.scenario, arguments.model, arguments.seed, arguments.save_at)
    is_given = any(value is not None for value in given)
    if is_given or arguments.settings or arguments.effects:
        raise InputError("--from: with a scenario or other values; expected the saved state alone")
    loop = load(arguments.state)
    folder = prepare_folder(arguments.out, loop.loaded.scenario.name, arguments.force)
    return _report(arguments, resume(loop, folder), folder)


def _report(arguments: argparse.Namespace, finished: Finished, folder: Path) -> int:
    """Write page and JUnit file, print the result; return the exit code."""
    from sil.cli.run_summary import summary_lines
    from sil.simulation.results import as_json, junit_xml

    if not arguments.no_report and finished.result.complete:
        from sil.report.run_page import write_report

        write_report(finished, folder)
    if arguments.junit is not None:
        write_atomically(arguments.junit, junit_xml(finished.result))
    if finished.result.complete:
        close_folders(None)  # the mark INCOMPLETE goes before the files are listed
    if arguments.json:
        print(as_json(finished.result))
    else:
        name = finished.result.scenario_name
        print("\n".join(summary_lines(finished, folder, f"{name} with {_changed_by(arguments)}")))
    if not finished.result.complete:
        why = f"opc4 run: {finished.result.why}"
        say("; ".join([why, *close_folders(why)]))
        return 3
    return 0 if finished.result.passed else 1


def _check_junit(path: Path) -> None:
    """Raise InputError if the file cannot be written."""
    problems = {
        "no such folder; expected one that exists": not path.parent.is_dir(),
        "is a folder; expected a file": path.is_dir(),
        "no permission; expected a folder to write in": not os.access(path.parent, os.W_OK),
    }
    for problem, is_so in problems.items():
        if is_so:
            raise InputError(f"{path}: --junit: {problem}")


def _changed_by(arguments: argparse.Namespace) -> str:
    """Return what was changed, as it was typed."""
    from sil.files.overrides import setting_texts

    others = {"model": arguments.model, "effects": arguments.effects}
    words = [f"{option} {value}" for option, value in others.items() if value]
    return ", ".join([*setting_texts(arguments.settings), *words])


def _list() -> int:
    from sil.simulation import load_scenario

    for name in load_scenario.shipped():
        loaded = load_scenario.load(name)
        first = loaded.scenario.description.strip().split("\n")[0]
        print(f"{name:<24} {first}")
    return 0
