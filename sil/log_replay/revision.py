"""The source of another commit in a temporary git worktree, gone again whatever happens."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from can_dbc.errors import InputError
from sil.files.typed_toml import one_line
from sil.simulation.build import ROOT


@contextlib.contextmanager
def checkout(revision: str, repository: Path = ROOT) -> Iterator[Path]:
    """Check a commit out beside the repository's own files, and remove it on leaving.

    A termination signal is turned into KeyboardInterrupt meanwhile, so that it cleans up, too.
    Raises InputError for a commit that is not there, or code that is in no git repository.
    Checked by: tests/unit/sil/log_replay/test_revision.py
    """
    commit = _commit(revision, repository)
    with (
        _interrupted_by_termination(),
        tempfile.TemporaryDirectory(prefix="opc4-against-") as folder,
    ):
        tree = Path(folder) / "tree"
        try:
            added = _git(repository, "worktree", "add", "--detach", "--quiet", str(tree), commit)
            if added.returncode:
                raise InputError(f"--against {revision}: {_reason(added)}; expected a commit")
            yield tree
        finally:
            _git(repository, "worktree", "remove", "--force", str(tree))
            _git(repository, "worktree", "prune")


def _commit(revision: str, repository: Path) -> str:
    if revision.startswith("-"):
        raise InputError(f"--against {one_line(revision, 60)}: no name of a commit")
    try:
        found = _git(repository, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    except (OSError, ValueError) as error:
        raise InputError(f"--against {one_line(revision, 60)}: git: {error}") from None
    if found.returncode:
        inside = _git(repository, "rev-parse", "--git-dir").returncode == 0
        where = "no such commit" if inside else f"{repository} is in no git repository"
        raise InputError(
            f"--against {one_line(revision, 60)}: {where}; expected a commit, tag or branch"
        )
    return found.stdout.strip()


def _git(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["git", "-C", str(repository), *arguments],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )


def _reason(finished: subprocess.CompletedProcess[str]) -> str:
    lines = finished.stderr.strip().splitlines()
    return one_line(lines[-1]) if lines else f"git ended with {finished.returncode}"


@contextlib.contextmanager
def _interrupted_by_termination() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, where signals can be handled."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before: dict[signal.Signals, Any] = {}
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            before[number] = signal.signal(number, interrupt)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
