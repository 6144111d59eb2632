"""A truck's log through `opc4 replay`: each recorded shift next to ours, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sil.cli import main
from sil.j1939.mapping import LAYOUT, SHIPPED
from sil.log_replay import report
from tests.support.truck_synthesis import DRIVE, MadeShift, Truck, replace, without, write_log

Capture = pytest.CaptureFixture[str]
ONE = Truck(drive=DRIVE[:1], end_ms=6_000)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the drawing, which takes longer than all else."""
    monkeypatch.setattr(report, "save", lambda figure, folder, name: bytes(64))


def replayed(log: Path, capsys: Capture, *options: str) -> dict[str, Any]:
    """What `opc4 replay LOG --json` prints; its exit code is in "code"."""
    folder = str(log.parent / "out")
    code = main(["replay", str(log), "--out", folder, "--force", "--json", "--quiet", *options])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found | {"code": code}


def test_a_log_of_a_truck_gives_the_comparison_page(tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / "truck.asc", ONE.frames())
    assert main(["replay", str(log), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "1 shift in" in printed and "1. 3 to 4: " in printed and " quicker: " in printed
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"diff.txt", "report.html", "shifts.png", "shift_1.png", "shift_1.svg"} <= files
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("<img") == 2 and "odd gears forward" in page


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("suffix", ["asc", "blf", "csv.gz"])
def test_all_shifts_of_a_drive(suffix: str, tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / f"truck.{suffix}", Truck().frames())
    assert main(["replay", str(log), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "3 shifts in" in printed and "2. 4 to 5: " in printed and " quicker: " in printed
    found = json.loads((tmp_path / "out/diff.json").read_text())
    for made, shift in zip(DRIVE, found["shifts"], strict=True):
        assert (shift["from_gear"], shift["to_gear"]) == (made.before, made.after)
        times = shift["recorded"]["times_s"]
        assert times["torque_cut"] == pytest.approx(made.cut_ms / 1e3, abs=0.025)
        assert 0.0 <= times["disengaged"] - made.out_ms / 1e3 <= 0.1
        assert times["synchronised"] == pytest.approx(made.fall_to_ms / 1e3, abs=0.06)
        assert 0.0 <= times["engaged"] - made.in_ms / 1e3 <= 0.1
        assert times["torque_back"] == pytest.approx(made.back_ms / 1e3, abs=0.05)
        assert shift["ours"][0]["reached"] and shift["in_statistics"]
    text = (tmp_path / "out/diff.txt").read_text()
    assert "default: plant.mesh_force_n = 500" in text and "log: plant.supply_pressure_pa" in text


@pytest.mark.usefixtures("no_pictures")
def test_what_if_on_recorded_driving_is_a_second_column(tmp_path: Path, capsys: Capture) -> None:
    slow = replace(ONE, drive=(replace(DRIVE[0], fall_to_ms=1_100, in_ms=1_160, back_ms=1_400),))
    log = write_log(tmp_path / "truck.log", slow.frames())
    found = replayed(log, capsys, "--set", "controller.shift.wait_for_sync=true")
    assert found["columns"] == ["recorded", "ours", "what-if"] and found["code"] == 0
    plain, waiting = found["shifts"][0]["ours"]
    assert waiting["times_s"]["engaged"] > plain["times_s"]["engaged"] + 0.1
    assert waiting["peak_rad_s2"] < plain["peak_rad_s2"]
    by_name = replayed(log, capsys, "--strategy", "air_cushion")
    assert len(by_name["shifts"][0]["ours"]) == 2
    assert by_name["changes"][1] == "controller.strategy=air_cushion"
    assert by_name["shifts"][0]["ours"][0] == plain
    assert by_name["shifts"][0]["ours"][1]["impact_speed_m_s"] < 0.9 * plain["impact_speed_m_s"]
    firmware = tmp_path / "patient.toml"
    firmware.write_text("[shift]\nwait_for_sync = true\n")
    by_file = replayed(log, capsys, "--firmware", str(firmware))
    assert by_file["shifts"][0]["ours"][1] == waiting


@pytest.mark.usefixtures("no_pictures")
def test_a_gear_that_ours_does_not_reach_fails(tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / "truck.log", ONE.frames())
    found = replayed(log, capsys, "--set", "plant.pull_force_n=90000")
    assert found["code"] == 1 and found["failed"] == [1]
    assert found["shifts"][0]["verdict"][1][0].startswith("ours does not reach the gear")


@pytest.mark.slow
def test_the_same_files_at_every_run(tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / "truck.csv", ONE.frames())
    for name in ("first", "second"):
        assert main(["replay", str(log), "--out", str(tmp_path / name), "--quiet"]) == 0
    for name in ("diff.json", "diff.txt", "shift_1.svg", "shift_1.png", "shifts.png"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    assert capsys.readouterr().out


@pytest.mark.usefixtures("no_pictures")
def test_a_copied_mapping_gives_the_same(tmp_path: Path, capsys: Capture) -> None:
    assert main(["replay", "--print-map"]) == 0
    (tmp_path / "my.toml").write_text(capsys.readouterr().out)
    assert (tmp_path / "my.toml").read_text() == SHIPPED.read_text()
    log = write_log(tmp_path / "truck.log", ONE.frames())
    own = replayed(log, capsys)
    mapped = replayed(log, capsys, "--map", str(tmp_path / "my.toml"), "--dbc", str(LAYOUT))
    for shift in own["shifts"]:
        shift["engine"] = None  # EEC1 is read by --summary's own rule, and from our mapping here
    assert mapped["shifts"] == own["shifts"] and mapped["dbc"] == str(LAYOUT)


@pytest.mark.parametrize("pgn", [61442, 61445])
def test_a_missing_message_is_named_in_one_line(pgn: int, tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / "truck.log", without(ONE.frames(), 0, 99_000, pgn))
    assert main(["replay", str(log), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"(PGN {pgn})" in said and said.count("\n") == 1 and "truck.log" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--map", "none.toml"], "none.toml"),
        (["--map", str(LAYOUT)], "j1939.dbc"),
        (["--map", str(SHIPPED), "--dbc", "none.dbc"], "none.dbc"),
        (
            ["--map", str(SHIPPED), "--dbc", "{here}/other.dbc"],
            "'ETC1' is unknown; expected one of Speeds",
        ),
        (["--map", str(SHIPPED), "--plant"], "--map: a truck's log has no commands for --plant"),
        (["--plant"], "no ValveCommand in it"),
        (["--set", "controller.stratgy=open_loop"], "expected one of controller.strategy"),
        (["--strategy", "sliding"], "sliding_mode"),
        (["--firmware", "none.py"], "none.py"),
    ],
)
def test_wrong_options_are_one_line(
    options: list[str], expected: str, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "other.dbc").write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: X\nBO_ 256 Speeds: 8 X\n SG_ A : 0|8@1+ (1,0) [0|0] "" X\n'
    )
    log = write_log(tmp_path / "truck.log", ONE.frames())
    given = [option.replace("{here}", str(tmp_path)) for option in options]
    assert main(["replay", str(log), "--out", str(tmp_path / "out"), "--quiet", *given]) == 2
    said = capsys.readouterr().err
    assert expected in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_pictures")
def test_a_gap_stays_out_of_the_statistics(tmp_path: Path, capsys: Capture) -> None:
    frames = without(Truck(drive=DRIVE[:2], end_ms=11_000).frames(), 8_300, 9_000)
    found = replayed(write_log(tmp_path / "truck.trc", frames), capsys)
    assert [shift["in_statistics"] for shift in found["shifts"]] == [True, False]
    assert found["statistics"][0]["columns"][0]["shifts"] == 1
    assert found["shifts"][1]["verdict"] == [["not comparable: the log has a gap inside"]]


@pytest.mark.usefixtures("no_pictures")
def test_shifts_that_have_no_counterpart_are_listed(tmp_path: Path, capsys: Capture) -> None:
    """Into park, and one of which ETC2 shows no gear."""
    parked = Truck(drive=(DRIVE[0], MadeShift(6_000, 4, 126)), end_ms=9_000)
    found = replayed(write_log(tmp_path / "truck.log", parked.frames()), capsys)
    assert [bool(shift["skipped"]) for shift in found["shifts"]] == [False, True]
    assert found["shifts"][1]["verdict"] == [["not simulated: park is no position of the actuator"]]
    assert found["code"] == 0
