"""Firmware in C and WebAssembly: the same bits as in Python, and a place in the source when it fails."""

from __future__ import annotations

import json
import random
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import pytest

from can_dbc.errors import InputError
from controller.c_settings import STRATEGIES
from controller.config import FirmwareConfig, load_config
from controller.node import ControllerNode
from sil.cli import main
from sil.coupling.transports.channel import ParticipantLost
from sil.firmware import compiler, contract
from sil.firmware.load import SHIPPED_IN_C, firmware_node
from sil.log_replay.replay import ReplayRequest, replay
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import Loaded, load, shipped
from sil.simulation.state import State
from sil.studies.load_study import load_study
from tests.conftest import ROOT
from tests.faults.drawn import draw
from tests.golden_replays import golden_path
from tests.support.twins import drawn_config, feed, run_with_twins

wasmtime = pytest.importorskip("wasmtime", reason="extra c")
pytest.importorskip("ziglang", reason="extra c")

DRAFT = ROOT / "sil" / "cli" / "drafts" / "firmware.c"
FAULTS = ROOT / "tests" / "foreign_controller" / "faults.c"
MS = 1_000_000


@pytest.fixture(scope="module")
def faults_wasm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The twelve faults as a plain module, which has no source beside it."""
    path = tmp_path_factory.mktemp("built") / "faults.wasm"
    path.write_bytes(compiler.compiled(FAULTS))
    return path


def in_c(loaded: Loaded) -> bool:
    return loaded.scenario.controller.strategy in STRATEGIES


def varied(number: int) -> Loaded:
    """A drawn shift with faults, by a strategy of the firmware in C and other settings of it."""
    rng = random.Random(f"settings {number}")
    loaded = draw(number)
    table = {
        "strategy": STRATEGIES[number % len(STRATEGIES)],
        "period_s": rng.choice((0.01, 0.01, 0.005, 0.0025, 0.02)),
        "filter": {"enabled": rng.random() < 0.7, "order": rng.randint(1, 8)},
        "shift": {"retries": rng.randint(0, 2), "wait_for_sync": rng.random() < 0.3},
        "blow": {"cut": rng.choice(("none", "sync", "confirmation"))},
    }
    scenario = msgspec.structs.replace(loaded.scenario, controller=load_config(table, "varied"))
    return Loaded(scenario, loaded.parameters, loaded.source)


def test_the_shipped_firmware_in_c_gives_the_same_trace() -> None:
    for name in ("full_shift", "strategy_synchro_brake"):
        hashes = {
            run_in_memory(load(name, settings=settings)).trace_sha256
            for settings in ({}, {"firmware": "c"})
        }
        assert len(hashes) == 1, name


@pytest.mark.parametrize("source", [SHIPPED_IN_C, DRAFT], ids=lambda path: path.name)
def test_the_sources_compile_without_a_warning(source: Path) -> None:
    assert compiler.compiled(
        source, options=("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror")
    )


def test_drawn_shifts_with_faults_send_the_same_frames() -> None:
    for number in range(len(STRATEGIES)):
        run_with_twins(varied(number), str(SHIPPED_IN_C))


def feed_drawn(numbers: range) -> None:
    for number in numbers:
        rng = random.Random(f"inputs {number}")
        config = drawn_config(rng)
        feed(ControllerNode(config), firmware_node(str(SHIPPED_IN_C), config), rng)


def test_drawn_inputs_get_the_same_answers() -> None:
    feed_drawn(range(8))


@pytest.mark.slow
def test_hundreds_of_drawn_inputs_get_the_same_answers() -> None:
    feed_drawn(range(8, 300))


@pytest.mark.slow
def test_every_shipped_scenario_and_golden_replay_is_the_same() -> None:
    names = [name for name in shipped() if in_c(load(name))]
    assert len(names) > 20
    for name in names:
        run_with_twins(load(name), str(SHIPPED_IN_C))
        path = golden_path(ROOT / "tests" / "golden", name)
        if path.exists():
            outcome = replay(ReplayRequest(str(path), run=name, firmware="c"))
            assert outcome.comparison.ticks > 10 and not outcome.differs, name


@pytest.mark.slow
def test_a_hundred_drawn_shifts_with_faults_send_the_same_frames() -> None:
    for number in range(5, 105):
        run_with_twins(varied(number), str(SHIPPED_IN_C))


def test_the_draft_shifts_and_its_steps_cost_the_same_every_time() -> None:
    costs = []
    for _ in range(2):
        run = run_in_memory(load("lab_n_b", settings={"firmware": str(DRAFT)}))
        assert run.shifts[-1].confirmed_s is not None
        costs.append(run.firmware)
    assert costs[0] == costs[1] and costs[0] is not None
    assert 1000 < costs[0].mean_instructions < costs[0].max_instructions < 20_000
    assert 0 < costs[0].stack_bytes < 1000


MARKED = {
    11: ("null", "null pointer"),
    12: ("array", "array index out of bounds"),
    13: ("pointer", "null or misaligned pointer, or one to too small an object"),
    14: ("overflow", "signed integer overflow"),
    15: ("shift", "shift by a negative or too large number"),
    16: ("division", "division by zero"),
    17: ("loop", "endless loop: more than 50000000 instructions"),
    18: ("recursion", "stack overflow"),
    19: (None, "plain and sanitised build send different frames"),
    20: ("length", "frame of more than 8 bytes"),
    21: ("flood", "more frames in a step than a bus takes"),
    22: ("nan", "ValveCommand.duty_n cannot be sent; expected 0 to 1"),
}
"""What each fault is called, and the comment in its line."""
CAUGHT_IN_WASM = (17, 18, 20, 21, 22)


def step_with_fault(path: Path, which: int) -> None:
    """Step a control unit past its fault, which is at 50 ms."""
    node = firmware_node(str(path), load_config({"windows": {"samples": which}}, "faults"))
    for tick in range(8):
        node.advance(10 * MS * tick, [])


@pytest.mark.parametrize("which", MARKED)
def test_a_fault_in_c_is_reported_with_its_place(which: int) -> None:
    mark, what = MARKED[which]
    lines = FAULTS.read_text().splitlines()
    line = next((k for k, text in enumerate(lines, 1) if f"/* {mark} */" in text), None)
    with pytest.raises(ParticipantLost) as failed:
        step_with_fault(FAULTS, which)
    place = "" if line is None else rf":({line}|{line - 1})(:\d+)?"
    assert re.search(rf"failed: .*faults\.c{place}: {what}.*, tick 5$", str(failed.value))


@pytest.mark.parametrize("which", MARKED)
def test_a_fault_in_a_module_is_reported_or_harms_nobody(which: int, faults_wasm: Path) -> None:
    if which in CAUGHT_IN_WASM:
        with pytest.raises(ParticipantLost, match=rf"{MARKED[which][1]}.*, tick 5"):
            step_with_fault(faults_wasm, which)
    else:
        step_with_fault(faults_wasm, which)


def test_the_command_ends_with_3_and_the_next_run_is_not_affected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "lab_n_b", "--no-report", "--set", f"firmware={FAULTS}"]
    words += ["--set", "controller.windows.samples=14", "--out", str(tmp_path / "out")]
    before = run_in_memory(load("lab_n_b", settings={"firmware": "c"})).trace_sha256
    assert main(words) == 3
    place = "faults.c:35:22: signed integer overflow, tick 5 (at 0.050000 s sim"
    assert place in capsys.readouterr().err
    assert run_in_memory(load("lab_n_b", settings={"firmware": "c"})).trace_sha256 == before
    out = tmp_path / "out"
    assert {"break_5.c", "opc4.h", "break_5.opc4"} < {path.name for path in out.iterdir()}
    from_state = ["run", "--from", str(out / "break_5.opc4"), "--out", str(tmp_path / "again")]
    assert main([*from_state, "--no-report"]) == 3
    assert "signed integer overflow, tick 5 (at 0.050000 s sim" in capsys.readouterr().err


def refused(content: bytes, folder: Path) -> str:
    path = folder / "own.wasm"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        firmware_node(str(path), FirmwareConfig())
    assert "\n" not in str(error.value)
    return str(error.value)


def module(more: str = "", *, number: int | None = None, pages: int = 2) -> bytes:
    number = contract.contract_number() if number is None else number
    content = "".join(f"\\{byte:02x}" for byte in number.to_bytes(4, "little"))
    text = f"""(module {more} (memory (export "memory") {pages})
        (data (i32.const 8) "{content}")
        (global (export "fw_in") i32 (i32.const 16)) (global (export "fw_out") i32 (i32.const 62000))
        (global (export "fw_contract") i32 (i32.const 8))
        (func (export "fw_init")) (func (export "fw_step")))"""
    return bytes(wasmtime.wat2wasm(text))


def test_bad_modules_are_refused_in_one_line(tmp_path: Path, faults_wasm: Path) -> None:
    (tmp_path / "good.wasm").write_bytes(module())
    assert firmware_node(str(tmp_path / "good.wasm"), FirmwareConfig()).start() == 0
    wasi = (
        '(import "wasi_snapshot_preview1" "fd_write" (func (param i32 i32 i32 i32) (result i32)))'
    )
    printf = '(import "env" "printf" (func (param i32 i32) (result i32)))'
    for content, complaint in (
        (b"#include", "not WebAssembly"),
        (faults_wasm.read_bytes()[:900], "not a module"),
        (bytes(wasmtime.wat2wasm("(module)")), "does not export memory"),
        (module(printf), "imports env.printf; expected no imports"),
        (module(wasi), "needs WASI (fd_write); expected a module for wasm32-freestanding"),
        (module(number=7), "made for contract 7; expected"),
        (module(pages=1), "reaches beyond the memory"),
        (b"\0asm" + bytes(100 << 20), "larger than 16 MiB"),
    ):
        assert complaint in refused(content, tmp_path)


def test_the_compiler_speaks_for_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "own.c"
    own.write_text(DRAFT.read_text().replace("seen = OPC4_GEAR_UNKNOWN;", "seen = ;"))
    words = ["run", "lab_n_b", "--set", f"firmware={own}", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    complaint = capsys.readouterr().err
    assert "own.c:" in complaint and "error: expected expression" in complaint
    assert "does not compile, see above; expected C99 that includes opc4.h" in complaint
    own.write_bytes(bytes(300))  # a warning for each byte
    assert main(words) == 2
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) < 70 and any("more lines of the compiler" in c for c in complaints)
    shutil.copy(DRAFT, own)
    (tmp_path / "opc4.h").write_text(
        re.sub(r"fw_contract = \d+", "fw_contract = 7", contract.header())
    )
    assert main(words) == 2
    assert "made for contract 7; expected" in capsys.readouterr().err


def test_without_the_extras_the_message_says_what_to_install(monkeypatch: Any) -> None:
    from sil.firmware import wasm

    monkeypatch.setitem(__import__("sys").modules, "wasmtime", None)
    wasm.engine.cache_clear()
    with pytest.raises(InputError, match=r"needs wasmtime.*pip install.*\[wasm\]"):
        wasm.engine()
    monkeypatch.setattr(compiler.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", "")
    compiler.tool.cache_clear()
    with pytest.raises(InputError, match=r"clang and wasm-ld.*pip install.*\[c\]"):
        compiler.tool("cc")
    compiler.tool.cache_clear()


def test_a_control_unit_goes_on_from_a_saved_state_even_after_it_failed() -> None:
    node = firmware_node(str(FAULTS), load_config({"windows": {"samples": 18}}, "faults"))
    state, turns = State(node), []
    node.advance(0, [])
    saved = state.values()
    for _ in range(2):
        state.restore(saved)
        turns.append([node.advance(10 * MS * tick, []) for tick in (1, 2, 3, 4)])
        with pytest.raises(ParticipantLost, match="stack overflow, tick 5"):
            node.advance(50 * MS, [])
    assert turns[0] == turns[1]


def test_a_file_is_compiled_again_when_it_or_what_it_includes_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    real = compiler._call
    monkeypatch.setattr(compiler, "_call", lambda *what: calls.append(real(*what)) or calls[-1])
    (tmp_path / "own.c").write_text('#include "part.h"\nint number(void) { return NUMBER; }\n')
    part, path = tmp_path / "part.h", tmp_path / "own.c"
    modules = []
    for number in (1, 1, 22):
        if not part.exists() or str(number) not in part.read_text():
            part.write_text(f"#define NUMBER {number}\n{DRAFT.read_text()}")
        modules.append(compiler.compiled(path))
    assert modules[0] == modules[1] != modules[2]
    assert len(calls) == 4  # compiler and linker, twice


def own_scenario(folder: Path, firmware: str, more: str = "") -> Path:
    shutil.copy(DRAFT, folder / "own.c")
    path = folder / "own.toml"
    path.write_text(
        f'name = "own"\nduration_s = 0.3\nrequest = [{{ at_s = 0.1, gear = "backward" }}]\n'
        f"[firmware]\n{firmware}\n{more}"
    )
    return path


def test_limits_of_a_scenario_are_expectations(tmp_path: Path) -> None:
    path = own_scenario(tmp_path, 'file = "own.c"\nmax_instructions = 500\nmax_stack_bytes = 4000')
    checks = {check.name: check.passed for check in run_in_memory(load(str(path))).checks}
    assert checks["firmware_instructions"] is False and checks["firmware_stack_bytes"] is True
    with pytest.raises(InputError, match=r"firmware\.max: unknown; expected one of"):
        load(str(own_scenario(tmp_path, 'file = "own.c"\nmax = 1')))


def test_what_a_step_costs_is_in_the_report_and_in_a_study(tmp_path: Path) -> None:
    path = own_scenario(tmp_path, 'file = "own.c"\nmax_instructions = 7001')
    assert main(["run", str(path), "--quiet", "--out", str(tmp_path / "run")]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    page, cost = (tmp_path / "run" / "report.html").read_text(), result["firmware"]
    figures = [cost[name] for name in ("max_instructions", "stack_bytes", "memory_bytes")]
    for shown in (*figures, 7001, "none"):
        assert f'<td class="n">{shown}</td>' in page
    assert all(f"<code>{frame}</code>" in page for frame in cost["max_inputs"])
    study = tmp_path / "study.toml"
    study.write_text(
        'name = "slow"\nscenario = "own.toml"\nreads = ["shift_time_s", "firmware_instructions"]\n'
        '[[sweep]]\npath = "controller.ns_per_instruction"\nvalues = [0.0, 500.0]\n'
    )
    own = load_study(str(study))
    rows = [own.file.run(own, row).figures for row in own.rows()]
    assert [row["firmware_instructions"] for row in rows] == [cost["max_instructions"]] * 2
    later_s = rows[1]["shift_time_s"] - rows[0]["shift_time_s"]
    assert later_s == pytest.approx(500e-9 * cost["max_instructions"] - 1e-4, rel=0.02)
    shipped_in_c = load_study(str(study), firmware="c")
    figures = shipped_in_c.file.run(shipped_in_c, next(shipped_in_c.rows())).figures
    assert figures["firmware_instructions"] > 1.2 * cost["max_instructions"]


def test_frames_leave_after_the_instructions_of_their_step(tmp_path: Path) -> None:
    path = own_scenario(tmp_path, 'file = "own.c"')
    released = {}
    for ns in (1000.0, 3000.0):
        run = run_in_memory(load(str(path), settings={"controller.ns_per_instruction": ns}))
        assert run.firmware is not None
        times = sorted({f.released_ns for f in run.frames if f.sender == "controller"})
        released[ns] = len(times)
        if ns == 1000.0:
            assert max(time % (10 * MS) for time in times) == 1000 * run.firmware.max_instructions
    assert released[1000.0] == 30 and 5 < released[3000.0] <= 15  # every other tick is missed
    with pytest.raises(InputError, match="only the instructions of a firmware in C are counted"):
        load("lab_n_b", settings={"controller.ns_per_instruction": 1.0})


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler of the system")
def test_a_step_is_written_as_a_program_that_sends_the_same(tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["run", "strategy_synchro_brake", "--firmware", "c", "--break-at", "16"]
    assert main([*words, "--no-report", "--quiet", "--out", str(out)]) == 0
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-I", "."]
    flags += ["-ffp-contract=off", "-fno-math-errno"]
    subprocess.run(["cc", *flags, "-o", "step", "break_16.c"], cwd=out, check=True)
    printed = subprocess.run([out / "step"], capture_output=True, text=True, check=True).stdout
    frames = [line.upper() for line in printed.split()]
    log = [line.split() for line in (out / "bus.log").read_text().splitlines()]
    sent = {frame for time, _, frame in log if 0.16 <= float(time[1:-1]) < 0.17}
    assert len(frames) == 5 and set(frames) <= sent


DEBOUNCE = """
#include <stdint.h>
static uint8_t debounced(uint8_t value)
{
    static uint8_t stable = 3, candidate;
    static int count;
    count = value == candidate ? count + 1 : 1;
    candidate = value;
    if (count >= 4)
        stable = candidate;
    return stable;
}
"""


def test_a_routine_of_another_file_is_included_as_it_is(tmp_path: Path) -> None:
    """A debounce of the request, which comes every 20 ms, delays the push by three of them."""
    (tmp_path / "debounce.h").write_text(DEBOUNCE)
    text = DRAFT.read_text().replace("#include", '#include "debounce.h"\n#include', 1)
    own = tmp_path / "own.c"
    own.write_text(
        text.replace("requested = request.target;",
                     "requested = (enum opc4_gear)debounced((uint8_t)request.target);")
    )  # fmt: skip
    times = [
        run_in_memory(load("lab_n_b", settings={"firmware": str(path)})).shifts[-1].confirmed_s
        for path in (own, DRAFT)
    ]
    assert times[0] - times[1] == pytest.approx(0.06, abs=0.011)
