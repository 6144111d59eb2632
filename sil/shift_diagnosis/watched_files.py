"""Which files a watch takes, of which truck and in which order; files of per-shift observations.

Checked by: tests/unit/sil/shift_diagnosis/test_watched_files.py
"""

from __future__ import annotations

import codecs
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from sil.logs import FORMATS, open_log
from sil.shift_diagnosis.change import Change
from sil.shift_diagnosis.store import ABSOLUTE_S, Taken
from sil.shift_diagnosis.track import Track

Floats = NDArray[np.float64]

OBSERVATIONS: Final = "time_s,"
"""How a file of per-shift observations begins: time_s, then NAME and NAME_sd of every parameter."""
AT_ONCE: Final = 5000
"""Observations that are taken in one call."""


def log_files(targets: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Yield (truck, log): a file's truck is its folder; under a folder, the first folder below it.

    Numbers in names count as numbers: 9 before 10. Names that begin with a dot are left out.
    Raises InputError for what does not exist, or a folder without logs.
    """
    suffixes = {suffix for one in FORMATS.values() for suffix in one.suffixes}
    for target in targets:
        path = Path(target)
        if path.is_file():
            yield Path(os.path.abspath(path)).parent.name, path
            continue
        if not path.is_dir():
            raise InputError(f"{target}: no such file or folder; expected logs or a folder of them")
        files = sorted(
            (
                file
                for file in _files(path)
                if Path(file.name.removesuffix(".gz")).suffix.lower() in suffixes
            ),
            key=lambda file: [_by_number(part) for part in file.parts],
        )
        if not files:
            raise InputError(f"{target}: no log in it; expected {', '.join(sorted(suffixes))}")
        for file in files:
            inside = file.relative_to(path).parts
            yield inside[0] if len(inside) > 1 else Path(os.path.abspath(path)).name, file


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files under a folder, links followed; no hidden ones, no folder twice."""
    passed = set[str]()
    for parent, folders, names in os.walk(folder, onerror=_refuse, followlinks=True):
        real = os.path.realpath(parent)
        folders[:] = [] if real in passed else [n for n in folders if not n.startswith(".")]
        if real not in passed:
            yield from (Path(parent, n) for n in names if not n.startswith("."))
        passed.add(real)


def _refuse(error: OSError) -> NoReturn:
    raise error


def _by_number(name: str) -> list[str | int]:
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def in_time(paths: Iterable[Path]) -> list[Path]:
    """Return logs by the time at which they begin; as given if one has no time of day.

    A log that cannot be read comes last.
    """
    ordered = sorted(((_begin_s(path), path) for path in paths), key=lambda item: item[0])
    if ordered and ordered[0][0] < ABSOLUTE_S:
        return list(paths)
    return [path for _, path in ordered]


def _begin_s(path: Path) -> float:
    """Return the time of a log's first frame or observation, infinity if it cannot be read."""
    try:
        if is_observations(path):
            return float(next(_blocks_of(path))[1][0, 0])
        return next(frame.time_ns for frame in open_log(path)) / 1e9
    except (InputError, StopIteration):
        return math.inf


def is_observations(path: Path) -> bool:
    """Return whether a file begins as one of per-shift observations does."""
    with path.open("rb") as file:
        head = file.read(len(OBSERVATIONS) + len(codecs.BOM_UTF8))
    return head.removeprefix(codecs.BOM_UTF8).startswith(OBSERVATIONS.encode())


def observed(path: Path, track: Track | None) -> tuple[Track, list[Change], Taken]:
    """Take a file of per-shift observations: estimates with standard deviations.

    Raises InputError for a line that is none.
    """
    changes: list[Change] = []
    taken = Taken()
    for names, rows in _blocks_of(path):
        track = track or Track.of(names)
        require_names(path, track, names)
        weight = rows[:, 2::2] ** -2.0
        information = np.zeros((len(rows), len(names), len(names)))
        information[:, range(len(names)), range(len(names))] = weight
        changes += track.take(information, weight * rows[:, 1::2], rows[:, 0])
        taken = taken.after(rows[:, 0].tolist())
    assert track is not None  # there is at least one block, or an error
    return track, changes, taken


def _blocks_of(path: Path) -> Iterator[tuple[tuple[str, ...], Floats]]:
    """Yield the parameters' names, and some thousand rows at a time.

    Raises InputError for a line that is none of such a file, and a file without rows.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = [word.strip() for word in file.readline().split(",")]
        names, first = tuple(head[1::2]), 2
        if not names or head[2::2] != [f"{name}_sd" for name in names]:
            raise InputError(
                f"{path}: line 1: {','.join(head)[:80]}; expected time_s, then NAME and NAME_sd"
            )
        while lines := list(islice(file, AT_ONCE)):
            yield names, np.array([_row(path, *item, names) for item in enumerate(lines, first)])
            first += len(lines)
        if first == 2:
            raise InputError(f"{path}: no line after the first; expected one for each shift")


def _row(path: Path, number: int, line: str, names: Sequence[str]) -> list[float]:
    try:
        row = [float(word) for word in line.split(",")]
    except ValueError:
        row = []
    if len(row) != 1 + 2 * len(names):
        raise InputError(
            f"{path}: line {number}: {line.strip()[:60]!r}; expected {1 + 2 * len(names)} numbers"
        )
    if not all(map(math.isfinite, row)) or min(row[2::2]) <= 0.0:
        raise InputError(
            f"{path}: line {number}: {line.strip()[:60]!r}; expected finite numbers and standard "
            "deviations above 0"
        )
    return row


def require_names(path: Path, track: Track, names: Sequence[str]) -> None:
    """Raise InputError unless a log tells of the parameters that the truck has in the store."""
    if list(track.names) != list(names):
        raise InputError(
            f"{path}: parameters {', '.join(names)}; expected those that the truck has in the store: "
            f"{', '.join(track.names)}"
        )
