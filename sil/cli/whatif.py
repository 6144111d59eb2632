"""Run a study: any values of model, firmware, sensor and bus swept, one table and its pictures."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

EXAMPLE = "example: opc4 whatif sensor_delay --workers 2 --out sweep/"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("study", metavar="STUDY", nargs="?", help="study file, or a shipped study")
    parser.add_argument("--list", action="store_true", help="list the shipped studies")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="dask.distributed scheduler")
    parser.add_argument("--resume", action="store_true", help="continue the sweep in DIR")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write")
    parser.add_argument("--force", action="store_true", help="replace a sweep in DIR")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Run the rows, write table, summary, pictures and page."""
    from can_dbc.errors import InputError
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite, prepare_folder, reopen_folder
    from sil.studies.executor import RESULTS, run_study
    from sil.studies.load_study import load_study, shipped
    from sil.studies.pictures import draw, read_metrics
    from sil.studies.study_page import page
    from sil.studies.table import read_table, summary

    if arguments.list:
        for name, path in shipped().items():
            print(f"{name:24} {load_study(str(path)).study.description}")
        return 0
    if arguments.study is None:
        raise InputError("whatif: no study; expected a study file, or --list")
    if arguments.workers < 1:
        raise InputError(f"--workers {arguments.workers}: expected 1 or more")
    study = load_study(arguments.study)
    if arguments.resume:
        if arguments.out is None or not (arguments.out / RESULTS).exists():
            raise InputError("--resume: no sweep to continue; expected --out DIR of one")
        folder = reopen_folder(arguments.out)
    else:
        folder = prepare_folder(arguments.out, study.study.name, arguments.force)
    terminal = sys.stderr.isatty()

    def progress(done: int, size: int) -> None:
        if terminal:
            print(f"\r{done} of {size} rows", end="", file=sys.stderr, flush=True)

    now = run_study(
        study,
        folder,
        workers=arguments.workers,
        cluster=arguments.cluster,
        resume=arguments.resume,
        progress=progress,
    )
    if terminal:
        print(file=sys.stderr)
    table = read_table(study, folder)
    told = summary(study, table)
    write_atomically(folder / "summary.json", json.dumps(finite(told), indent=1) + "\n")
    if study.study.safety:
        from sil.studies.fault_table import FAULT_TABLE, draw_outcomes, fault_table, kept

        told["kept"] = kept(study, table)
        write_atomically(folder / FAULT_TABLE, fault_table(study, table))
    pictures = draw(study, table, folder)
    if study.study.safety:
        pictures.append(draw_outcomes(study, table, folder))
    again = shlex.join(["opc4", "whatif", arguments.study])
    write_atomically(folder / "report.html", page(study, table, told, pictures, again))
    if arguments.json:
        print(json.dumps(finite({"out": str(folder), "rows_now": now, **told})))
        return 0
    for sentence in told.get("kept", ()):
        print(sentence)
    groups = {} if study.study.safety else told["groups"]
    for name, entry in groups.items():
        if study.study.kind != "runs":
            print(f"{name or study.study.name}: {brief(entry, read_metrics(study))}")
            continue
        speed = entry.get("impact_speed_m_s")
        time = entry.get("shift_time_s") or entry.get("arrival_s")
        parts = [f"{entry['rows']} rows"]
        if time:
            parts.append(f"time {1e3 * time['median']:.0f} ms ({1e3 * time['max']:.0f} at worst)")
        if speed:
            parts.append(f"impact {speed['median']:.2f} m/s ({speed['max']:.2f} at worst)")
        parts.append(f"failed {100 * entry['failed_share']:.1f} %")
        print(f"{name or study.study.name}: {', '.join(parts)}")
    print(f"{told['rows']} rows ({now} run now) in {folder}")
    return 0


def brief(entry: dict[str, Any], metrics: list[str]) -> str:
    """The first metrics of a group of rows on one line: value, or least to greatest."""
    parts = [f"{entry['rows']} rows"] if entry["rows"] > 1 else []
    for name in metrics:
        if name in entry:
            low, high = entry[name]["min"], entry[name]["max"]
            parts.append(f"{name} {low:.3g}" + (f" to {high:.3g}" if high > low else ""))
    return ", ".join(parts) or "nothing to tell"
