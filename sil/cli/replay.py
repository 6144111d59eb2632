"""Feed the inputs of a recorded log into the firmware alone, and compare its answers.

A truck's log, without commands of our control unit: each gear shift in it (J1939: ETC1 and ETC2, or by
--map) is simulated with our firmware and plant and compared with the recorded one.

LOG is a candump, ASC, BLF, TRC, MF4 or CSV log, packed or not. The firmware has the settings of the
run whose result.json is in the folder of LOG, else its defaults with the periods that the log shows.
Exit 1: something differs; for a truck's log: our firmware does not reach a gear. Exit 2: the log has no
valve command or shift, or it cannot be used.

example:
  opc4 replay runs/full_shift-1/bus.log --set controller.filter=false
  opc4 replay truck.asc.gz --strategy air_cushion
  opc4 replay truck-1.asc.gz truck-2.asc.gz --summary --out shifts

options of --options FILE, all optional:
  ignore = ["Etc1.*", "ControllerStatus.estimate_m"]     # signals that are not compared
  time_s = 0.01                                          # a value may come this much earlier or later
  [tolerance]                                            # differences up to this are ignored, SI units
  "ControllerStatus.estimate_m" = 1e-5
  [edges]
  window_s = 0.2                                         # an edge moved farther is another edge
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.errors import InputError
from sil.cli.options import JSON, SELECTION, SETTINGS, STRICT, TIMES, argument, out, reading
from sil.files.output_folder import close_folders, prepare_folder

if TYPE_CHECKING:
    from sil.log_replay.replay import ReplayResult
    from sil.log_replay.truck_replay import TruckReplay
    from sil.logs import Logs


class _PrintMap(argparse.Action):
    """Prints the shipped mapping and ends the command, as --help does."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from sil.j1939.mapping import SHIPPED

        print(SHIPPED.read_text(encoding="utf-8"), end="")
        parser.exit(0)


