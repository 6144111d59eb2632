"""The store of a watch: trucks and the logs taken of them, in one SQLite file.

A log is taken in one transaction. Killed at any moment, the store holds the logs before it as a whole.
Checked by: tests/unit/sil/shift_diagnosis/test_watch.py, test_store.py
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import msgspec

from can_dbc.errors import InputError, RunError
from plant.parameters import ParameterSet
from sil.shift_diagnosis.track import Track

STORE: Final = "watch.sqlite"
STORE_VERSION: Final = 6
ABSOLUTE_S: Final = 315_532_800.0
"""Times after this, 1980, count from 1970; others from the begin of a log."""

_TABLES: Final = f"""
begin;
create table model (digest text);
create table log (path text primary key, digest text unique, truck text, size integer, begin_s real,
  end_s real, first integer, shifts integer, skipped integer, fault text);
create table truck (name text primary key, reference blob, track blob, crc integer);
create table odd (truck text, number integer, time_s real, path text, chi2 real);
pragma user_version = {STORE_VERSION};
commit;
"""
_ANEW: Final = "choose another folder by --out, where all logs are taken anew"


_LATE: Final = """
select path from (
  select path, begin_s, lag(end_s) over (order by rowid) as before_s from log
  where truck = ? and begin_s > ?
) where begin_s < before_s
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
    """One truck as the store has it.

    change_logs: the log that begins with or holds each change; late_logs: those that begin before the
    end of the one that was taken before them; faults: the latest logs that are not whole, and why.
    """

    name: str
    track: Track
    logs: int
    change_logs: list[str]
    late_logs: list[str]
    skipped: int
    faults: list[tuple[str, str]]
    odd: list[tuple[int, float, str, float]]


@dataclass(frozen=True)
class Taken:
    """What a log was: how many shifts, from when to when, how many were left out, what is not whole."""

    shifts: int = 0
    begin_s: float | None = None
    end_s: float | None = None
    skipped: int = 0
    fault: str = ""

    def after(self, times_s: Sequence[float]) -> Taken:
        """Return what it is with further shifts, at these times."""
        if not times_s:
            return self
        begin_s = times_s[0] if self.begin_s is None else self.begin_s
        return replace(self, shifts=self.shifts + len(times_s), begin_s=begin_s, end_s=times_s[-1])


