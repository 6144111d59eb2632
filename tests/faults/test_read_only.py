"""An installation that cannot be written, of a user without a home: a container, a shared server."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from plant.kernel.compiled import cache_folder
from tests.conftest import ROOT

READ_ONLY = """
import errno, os, sys

def refuse(event, given):
    if event == "open" and isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR):
        if str(given[0]).startswith(tuple(INSTALLATION)):
            raise OSError(errno.EROFS, "Read-only file system", given[0])

sys.addaudithook(refuse)
sys.path.insert(0, SITE)
from sil.cli import main
sys.exit(main(["run", "lab_n_b", "--out", "out"]))
"""


PACKAGES = ("sil", "plant", "controller", "can_dbc")


def run_read_only(folder: Path, site: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a scenario with the packages in `site`, where nothing may be written, without a home."""
    installation = [str(site / name) for name in PACKAGES]
    code = f"INSTALLATION, SITE = {installation}, {str(site)!r}{READ_ONLY}"
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder, capture_output=True, text=True, timeout=600, check=False,
        env={"PATH": os.environ["PATH"], "HOME": "/dev/null/none", **environment},
    )  # fmt: skip


def test_a_run_needs_no_home_and_writes_nothing_into_the_installation(tmp_path: Path) -> None:
    done = run_read_only(tmp_path, ROOT, NUMBA_CACHE_DIR=str(cache_folder().parent))  # warm
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder into which the project's wheel is installed."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", source, source], check=True)
    (wheel,) = source.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)
    return site


@pytest.mark.slow
def test_an_installed_wheel_needs_no_home_either(tmp_path: Path, installed: Path) -> None:
    before = sorted(installed.rglob("*"))
    done = run_read_only(tmp_path, installed)
    assert done.returncode == 0, done.stderr
    told, compiling = done.stderr.splitlines()
    assert "/dev/null/none" in told and "the compiled equations go to" in told
    assert "compiling the plant's equations" in compiling
    assert (tmp_path / "out" / "report.html").is_file()
    assert sorted(installed.rglob("*")) == before
