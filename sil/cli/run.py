"""Run one scenario: plant and controller over CAN.

SCENARIO is a file, the name of a shipped scenario (see --list), or the result.json of an earlier
run, which then runs again as it was.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from sil.cli.draft import NEW, write_draft
from sil.cli.options import EFFECTS, JSON, MODEL, SEED, SETTINGS, argument, out, say
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.simulation.metrics import Shift
    from sil.simulation.runner import Finished

EXAMPLE = """\
example:
  opc4 run full_shift --transport local --out first
  opc4 run lab_n_b --set controller.filter=false --set valve.D_fall=0.01
"""

SHIFTS_PRINTED = 12


ARGUMENTS = (
    argument("scenario", "file or shipped name", "SCENARIO", nargs="?"),
    argument("--list", "list the shipped scenarios"),
    NEW,
    argument(
        "--transport",
        "one process; processes on a local bus; processes on a CAN interface [inproc]",
        "inproc|local[:NAME]|CHANNEL",
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
        "--speed",
        "pace the lockstep: simulated seconds per wall second",
        "FACTOR",
        type=float,
    ),
    *(MODEL, EFFECTS, SETTINGS, SEED),
    argument("--junit", "write the checks as JUnit XML", "FILE", type=Path),
    argument("--no-report", "no picture and no page"),
    *(*out("runs/SCENARIO-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario and print its result. Raises InputError and RunError as the runner does."""
    from can_dbc.errors import InputError

    if arguments.list:
        return _list()
    if arguments.new is not None:
        return write_draft("run", arguments, f"opc4 run {arguments.new}")
    if arguments.scenario is None:
        raise InputError("no SCENARIO; expected a file or a shipped name, see opc4 run --list")
    if arguments.junit is not None and not arguments.junit.parent.is_dir():
        raise InputError(f"{arguments.junit}: --junit: no such folder; expected one that exists")
    if arguments.junit is not None and arguments.junit.is_dir():
        raise InputError(f"{arguments.junit}: --junit: is a folder; expected a file")
    if arguments.junit is not None and not os.access(arguments.junit.parent, os.W_OK):
        raise InputError(
            f"{arguments.junit}: --junit: no permission; expected a folder to write in"
        )
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import close_folders, prepare_folder
    from sil.simulation import load_scenario
    from sil.simulation.free_run import jitter_lines
    from sil.simulation.results import as_json, junit_xml

    loaded = load_scenario.load(
        arguments.scenario,
        model=arguments.model,
        settings=arguments.settings,
        effects=arguments.effects,
        seed=arguments.seed,
    )
    paced = arguments.speed is not None or arguments.transport == "inproc"
    free_running = arguments.realtime and not paced
    speed = 1.0 if arguments.speed is None and arguments.realtime and paced else arguments.speed
    folder = prepare_folder(arguments.out, loaded.scenario.name, arguments.force)
    from sil.simulation import runner

    finished = runner.run(
        loaded,
        folder,
        transport=arguments.transport,
        speed=speed,
        free_running=free_running,
        external=arguments.external,
        say=say,
    )
    if not arguments.no_report and finished.result.complete:
        from sil.report.run_page import write_report

        write_report(finished, folder)
    if arguments.junit is not None:
        write_atomically(arguments.junit, junit_xml(finished.result))
    if finished.result.complete:
        close_folders(None)  # the mark INCOMPLETE goes before the files are listed
    if free_running:
        for line in jitter_lines(finished.result.bus):
            say(line)
    if arguments.json:
        print(as_json(finished.result))
    else:
        was_changed = bool(arguments.settings or arguments.model or arguments.seed is not None)
        is_shipped = loaded.source == str(load_scenario.shipped().get(arguments.scenario))
        _print_summary(finished, folder, is_shipped and was_changed)
    if not finished.result.complete:
        say(f"opc4 run: {finished.result.why}; what was recorded is in {folder}")
        return 3
    return 0 if finished.result.passed else 1


def _list() -> int:
    from sil.simulation import load_scenario

    for name in load_scenario.shipped():
        loaded = load_scenario.load(name)
        first = loaded.scenario.description.strip().split("\n")[0]
        print(f"{name:<24} {first}")
    return 0


def _harder_impact(shift: Shift) -> str:
    """Return what was harder than the stop, and whether the gear was confirmed too early."""
    worst, text = max(shift.impacts, key=lambda i: i.energy_j, default=None), ""
    if worst is not None and worst.name != "stay_stop":
        text += (
            f"; hardest impact: {worst.name.replace('_', ' ')}, {worst.energy_j:.2f} J, "
            f"{1e-3 * worst.peak_force_n:.1f} kN"
        )
    if shift.confirmed_early_s:
        text += f"; CONFIRMED {1e3 * shift.confirmed_early_s:.0f} ms BEFORE IT ARRIVED"
    return text


def _print_summary(finished: Finished, folder: Path, was_changed: bool) -> None:
    """Print the checks, shifts and files; `was_changed`: a shipped scenario with other values."""
    result = finished.result
    failed = [check for check in result.expectations if not check.passed]
    checks = len(result.expectations)
    outcome = f"{result.status}, {checks - len(failed)} of {checks} checks met"
    if was_changed and failed and result.complete:
        outcome = f"differs from the shipped expectations in {len(failed)} of {checks} checks"
    print(f"{result.scenario_name}: {outcome}")
    for check in failed:
        print(f"  {'differs' if was_changed else 'not met'}: {check}")
    for shift in finished.shifts[:SHIFTS_PRINTED]:
        took_s = shift.shift_time_s
        took = "never arrived" if took_s is None else f"{1e3 * took_s:.0f} ms from request to stop"
        line = f"  {shift.from_gear} to {shift.to_gear}: {took}"
        if shift.impact_speed_m_s is not None and shift.impact_energy_j is not None:
            line += f", impact {shift.impact_speed_m_s:.2f} m/s ({shift.impact_energy_j:.1f} J)"
        line += _harder_impact(shift)
        if shift.position_lag_10_s is not None and shift.position_lag_90_s is not None:
            line += (
                f"; controller's position late by {1e3 * shift.position_lag_10_s:.0f} ms at 10 %, "
                f"{1e3 * shift.position_lag_90_s:.0f} ms at 90 % of travel"
            )
        print(line)
    if len(finished.shifts) > SHIFTS_PRINTED:
        print(
            f"  and {counted(len(finished.shifts) - SHIFTS_PRINTED, 'more shift')}, in result.json"
        )
    if result.bus:
        print(
            f"  bus {100 * result.bus['load']:.0f} % loaded, {counted(result.bus['frames'], 'frame')}"
        )
    if "late_p50_s" in result.speed:
        late = [f"{q} {1e3 * result.speed[f'late_{q}_s']:.2f} ms" for q in ("p50", "p99", "max")]
        print(f"  real time: late by {', '.join(late)}; {result.speed['overruns']:.0f} overruns")
    names = sorted(p.name for p in folder.iterdir() if p.is_file())
    print(f"  {folder}: {' '.join(names)}")
