"""One scenario, one trace hash: whatever the transport, the speed, and the processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil import cosim, scenario


def run(folder: Path, name: str, **how: object) -> cosim.Finished:
    folder.mkdir()
    return cosim.run(scenario.load(name), folder, **how)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["lab_n_b", "lost_frames", "dead_controller"])
def test_one_process_and_three_processes_on_the_local_bus(name: str, tmp_path: Path) -> None:
    one = run(tmp_path / "inproc", name)
    many = run(tmp_path / "local", name, transport="local")
    assert one.result.passed and many.result.passed
    assert one.result.trace_sha256 == many.result.trace_sha256
    for file in ("bus.log", "trace.csv", "events.jsonl"):
        assert (tmp_path / "inproc" / file).read_bytes() == (tmp_path / "local" / file).read_bytes()
    assert one.result.metrics == many.result.metrics


def test_three_speeds(tmp_path: Path) -> None:
    speeds = {"fast": None, "x20": 20.0, "x3": 3.0}
    found = {n: run(tmp_path / n, "lab_n_b", speed=s) for n, s in speeds.items()}
    assert len({f.result.trace_sha256 for f in found.values()}) == 1
    assert found["x3"].result.speed["wall_s"] > 0.7 / 3.0
    assert found["x3"].result.speed["late_max_s"] >= 0.0


def test_another_seed_matters_only_where_something_is_random(tmp_path: Path) -> None:
    hashes = {}
    for name in ("lab_n_b", "lost_frames"):
        for seed in (1, 2):
            folder = tmp_path / f"{name}-{seed}"
            folder.mkdir()
            finished = cosim.run(scenario.load(name, seed=seed), folder)
            hashes[name, seed] = finished.result.trace_sha256
    assert hashes["lab_n_b", 1] == hashes["lab_n_b", 2]
    assert hashes["lost_frames", 1] != hashes["lost_frames", 2]


def test_a_speed_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="real-time factor"):
        cosim.run(scenario.load("lab_n_b"), tmp_path, speed=0.0)
    with pytest.raises(InputError, match="--external"):
        cosim.run(scenario.load("lab_n_b"), tmp_path, external=["plant"])
