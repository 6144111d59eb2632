"""Output folders: files written whole or not at all, and what marks a folder as incomplete."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError

RESULT = "result.json"
RUN_FILES = frozenset(
    (
        *(RESULT, "trace.csv", "bus.log", "report.html", "shift.png", "shift.svg", "events.jsonl"),
        *("scenario.json", "plant.trace", "bus.frames", "diff.json", "diff.txt"),
        *("INCOMPLETE", "results.csv", "study.json", "summary.json", "fault_table.md"),
        *("diagnosis.json", "extended_model.toml", "claims.json", "claims.md", "model.toml"),
    )
)
"""The files that commands write; any of them in a folder marks it as holding a run."""

LAST_WRITTEN = frozenset(
    ("summary.json", "diff.json", "diagnosis.json", "claims.json", "model.toml")
)
"""Of these each stands only when its command has finished; result.json says so itself."""

INCOMPLETE = "INCOMPLETE"
"""A file that says why a command's output is not complete; while it runs, that it is not yet."""

PREVIOUS = "previous"
"""Where a run that --force replaces waits inside its folder until the new one stands."""


def finite(value: Any) -> Any:
    """Return the value with every not-finite float replaced by None, as JSON wants it."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under another name and move it in place, so that no half file is ever seen.

    A link of either name is replaced, not followed.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.unlink(missing_ok=True)
        with open(part, "xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from None


def prepare_folder(out: Path | None, name: str, force: bool, says_itself: bool = False) -> Path:
    """Return the folder of a new run, made if missing.

    Without `out` it is the first free runs/<name>-<n>. A folder that holds another run is refused
    unless `force`, which sets that run's files aside until `settle` is called. `says_itself`: what
    is written there tells from the start that it is not complete. Raises InputError.
    Checked by test_results, test_nothing_is_lost_before_the_new_run_stands.
    """
    folder = _next_free(Path("runs"), name) if out is None else _made(out, force)
    if says_itself:
        _under_way.append(folder)
    else:
        begin(folder)
    return folder


def straight(out: Path) -> Path:
    """The same folder by a path that goes up first: making `a/../b` would leave an `a` behind."""
    return Path(os.path.relpath(os.path.realpath(out))) if ".." in out.parts else out


def _made(out: Path, force: bool) -> Path:
    out = straight(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        held = sorted(RUN_FILES.intersection(p.name for p in out.iterdir()))
    except FileExistsError:
        raise InputError(f"{out}: --out: is a file; expected a folder") from None
    except OSError as error:
        raise InputError(f"{out}: --out: {error.strerror}; expected a folder to write in") from None
    if held and not force:
        raise InputError(
            f"{out}: --out: holds another run ({held[0]}); expected an empty folder, or --force"
        )
    if not os.access(out, os.W_OK):
        raise InputError(f"{out}: --out: no permission; expected a folder to write in")
    if held:
        set_aside(out, held)
    return out


_under_way: list[Path] = []


def begin(folder: Path) -> None:
    """Let a folder say that it is not complete, until `settle`."""
    write_whole(folder / INCOMPLETE, "cut off before it could say why\n")
    _under_way.append(folder)


def set_aside(folder: Path, held: Sequence[str]) -> None:
    """Move the files of a run into the folder's `previous`, for `settle` to remove or put back.

    What stands there already is the last run that was complete: then it is the one to keep, unless
    the run in the folder is complete itself. What makes it complete moves last: killed in between, a
    folder still tells which of both it is.
    """
    previous = folder / PREVIOUS
    if previous.is_symlink() or (previous.exists() and not previous.is_dir()):
        raise InputError(f"{previous}: not a folder; expected one, or none")
    keeps = _is_complete(previous) and not _is_complete(folder)
    previous.mkdir(exist_ok=True)
    for name in sorted(held, key=lambda name: name == RESULT or name in LAST_WRITTEN):
        if keeps:
            (folder / name).unlink()
        else:
            os.replace(folder / name, previous / name)


def _is_complete(folder: Path) -> bool:
    if any((folder / name).exists() for name in LAST_WRITTEN):
        return True
    try:
        return bool(json.loads((folder / RESULT).read_text(encoding="utf-8"))["complete"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def settle(why: str | None) -> list[str]:
    """End what `prepare_folder` and `begin` began; `why` it is not complete, None if it is.

    When it is, what was set aside is removed. Otherwise it is put back where nothing has taken its
    place; where something has, it stays in `previous`. Returns lines for the user about that.
    """
    told = []
    while _under_way:
        folder = _under_way.pop()
        marker, previous = folder / INCOMPLETE, folder / PREVIOUS
        had_marker = marker.exists()
        marker.unlink(missing_ok=True)
        if why is None:
            shutil.rmtree(previous, ignore_errors=True)
            continue
        if not folder.is_dir():
            continue
        left = [p for p in folder.iterdir() if p != previous]
        if had_marker and left:
            write_whole(marker, why + "\n")
        if not previous.is_dir():
            if not left:
                folder.rmdir()
        elif RUN_FILES.intersection(p.name for p in left):
            told.append(f"the run that was there before is in {previous}")
        else:
            marker.unlink(missing_ok=True)
            for file in list(previous.iterdir()):
                os.replace(file, folder / file.name)
            previous.rmdir()
    return told


def _next_free(parent: Path, name: str) -> Path:
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "run"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        taken = [
            int(m[1])
            for p in parent.iterdir()
            if (m := re.fullmatch(re.escape(stem) + r"-(\d{1,9})", p.name))
        ]
        number = max(taken, default=0) + 1
        while True:
            try:
                (folder := parent / f"{stem}-{number}").mkdir()
                return folder
            except FileExistsError:  # another run took the number meanwhile
                number += 1
    except OSError as error:
        raise InputError(f"{parent}: {error.strerror}; expected a folder, or --out DIR") from None
