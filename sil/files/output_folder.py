"""Output folders: one writer at a time, and a mark on what is not complete."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError
from can_dbc.user_file import parse_json, resolved
from sil.files.atomic import write_atomically

RESULT = "result.json"
RUN_FILES = frozenset(
    (
        *(RESULT, "trace.csv", "bus.log", "report.html", "shift.png", "shift.svg", "events.jsonl"),
        *("scenario.json", "plant.trace", "bus.frames", "diff.json", "diff.txt", "INCOMPLETE"),
        *("results.csv", "study.json", "summary.json", "fault_table.md", "sensitivity.md"),
        *("diagnosis.json", "extended_model.toml", "model.toml", "compare.json"),
        *("swarm.jsonl", "swarm.json"),
    )
)
"""The files that commands write; any of them in a folder marks it as holding a run."""

LAST_WRITTEN = frozenset(
    ("summary.json", "diff.json", "diagnosis.json", "model.toml", "compare.json", "swarm.json")
)
"""Of these each exists only when its command has finished; result.json itself says `complete`."""

INCOMPLETE = "INCOMPLETE"
"""The file that says why a command's output is not complete; it also exists while one runs."""

PREVIOUS = "previous"
"""The subfolder in which a run that --force replaces waits until the new one is complete."""

_open_folders: list[tuple[Path, int]] = []
"""Folders that this process writes to, each with the descriptor that holds its lock."""


def finite(value: Any) -> Any:
    """Return the value with every not-finite float replaced by None, as JSON needs it."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value


def prepare_folder(out: Path | None, name: str, force: bool, inputs: Iterable[str] = ()) -> Path:
    """Return the locked folder of a new run, made if missing, and marked INCOMPLETE until `close_folders`.

    Without `out` it is the first free runs/<name>-<n>.  With `force`, the files of a run that the
    folder holds are set aside until then. `inputs`: files that the command reads. Raises InputError for
    a folder that holds a run, to which another process writes, or in which nothing can be written, and
    if an input would be deleted.
    """
    if out is not None and force:
        for file in map(Path, inputs):
            if file.name in RUN_FILES and resolved(file).parent == resolved(out):
                what = f"--force would delete {file}, which is read; expected another folder"
                raise InputError(f"{out}: --out: {what}")
    folder, lock = _new_numbered(Path("runs"), name) if out is None else _made(out)
    _open_folders.append((folder, lock))
    try:
        _empty(folder, force)
        _mark_incomplete(folder)
    except BaseException:
        _open_folders.remove((folder, lock))
        os.close(lock)
        raise
    return folder


def reopen_folder(out: Path) -> Path:
    """Return the folder of a run to be continued, locked and marked. Raises InputError if that fails."""
    folder = without_parent_steps(out)
    _open_folders.append((folder, _lock(folder)))
    _mark_incomplete(folder)
    return folder


@contextlib.contextmanager
def locked_folder(out: Path, option: str = "--out") -> Iterator[Path]:
    """Lock a folder, made if missing, while the block runs. Raises InputError, naming the option, if it cannot."""
    folder, lock = _made(out, option)
    try:
        yield folder
    finally:
        _unlock(lock)


def without_parent_steps(out: Path) -> Path:
    """Return the same folder by a path without `..` inside: making `a/../b` would also make `a`."""
    return Path(os.path.relpath(os.path.realpath(out))) if ".." in out.parts else out


def close_folders(why: str | None) -> list[str]:
    """End what `prepare_folder` began; `why` it is not complete, or None; return lines for the user.

    If it is complete, the run that was set aside is removed.  Otherwise it is put back, unless the
    new run has left files of its own: then it stays in `previous`.
    """
    messages = []
    while _open_folders:
        folder, lock = _open_folders.pop()
        try:
            if _is_at(folder, lock):
                messages += _close(folder, why)
        finally:
            _unlock(lock)
    return messages


def _close(folder: Path, why: str | None) -> list[str]:
    marker, previous = folder / INCOMPLETE, folder / PREVIOUS
    had_marker = marker.exists()
    marker.unlink(missing_ok=True)
    if why is None:
        shutil.rmtree(previous, ignore_errors=True)
        return []
    files = [p for p in folder.iterdir() if p != previous]
    messages = []
    if had_marker and files:
        write_atomically(marker, why + "\n")
        messages = [f"{folder} holds what was done, marked {INCOMPLETE}"]
    if not previous.is_dir():
        if not files:
            folder.rmdir()
    elif RUN_FILES.intersection(p.name for p in files):
        return [*messages, f"the previous run is in {previous}"]
    else:
        messages = []
        marker.unlink(missing_ok=True)
        for file in list(previous.iterdir()):
            os.replace(file, folder / file.name)
        previous.rmdir()
    return messages


def _mark_incomplete(folder: Path) -> None:
    write_atomically(folder / INCOMPLETE, "cut off before it could say why\n")


def _made(out: Path, option: str = "--out") -> tuple[Path, int]:
    """Return the folder, made if missing, and the descriptor of its lock."""
    folder = without_parent_steps(out)
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(f"{folder}: {option}: is a file; expected a folder") from None
        except OSError as error:
            raise _unusable(folder, error, option) from None
        lock = _lock(folder, option)
        if _is_at(folder, lock):
            return folder, lock
        os.close(lock)  # the run that held it has just removed the folder


def _is_at(folder: Path, lock: int) -> bool:
    """Return whether the locked folder is still the one at this path."""
    try:
        return os.path.samestat(folder.stat(), os.fstat(lock))
    except OSError:
        return False


def _unusable(folder: Path, error: OSError, option: str = "--out") -> InputError:
    return InputError(f"{folder}: {option}: {error.strerror}; expected a folder to write in")


def _lock(folder: Path, option: str = "--out") -> int:
    """Return a descriptor that holds the folder's lock. Raises InputError while another process has it."""
    try:
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise _unusable(folder, error, option) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        what = "another run is writing here; expected another folder, or its end"
        raise InputError(f"{folder}: {option}: {what}") from None
    except OSError:  # some network file systems cannot lock folders
        pass
    return lock


