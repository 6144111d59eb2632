"""The first `opc4 simulate` after installation, and the next ones."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

CAMPAIGN = """
name = "one_stroke"
rig = "fixed"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 10000.0

[[stroke]]
file = "stroke_001.csv"
label = "fixed"
kind = "fixed"
supply_pressure_pa = 900000.0
load = "none"
spring_n_per_m = 0.0
start_offset_m = 0.0
rest_s = 60.0
commands = [[0.01, "1", 0.98], [0.2, "1", 0.0]]
charged_before = []
"""
WARM_RUNS = 5


def measure() -> Iterator[str]:
    """Lines of the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "measured").mkdir()
        (folder / "measured" / "campaign.toml").write_text(CAMPAIGN.lstrip(), encoding="utf-8")
        command = [
            sys.executable, "-m", "sil.cli", "simulate", str(folder / "measured"),
            "--out", str(folder / "simulated"), "--force",
        ]  # fmt: skip
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}

        def once() -> float:
            begin = time.perf_counter()
            subprocess.run(command, env=environment, check=True, capture_output=True)
            return time.perf_counter() - begin

        first_s = once()
        warm_s = min(once() for _ in range(WARM_RUNS))
    yield f"opc4 simulate, one stroke: first run, no compiled kernel yet {first_s:.1f} s; then {warm_s:.2f} s"
