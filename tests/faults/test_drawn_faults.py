"""The safe states hold whatever fails: drawn at random, in the shipped fault study, on a disturbed bus."""

from __future__ import annotations

import math
import random
import typing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from plant.devices.position_circuit import SensorFault
from plant.devices.signal_faults import SpeedFault, TemperatureFault
from plant.devices.valve_faults import ValveFault
from sil.cli import main
from sil.recording.end_to_end import EndToEnd
from sil.recording.run_record import RunRecord
from sil.rules import violations
from sil.rules.shipped import RULES
from sil.simulation import load_scenario, runner, safety
from sil.simulation.circumstances import circumstances, sight_s
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table
from sil.simulation.scenario import FAULT_TABLES, Scenario
from sil.studies.load_study import load_study
from sil.swarm.draw import state, vocabulary
from tests.faults.drawn import base, draw, faults_of
from tests.support import disturbed_bus


def repeated_taken(record: RunRecord, message: str = "ControllerStatus") -> int:
    """How many repeated frames passed for new, because their counter had come round."""
    checked = EndToEnd()
    checked.add(record)
    return checked.counts()[message]["intruder's taken"]


def check(first: int, count: int) -> None:
    shifted = reported = judged = 0
    for number in range(first, first + count):
        loaded = draw(number)
        run = run_in_memory(loaded)
        given = circumstances(loaded.scenario)
        assert violations(run.record, given, RULES) == [], number
        judged += math.isfinite(given.sight_s) and not given.repeated_s
        shifted += bool(run.shifts) and run.shifts[-1].arrived_s is not None
        reported += safety.figures(run.record, loaded.scenario)["fault_bits"] > 0
    # not vacuous: many shifts were done all the same, many faults were seen, few runs left aside
    assert shifted > 0.4 * count
    assert reported > 0.2 * count
    assert judged > 0.7 * count


def test_safe_states_hold() -> None:
    check(0, 24)


@pytest.mark.slow
def test_safe_states_hold_in_a_thousand_runs() -> None:
    check(24, 1000)


def test_everything_that_a_scenario_lets_fail_is_drawn() -> None:
    every = [fault for group in vocabulary().values() for fault in group]
    assert len(set(every)) == len(every) > 100
    assert {faults_of(number)[0] for number in range(len(every))} == set(every)
    # what the fault table states can be drawn, and what a scenario states as a list of faults
    stated = {
        (where, entry["kind"], entry.get("message") or entry.get("node") or entry.get("valve", ""))
        for variant in load_study("faults").file.variant
        for where, entries in variant.set.items()
        if isinstance(entries, list)
        for entry in entries
    }
    assert stated and stated <= {fault[:3] for fault in every}
    lists = {f.name for f in msgspec.structs.fields(Scenario) if f.name.endswith("fault")}
    assert lists == set(FAULT_TABLES) == {fault.where for fault in every} - {"bus", "clock"}


def test_every_parameter_of_every_fault_is_drawn() -> None:
    rng = random.Random("parameters")
    for fault in (fault for group in vocabulary().values() for fault in group):
        if fault.where in ("bus", "clock"):
            continue
        table: dict[str, Any] = {"request": []}
        for _ in range(16):
            state(table, fault, rng)
        drawn = {name for entry in table[fault.where] for name in entry}
        names = {f.name for f in msgspec.structs.fields(fault.type)} | {"kind"}
        assert drawn == names - ({"end_s"} if fault.kind in ("dead", "sent") else set()), fault


def test_repeated_reports_pass_for_new_after_a_round_of_the_counter() -> None:
    """The limit that the claim states: protection by counter and checksum knows no time."""
    found = {}
    for delay_s in (0.1, 0.155):
        fault = {"kind": "replayed", "message": "ControllerStatus", "delay_s": delay_s}
        loaded = from_table(base("N-B") | {"fault": [fault]}, "test")
        record = run_in_memory(loaded).record
        found[delay_s] = repeated_taken(record)
        figures = safety.figures(record, loaded.scenario)
        assert figures["false_gear_s"] <= sight_s(loaded.scenario) + delay_s
        assert (figures["false_gear_s"] > sight_s(loaded.scenario)) == (delay_s == 0.155)
    assert found[0.1] == 0 and found[0.155] > 90


@pytest.mark.parametrize("delay_s", [0.03, 0.155, 0.3])
def test_repeated_commands_of_a_dead_controller_hold_no_valve(delay_s: float) -> None:
    """One repeated message is not enough: the driver wants commands and blows to be good."""
    dead = {"kind": "dead", "node": "controller", "start_s": 0.13}
    for message in ("ValveCommand", "SafetyBlow"):
        fault = {"kind": "replayed", "message": message, "delay_s": delay_s}
        loaded = from_table(base("N-B") | {"fault": [dead, fault]}, "test")
        record = run_in_memory(loaded).record
        assert repeated_taken(record, message) > 0 and (record.truth["cmd_B"] > 0.5).any()
        assert safety.figures(record, loaded.scenario)["orphan_energised_s"] == 0.0


