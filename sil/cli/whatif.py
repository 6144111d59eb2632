"""Run a study: any values of model, firmware, sensor and bus swept, one table and its figures.

Exit code 3 if a row could not run, else 1 if a row failed, else 0.

example: opc4 whatif sensor_delay --workers 2 --out sweep/
"""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError
from sil.cli.options import EFFECTS, JSON, NEW, argument, out, table_lines, write_draft
from sil.files.output_folder import close_folders, finite, prepare_folder, reopen_folder
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.studies.study import Study, Table

ARGUMENTS = (
    argument("study", "study file, or a shipped study", "STUDY", nargs="?"),
    argument("--list", "list the shipped studies"),
    NEW,
    argument("--workers", "processes (default 1)", "N", type=int, default=1),
    argument("--cluster", "dask.distributed scheduler", "ADDRESS"),
    argument("--resume", "continue the sweep in DIR"),
    argument("--firmware", "a firmware of your own, as of opc4 run", "FILE"),
    argument("--rejudge", "of a study that searches: judge what is stored, without a search"),
    argument("--model", "parameter set or model file [the study's]", "MODEL"),
    *(EFFECTS, *out("runs/STUDY-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the rows and write what they give; return the exit code. Raises InputError and RunError."""
    from sil.files.atomic import write_atomically
    from sil.files.progress import Progress
    from sil.studies.executor import run_study
    from sil.studies.load_study import load_study, shipped
    from sil.studies.table import exit_code, read_table, summary

    if arguments.new is not None:
        return write_draft("whatif", arguments, f"opc4 whatif {arguments.new}")
    if arguments.list:
        for name, path in shipped().items():
            print(f"{name:24} {load_study(str(path)).file.description}")
        return 0
    if arguments.study is None:
        raise InputError("no STUDY; expected a file or a shipped name, see opc4 whatif --list")
    if arguments.workers < 1:
        raise InputError(f"--workers {arguments.workers}: expected 1 or more")
    study = load_study(arguments.study, arguments.effects, arguments.model, arguments.firmware)
    if arguments.rejudge:
        study = replace(study, file=study.file.without_search())
    folder = _folder(study, arguments)
    study = replace(study, folder=folder)
    how = {name: getattr(arguments, name) for name in ("workers", "cluster", "resume")}
    with Progress("rows") as progress:
        now = run_study(study, folder, progress=progress, **how)
    from sil.studies.study_page import write_page  # loads every kind of study

    table = read_table(study, folder)
    result = summary(study, table)
    files = [word for file in arguments.effects for word in ("--effects", file)]
    files += [] if arguments.model is None else ["--model", arguments.model]
    again = shlex.join(["opc4", "whatif", arguments.study, *files])
    write_atomically(folder / "summary.json", json.dumps(finite(result), indent=1) + "\n")
    for name, text in study.file.texts(study, table).items():
        write_atomically(folder / name, text)
    if sentences := study.file.sentences(study, table):
        result["safe_states"] = sentences
    write_page(study, table, result, folder, again)
    if arguments.json:
        print(json.dumps(finite({"out": str(folder), "rows_now": now, **result})))
    else:
        _print_summary(study, table, result)
        print(f"{counted(result['rows'], 'row')} ({now} run now) in {folder}")
    close_folders(None)  # complete, also if rows could not run
    return exit_code(table)


def _folder(study: Study, arguments: argparse.Namespace) -> Path:
    """Return the folder to write. Raises InputError if it cannot be used, naming --resume if that can."""
    from sil.studies.executor import rows_to_resume
    from sil.studies.table import RESULTS

    out: Path | None = arguments.out
    if arguments.resume:
        if out is None or not (out / RESULTS).exists():
            raise InputError("--resume: no sweep to continue; expected --out DIR of one")
        return reopen_folder(out)
    stored = None if arguments.force else rows_to_resume(study, out)
    if stored is not None:
        what = f"holds {stored} of {counted(study.size, 'row')} of this study"
        expected = "expected --resume to continue it, or --force to replace it"
        raise InputError(f"{out}: --out: {what}; {expected}")
    return prepare_folder(out, study.file.name, arguments.force)


def _print_summary(study: Study, table: Table, result: dict[str, Any]) -> None:
    """Print the metrics of rows or groups, and why rows did not pass."""
    from sil.studies.study_page import shown_rows

    sentences = result.get("safe_states", ())
    for sentence in sentences:
        print(sentence)
    if not sentences:
        print("\n".join(table_lines(*shown_rows(study, table))))
    for name, entry in result["groups"].items() if study.file.design.is_drawn else ():
        print(f"{name}: {_drawn_line(entry)}")
    counts = result["outcomes"]
    if counts["failed"] or counts["not_run"]:
        print(f"{counted(counts['failed'], 'row')} failed, {counts['not_run']} could not run:")
        reasons = [each for each in result["reasons"] if each["outcome"] != "passed"]
        for each in reasons[:10]:
            print(f"  {each['rows']} {each['outcome']}: {each['reason']} (row {each['first_row']})")


def _drawn_line(entry: dict[str, Any]) -> str:
    """Return the share of failures of a drawn group, and its hardest impacts."""
    failed = f"failed {100 * entry['failed_share']:.1f} %"
    failed += " ({:.1f} to {:.1f} %)".format(*(100 * end for end in entry["failed_interval"]))
    worst = entry.get("impact_worst_m_s", {}).get("p95")
    if worst:
        failed += ", hardest impact below {:.2f} m/s ({:.2f} to {:.2f}) in 95 %".format(*worst)
    return failed
