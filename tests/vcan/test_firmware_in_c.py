"""Firmware in C on a CAN interface: the same run as in one process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import Run

pytestmark = pytest.mark.vcan
pytest.importorskip("ziglang", reason="extra c")

PATIENCE_S = 400.0
"""A cold start compiles the plant; the emulated kernel has one slow core."""


def test_the_trace_is_that_of_the_firmware_in_python(opc4: Run, tmp_path: Path) -> None:
    hashes = set()
    for firmware, transport in (("c", "vcan0"), ("", "inproc")):
        words = ["--transport", transport, "--no-report", "--json", "--out", f"{transport}"]
        words += ["--firmware", firmware] if firmware else []
        done = opc4("run", "lab_n_b", *words, timeout=PATIENCE_S)
        assert done.returncode == 0, done.stderr
        hashes.add(json.loads(done.stdout)["trace_sha256"])
    assert len(hashes) == 1
