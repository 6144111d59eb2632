"""Trucks watched over months: logs taken once, each in one transaction of an SQLite store.

Checked by: tests/unit/sil/shift_diagnosis/test_watch.py
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from can_dbc.errors import InputError
from plant.parameters import ParameterSet
from sil.files.progress import Progress
from sil.j1939.mapping import SignalMapping
from sil.logs import FORMATS
from sil.shift_diagnosis.change import Change
from sil.shift_diagnosis.confirm import Confirming
from sil.shift_diagnosis.healthy import FIT_SHIFTS, loaded_fit, rest_noise_m
from sil.shift_diagnosis.linear import Floats, Noise, linearise
from sil.shift_diagnosis.loads import CONE, own_loads, with_speeds, without_speeds
from sil.shift_diagnosis.model import Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import Shift, shifts_of
from sil.shift_diagnosis.track import Track
from sil.shift_diagnosis.verdict import LARGEST

STORE: Final = "watch.sqlite"
STORE_VERSION: Final = 5
AT_ONCE: Final = 200
"""Shifts that are simulated in one call."""
ODD: Final = 8.0
"""Chi squared by that of the truck's usual shifts from which a shift is odd: reported, not tracked."""
MOST_ODD: Final = 200
OBSERVATIONS: Final = "time_s,"
"""How a file of per-shift observations begins: time_s, then NAME and NAME_sd of every parameter."""

_TABLES: Final = """
create table if not exists log (truck text, path text, size integer, first integer, shifts integer,
  skipped integer, primary key (truck, path));
create table if not exists truck (name text primary key, reference blob, track blob);
create table if not exists odd (truck text, number integer, time_s real, path text, chi2 real);
"""


class Reference(msgspec.Struct):
    """Where a truck's shifts are linearised: its own quantities, as its first log shows them.

    values: in prior standard deviations; chi2: per number, of its usual shifts; loads: those that
    each shift has of its own.
    """

    mounted: bool
    values: list[float]
    noise_m: float
    scatter: float
    chi2: float
    shifts: int
    loads: tuple[str, ...] = ()


@dataclass(frozen=True)
class Watched:
    """One truck as the store has it.  change_logs: the log that begins with or holds each change."""

    name: str
    track: Track
    logs: int
    change_logs: list[str]
    skipped: int
    odd: list[tuple[int, float, str, float]]


def tracked_causes() -> list[Cause]:
    """Return the causes that are tracked: each effect that healthy trucks differ in, leaks, sensor."""
    found: dict[str, Cause] = {}
    for cause in catalogue():
        own = cause.effect
        if own.tolerance or own.cause_class in ("leak", "internal sensor"):
            found.setdefault(own.id, cause)
    return list(found.values())


