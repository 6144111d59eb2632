"""A run continued from its middle is the run that was never interrupted, bit by bit."""

from __future__ import annotations

import hashlib
import json
import pickle
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.simulation import loop
from sil.simulation.in_memory import finished, run_in_memory
from sil.simulation.inputs import changed_inputs
from sil.simulation.load_scenario import Loaded, load, shipped
from sil.simulation.loop import Loop
from sil.simulation.state import State
from sil.studies.executor import STATE, run_study
from sil.studies.load_study import load_study
from sil.studies.table import RESULTS
from tests.faults.drawn import draw


def continued_sha256(loaded: Loaded, *shares: float) -> str:
    """The hash of a run that is saved and restored at shares of its duration, in place and anew."""
    running, duration_s = Loop(loaded), loaded.scenario.duration_s
    places = places_of(running)
    for share in shares:
        running.advance(share * duration_s)
        state = running.snapshot()
        running.advance(min(share + 0.2, 0.9) * duration_s)
        running.restore(state)
        running.advance((share + 0.02) * duration_s)
        running = Loop(loaded)
        running.restore(state)
        places = places_of(running)
    running.finish()
    assert places_of(running) == places  # no object with a state was made or dropped on the way
    return finished(running).trace_sha256


def places_of(running: Loop) -> list[object]:
    parts = (running.participants, running.plan, running.bus, running.lockstep, running.trace)
    return [(id(place.owner), place.names) for place in State(*parts).places]


@pytest.mark.parametrize("name", ["lab_n_b", "busy_bus", "late_valve_commands"])
def test_a_restored_loop_goes_on_as_before(name: str) -> None:
    loaded = load(name)
    assert continued_sha256(loaded, 0.15, 0.4) == run_in_memory(loaded).trace_sha256


def test_a_restored_firmware_in_c_goes_on_as_before() -> None:
    pytest.importorskip("ziglang", reason="extra c")
    loaded = load("strategy_synchro_brake", settings={"firmware": "c"})
    assert continued_sha256(loaded, 0.3) == run_in_memory(loaded).trace_sha256


@pytest.mark.slow
def test_every_shipped_scenario_and_every_fault_goes_on_as_before() -> None:
    for loaded in (*map(load, shipped()), *map(draw, range(120))):
        assert continued_sha256(loaded, 0.2, 0.5) == run_in_memory(loaded).trace_sha256, loaded


def test_the_command_saves_a_state_and_continues_it(tmp_path: Path) -> None:
    out, state = tmp_path / "whole", tmp_path / "whole" / "state.opc4"
    words = ["--no-report", "--json"]
    assert main(["run", "lab_n_b", "--save-at", "0.12", "--out", str(out), *words]) == 0
    assert main(["run", "--from", str(state), "--out", str(tmp_path / "rest"), *words]) == 0
    whole, rest = (
        json.loads((tmp_path / name / "result.json").read_text()) for name in ("whole", "rest")
    )
    for key in ("trace_sha256", "metrics", "expectations", "bus", "balances", "passed"):
        assert whole[key] == rest[key], key
    for name in ("bus.log", "trace.csv", "events.jsonl"):
        assert (out / name).read_bytes() == (tmp_path / "rest" / name).read_bytes()


def test_other_files_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state.opc4"
    loop.save(Loop(load("lab_n_b")), path)
    content = path.read_bytes()
    evil = pickle.dumps(print)
    for bad, complaint in (
        (content[:-9], "damaged"),
        (b"{}\n" + content, "damaged"),
        (b"nothing", "damaged"),
    ):
        path.write_bytes(bad)
        with pytest.raises(InputError, match=complaint):
            loop.load(path)
    head, _, _ = content.partition(b"\n")
    table = json.loads(head) | {"sha256": hashlib.sha256(evil).hexdigest()}
    path.write_bytes(json.dumps(table).encode() + b"\n" + evil)
    with pytest.raises(InputError, match="damaged"):
        loop.load(path)
    path.write_bytes(content)
    monkeypatch.setattr(loop, "FORMAT", "opc4-state-3")
    with pytest.raises(InputError, match="damaged, or not a state"):
        loop.load(path)


def test_a_state_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "state.opc4"
    loop.save(Loop(load("lab_n_b")), path)
    head, _, state = path.read_bytes().partition(b"\n")
    table = json.loads(head)
    table["made_by"]["sources_sha256"] = "0"
    path.write_bytes(json.dumps(table).encode() + b"\n" + state)
    with pytest.raises(InputError, match="made by another version"):
        loop.load(path)


STUDY = """
name = "closing"
scenario = "my.toml"
model = "model.toml"
[[sweep]]
path = "valve.D_fall"
values = [0.01, 0.02]
"""
MODEL = '[base]\nmodel = "base.toml"\n'
BASE = (
    '[base]\nmodel = "nominal"\n[valve]\nD_rise = { value = 0.008, unit = "s", source = "test" }\n'
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    files = {
        "study.toml": STUDY,
        "model.toml": MODEL,
        "base.toml": BASE,
        "my.toml": 'name = "my"\nduration_s = 0.2\ninitial_gear = "neutral"\nfirmware = "own.py:Own"\n',
        "own.py": "import numpy\nfrom controller.firmware import Firmware\nfrom helper import GAIN\n",
        "helper.py": "import parts.curve\nGAIN = 1\n",
        "parts/curve.py": "from . import knots\n",  # a folder without __init__.py
        "parts/knots.py": "",
        "unrelated.py": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_every_file_that_decides_a_row_counts(folder: Path) -> None:
    def digests() -> dict[str, str]:
        return load_study(str(folder / "study.toml")).input_digests()

    before = digests()
    named = {str(Path(name).relative_to(folder)) for name in before if str(folder) in name}
    python = {"own.py", "helper.py", "parts/curve.py", "parts/knots.py"}
    assert named == {"my.toml", "model.toml", "base.toml", *python}
    assert {"the study", "its scenario", "the program", "numpy", "opc4-sil"} <= before.keys()
    assert changed_inputs(before, digests()) == []
    for name in sorted(named - {"my.toml"}):
        (folder / name).write_text((folder / name).read_text() + "# changed\n")
        assert changed_inputs(before, digests()) == [str(folder / name)]
        before = digests()


def test_a_study_with_another_model_is_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.toml").write_text(BASE)
    stroke = (
        STUDY.replace('scenario = "my.toml"\n', "")
        + '[stroke]\nkind = "N-B"\ncommands = [[0.01, "B", 0.98]]\n'
    )
    (tmp_path / "study.toml").write_text(stroke)
    study = load_study(str(tmp_path / "study.toml"))
    out = tmp_path / "out"
    out.mkdir()
    run_study(study, out)
    table = (out / RESULTS).read_text()
    assert run_study(study, out, resume=True) == 0
    (tmp_path / "model.toml").write_text(BASE.replace("0.008", "0.020"))
    with pytest.raises(InputError, match=r"another study: \S*model\.toml changed since; expected"):
        run_study(study, out, resume=True)
    assert (out / RESULTS).read_text() == table
    assert json.loads((out / STATE).read_text())["study"] == "closing"