ARGUMENTS = (
    argument("log", "recorded log of the bus, - for standard input", "LOG"),
    argument("more_logs", "more files of the same log", "LOG", nargs="*", default=[]),
    argument(
        "--firmware",
        "settings of the firmware (TOML, a scenario, a result.json), a firmware of your own "
        "(FILE.py, FILE.py:CLASS, FILE.c or FILE.wasm), or the folder of another checkout with its firmware",
        "FILE",
    ),
    SETTINGS,
    argument("--options", "tolerances and ignore list (TOML)", "FILE"),
    argument("--dbc", "database of a log with other identifiers", "FILE"),
    argument("--map", "meaning of the signals of a truck's log (TOML; see --print-map)", "FILE"),
    argument(
        "--print-map", "print the mapping for J1939, to copy and change", action=_PrintMap, nargs=0
    ),
    argument("--strategy", "short for --set controller.strategy=NAME", "NAME"),
    argument(
        "--run",
        "scenario or result.json of the run that wrote the log [in the folder of LOG]",
        "SCENARIO",
    ),
    argument("--plant", "feed the recorded commands into the plant as well"),
    argument("--closed-loop", "let the plant answer from the first command that differs"),
    argument("--against", "compare with the firmware of another commit instead", "REV"),
    argument("--summary", "list the gear shifts of any truck's log (J1939)"),
    *(*SELECTION, STRICT, TIMES, *out("runs/replay-LOG-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Replay a log, or list its gear shifts. Raises InputError for options that exclude each other."""
    if arguments.summary:
        return _summary(arguments)
    if arguments.strategy is not None:
        chosen = {"controller.strategy": arguments.strategy}
        arguments.settings = {**arguments.settings, **chosen}
    if (code := _truck(arguments)) is not None:
        return code
    if arguments.against is not None and (arguments.plant or arguments.closed_loop):
        raise InputError("--against: not together with --plant or --closed-loop; expected one")
    from sil.log_replay.checkout import checkout
    from sil.log_replay.replay import ReplayRequest, replay
    from sil.log_replay.signals import Options, load_options

    with ExitStack() as stack:
        reference = None
        if arguments.against is not None:
            reference = stack.enter_context(checkout(arguments.against)), arguments.against
        names = ("settings", "log", "firmware", "run", "dbc", "plant", "closed_loop")
        request = ReplayRequest(
            reader=_open(arguments),
            options=load_options(arguments.options) if arguments.options else Options(),
            reference=reference,
            **{name: getattr(arguments, name) for name in names},
        )
        outcome = replay(request)
    _report(arguments, outcome)
    return 1 if outcome.differs else 0


def _report(arguments: argparse.Namespace, outcome: ReplayResult | TruckReplay) -> None:
    """Write the files of a replay and print it: a log that is refused leaves no folder behind."""
    from can_dbc.user_file import resolved
    from sil.log_replay.report import report

    reported = report(outcome)
    stem = Path(arguments.log).name.removesuffix(".gz").rsplit(".", 1)[0]
    parent = resolved(arguments.log).parent.name
    folder = _prepared(arguments, f"replay-{parent}" if stem == "bus" else f"replay-{stem}")
    files = {
        "diff.txt": reported.text,
        "report.html": reported.page(shlex.join(["opc4", *sys.argv[1:]]), folder),
        "diff.json": json.dumps(reported.values, ensure_ascii=False, indent=1) + "\n",
    }
    _complete(folder, files)
    if arguments.json:
        print(json.dumps(reported.values | {"out": str(folder)}, ensure_ascii=False, indent=1))
    else:
        print("\n".join([*reported.lines, f"  {_listing(folder)}"]))


def _prepared(arguments: argparse.Namespace, name: str) -> Path:
    """Return the output folder, without the figures of a replay that --force replaces."""
    logs = [arguments.log, *arguments.more_logs]
    folder = prepare_folder(arguments.out, name, arguments.force, inputs=logs)
    for figure in folder.glob("*.*"):
        is_picture = figure.suffix in (".png", ".svg")
        if is_picture and figure.stem.startswith(("scene_", "shift")):
            figure.unlink()
    return folder


def _complete(folder: Path, files: dict[str, str]) -> None:
    from sil.files.atomic import write_atomically

    for name, content in files.items():
        write_atomically(folder / name, content)
    close_folders(None)  # complete: the mark INCOMPLETE goes before the files are listed


def _listing(folder: Path) -> str:
    """Return the folder and the files in it, the pictures of single shifts counted."""
    names = sorted(path.name for path in folder.iterdir())
    if pictures := sum(name.startswith("shift_") for name in names):
        names = [name for name in names if not name.startswith("shift_")]
        names.append(f"and {pictures} pictures shift_N.png, shift_N.svg")
    return f"{folder}: {' '.join(names)}"


OWN_LOG_ONLY = ("run", "plant", "closed_loop", "against", "options")
"""Options that compare with commands of our own control unit, which a truck's log does not hold."""


def _truck(arguments: argparse.Namespace) -> int | None:
    """Compare a truck's log with our firmware and plant; return None for a log of our own unit."""
    from sil.log_replay.truck_replay import replay_truck

    given = [name for name in OWN_LOG_ONLY if getattr(arguments, name)]
    if given and arguments.map is not None:
        name = given[0].replace("_", "-")
        raise InputError(f"--map: a truck's log has no commands for --{name}; expected one of them")
    if given or (arguments.dbc is not None and arguments.map is None):
        return None
    options = {name: getattr(arguments, name) for name in ("map", "dbc", "settings", "firmware")}
    comparison = replay_truck(_open(arguments), **options)
    if comparison is None:
        return None
    _report(arguments, comparison)
    return 1 if comparison.failed else 0


def _open(arguments: argparse.Namespace) -> Logs:
    """Return all files of the log, of which the filters select."""
    from sil.logs import open_logs

    return open_logs([arguments.log, *arguments.more_logs], **reading(arguments))


def _summary(arguments: argparse.Namespace) -> int:
    from sil.j1939.summary import summarize
    from sil.shifts.reported import PGN_ETC1, PGN_ETC2

    replaying = (*OWN_LOG_ONLY, "firmware", "settings", "strategy", "dbc", "map")
    if given := [name for name in replaying if getattr(arguments, name)]:
        option = given[0].replace("settings", "set").replace("_", "-")
        what = "not together with --summary, which replays nothing; expected one of them"
        raise InputError(f"--{option}: {what}")
    reader = _open(arguments)
    summary = summarize(reader)
    report = reader.report
    if not any(pgn in (PGN_ETC1, PGN_ETC2) for pgn, _ in summary.groups):
        what = f"no ETC1 (PGN 61442) and no ETC2 (PGN 61445) among {summary.frames} frames"
        raise InputError(f"{reader.path}: {what}; expected a log of a truck's transmission")
    if report.time_base == "none":
        what = "has no times, so that no shift time is known"
        raise InputError(f"{reader.path}: {what}; expected a log with times (candump -L or -ta)")
    values = summary.as_dict() | {"log_report": report.as_dict()}
    lines = [f"{reader.path}: " + "\n".join(summary.lines())]
    if report.files or report.notes or not report.clean:
        lines += [f"log: {line}" for line in report.lines()[1:]]
    if arguments.out is not None:
        from sil.log_replay.report import shifts_page

        folder = _prepared(arguments, "summary")
        call = shlex.join(["opc4", *sys.argv[1:]])
        page = shifts_page(summary, reader.path, call, folder)
        values["out"] = str(folder)
        text = json.dumps(values, indent=1) + "\n"
        _complete(folder, {"report.html": page, "summary.json": text})
        lines.append(_listing(folder))
    print(json.dumps(values, indent=1) if arguments.json else "\n".join(lines))
    return 0
