"""Runs a study's rows, in order, over processes or a cluster, into a table that can be resumed.

Rows are written in the order of their numbers whoever ran them, so one worker, two, or a cluster
give the same bytes, and a killed sweep leaves a prefix that `resume` continues.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path

from can_dbc.errors import InputError, RunError
from sil.results import write_whole
from sil.whatif.rows import columns, run_row
from sil.whatif.study import LoadedStudy, Row, load_study, toml_value

RESULTS, STATE = "results.csv", "study.json"
CHUNK = 16

Progress = Callable[[int, int], None]


def header(study: LoadedStudy) -> list[str]:
    """Columns of the table: row, choices, swept values, metrics."""
    names = ["row", *(name for name, _items in study.groups)]
    return [*names, *(sweep.path for sweep in study.study.sweep), *columns(study)]


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


def run_chunk(source: str, numbers: tuple[int, int]) -> list[str]:
    """Lines of the rows begin..end-1 of a study file; what a worker does."""
    study = _study(source)
    rows = islice(study.rows(numbers[0]), numbers[1] - numbers[0])
    return [line(study, row, run_row(study, row)) for row in rows]


_LOADED: dict[str, LoadedStudy] = {}


def _study(source: str) -> LoadedStudy:
    if source not in _LOADED:
        _LOADED[source] = load_study(source)
    return _LOADED[source]


def chunks(begin: int, size: int) -> Iterator[tuple[int, int]]:
    """Row numbers in pieces."""
    for start in range(begin, size, CHUNK):
        yield start, min(start + CHUNK, size)


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
        write_whole(folder / STATE, json.dumps({"study": study.study.name, "sha256": study.digest}))
        write_whole(path, ",".join(header(study)) + "\n")
    wanted = list(chunks(begin, study.size))
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
    source = str(Path(study.source).resolve())
    _LOADED[source] = study
    yield run_chunk(source, wanted[0])
    rest = wanted[1:]
    if cluster is not None:
        yield from on_cluster(source, rest, cluster)
    elif workers > 1 and rest:
        yield from on_processes(source, rest, workers)
    else:
        for piece in rest:
            yield run_chunk(source, piece)


def on_processes(
    source: str, wanted: list[tuple[int, int]], workers: int
) -> Iterable[list[str]]:
    """Chunks over worker processes of this machine."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(workers, mp_context=context)
    try:
        yield from pool.map(run_chunk, [source] * len(wanted), wanted)
    except BrokenProcessPool:
        raise RunError("a worker process died; what was done is kept: --resume goes on") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def on_cluster(source: str, wanted: list[tuple[int, int]], address: str) -> Iterable[list[str]]:
    """Chunks over a dask.distributed cluster, gathered in order."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--cluster: dask.distributed is not installed; expected the extra 'cluster'"
        ) from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise RunError(f"--cluster {address}: cannot be reached: {error}") from None
    text = Path(source).read_text(encoding="utf-8")
    try:
        futures = client.map(
            run_chunk_of_text, [text] * len(wanted), wanted, pure=False, retries=2
        )
        for future in futures:
            yield future.result()
    finally:
        client.close()


def run_chunk_of_text(text: str, numbers: tuple[int, int]) -> list[str]:
    """As `run_chunk`, on a machine that has the study only as text."""
    import hashlib
    import tempfile

    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"opc4-study-{os.getuid()}-{name}.toml"
    if not path.exists():
        write_whole(path, text)
    return run_chunk(str(path), numbers)


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
        raise InputError(f"{folder}: holds the rows of another study; expected --force or another --out")
    path = folder / RESULTS
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    lines = content[:whole].decode().splitlines()
    if not lines or lines[0] != ",".join(header(study)):
        raise InputError(f"{path}: line 1: not this study's columns")
    for expected, text in enumerate(lines[1:]):
        if text.split(",", 1)[0] != str(expected):
            raise InputError(f"{path}: line {expected + 2}: not row {expected}")
    if whole < len(content):
        with open(path, "r+b") as file:
            file.truncate(whole)
    return len(lines) - 1
