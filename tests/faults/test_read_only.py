"""An installation that cannot be written, of a user without a home: a container, a shared server."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from plant.kernel.compiled import cache_folder
from tests.conftest import ROOT

READ_ONLY = """
import errno, os, sys

def refuse(event, given):
    if event == "open" and isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR):
        if str(given[0]).startswith(tuple(INSTALLATION)):
            raise OSError(errno.EROFS, "Read-only file system", given[0])

sys.addaudithook(refuse)
from sil.cli import main
sys.exit(main(["run", "lab_n_b", "--out", "out"]))
"""


def test_a_run_needs_no_home_and_writes_nothing_into_the_installation(tmp_path: Path) -> None:
    folders = [str(ROOT / name) for name in ("sil", "plant", "controller", "can_dbc")]
    cache = str(cache_folder().parent)  # warm: what happens without one is in test_compiled
    done = subprocess.run(
        [sys.executable, "-c", f"INSTALLATION = {folders}{READ_ONLY}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
        env={"PATH": os.environ["PATH"], "HOME": "/dev/null/none", "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": cache},
    )  # fmt: skip
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert (tmp_path / "out" / "report.html").is_file()