def test_every_scenario_is_in_the_table() -> None:
    assert {path.stem for path in disturbed_bus.SCENARIOS.glob("*.toml")} == set(
        disturbed_bus.NAMES
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", disturbed_bus.NAMES)
def test_no_coil_is_orphaned_and_nothing_forged_is_taken(name: str, tmp_path: Path) -> None:
    loaded = load_scenario.load(str(disturbed_bus.SCENARIOS / f"{name}.toml"))
    finished = runner.run(loaded, tmp_path)
    assert finished.result.complete
    safety = disturbed_bus.safety_of(finished, loaded)
    assert safety["orphan_energised_s"] == 0.0
    taken = sum(c["intruder's taken"] for c in finished.result.bus["end_to_end"].values())
    # A 4-bit counter comes round after 15 or 16 frames: then an old frame looks like the next one.
    assert taken == 0 or name == "replayed_300ms"
    assert run_in_memory(loaded).trace_sha256 == finished.result.trace_sha256


@pytest.mark.slow
def test_drifting_clocks_are_the_same_in_two_processes(tmp_path: Path) -> None:
    loaded = load_scenario.load(str(disturbed_bus.SCENARIOS / "drift.toml"))
    result = runner.run(loaded, tmp_path, transport="local").result
    assert result.trace_sha256 == run_in_memory(loaded).trace_sha256


STUDY = load_study("faults")


def kinds(fault: type) -> set[str]:
    return set(typing.get_args(typing.get_type_hints(fault)["kind"]))


def stated(name: str, **wanted: Any) -> set[str]:
    """Kinds that the study states in a list of faults, of those entries that have `wanted`."""
    entries: list[Any] = [e for v in STUDY.file.variant for e in v.set.get(name, ())]  # type: ignore[union-attr]
    return {e["kind"] for e in entries if all(e.get(key) == x for key, x in wanted.items())}


def test_every_fault_of_every_device_is_in_it_twice() -> None:
    assert stated("sensor_fault") == kinds(SensorFault)
    assert stated("temperature_fault") == kinds(TemperatureFault)
    assert stated("speed_fault") == kinds(SpeedFault)
    for valve in "BNF":
        assert stated("valve_fault", valve=valve) == kinds(ValveFault)
    for message in ("ShiftRequest", "ValveCommand", "SafetyBlow", "PositionPulse",
                    "DrivelineSpeeds", "ControllerStatus"):  # fmt: skip
        assert stated("fault", message=message) == {
            "loss", "delay", "corruption", "frozen_counter", "error_frame",
            "spoofed", "replayed"}  # fmt: skip
    for node in ("controller", "driver"):
        assert stated("fault", node=node) == {"dead", "bus_off", "stalled", "bit_rate"}
    names = [variant.name for variant in STUDY.file.variant]
    during, before = (
        {n.removesuffix(when) for n in names if n.endswith(when)}
        for when in (", in the shift", ", before")
    )
    assert len(names) == 1 + len(during) + len(before) and len(during) == 129
    # a clock is wrong, and a node is late, from the start
    assert during <= before and all("clock" in n or "late" in n for n in before - during)
    assert {choice.name for choice in STUDY.file.load} == {"N-B", "B-N", "N-F", "F-N"}


SMALL = """
name = "few"
scenario = "truck_into_gear_easy"
safety = true
[[variant]]
name = "ok"
[[variant]]
name = "sensor off"
set = { sensor_fault = [{ kind = "off", start_s = 0.13 }] }
[[variant]]
name = "controller dead"
set = { fault = [{ kind = "dead", node = "controller", start_s = 0.13 }] }
[[variant]]
name = "coil off"
set = { valve_fault = [{ valve = "B", kind = "off" }] }
"""

WORDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent")


@pytest.mark.parametrize(
    "what",
    [
        *(
            "position sensor",
            "shaft speeds",
            "valve B",
            "valve N",
            "valve F",
            "controller",
            "driver",
        ),
        *("ShiftRequest", "ValveCommand", "SafetyBlow", "PositionPulse", "DrivelineSpeeds"),
        "ControllerStatus",
    ],
)
def test_every_word_of_the_vocabulary_is_said_of_everything(what: str) -> None:
    said = {v.name.removeprefix(f"{what} ") for v in STUDY.file.variant if v.name.startswith(what)}
    for word in WORDS:
        assert any(word in name for name in said), (what, word)


def test_the_table_tells_detection_reaction_and_end(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "few.toml").write_text(SMALL)
    assert main(["whatif", str(tmp_path / "few.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "A valve energised without a living controller: in 0 runs." in capsys.readouterr().out
    table = (tmp_path / "out" / "fault_table.md").read_text().splitlines()
    # the single group of choices stands in the column of the shift
    rows = {line.split("|")[2].strip(): line for line in table if line.startswith("| few")}
    assert set(rows) == {"ok", "sensor off", "controller dead", "coil off"}
    assert "| - | - |" in rows["ok"] and "backward | backward" in rows["ok"]
    assert "POSITION_LOST" in rows["sensor off"] and "| unknown |" in rows["sensor off"]
    # the driver's timeout of 50 ms after the last frame of the dead controller
    off = rows["controller dead"].split("|")[5].strip()
    assert off.endswith(" ms") and 40 <= float(off[:-3]) <= 60
    assert "neutral" in rows["coil off"]
    assert (tmp_path / "out" / "faults.png").stat().st_size > 1000


def test_a_safety_study_needs_a_scenario(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "s.toml"
    path.write_text('name = "s"\nsafety = true\n[stroke]\nkind = "N-B"\ncommands = []\n')
    assert main(["whatif", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "safety: unknown" in capsys.readouterr().err
