"""The firmware of another commit in a folder of its own."""

from __future__ import annotations

import contextlib
import io
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.typed_toml import one_line
from sil.files.extras import ROOT


@contextlib.contextmanager
def checkout(revision: str, repository: Path = ROOT) -> Iterator[Path]:
    """Yield a temporary folder with the firmware of a commit.

    Raises InputError for a commit that does not exist, or code outside a git repository.
    """
    name, expected = f"--against {one_line(revision, 60)}", "expected a commit, tag or branch"
    if revision.startswith("-"):
        raise InputError(f"{name}: not a commit; {expected}")
    try:
        commit = _git(repository, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}")
    except (OSError, ValueError) as error:
        raise InputError(f"{name}: git: {error}") from None
    if commit.returncode:
        inside = _git(repository, "rev-parse", "--git-dir").returncode == 0
        where = "no such commit" if inside else f"{repository} is in no git repository"
        raise InputError(f"{name}: {where}; {expected}")
    name_of_commit = commit.stdout.decode().strip()
    packages = _git(repository, "archive", "--format=zip", name_of_commit, "can_dbc", "controller")
    if packages.returncode:
        reason = packages.stderr.decode(errors="replace").strip().splitlines()[-1]
        raise InputError(f"{name}: {one_line(reason)}; {expected} with a firmware")
    with tempfile.TemporaryDirectory(prefix="opc4-against-") as folder:
        with zipfile.ZipFile(io.BytesIO(packages.stdout)) as archive:
            archive.extractall(folder)
        yield Path(folder)


def _git(repository: Path, *arguments: str) -> subprocess.CompletedProcess[bytes]:
    command = ["git", "-C", str(repository), *arguments]
    return subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)
