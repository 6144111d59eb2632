"""Two threads on a batch, against processes of a plain C loop; the first start after installation."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

C_LOOP = """
#include <stdio.h>
int main(void) {
    volatile double sink;
    double a = 1.0, b = 0.5, c = 0.25, d = 0.125;
    for (long i = 0; i < 400000000L; i++) {
        a = a * 0.999999 + 1e-6; b = b * 0.999998 + 1e-6;
        c = c * 0.999997 + 1e-6; d = d * 0.999996 + 1e-6;
    }
    sink = a + b + c + d;
    return sink < 0.0;
}
"""
BATCH = 20_000
REPEATS = 5


def two_cores() -> Iterator[str]:
    from plant.batch.batch import simulate_batch
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.kernel.layout import Parameters
    from plant.parameters import load
    from plant.systems.setup import make_setup
    from tests.varied_strokes import varied_strokes

    setup = make_setup(load(), StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),)))
    masses = np.random.default_rng(4).uniform(0.8, 3.0, BATCH)
    strokes = varied_strokes(setup, 0.25, {Parameters.m_s: masses})
    one_s = best_wall_s(lambda: simulate_batch(strokes))
    two_s = best_wall_s(lambda: simulate_batch(strokes, workers=2))
    cores = len(os.sched_getaffinity(0))
    yield f"two cores of {cores}, load {os.getloadavg()[0]:.1f} while measured"
    yield f"ours, {BATCH} strokes, two threads for one: {one_s / two_s:.2f} times as fast"
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        yield "plain C loop: no C compiler here"
        return
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "loop.c", Path(folder) / "loop"
        source.write_text(C_LOOP, encoding="ascii")
        subprocess.run([compiler, "-O2", "-o", str(program), str(source)], check=True)
        alone_s = best_wall_s(lambda: together(program, 1))
        both_s = best_wall_s(lambda: together(program, 2))
    yield f"plain C loop, two processes for one: {2.0 * alone_s / both_s:.2f} times as fast"


def best_wall_s(once: Callable[[], object]) -> float:
    """Shortest of several wall times: two cores show in no other."""
    times = []
    for _ in range(REPEATS + 1):
        begin = time.perf_counter()
        once()
        times.append(time.perf_counter() - begin)
    return min(times)


def together(program: Path, count: int) -> None:
    """Run `count` processes at once."""
    running = [subprocess.Popen([str(program)]) for _ in range(count)]
    for process in running:
        if process.wait() != 0:
            raise RuntimeError("the C loop failed")


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


def first_start() -> Iterator[str]:
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
