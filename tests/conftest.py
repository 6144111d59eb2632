"""What all tests share: the repository's root, and one way to run the installed command."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# The same examples in every run; `--hypothesis-profile=explore` draws new ones, `few` fewer.
# A busy machine fails no test: neither deadlines nor slow draws count.
UNTIMED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **UNTIMED)
settings.register_profile("explore", derandomize=False, **UNTIMED)
settings.register_profile("few", derandomize=True, max_examples=25)
settings.load_profile("same")

ROOT = Path(__file__).resolve().parent.parent

Run = Callable[..., subprocess.CompletedProcess[str]]


def run_opc4(
    folder: Path, *arguments: str, timeout: float = 120.0
) -> subprocess.CompletedProcess[str]:
    """Run `opc4 ...` in a process of its own, inside a folder."""
    return subprocess.run(
        [sys.executable, "-m", "sil.cli", *arguments],
        cwd=folder,
        env=_environment(),
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


@pytest.fixture
def opc4(tmp_path: Path) -> Run:
    """Run `opc4 ...` in a process of its own, inside the test's folder."""
    return functools.partial(run_opc4, tmp_path)


@pytest.fixture
def runtime_folder(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Keep the sockets of local channels in a folder of this test's, with a short path."""
    folder = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def _environment() -> dict[str, str]:
    import os

    environment = dict(os.environ)
    environment["PYTHONPATH"] = str(ROOT)
    environment["PYTHONWARNINGS"] = "error"
    return environment
