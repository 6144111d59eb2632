"""Runs a study's rows, in order, over processes or a cluster, into a table that can be resumed.

Rows are written in the order of their numbers whoever ran them, so one worker, two, or a cluster
give the same bytes, and a killed sweep leaves a prefix that `resume` continues.
"""

from __future__ import annotations

import functools
import gc
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.errors import InputError, RunError
from sil.files.atomic import write_atomically
from sil.studies.rows import columns, run_row
from sil.studies.study import Base, LoadedStudy, Row, Study, toml_value

RESULTS, STATE = "results.csv", "study.json"
CHUNK = 16
"""Rows of runs that a worker takes at a time; the longer rows of other kinds go one by one."""

Progress = Callable[[int, int], None]


def header(study: LoadedStudy) -> list[str]:
    """Columns of the table: row, choices, swept values, metrics."""
    names = ["row", *(name for name, _items in study.groups)]
    return [*names, *(sweep.path for sweep in study.study.sweep), *columns(study)]


def first_line(study: LoadedStudy) -> str:
    """The columns as CSV text."""
    return ",".join(quoted(name) for name in header(study)) + "\n"


def line(study: LoadedStudy, row: Row, found: dict[str, float]) -> str:
    """One row of the table as CSV text."""
    cells = [str(row.number), *row.choices]
    cells += [toml_value(row.settings[sweep.path]) for sweep in study.study.sweep]
    cells += [number(found[name]) for name in columns(study)]
    return ",".join(quoted(cell) for cell in cells) + "\n"


def number(value: float) -> str:
    """A number with all its digits; empty for none."""
    return "" if math.isnan(value) else repr(value)


def quoted(cell: str) -> str:
    """A CSV cell, quoted where it must be."""
    if any(c in cell for c in ',"\n'):
        return '"' + cell.replace('"', '""') + '"'
    return cell


def run_chunk(study: LoadedStudy, numbers: tuple[int, int]) -> list[str]:
    """Lines of the rows begin..end-1 of a study; what a worker does."""
    rows = islice(study.rows(numbers[0]), numbers[1] - numbers[0])
    lines = [line(study, row, run_row(study, row)) for row in rows]
    _spare_the_collector()
    return lines


@functools.cache
def _spare_the_collector() -> None:
    """Once a process has loaded what rows need, the collector need not walk it again and again."""
    gc.collect()
    gc.freeze()


def chunks(begin: int, size: int, rows: int = CHUNK) -> Iterator[tuple[int, int]]:
    """Row numbers in pieces."""
    for start in range(begin, size, rows):
        yield start, min(start + rows, size)


def run_study(
    study: LoadedStudy,
    folder: Path,
    *,
    workers: int = 1,
    cluster: str | None = None,
    resume: bool = False,
    progress: Progress = lambda done, size: None,
) -> int:
    """Run the rows that are missing into folder/results.csv; returns how many were run now.

    Raises InputError when `folder` holds another study's rows, or a row cannot be set up; RunError
    when a worker dies or the cluster cannot be reached.
    """
    path, begin = folder / RESULTS, 0
    if resume and path.exists():
        begin = completed(study, folder)
    else:
        write_atomically(
            folder / STATE, json.dumps({"study": study.study.name, "sha256": study.digest})
        )
        write_atomically(path, first_line(study))
    wanted = list(chunks(begin, study.size, CHUNK if study.study.kind == "runs" else 1))
    # the first row runs here: bad settings are told at once, and kernels are compiled once
    done = begin
    with open(path, "a", encoding="utf-8", newline="") as file:
        for lines in results(study, wanted, workers, cluster):
            file.write("".join(lines))
            file.flush()
            os.fsync(file.fileno())
            done += len(lines)
            progress(done, study.size)
    return done - begin


