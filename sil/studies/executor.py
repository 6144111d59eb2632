"""Run the rows of a study, in order, over processes or a cluster, into a table that can be resumed.

One worker, two, or a cluster give the same bytes; a killed sweep leaves a prefix that `resume` continues.
"""

from __future__ import annotations

import csv
import functools
import gc
import io
import json
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.user_file import parse_json
from sil.files.atomic import write_atomically
from sil.files.worker import in_turn
from sil.simulation.inputs import changed_inputs
from sil.studies.study import Study, StudyRow
from sil.studies.table import RESULTS

STATE = "study.json"
OnProgress = Callable[[int, int], None]


def header(study: Study) -> str:
    """Return the first line: row, choices, swept values, figures, outcome, reason."""
    swept = [sweep.path for sweep in study.file.sweep]
    figures = study.file.columns()
    return _csv_line(["row", *study.file.groups, *swept, *figures, "outcome", "reason"])


def _csv_line(cells: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _line(study: Study, row: StudyRow) -> str:
    """Run one row and return it as CSV text; figures with all their digits, empty for NaN."""
    result = study.run(row)
    cells = [str(row.number), *row.choices]
    cells += [json.dumps(row.settings[sweep.path]) for sweep in study.file.sweep]
    figures = (result.figures[name] for name in study.file.columns())
    cells += ["" if math.isnan(value) else repr(value) for value in figures]
    return _csv_line([*cells, result.outcome, result.reason])


def run_chunk(study: Study, numbers: tuple[int, int]) -> list[str]:
    """Run the rows begin..end-1 of a study and return their lines."""
    rows = islice(study.rows(numbers[0]), numbers[1] - numbers[0])
    lines = [_line(study, row) for row in rows]
    _freeze_loaded_objects()
    return lines


@functools.cache
def _freeze_loaded_objects() -> None:
    """Exclude what a process has loaded for its rows from further garbage collections."""
    gc.collect()
    gc.freeze()


def run_study(
    study: Study,
    folder: Path,
    *,
    workers: int = 1,
    cluster: str | None = None,
    resume: bool = False,
    progress: OnProgress = lambda done, size: None,
) -> int:
    """Run the rows that are missing into folder/results.csv and return how many were run now.

    Raises InputError for another study's rows or a row that cannot be set up, RunError if a worker dies.
    """
    path, begin = folder / RESULTS, 0
    inputs = study.input_digests()
    if resume and path.exists():
        begin, length = completed(study, folder)
        os.truncate(path, length)
    else:
        state = {"study": study.file.name, "inputs": inputs}
        write_atomically(folder / STATE, json.dumps(state, indent=1) + "\n")
        write_atomically(path, header(study))
    rows = study.file.rows_together
    wanted = [(start, min(start + rows, study.size)) for start in range(begin, study.size, rows)]
    # the first rows run here: bad settings are reported at once, and kernels are compiled once
    work = partial(run_chunk if cluster is None else _run_sent_chunk, study)
    then = "the finished rows are stored; add --resume to continue"
    others = in_turn(work, wanted[1:], workers=workers, cluster=cluster, then=then)
    done = begin
    progress(done, study.size)
    try:
        with open(path, "a", encoding="utf-8", newline="") as file:
            for lines in chain((run_chunk(study, piece) for piece in wanted[:1]), others):
                file.write("".join(lines))
                file.flush()
                os.fsync(file.fileno())
                done += len(lines)
                progress(done, study.size)
    except InputError:
        if not done:  # there is nothing to resume
            path.unlink()
            (folder / STATE).unlink()
        raise
    if changed := changed_inputs(inputs, study.input_digests()):
        what = "changed while the study ran; the rows are of both"
        raise RunError(f"{path}: {', '.join(changed)} {what}")
    return done - begin


def _run_sent_chunk(study: Study, numbers: tuple[int, int]) -> list[str]:
    """Run a chunk on a machine that has the study only as it was sent."""
    from plant.effects.user_file import load_effects

    for file in study.file.effects:
        load_effects(file)
    return run_chunk(study, numbers)


def completed(study: Study, folder: Path) -> tuple[int, int]:
    """Return the number of whole rows in a study's table and their bytes. Raises InputError for another's."""
    state = folder / STATE
    try:
        stored = parse_json(state.read_text(encoding="utf-8"))
        inputs = msgspec.convert(stored["inputs"], dict[str, str])
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{state}: not the state of a sweep; expected one begun here") from None
    if changed := changed_inputs(inputs, study.input_digests()):
        remedy = "expected all as it was, --force or another --out"
        what = f"holds the rows of another study: {', '.join(changed)} changed since"
        raise InputError(f"{folder}: {what}; {remedy}")
    path = folder / RESULTS
    content = path.read_bytes()
    length = content.rfind(b"\n") + 1
    lines = content[:length].decode().splitlines()
    if not lines or lines[0] + "\n" != header(study):
        raise InputError(f"{path}: line 1: not this study's columns")
    for expected, text in enumerate(lines[1:]):
        if text.split(",", 1)[0] != str(expected):
            what = f"not row {expected}; expected the rows in order, or --force"
            raise InputError(f"{path}: line {expected + 2}: {what}")
    return len(lines) - 1, length


def rows_to_resume(study: Study, folder: Path | None) -> int | None:
    """Return how many rows of this study an interrupted run left in a folder, None for any other."""
    try:
        return None if folder is None else completed(study, folder)[0]
    except (InputError, OSError):
        return None
