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
from sil.logs.csv_log import OUR_HEADER
from sil.shift_diagnosis.change import Change
from sil.shift_diagnosis.store import ABSOLUTE_S, Taken
from sil.shift_diagnosis.track import Track

Floats = NDArray[np.float64]

OBSERVATIONS: Final = (b"time_s,", b"time_s;")
"""How a file of per-shift observations begins: time_s, then NAME and NAME_sd of every parameter."""
LATEST_S: Final = 1e11
LARGEST: Final = 1e30
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
    """Return whether a file begins as one of per-shift observations does, and not as a CAN log."""
    with path.open("rb") as file:
        head = file.read(200).removeprefix(codecs.BOM_UTF8)
    return head.startswith(OBSERVATIONS) and not head.startswith(OUR_HEADER.encode())


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
        line = file.readline()
        delimiter = ";" if ";" in line else ","
        head = [word.strip() for word in line.split(delimiter)]
        names, first = tuple(head[1::2]), 2
        named = all(names) and len(set(names)) == len(names) > 0
        if not named or head[2::2] != [f"{name}_sd" for name in names]:
            raise InputError(
                f"{path}: line 1: {line.strip()[:80]}; expected time_s, then NAME and NAME_sd, each "
                "name once"
            )
        while lines := list(islice(file, AT_ONCE)):
            rows = [
                _row(f"{path}: line {k}", line, delimiter, names)
                for k, line in enumerate(lines, first)
            ]
            yield names, np.array(rows)
            first += len(lines)
        if first == 2:
            raise InputError(f"{path}: no line after the first; expected one for each shift")


def _row(where: str, line: str, delimiter: str, names: Sequence[str]) -> list[float]:
    """Return the numbers of a line; with semicolons between them they may have decimal commas."""
    try:
        words = line.split(delimiter)
        row = [float(word.replace(",", ".") if delimiter == ";" else word) for word in words]
    except ValueError:
        row = []
    shown = f"{where}: {line.strip()[:60]!r}"
    if len(row) != 1 + 2 * len(names):
        raise InputError(f"{shown}; expected {1 + 2 * len(names)} numbers")
    if not abs(row[0]) <= LATEST_S:
        raise InputError(f"{shown}; expected a time in s, from 1970 or from the begin of the log")
    if not all(abs(number) <= LARGEST for number in row) or min(row[2::2]) < 1.0 / LARGEST:
        raise InputError(
            f"{shown}; expected numbers up to {LARGEST:g}, and standard deviations above 0"
        )
    return row


def require_names(path: Path, track: Track, names: Sequence[str]) -> None:
    """Raise InputError unless a log tells of the parameters that the truck has in the store."""
    if list(track.names) != list(names):
        raise InputError(
            f"{path}: parameters {', '.join(names)}; expected those that the truck has in the store: "
            f"{', '.join(track.names)}"
        )
