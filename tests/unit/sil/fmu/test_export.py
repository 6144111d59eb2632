"""The exported units: valid, and the same numbers in another tool as here."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from can_dbc.messages import DrivelineSpeeds, E2eState, Gear, PositionPulse, ShiftRequest
from controller.firmware import Firmware, Inputs
from plant.devices.valve import Valve, ValveTiming
from plant.parameters import load
from plant.systems.length_stroke import LengthStroke
from sil.cli import main
from sil.fmu.slave import release_static_state
from sil.simulation import load_scenario

MS = 1_000_000
STEP_S = 0.001
OPEN_MS, CLOSE_MS, END_MS = 10, 90, 200

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("fmu")
    found = {what: folder / f"{what}.fmu" for what in ("plant", "controller")}
    for what, path in found.items():
        assert main(["fmu", what, str(path), "--scenario", "lab_n_b"]) == 0
    return found


@pytest.mark.parametrize("what", ["plant", "controller"])
def test_the_unit_is_valid(units: dict[str, Path], what: str) -> None:
    assert validate_fmu(str(units[what])) == []
    described = read_model_description(str(units[what]))
    assert described.fmiVersion == "3.0" and described.coSimulation is not None
    causalities = [v.causality for v in described.modelVariables]
    assert causalities.count("input") >= 3 and causalities.count("output") >= 8


SIMULATE = """
import sys
from fmpy import simulate_fmu
found = simulate_fmu(sys.argv[1], stop_time=0.01, step_size=0.001)
print(len(found))
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["plant", "controller"])
def test_a_process_that_imported_a_unit_ends_without_a_complaint(
    units: dict[str, Path], what: str
) -> None:
    """pythonfmu3 alone aborts the plant's process at exit: its library frees a counter twice."""
    for _ in range(15 if what == "plant" else 5):
        done = subprocess.run(
            [sys.executable, "-c", SIMULATE, str(units[what])], capture_output=True, text=True
        )
        assert done.returncode == 0 and int(done.stdout) > 1, done.stderr


