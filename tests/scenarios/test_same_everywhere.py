"""One scenario, one trace hash: whatever the transport, the speed, and the processes."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from controller.strategies import NAMES
from sil.coupling.transports.link import open_link, take_part
from sil.files.overrides import Settings
from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from tests.conftest import ROOT
from tests.scenarios.conftest import ShippedRun
from tests.support.step_cost import cost


def run(folder: Path, name: str, **how: object) -> runner.Finished:
    folder.mkdir()
    return runner.run(load_scenario.load(name), folder, **how)  # type: ignore[arg-type]


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
            finished = runner.run(load_scenario.load(name, seed=seed), folder)
            hashes[name, seed] = finished.result.trace_sha256
    assert hashes["lab_n_b", 1] == hashes["lab_n_b", 2]
    assert hashes["lost_frames", 1] != hashes["lost_frames", 2]


def test_a_speed_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"speed: .+; expected 1e-6"):
        runner.run(load_scenario.load("lab_n_b"), tmp_path, speed=0.0)
    with pytest.raises(InputError, match="--external"):
        runner.run(load_scenario.load("lab_n_b"), tmp_path, external=["plant"])


@pytest.mark.parametrize("transport", ["inproc", "local"])
@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"position_sensor.t_mid": 1}, "sensor.capture_s: 0.0015; expected at least"),
        ({"length.V_N0": 6e-5}, "length.V_N0: 6e-05 m^3 leaves chamber N no volume"),
    ],
)
def test_what_only_the_plant_can_refuse_is_bad_input_on_every_transport(
    transport: str, settings: Settings, complaint: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(InputError) as caught:
        runner.run(load_scenario.load("lab_n_b", settings=settings), folder, transport=transport)
    assert str(caught.value).startswith(str(load_scenario.shipped()["lab_n_b"]) + ": ")
    assert complaint in str(caught.value)
    assert not folder.exists()


@pytest.mark.parametrize(
    ("name", "transport"), [("controller", "local"), ("plant", "local:bench-1")]
)
def test_the_command_that_an_external_participant_needs_is_printed(
    name: str, transport: str, tmp_path: Path
) -> None:
    """Run verbatim in a second process, it joins the run; the result is the same to the bit."""
    (tmp_path / "a folder").mkdir()
    (tmp_path / "bin").mkdir()
    opc4 = tmp_path / "bin" / "opc4"
    opc4.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sil.cli "$@"\n')
    opc4.chmod(0o755)
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PATH": f"{opc4.parent}:{os.environ['PATH']}",
    }
    words = ["run", "lab_n_b", "--transport", transport, "--external", name]
    with subprocess.Popen(
        [opc4, *words, "--json", "--no-report", "--out", "run"],
        cwd=tmp_path / "a folder",
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as coordinator:
        assert coordinator.stderr is not None
        line = ""
        while "opc4 node" not in line:
            line = coordinator.stderr.readline()
            assert line, "the coordinator ended"
        node = subprocess.run(
            line.split(": ", 1)[1],
            shell=True,
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


def test_a_plant_that_records_elsewhere_is_named(tmp_path: Path) -> None:
    """Without the plant's records there is no result, and the reason says where they belong."""
    folder = tmp_path / "run"
    folder.mkdir()
    nodes: list[subprocess.Popen[bytes]] = []

    def start(message: str) -> None:
        if "opc4 node" in message:
            words = shlex.split(message.split("opc4 ", 1)[1])
            words[words.index("--out") + 1] = str(tmp_path / "elsewhere")
            nodes.append(subprocess.Popen([sys.executable, "-m", "sil.cli", *words], cwd=ROOT))

    loaded = load_scenario.load("lab_n_b")
    finished = runner.run(loaded, folder, transport="local", external=["plant"], say=start)
    assert nodes[0].wait(60.0) == 0
    assert not finished.result.complete
    why = f"the plant recorded nothing in {folder}; expected opc4 node plant --out {folder}"
    assert finished.result.why == why


class Guest:
    """A node of the user: sends the number of frames received so far every 20 ms."""

    name = "guest"

    def __init__(self) -> None:
        self.received = 0

    def start(self) -> int:
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        self.received += len(deliveries)
        frame = Frame(0x18FF9927, self.received.to_bytes(8, "little"))
        return [(until_ns, frame)], until_ns + 20_000_000

    def close(self) -> None:
        """Nothing to give back."""


def test_a_guest_announced_in_the_scenario_sends_too(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same guest gives the same bits; in one process, where it cannot join, it is refused."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("r")))
    loaded = load_scenario.load("lab_n_b", settings={"bus.guest": True})
    results = []
    for name in ("first", "second"):
        (folder := tmp_path / name).mkdir()
        guest = Guest()
        joining = threading.Thread(
            target=lambda guest=guest: take_part(guest, open_link("local:bench", 60.0))
        )
        joining.start()
        results.append(runner.run(loaded, folder, transport="local:bench").result)
        joining.join()
        sent = (folder / "bus.log").read_text().count(" 18FF9927#")
        assert sent == 35 and guest.received + sent == results[-1].bus["frames"]
    assert results[0].passed and results[0].trace_sha256 == results[1].trace_sha256
    with pytest.raises(InputError, match="its program joins over a channel only"):
        runner.run(loaded, tmp_path / "first")


STRATEGIES = [name for name in NAMES if name != "open_loop"]


def test_every_strategy_has_a_scenario() -> None:
    assert {f"strategy_{name}" for name in STRATEGIES} <= set(load_scenario.shipped())


@pytest.mark.slow
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process(name: str, tmp_path: Path) -> None:
    memory = run_in_memory(load_scenario.load(f"strategy_{name}"))
    finished = runner.run(load_scenario.load(f"strategy_{name}"), tmp_path, transport="local")
    assert finished.result.passed
    assert finished.result.scenario["controller"]["strategy"] == name
    assert finished.result.trace_sha256 == memory.trace_sha256


@pytest.mark.vcan
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process_over_vcan(name: str, tmp_path: Path) -> None:
    """Up to the stop and a little beyond: there the strategy has done all that it does."""
    gearbox = name in ("blow_cut", "synchro_brake", "fixed_programme")
    table, _path = load_scenario.read(f"strategy_{name}")
    table["duration_s"], table["request"] = 0.4 if gearbox else 0.2, table["request"][:1]
    loaded = load_scenario.from_table(table, name)
    memory = run_in_memory(loaded)
    finished = runner.run(loaded, tmp_path, transport="vcan0")
    assert memory.shifts[-1].arrived_s is not None
    assert finished.result.metrics == memory.metrics
    assert finished.result.trace_sha256 == memory.trace_sha256


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "predictive" else n for n in STRATEGIES],
)
def test_a_step_costs_no_more_operations_than_it_says(name: str) -> None:
    """Bounded work: what each strategy's docstring states."""
    stated = {
        "blow_cut": 0,
        "air_cushion": 20,
        "sliding_mode": 20,
        "synchro_brake": 60,
        "fixed_programme": 20,
        "bang_bang": 60_000,
        "predictive": 260_000,
    }
    _median_us, worst_us, counted = cost(name)
    assert 0 <= counted <= stated[name]
    assert counted > 0 or name == "blow_cut"
    assert worst_us > 0.0
