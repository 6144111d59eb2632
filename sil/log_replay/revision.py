"""The source of another commit in a temporary git worktree, which is always removed again."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.typed_toml import one_line
from sil.simulation.build import ROOT


@contextlib.contextmanager
def checkout(revision: str, repository: Path = ROOT) -> Iterator[Path]:
    """Check a commit out into a temporary folder, and remove it at the end of the block.

    Raises InputError for a commit that does not exist, or code outside a git repository.
    Checked by: tests/unit/sil/log_replay/test_revision.py
    """
    commit = _commit(revision, repository)
    with tempfile.TemporaryDirectory(prefix="opc4-against-") as folder:
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
        raise InputError(
            f"--against {one_line(revision, 60)}: not a commit; expected a commit, tag or branch"
        )
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