def test_the_static_state_is_released_only_in_an_unpacked_unit(
    units: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resources = str(tmp_path / "resources")
    assert not release_static_state(resources, "Opc4Plant")
    with zipfile.ZipFile(units["plant"]) as packed:
        packed.extractall(tmp_path)
    assert release_static_state(resources, "Opc4Plant")
    monkeypatch.setattr(sys, "orig_argv", [])  # a program that is not Python
    assert not release_static_state(resources, "Opc4Plant")


def native() -> np.ndarray:
    """Position, pressures at every millisecond of the same stroke, without the unit."""
    parameters = load()
    valve = Valve(ValveTiming.from_parameters(parameters))
    valve.command(OPEN_MS * MS, 1.0)
    valve.command(CLOSE_MS * MS, 0.0)
    switches = [(t, 0, u) for t, u in valve.moves(END_MS * MS)]
    stroke = LengthStroke(parameters, initial="N")
    wanted = np.arange(1, END_MS + 1, dtype=np.int64) * MS
    y = stroke.advance(END_MS * MS, switches, wanted)
    columns = [stroke.columns.index(n) for n in ("position_m", "pressure_B_pa", "pressure_N_pa")]
    assert y[-1, columns[0]] == pytest.approx(0.01285)  # the stroke was made
    return np.asarray(y[:, columns])


def test_another_tool_gets_the_same_stroke(units: dict[str, Path]) -> None:
    commands = np.array(
        [(0.0, 0.0), (OPEN_MS * STEP_S - 1e-9, 0.0), (OPEN_MS * STEP_S, 1.0),
         (CLOSE_MS * STEP_S - 1e-9, 1.0), (CLOSE_MS * STEP_S, 0.0)],
        dtype=[("time", np.float64), ("duty_b", np.float64)],
    )  # fmt: skip
    found = simulate_fmu(
        str(units["plant"]),
        start_time=0.0,
        stop_time=END_MS * STEP_S,
        step_size=STEP_S,
        output_interval=STEP_S,
        input=commands,
        output=["position_m", "pressure_b_pa", "pressure_n_pa"],
    )
    here = native()
    there = np.column_stack([found[n] for n in ("position_m", "pressure_b_pa", "pressure_n_pa")])
    assert len(there) == END_MS + 1
    np.testing.assert_allclose(there[1:], here, rtol=1e-6, atol=1e-9)


OUTPUTS = ["duty_b", "duty_n", "duty_f", "estimate_m", "state", "confirmed", "faults"]


def simulated(unit: Path) -> tuple[np.ndarray, Any]:
    """What a unit is given, and answers: asked for backward at 0.3 s, the stay moves from 0.35 s."""
    times = np.arange(0.0, 0.6, 0.01)
    inputs = np.zeros(
        len(times),
        dtype=[("time", float), ("pulse_s", float), ("coil_temperature_k", float),
               ("sample_index", np.int32), ("request", np.int32)],
    )  # fmt: skip
    inputs["time"] = times
    inputs["pulse_s"] = 0.0009 + 0.00028 * np.clip((times - 0.35) / 0.05, 0.0, 1.0)
    inputs["coil_temperature_k"] = 293.15
    inputs["sample_index"] = np.arange(len(times))
    inputs["request"] = np.where(times >= 0.3, Gear.BACKWARD, Gear.NEUTRAL)
    answers: Any = simulate_fmu(
        str(unit), stop_time=0.6, step_size=0.01, output_interval=0.01, input=inputs, output=OUTPUTS
    )
    return inputs, answers


def test_a_firmware_in_c_goes_along_as_a_module(tmp_path: Path) -> None:
    pytest.importorskip("wasmtime", reason="extra c")
    pytest.importorskip("ziglang", reason="extra c")
    own, unit = tmp_path / "own.c", tmp_path / "own.fmu"
    assert main(["firmware", "--new", str(own)]) == 0
    assert main(["fmu", "controller", str(unit), "--firmware", str(own)]) == 0
    own.unlink()
    _, answers = simulated(unit)
    assert answers["duty_b"].max() > 0.9 and answers["confirmed"][-1] == Gear.BACKWARD


def test_the_firmware_unit_answers_as_the_firmware_does(units: dict[str, Path]) -> None:
    inputs, found = simulated(units["controller"])
    firmware = Firmware(load_scenario.load("lab_n_b").scenario.controller)
    valid = E2eState.VALID
    for k, reported in enumerate(inputs):
        out = firmware.step(
            10 * MS * k,
            Inputs(
                (PositionPulse(reported["pulse_s"], reported["coil_temperature_k"], k),),
                ShiftRequest(Gear(reported["request"])),
                DrivelineSpeeds(0.0, 0.0),
                *(valid, valid, valid),
            ),
        )
        here = (
            *(out.valves.duty_b, out.valves.duty_n, out.valves.duty_f, out.status.estimate_m),
            *(out.status.state, out.status.confirmed, out.status.faults),
        )
        there = [found[name][k + 1] for name in OUTPUTS]
        np.testing.assert_allclose(there, [float(value) for value in here], rtol=1e-12, atol=0.0)
    assert found["duty_b"].max() > 0.9 and found["duty_b"][:30].max() == 0.0
    assert {Gear.NEUTRAL, Gear.BACKWARD} <= set(found["confirmed"])


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["plant", "x.txt"], "expected OUT.fmu"),
        (["plant", "none/x.fmu"], "no such folder"),
        (["plant", "x.fmu", "--scenario", "lab_n_x"], "lab_n_b"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], reported: str, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fmu", *arguments]) == 2
    complaint = capsys.readouterr().err
    assert reported in complaint and complaint.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_without_the_library_the_install_command_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pythonfmu3", None)
    assert main(["fmu", "plant", str(tmp_path / "x.fmu")]) == 2
    complaint = capsys.readouterr().err
    assert "pip install -e" in complaint and "[fmu]'" in complaint and complaint.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "x.fmu"
    path.write_text("mine")
    assert main(["fmu", "plant", str(path)]) == 2
    assert path.read_text() == "mine"
