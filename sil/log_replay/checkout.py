"""The control unit of another checkout or commit, run by a process of its own."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from can_dbc.typed_toml import one_line
from controller.config import FirmwareConfig
from sil.simulation.build import ROOT


class CheckoutController:
    """The controller node of another checkout; a participant of the name `source`.

    Raises InputError when its controller cannot be started with these settings.
    Checked by: tests/unit/sil/log_replay/test_checkout.py
    """

    def __init__(self, checkout: Path, config: FirmwareConfig, source: str) -> None:
        self.name = source
        self._pipe, theirs = Pipe()
        program = Path(__file__).with_name("checkout_process.py")
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-B", program, checkout, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                cwd=checkout,
            )
        try:
            self._ask(msgspec.to_builtins(config))
        except EOFError as end:
            raise InputError(
                f"{source}: its controller cannot be used: {end}; expected one that can"
            ) from None

    def start(self) -> int:
        """Return the time of the first tick, ns."""
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Advance as `controller.node.ControllerNode` does. Raises RunError when the process ends."""
        frames = [(time_ns, tuple(frame)) for time_ns, frame in deliveries]
        try:
            released, next_ns = self._ask((until_ns, frames))
        except EOFError as end:
            raise RunError(f"{self.name}: its firmware ended: {end}") from None
        return [(time_ns, Frame(*frame)) for time_ns, frame in released], next_ns

    def _ask(self, request: object) -> Any:
        """Return the answer of the process. Raises EOFError with its last line of errors."""
        try:
            self._pipe.send(request)
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            errors = self._process.communicate()[1].decode(errors="replace").strip().splitlines()
            raise EOFError(errors[-1][:300] if errors else "without an error line") from None

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        with self._process:
            self._process.kill()


@contextlib.contextmanager
def checkout(revision: str, repository: Path = ROOT) -> Iterator[Path]:
    """Yield a temporary folder with the firmware of a commit.

    Raises InputError for a commit that does not exist, or code outside a git repository.
    Checked by: tests/unit/sil/log_replay/test_checkout.py
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
