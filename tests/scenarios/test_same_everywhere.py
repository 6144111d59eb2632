"""One scenario, one trace hash: whatever the transport, the speed, and the processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.simulation import runner, scenario
from tests.conftest import ROOT
from tests.scenarios.conftest import ShippedRun


def run(folder: Path, name: str, **how: object) -> runner.Finished:
    folder.mkdir()
    return runner.run(scenario.load(name), folder, **how)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["lab_n_b", "lost_frames", "dead_controller"])
def test_one_process_and_three_processes_on_the_local_bus(
    name: str, shipped_run: ShippedRun, tmp_path: Path
) -> None:
    one, folder = shipped_run(name)
    many = run(tmp_path / "local", name, transport="local")
    assert one.result.passed and many.result.passed
    assert one.result.trace_sha256 == many.result.trace_sha256
    for file in ("bus.log", "trace.csv", "events.jsonl"):
        assert (folder / file).read_bytes() == (tmp_path / "local" / file).read_bytes()
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
            finished = runner.run(scenario.load(name, seed=seed), folder)
            hashes[name, seed] = finished.result.trace_sha256
    assert hashes["lab_n_b", 1] == hashes["lab_n_b", 2]
    assert hashes["lost_frames", 1] != hashes["lost_frames", 2]


def test_a_speed_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="real-time factor"):
        runner.run(scenario.load("lab_n_b"), tmp_path, speed=0.0)
    with pytest.raises(InputError, match="--external"):
        runner.run(scenario.load("lab_n_b"), tmp_path, external=["plant"])


@pytest.mark.parametrize("transport", ["inproc", "local"])
@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("position_sensor.t_mid=1", "sensor.capture_s: 0.0015; expected at least"),
        ("length.V_N0=6e-5", "length.V_N0: 6e-05 m^3 leaves chamber N no volume"),
    ],
)
def test_what_only_the_plant_can_refuse_is_bad_input_on_every_transport(
    transport: str, setting: str, told: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(InputError) as caught:
        runner.run(scenario.load("lab_n_b", settings=[setting]), folder, transport=transport)
    assert str(caught.value).startswith(str(scenario.shipped()["lab_n_b"]) + ": ")
    assert told in str(caught.value)
    assert not folder.exists()


def test_a_participant_that_the_user_starts_joins_the_run(tmp_path: Path) -> None:
    """opc4 run --external controller, and opc4 node controller beside it: the same bits."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    opc4 = [sys.executable, "-m", "sil.cli"]
    with subprocess.Popen(
        [
            *opc4,
            "run",
            "lab_n_b",
            "--transport",
            "local",
            "--external",
            "controller",
            "--json",
            "--no-report",
            "--out",
            "run",
        ],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as coordinator:
        assert coordinator.stderr is not None
        told = ""
        while "opc4 node" not in told:
            told = coordinator.stderr.readline()
            assert told, "the coordinator ended"
        channel = told.split("--channel ")[1].split()[0]
        node = subprocess.run(
            [*opc4, "node", "controller", "--channel", channel, "--scenario", "lab_n_b"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=200,
        )
        out, err = coordinator.communicate(timeout=60)
    assert (node.returncode, coordinator.returncode) == (0, 0), (node.stderr, err)
    alone = run(tmp_path / "inproc", "lab_n_b")
    assert json.loads(out)["trace_sha256"] == alone.result.trace_sha256
