"""Watch trucks over months: track parameters shift by shift, date changes, extrapolate drifts.

A truck is a folder: under DIR the first folder below it, of a LOG the folder that it is in. --out
holds the results so far: called again, with more logs or after it was killed, it reads the logs that these
do not cover. A CSV file that begins with time_s,NAME,NAME_sd holds per-shift estimates of any names.
Exit 1: a change or a drift was found.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from pathlib import Path

from can_dbc.errors import InputError, RunError
from sil.cli.options import JSON, argument
from sil.files.quantity import counted

EXAMPLE = """\
example:
  opc4 watch fleet/ --out fleet-watch
"""

ARGUMENTS = (
    argument("target", "logs, or folders of logs", "DIR|LOG", nargs="+"),
    argument(
        "--limit",
        "extrapolate a drift to this value, in the parameter's unit; repeatable [two typical sizes]",
        "NAME=VALUE",
        action="append",
        default=[],
    ),
    argument("--model", "parameter set or model file", default="nominal", metavar="MODEL"),
    argument("--map", "meaning of the signals of logs with another layout (TOML)", "FILE"),
    argument("--dbc", "database with the signals that --map names", "FILE"),
    argument("--workers", "processes, for several trucks (default 1)", "N", type=int, default=1),
    argument("--cluster", "dask.distributed scheduler", "ADDRESS"),
    argument(
        "--out", "folder for the results, made if missing [runs/NAME-watch]", "DIR", type=Path
    ),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Take the logs; write watch.json and report.html; 1 if anything has changed.

    Raises InputError for a log that cannot be used and a limit that is none.
    """
    from plant.parameters import load_actuator
    from sil.files.output_folder import finite, locked_folder
    from sil.files.progress import Progress
    from sil.j1939.mapping import SignalMapping
    from sil.shift_diagnosis.store import STORE
    from sil.shift_diagnosis.track import CHANGED
    from sil.shift_diagnosis.watch import Watch
    from sil.shift_diagnosis.watch_page import write_watch
    from sil.shift_diagnosis.watched_files import log_files

    if arguments.workers < 1:
        raise InputError(f"--workers {arguments.workers}: expected 1 or more")
    limits = dict(map(_limit, arguments.limit))
    files = list(log_files(arguments.target))
    layout = arguments.map, arguments.dbc
    mapping = SignalMapping(*layout) if any(layout) else None
    out = arguments.out or Path("runs") / f"{Path(arguments.target[0]).resolve().stem}-watch"
    parameters, is_new = load_actuator(arguments.model), not out.exists()
    with locked_folder(out) as folder:
        for part in folder.glob(".*.part"):  # of a watch that was killed
            part.unlink()
        had_store = (folder / STORE).exists()
        watch = Watch(folder / STORE, parameters, mapping)
        try:
            with Progress("watching", "logs") as progress:
                found = watch.take(files, progress, arguments.workers, arguments.cluster)
            again = shlex.join(["opc4", *sys.argv[1:]])
            values = finite(write_watch(watch.trucks(), limits, folder, again))
        except (InputError, RunError, OSError):
            if not had_store and watch.is_empty:
                (folder / STORE).unlink()
                if is_new:
                    folder.rmdir()
            raise
        finally:
            watch.close()
    if arguments.json:
        print(json.dumps(values, ensure_ascii=False))
    else:
        _print(values)
        print(
            f"  {counted(len(found), 'change')} in new logs; written to {folder}", file=sys.stderr
        )
    return int(any(truck["verdict"] in CHANGED for truck in values["trucks"]))


def _limit(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        limit = float(value)
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        raise InputError(f"--limit {text}: expected NAME=VALUE, a finite number")
    return name, limit


def _print(values: dict) -> None:  # type: ignore[type-arg]
    for truck in values["trucks"]:
        print(
            f"{truck['truck']}: {truck['verdict']}, {counted(truck['shifts'], 'shift')} of "
            f"{counted(truck['logs'], 'log')}"
        )
        for line in truck["lines"]:
            print(f"  {line}")
