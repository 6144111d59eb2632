"""The shipped fault study is complete, and its table tells what happened."""

from __future__ import annotations

import typing
from pathlib import Path
from typing import Any

import pytest

from plant.devices.position_circuit import SensorFault
from plant.devices.signal_faults import SpeedFault, TemperatureFault
from plant.devices.valve_faults import ValveFault
from sil.cli import main
from sil.studies.load_study import load_study

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