def _unlock(lock: int) -> None:
    with contextlib.suppress(OSError):
        fcntl.flock(lock, fcntl.LOCK_UN)
    os.close(lock)


def _close_locks() -> None:
    """Close the locks in a forked process, which must not hold them when its parent has ended."""
    for _, lock in _open_folders:
        os.close(lock)
    _open_folders.clear()


os.register_at_fork(after_in_child=_close_locks)


def _empty(folder: Path, force: bool) -> None:
    """Set aside what the folder holds of another run, or refuse it."""
    try:
        run_files = sorted(RUN_FILES.intersection(p.name for p in folder.iterdir()))
    except OSError as error:
        raise _unusable(folder, error) from None
    if run_files and not force:
        what = f"another run ({run_files[0]})"
        if INCOMPLETE in run_files:
            why = (folder / INCOMPLETE).read_text(encoding="utf-8", errors="replace").strip()
            what = f"another run, not complete ({why})"
        raise InputError(f"{folder}: --out: holds {what}; expected an empty folder, or --force")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{folder}: --out: no permission; expected a folder to write in")
    if run_files:
        _set_aside(folder, run_files)


def _set_aside(folder: Path, run_files: Sequence[str]) -> None:
    """Move the files of a run into `previous`, or delete them if they are not complete and those there are.

    What tells whether a run is complete goes last: killed in between, the folder still shows it.
    """
    previous = folder / PREVIOUS
    if previous.is_symlink() or (previous.exists() and not previous.is_dir()):
        raise InputError(f"{previous}: not a folder; expected one, or none")
    is_whole = _is_complete(folder)
    delete = _is_complete(previous) and not is_whole
    previous.mkdir(exist_ok=True)
    if is_whole:  # an older one there may have been marked
        (previous / INCOMPLETE).unlink(missing_ok=True)
    last = (INCOMPLETE,) if delete else (RESULT, *LAST_WRITTEN)
    for name in sorted(run_files, key=lambda name: name in last):
        if delete:
            (folder / name).unlink()
        else:
            os.replace(folder / name, previous / name)


def _is_complete(folder: Path) -> bool:
    if (folder / INCOMPLETE).exists():
        return False
    if any((folder / name).exists() for name in LAST_WRITTEN):
        return True
    try:
        return bool(parse_json((folder / RESULT).read_text(encoding="utf-8"))["complete"])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _new_numbered(parent: Path, name: str) -> tuple[Path, int]:
    """Make and lock parent/<name>-<n> with the first number above those taken."""
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "run"
    pattern = re.compile(re.escape(stem) + r"-(\d{1,9})")
    try:
        parent.mkdir(parents=True, exist_ok=True)
        taken = [int(m[1]) for p in parent.iterdir() if (m := pattern.fullmatch(p.name))]
        for number in count(max(taken, default=0) + 1):
            folder = parent / f"{stem}-{number}"
            with contextlib.suppress(FileExistsError):  # another run took the number meanwhile
                folder.mkdir()
                break
        return folder, _lock(folder)
    except OSError as error:
        raise InputError(f"{parent}: {error.strerror}; expected a folder, or --out DIR") from None