def log_files(targets: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Yield (truck, log): a file's truck is its folder; under a folder, the first folder below it.

    Raises InputError for what does not exist, or a folder without logs.
    """
    suffixes = {suffix for one in FORMATS.values() for suffix in one.suffixes}
    for target in targets:
        path = Path(target)
        if path.is_file():
            yield path.resolve().parent.name, path
            continue
        if not path.is_dir():
            raise InputError(f"{target}: no such file or folder; expected logs or a folder of them")
        files = sorted(
            file
            for file in path.rglob("*")
            if file.is_file() and Path(file.name.removesuffix(".gz")).suffix.lower() in suffixes
        )
        if not files:
            raise InputError(f"{target}: no log in it; expected {', '.join(sorted(suffixes))}")
        for file in files:
            inside = file.relative_to(path).parts
            yield inside[0] if len(inside) > 1 else path.resolve().name, file


class Watch:
    """The store of a watch, and the model that its trucks' shifts are compared with.

    Raises InputError for a store that is none, or of another version.
    """

    def __init__(
        self, store: Path, parameters: ParameterSet, mapping: SignalMapping | None = None
    ) -> None:
        self._parameters, self._mapping = parameters, mapping
        self._causes = tracked_causes()
        self._models: dict[bool, PlantModel] = {}
        self._connection = sqlite3.connect(store, isolation_level=None)
        try:
            self._require_version(store)
        except InputError:
            self.close()
            raise
        self._connection.executescript(_TABLES + f"pragma user_version = {STORE_VERSION};")

    def _require_version(self, store: Path) -> None:
        run = self._connection.execute
        try:
            (tables,) = run("select count(*) from sqlite_schema").fetchone()
            (version,) = run("pragma user_version").fetchone()
        except sqlite3.DatabaseError as error:
            raise InputError(f"{store}: {error}; expected the store of a watch") from None
        if tables and version != STORE_VERSION:
            raise InputError(
                f"{store}: a store of version {version}; expected version {STORE_VERSION}: choose "
                "another folder by --out, where all logs are taken anew"
            )

    def close(self) -> None:
        """Close the store."""
        self._connection.close()

    def take(
        self, files: Sequence[tuple[str, Path]], progress: Progress
    ) -> list[tuple[str, Change]]:
        """Take the logs that the store does not have; return the changes found, by truck.

        Raises InputError for a log that cannot be read; those before it are stored.
        """
        found: list[tuple[str, Change]] = []
        for number, (truck, path) in enumerate(files):
            progress(float(number), float(len(files)))
            found += [(truck, change) for change in self._take_log(truck, path)]
        return found

    def _take_log(self, truck: str, path: Path) -> list[Change]:
        run, name = self._connection.execute, os.path.relpath(path)
        size = path.stat().st_size
        have = run("select size from log where truck = ? and path = ?", (truck, name)).fetchone()
        if have is not None:
            if have[0] != size:
                raise InputError(
                    f"{name}: {size} bytes, {have[0]} when it was taken; expected a log that is "
                    "complete, or another name for what follows"
                )
            return []
        row = run("select reference, track from truck where name = ?", (truck,)).fetchone()
        track = None if row is None else Track.from_bytes(row[1])
        reference = None
        if row is not None and row[0] is not None:
            reference = msgspec.msgpack.decode(row[0], type=Reference)
        first = 0 if track is None else track.shifts
        run("begin")
        try:
            if _is_observations(path):
                track, changes, count = _observations(path, track)
                skipped = 0
            else:
                track, reference, changes, count, skipped = self._shifts(
                    truck, name, track, reference
                )
            stored = None if reference is None else msgspec.msgpack.encode(reference)
            values = truck, name, size, first, count, skipped
            run("insert into log values (?, ?, ?, ?, ?, ?)", values)
            run("insert or replace into truck values (?, ?, ?)", (truck, stored, track.to_bytes()))
            run("commit")
        except BaseException:
            run("rollback")
            raise
        return changes

    def _shifts(
        self, truck: str, path: str, track: Track | None, reference: Reference | None
    ) -> tuple[Track, Reference | None, list[Change], int, int]:
        """Judge the shifts of a log in the order in which they come."""
        track = track or Track.of(tuple(cause.effect.id for cause in self._causes))
        _require_names(path, track, [cause.effect.id for cause in self._causes])
        skipped = Counter[str]()
        shifts = shifts_of(path, self._parameters, self._mapping, skipped)
        changes: list[Change] = []
        count, confirm = 0, None
        while some := list(islice(shifts, AT_ONCE)):
            some = with_speeds(some, skipped)
            reference = reference or self._reference(some)
            count += len(some)
            model = self._model(reference.mounted)
            at = np.array(reference.values)
            cone = CONE if without_speeds(some) else ()  # a later log may lack what the first had
            free = tuple(dict.fromkeys((*reference.loads, *cone)))
            some = own_loads(model, some, at, free)
            noise = Noise(reference.noise_m, reference.scatter, loads=free)
            if track.is_far:
                track.linearised_at(self._present(model, some, reference, track, noise))
            elif track.drifting:
                track.point = self._present(model, some, reference, track, noise)
            sizes = self._sizes(track.point)
            linear = linearise(model, some, at, self._causes, sizes, noise=noise)
            chi2 = linear.misfit / np.maximum(linear.count, 1)
            odd = (chi2 > ODD * reference.chi2) & (chi2 > ODD) | (linear.count == 0)
            # after a lasting change every shift is far from the first ones: then none is odd
            odd &= bool(np.mean(odd) < 0.1)
            for k in np.flatnonzero(odd).tolist()[:MOST_ODD]:
                values = truck, track.shifts, some[k].begin_s, path, float(chi2[k])
                self._connection.execute("insert into odd values (?, ?, ?, ?, ?)", values)
            n, usual = linear.units, ~odd
            linear = linear.without_cliffs()  # what is about to stick would count by far too much
            times = np.array([shift.begin_s for shift in some])
            information = linear.information[usual][:, n:, n:]
            score = linear.score[usual][:, n:] + information @ linear.values[n:]
            confirm = Confirming(
                track, track.shifts, [some[k] for k in np.flatnonzero(usual)],
                partial(linearise, model, values=at, noise=noise), self._causes, sizes,
            )  # fmt: skip
            changes += track.take(information, score, times[usual], confirm)
        changes += track.end_cell(confirm)
        return track, reference, changes, count, sum(skipped.values())

    def _present(
        self,
        model: PlantModel,
        shifts: Sequence[Shift],
        reference: Reference,
        track: Track,
        noise: Noise,
    ) -> Floats:
        """Return the sizes to linearise shifts at: none, or what changed so far.

        That is the point which explains the first of them best. Far from their point shifts are
        not linear, and a cause would look like others.
        """
        few, at = shifts[: 2 * FIT_SHIFTS], np.array(reference.values)
        points = [np.zeros(len(self._causes)), *track.moved()]
        costs = []
        for point in points:
            sizes = self._sizes(point)
            linear = linearise(model, few, at, tuple(sizes), sizes, noise=noise)
            chi2 = linear.misfit / np.maximum(linear.count, 1)
            costs.append(float(np.median(np.where(linear.count, chi2, np.inf))))
        return points[int(np.argmin(costs))]

    def _sizes(self, point: Floats) -> dict[Cause, float]:
        """Return the causes that are not absent at a point, with their sizes there."""
        pairs = zip(self._causes, point.tolist(), strict=True)
        return {c: float(np.clip(size, *c.sizes(LARGEST))) for c, size in pairs if size}

    def _model(self, mounted: bool) -> PlantModel:
        if mounted not in self._models:
            self._models[mounted] = PlantModel(self._parameters, mounted)
        return self._models[mounted]

    def _reference(self, shifts: Sequence[Shift]) -> Reference:
        """Fit a truck's own quantities to its first shifts."""
        models = [self._model(mounted) for mounted in (True, False)]
        few = shifts[: 2 * FIT_SHIFTS]
        fitter, best, few = loaded_fit(models, few, Noise(rest_noise_m(few)))
        linear = linearise(fitter.model, few, best.values, noise=fitter.noise)
        chi2 = float(np.median(linear.misfit / np.maximum(linear.count, 1)))
        mounted = fitter.model.mounted
        noise = fitter.noise
        return Reference(
            mounted, best.values.tolist(), noise.position_m, noise.scatter, max(chi2, 0.1), len(few),
            noise.loads,
        )  # fmt: skip

    def trucks(self) -> Iterator[Watched]:
        """Yield every truck of the store, by name."""
        run = self._connection.execute
        for name, stored in run("select name, track from truck order by name").fetchall():
            track = Track.from_bytes(stored)
            logs, skipped = run(
                "select count(*), sum(skipped) from log where truck = ?", (name,)
            ).fetchone()
            odd = run(
                "select number, time_s, path, chi2 from odd where truck = ? order by number desc limit 20",
                (name,),
            ).fetchall()
            change_logs = [self._log_at(name, change.shift) for change in track.changes]
            yield Watched(name, track, logs, change_logs, skipped, odd)

    def _log_at(self, truck: str, shift: int) -> str:
        """Return the log that holds a tracked shift of a truck."""
        (path,) = self._connection.execute(
            "select path from log where truck = ? and first <= ? order by first desc, rowid desc limit 1",
            (truck, shift),
        ).fetchone()
        return str(path)


def _is_observations(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(OBSERVATIONS)) == OBSERVATIONS.encode()


def _require_names(path: str, track: Track, names: Sequence[str]) -> None:
    if list(track.names) != list(names):
        raise InputError(
            f"{path}: parameters {', '.join(names)}; expected those that the truck has in the store: "
            f"{', '.join(track.names)}"
        )


def _observations(path: Path, track: Track | None) -> tuple[Track, list[Change], int]:
    """Take a file of per-shift observations: estimates with standard deviations."""
    changes: list[Change] = []
    count = 0
    with path.open(encoding="utf-8-sig") as file:
        head = [word.strip() for word in file.readline().split(",")]
        names = tuple(head[1::2])
        if not names or head[2::2] != [f"{name}_sd" for name in names]:
            raise InputError(
                f"{path}: line 1: {','.join(head)[:80]}; expected time_s, then NAME and NAME_sd"
            )
        track = track or Track.of(names)
        _require_names(str(path), track, names)
        while lines := list(islice(file, 5000)):
            rows = _rows(path, lines, len(head), count + 2)
            count += len(rows)
            weight = rows[:, 2::2] ** -2.0
            information = np.zeros((len(rows), len(names), len(names)))
            information[:, range(len(names)), range(len(names))] = weight
            changes += track.take(information, weight * rows[:, 1::2], rows[:, 0])
    return track, changes, count


def _rows(path: Path, lines: Sequence[str], columns: int, first: int) -> Floats:
    rows = np.empty((len(lines), columns))
    for k, line in enumerate(lines):
        try:
            rows[k] = [float(word) for word in line.split(",")]
        except ValueError:
            raise InputError(
                f"{path}: line {first + k}: {line.strip()[:60]!r}; expected {columns} numbers"
            ) from None
    if not np.isfinite(rows).all() or not (rows[:, 2::2] > 0.0).all():
        raise InputError(
            f"{path}: from line {first}: expected finite numbers and standard deviations above 0"
        )
    return rows