class Store:
    """The store of one watch, open until `close`.

    Raises InputError for a file that is no store, of another version or of another model, and
    RunError for a full disk; so does every method.
    """

    def __init__(self, path: Path, parameters: ParameterSet) -> None:
        self._path = path
        with self._errors():
            self._connection = sqlite3.connect(path, isolation_level=None)
        try:
            with self._errors():
                self._open(parameters)
        except BaseException:
            self.close()
            raise

    def _open(self, parameters: ParameterSet) -> None:
        """Make the tables of a new store; check those of another one."""
        run = self._connection.execute
        (tables,) = run("select count(*) from sqlite_schema").fetchone()
        (version,) = run("pragma user_version").fetchone()
        if tables and version != STORE_VERSION:
            raise InputError(
                f"{self._path}: a store of version {version}; expected version {STORE_VERSION}: {_ANEW}"
            )
        if not tables:
            self._connection.executescript(_TABLES)
        digest = _digest_of(parameters)
        if (stored := run("select digest from model").fetchone()) is None:
            run("insert into model values (?)", (digest,))
        elif stored != (digest,):
            raise InputError(
                f"{self._path}: a watch with another model; expected the one that it began with by "
                f"--model, not {parameters.name} as it is now: else {_ANEW}"
            )

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Raise what SQLite cannot do as InputError or, of a full disk, RunError."""
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_NOMEM):
                raise RunError(f"{self._path}: {error}") from None
            expected = f"the store of a watch: {_ANEW}"
            if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
                expected = "the end of the other watch"
            elif code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN):
                expected = "a file and a folder to write in"
            raise InputError(f"{self._path}: {error}; expected {expected}") from None

    def close(self) -> None:
        """Close the store."""
        self._connection.close()

    @property
    def is_empty(self) -> bool:
        """Whether no log has been taken yet."""
        with self._errors():
            return self._connection.execute("select 1 from log limit 1").fetchone() is None

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Keep what is stored inside if the block ends, nothing of it if that fails."""
        with self._errors():
            self._connection.execute("begin immediate")
            try:
                yield
                self._connection.execute("commit")
            except BaseException:
                if self._connection.in_transaction:  # SQLite itself ends it after some errors
                    self._connection.execute("rollback")
                raise

    # --- logs -----------------------------------------------------------------------------------
    def has_path(self, truck: str, path: Path) -> bool:
        """Return whether the log at this path was taken, as it is now.

        Raises InputError for one that has another size now, or was taken as one of another truck.
        """
        row = self._log("path", os.path.realpath(path))
        if row is None:
            return False
        size = path.stat().st_size
        if row[1] != size:
            raise InputError(
                f"{path}: {size} bytes, {row[1]} when it was taken; expected a log that is "
                "complete, or another name for what follows"
            )
        _require_truck(path, truck, row[0])
        return True

    def has_content(self, truck: str, path: Path) -> bool:
        """Return whether a log with the same bytes was taken; if so, remember where it is now.

        Raises InputError if it was taken as one of another truck.
        """
        digest = _digest_of_file(path)
        if (row := self._log("digest", digest)) is None:
            return False
        _require_truck(path, truck, row[0])
        with self._errors():
            run, real = self._connection.execute, os.path.realpath(path)
            was = "select path from log where digest = ?"
            run(f"update odd set path = ? where path = ({was})", (real, digest))
            run("update log set path = ? where digest = ?", (real, digest))
        return True

    def _log(self, column: str, value: str) -> tuple[str, int] | None:
        """Return the truck and the size of the log with this path or digest, if there is one."""
        query = f"select truck, size from log where {column} = ?"
        with self._errors():
            found: tuple[str, int] | None = self._connection.execute(query, (value,)).fetchone()
        return found

    def add_log(self, truck: str, path: Path, first: int, taken: Taken) -> None:
        """Store that a log was taken; first: the number of its first shift."""
        values = os.path.realpath(path), _digest_of_file(path), truck, path.stat().st_size
        own = taken.shifts, taken.skipped, taken.fault
        with self._errors():
            self._connection.execute(
                "insert into log values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (*values, taken.begin_s, taken.end_s, first, *own),
            )

    def add_odd(self, truck: str, number: int, time_s: float, path: Path, chi2: float) -> None:
        """Store that a shift is odd."""
        values = truck, number, time_s, os.path.realpath(path), chi2
        with self._errors():
            self._connection.execute("insert into odd values (?, ?, ?, ?, ?)", values)

    # --- trucks ---------------------------------------------------------------------------------
    def truck(self, name: str) -> tuple[Track | None, Reference | None]:
        """Return what is stored of a truck. Raises InputError if it is not what was written."""
        with self._errors():
            row = self._connection.execute(
                "select reference, track, crc from truck where name = ?", (name,)
            ).fetchone()
        if row is None:
            return None, None
        reference, track, crc = row
        if crc != zlib.crc32((reference or b"") + track):
            raise InputError(
                f"{self._path}: truck {name} is damaged; expected what was written: {_ANEW}"
            )
        known = msgspec.msgpack.decode(reference, type=Reference) if reference else None
        return Track.from_bytes(track), known

    def put_truck(self, name: str, track: Track, reference: Reference | None) -> None:
        """Store a truck in place of what was known of it."""
        known = None if reference is None else msgspec.msgpack.encode(reference)
        state = track.to_bytes()
        values = name, known, state, zlib.crc32((known or b"") + state)
        with self._errors():
            self._connection.execute("insert or replace into truck values (?, ?, ?, ?)", values)

    def trucks(self) -> Iterator[Watched]:
        """Yield every truck, by name."""
        with self._errors():
            names = self._connection.execute("select name from truck order by name").fetchall()
        for (name,) in names:
            track, _reference = self.truck(name)
            assert track is not None
            with self._errors():
                yield self._watched(name, track)

    def _watched(self, name: str, track: Track) -> Watched:
        run = self._connection.execute
        logs, skipped = run(
            "select count(*), sum(skipped) from log where truck = ?", (name,)
        ).fetchone()
        faults = run(
            "select path, fault from log where truck = ? and fault <> '' order by rowid desc limit 20",
            (name,),
        ).fetchall()
        odd = run(
            "select number, time_s, path, chi2 from odd where truck = ? order by number desc limit 20",
            (name,),
        ).fetchall()
        return Watched(
            name,
            track,
            logs,
            [self._log_at(name, change.shift) for change in track.changes],
            [_shown(path) for (path,) in run(_LATE, (name, ABSOLUTE_S))],
            skipped,
            [(_shown(path), fault) for path, fault in faults],
            [(number, time_s, _shown(path), chi2) for number, time_s, path, chi2 in odd],
        )

    def _log_at(self, truck: str, shift: int) -> str:
        """Return the log that holds a tracked shift of a truck."""
        (path,) = self._connection.execute(
            "select path from log where truck = ? and first <= ? order by first desc, rowid desc limit 1",
            (truck, shift),
        ).fetchone()
        return _shown(path)


def _shown(path: str) -> str:
    """Return the path of a log as it is shown: from the current folder if it is below that."""
    found = os.path.relpath(path)
    return path if found.startswith(os.pardir) else found


def _digest_of(parameters: ParameterSet) -> str:
    """Return a digest of all values of a model."""
    effects = {
        name: {key: item.value for key, item in own.items()}
        for name, own in parameters.effects.items()
    }
    values = {path: parameters[path].value for path in parameters}
    return hashlib.sha256(msgspec.json.encode([values, effects], order="sorted")).hexdigest()


def _digest_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_truck(path: Path, truck: str, taken_as: str) -> None:
    if truck != taken_as:
        raise InputError(
            f"{path}: a log of truck {truck}, taken before as one of truck {taken_as}; expected the "
            f"same truck, so the same folder of trucks as then: else {_ANEW}"
        )