def results(
    study: LoadedStudy, wanted: list[tuple[int, int]], workers: int, cluster: str | None
) -> Iterable[list[str]]:
    """Lines of each chunk, in order."""
    if not wanted:
        return
    yield run_chunk(study, wanted[0])
    rest = wanted[1:]
    if cluster is not None:
        yield from on_cluster(study, rest, cluster)
    elif workers > 1 and rest:
        yield from on_processes(study, rest, workers)
    else:
        for piece in rest:
            yield run_chunk(study, piece)


_STUDY: list[LoadedStudy] = []
"""The study of a worker process."""


def begin_worker(study: LoadedStudy, parent: int) -> None:
    """Keep the study, leave interrupts to the parent, and end when it is gone."""
    import signal
    import threading

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _STUDY[:] = [study]
    threading.Thread(target=watch, daemon=True).start()


def run_worker_chunk(numbers: tuple[int, int]) -> list[str]:
    """As `run_chunk`, of the worker's study."""
    return run_chunk(_STUDY[0], numbers)


def on_processes(
    study: LoadedStudy, wanted: list[tuple[int, int]], workers: int
) -> Iterable[list[str]]:
    """Chunks over worker processes of this machine."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("fork"),
        initializer=begin_worker,
        initargs=(study, os.getpid()),
    )
    try:
        yield from pool.map(run_worker_chunk, wanted)
    except BrokenProcessPool:
        raise RunError("a worker process died; what was done is kept: --resume goes on") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def on_cluster(
    study: LoadedStudy, wanted: list[tuple[int, int]], address: str
) -> Iterable[list[str]]:
    """Chunks over a dask.distributed cluster, gathered in order; workers need this package."""
    try:
        from distributed import Client
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise InputError(
            "--cluster: dask.distributed is not installed; expected the extra 'cluster'"
        ) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise RunError(f"--cluster {address}: cannot be reached: {error}") from None
    try:
        if not client.scheduler_info()["workers"]:
            raise RunError(f"--cluster {address}: the scheduler has no workers; expected some")
        told = msgspec.to_builtins(study.study)
        base = None if study.base is None else msgspec.to_builtins(study.base)
        futures = client.map(
            partial(run_sent_chunk, study.digest, told, study.source, base),
            wanted,
            pure=False,
            retries=2,
        )
        for future in futures:
            yield future.result()
            future.release()
    except (KilledWorker, FutureCancelledError, OSError) as error:
        raise RunError(
            f"--cluster {address}: lost: {error}; what was done is kept: --resume goes on"
        ) from None
    finally:
        client.close()


_SENT: dict[str, LoadedStudy] = {}


def run_sent_chunk(
    digest: str,
    study: dict[str, Any],
    source: str,
    base: dict[str, Any] | None,
    numbers: tuple[int, int],
) -> list[str]:
    """As `run_chunk`, on a machine that has the study only as it was sent."""
    if digest not in _SENT:
        _SENT[digest] = LoadedStudy(
            msgspec.convert(study, Study),
            source,
            None if base is None else msgspec.convert(base, Base),
        )
    return run_chunk(_SENT[digest], numbers)


def completed(study: LoadedStudy, folder: Path) -> int:
    """How many rows of this study the folder's table holds; a torn last line is cut off.

    Raises InputError when the table belongs to another study.
    """
    state = folder / STATE
    try:
        told = json.loads(state.read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{state}: not the state of a sweep; expected one begun here") from None
    if told != study.digest:
        raise InputError(
            f"{folder}: holds the rows of another study; expected --force or another --out"
        )
    path = folder / RESULTS
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    lines = content[:whole].decode().splitlines()
    if not lines or lines[0] + "\n" != first_line(study):
        raise InputError(f"{path}: line 1: not this study's columns")
    for expected, text in enumerate(lines[1:]):
        if text.split(",", 1)[0] != str(expected):
            raise InputError(f"{path}: line {expected + 2}: not row {expected}")
    if whole < len(content):
        with open(path, "r+b") as file:
            file.truncate(whole)
    return len(lines) - 1
