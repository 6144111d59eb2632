"""Our firmware and plant in place of the truck's; page, statistics and the summary."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sil import cli
from sil.files.overrides import NO_SETTINGS, Settings
from sil.j1939.mapping import SignalMapping
from sil.log_replay import report
from sil.log_replay.figures import shift_figure
from sil.log_replay.truck_log import TruckLog
from sil.log_replay.truck_loop import Input, OurShift, inputs_of, side, simulate, why_not
from sil.log_replay.truck_replay import (
    ComparedShift,
    TruckReplay,
    quicker,
    replay_truck,
    statistics,
    truck_verdict,
)
from sil.log_replay.truck_shift import RecordedShift, recorded_shift
from sil.logs import LogFrame, open_logs
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from tests.support.golden_logs import write
from tests.support.j1939_logs import with_engine
from tests.support.truck_synthesis import DRIVE, MadeShift, Truck, replace, without, write_log

MAPPING = SignalMapping()
SHIFT = MadeShift(3_000, 3, 4, fall_from_ms=300, fall_to_ms=700)
ONE = Truck(drive=(SHIFT,), end_ms=6_000)


def recorded(frames: Iterable[LogFrame]) -> RecordedShift:
    log = TruckLog("truck.log", MAPPING)
    assert log.read(frames)
    return recorded_shift(log, log.shifts[0])


def of(shift: MadeShift, **changes: object) -> RecordedShift:
    return recorded(replace(ONE, drive=(shift,), end_ms=shift.end_ms + 2_500, **changes).frames())


def ours(found: RecordedShift, settings: Settings = NO_SETTINGS) -> OurShift:
    return simulate(found, inputs_of(found), "truck.log", {}, settings)


def by_path(found: RecordedShift) -> dict[str, Input]:
    return {entry.path: entry for entry in inputs_of(found)}


def test_every_input_says_where_it_is_from() -> None:
    inputs = by_path(of(SHIFT))
    assert inputs["plant.supply_pressure_pa"].value == 941325.0
    assert inputs["plant.supply_pressure_pa"].source == "log"
    assert inputs["plant.mesh_force_n"].source == "default"
    assert inputs["request.after_s"].value == pytest.approx(0.123)
    assert inputs["driveline.gear_step_rad_s"].source == "derived"
    # 4 % of 2000 N m at the cut, friction 0.1 at a radius of 0.06 m
    assert inputs["plant.pull_force_n"].value == pytest.approx(100.0 + 0.1 * 80.0 / 0.06)
    bare = by_path(of(SHIFT, supply_kpa=None))["plant.supply_pressure_pa"]
    assert (bare.value, bare.source) == ("nominal", "default")
    odd = by_path(of(SHIFT, supply_kpa=80.0))["plant.supply_pressure_pa"]
    assert odd.value == "nominal" and "no working pressure" in odd.text


def test_gears_become_sides_of_the_stay() -> None:
    assert [side(gear) for gear in (-1, 0, 1, 2)] == ["forward", "neutral", "forward", "backward"]
    same = by_path(of(replace(SHIFT, before=2, after=6)))
    assert (same["initial_gear"].value, same["request.gear"].value) == ("forward", "backward")
    assert "parity is the same" in same["initial_gear"].text
    found = of(SHIFT)
    for before, after, why in ((None, 4, "not known"), (3, 126, "park"), (3, 3, "the same before")):
        odd = RecordedShift(
            **{**vars(found), "shift": replace(found.shift, from_gear=before, to_gear=after)}
        )
        assert why in (why_not(odd) or "")
        assert truck_verdict(ComparedShift(1, odd, [], [], why_not(odd)))[0].startswith(
            "not simulated: "
        )
    assert why_not(found) is None


def test_a_full_shift_follows_the_recorded_engine() -> None:
    found = of(SHIFT)
    mine = ours(found)
    assert mine.reached and not mine.faults
    times = [
        mine.times_s[name]
        for name in ("torque_cut", "disengaged", "synchronised", "engaged", "torque_back")
    ]
    assert all(a is not None and b is not None and a < b for a, b in pairwise(times))
    sync = found.synchronisation
    assert sync is not None and sync.ramp_rad_s2 is not None
    left = mine.times_s["disengaged"]
    assert left is not None
    falling = (mine.time_s > left + 0.03) & (mine.time_s < left + 0.15)
    slope = np.polyfit(mine.time_s[falling], mine.difference_rad_s[falling], 1)[0]
    assert slope == pytest.approx(-np.sign(sync.step_rad_s) * sync.ramp_rad_s2, rel=0.1)
    assert mine.left_rad_s is not None
    assert mine.impulse_n_s == pytest.approx(mine.left_rad_s * 0.25 / 0.09)
    back, engaged = found.times_s["torque_back"], found.times_s["engaged"]
    assert back is not None and engaged is not None and times[3] is not None
    assert times[4] == pytest.approx(times[3] + back - engaged)


def test_a_slow_engine_leaves_more_to_the_cone() -> None:
    slow = ours(of(replace(SHIFT, fall_to_ms=1_900, in_ms=1_960, back_ms=2_200)))
    fast = ours(of(replace(SHIFT, fall_to_ms=450, in_ms=510, back_ms=750)))
    assert slow.left_rad_s is not None and slow.left_rad_s > 10.0
    assert (fast.left_rad_s or 0.0) < 2.0
    assert slow.peak_rad_s2 is not None and fast.peak_rad_s2 is not None
    patient = ours(
        of(replace(SHIFT, fall_to_ms=1_100, in_ms=1_160, back_ms=1_400)),
        {"controller.shift.wait_for_sync": True},
    )
    hasty = ours(of(replace(SHIFT, fall_to_ms=1_100, in_ms=1_160, back_ms=1_400)))
    assert patient.peak_rad_s2 is not None and hasty.peak_rad_s2 is not None
    assert patient.peak_rad_s2 < 0.5 * hasty.peak_rad_s2
    assert (patient.times_s["engaged"] or 0.0) > (hasty.times_s["engaged"] or 9.0) + 0.1


def test_without_torque_both_leave_the_gear_together() -> None:
    found = recorded(without(ONE.frames(), 0, 99_000, 61444))
    assert ours(found).times_s["disengaged"] == pytest.approx(found.times_s["disengaged"])
    assert by_path(found)["request.after_s"].value == "as the gear is left"


def test_from_neutral_ours_waits_for_the_recorded_speeds() -> None:
    found = of(replace(SHIFT, before=0, after=3), output_rpm=300.0)
    mine = ours(found)
    assert by_path(found)["request.after_s"].value == found.times_s["synchronised"]
    assert mine.times_s["disengaged"] is None and mine.reached
    still = of(replace(SHIFT, before=0, after=1), output_rpm=0.0)
    assert still.synchronisation is None
    assert any(
        entry.path == "driveline" and entry.source == "default" for entry in inputs_of(still)
    )
    out = ours(of(replace(SHIFT, before=3, after=0)))
    assert out.reached and out.times_s["synchronised"] is None


def test_a_gear_that_is_not_reached_is_said() -> None:
    found = of(SHIFT)
    stuck = ours(found, {"plant.pull_force_n": 90000})
    assert (not stuck.reached and "SHIFT_TIMEOUT" in stuck.faults) or "SENSOR_STUCK" in stuck.faults
    shift = ComparedShift(1, found, inputs_of(found), [stuck])
    assert truck_verdict(shift) == [f"ours does not reach the gear ({stuck.faults})"]


def test_our_own_bus_read_as_a_truck_s_gives_our_own_times() -> None:
    """A run's ETC1 and ETC2 as the log: what it shows agrees with the same run by this way."""
    made = {
        "name": "own", "duration_s": 3.0, "initial_gear": "forward", "trace_period_s": 0.0005,
        "request": [{"at_s": 1.0, "gear": "backward"}],
        "plant": {"mounted": True, "pull_force_n": 100.0, "mesh_force_n": 500.0},
        "driveline": {"output_rad_s": 80.0, "gear_step_rad_s": 24.0, "engine_delay_s": 0.0, "engine_ramp_rad_s2": 120.0},
        "controller": {"blow": {"cut": "none"}},
    }  # fmt: skip
    run = run_in_memory(load_scenario.from_table(made, "own"))
    frames = [LogFrame(e.arrival_ns, e.frame.can_id, e.frame.data) for e in run.record.frames]
    log = TruckLog("own.log", MAPPING)
    assert log.read(frames)
    (shift,) = log.shifts
    found = recorded_shift(log, shift)
    confirmed = run.shifts[0].confirmed_s
    assert confirmed is not None and found.times_s["engaged"] is not None
    assert found.request_ns / 1e9 + found.times_s["engaged"] == pytest.approx(confirmed, abs=0.015)


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> TruckReplay:
    log = write_log(tmp_path_factory.mktemp("log") / "truck.log", Truck().frames())
    found = replay_truck(open_logs([log]), settings={"controller.shift.wait_for_sync": True})
    assert found is not None and len(found.shifts) == len(DRIVE)
    return found


def test_statistics_are_over_the_shifts(replay: TruckReplay) -> None:
    rows = {row["figure"]: row for row in statistics(replay)}
    recorded, ours, changed = rows["request to new gear"]["columns"]
    times = sorted(shift.recorded.times_s["engaged"] or 0.0 for shift in replay.shifts)
    assert recorded["shifts"] == 3 and recorded["median"] == times[1]
    assert times[1] < recorded["p95"] <= times[2]
    assert ours["median"] < recorded["median"] and ours["median"] < changed["median"]
    assert rows["impact speed"]["columns"][0] == {"shifts": 0, "median": None, "p95": None}
    for column in (0, 1):
        assert sum(quicker(replay, column)) == 3


def test_the_verdict_says_why_and_by_how_much(replay: TruckReplay) -> None:
    second = replay.shifts[1]
    first, *reasons = truck_verdict(second)
    theirs, mine = second.recorded.times_s["engaged"], second.ours[0].times_s["engaged"]
    assert theirs is not None and mine is not None
    assert first.startswith(f"{theirs - mine:.3f} s quicker: {mine:.3f} s against {theirs:.3f} s")
    assert any("our cone takes the last" in line for line in reasons)
    assert any(line.startswith("harder: ") for line in reasons)
    assert any(line.startswith("as soft: ") for line in truck_verdict(second, 1))


def test_the_page_has_a_picture_per_shift_up_to_a_number(
    replay: TruckReplay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def empty(figure: object, folder: Path, name: str) -> bytes:
        (folder / f"{name}.png").touch()
        return bytes(64)

    monkeypatch.setattr(report, "save", empty)
    values = report.truck_dict(replay)
    page = report.truck_page(replay, values, "opc4 replay truck.log", tmp_path, max_pictures=2)
    assert page.count("<img") == 3
    assert "Pictures of 1 further shifts" in page
    assert {f"shift_{n}.png" for n in (1, 2, 3)} <= {path.name for path in tmp_path.iterdir()}
    assert "What-if: controller.shift.wait_for_sync=true" in page
    assert page.count("<details>") == 3 and "http" not in page.replace("http://www.w3.org", "")
    for row in values["statistics"]:
        assert row["figure"] in page


def test_the_figure_shows_both_sides(replay: TruckReplay) -> None:
    figure = shift_figure(replay, replay.shifts[1])
    panels = {panel.title: panel for panel in figure.stacks[0].panels}
    speeds = panels["Speed difference at the synchronizer"]
    assert [line.label for line in speeds.series] == ["recorded", "ours", "what-if"]
    assert [name for _, name in panels["Phases"].ticks] == ["recorded", "ours", "what-if"]
    assert len({span.low for span in panels["Phases"].spans}) == 3
    assert len(panels["Our stay"].series) == 2


def test_a_folder_with_page_pictures_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = with_engine()
    half = len(frames) // 2
    one, two = (write(tmp_path / "1.log", frames[:half]), write(tmp_path / "2.log", frames[half:]))
    out = tmp_path / "out"
    assert cli.main(["replay", str(two), str(one), "--summary", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "3 shifts in" in text and "engine torque 60 %" in text and "after a gap of" in text
    names = {path.name for path in out.iterdir()}
    assert {"report.html", "summary.json", "shifts.png", "shift_1.png", "shift_3.svg"} <= names
    values = json.loads((out / "summary.json").read_text())
    assert values["shifts"][1]["engine"]["torque_least_percent"] == -5
    assert len(values["log_report"]["files"]) == 2
    assert "1 to 2" in (out / "report.html").read_text(encoding="utf-8")


def test_a_log_without_times_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"can0  {f.can_id:08X}   [8]  {f.data.hex(' ').upper()}\n" for f in with_engine()]
    (tmp_path / "screen.log").write_text("".join(lines))
    assert cli.main(["replay", str(tmp_path / "screen.log"), "--summary"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "has no times, so that no shift time is known" in line


@pytest.mark.parametrize(
    "words", [["--set", "a=3"], ["--closed-loop"], ["--strategy", "x"], ["--map", "m.toml"]]
)
def test_options_of_a_replay_are_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / "1.log", with_engine())
    assert cli.main(["replay", str(log), "--summary", *words]) == 2
    assert capsys.readouterr().err == (
        f"opc4 replay: {words[0]}: not together with --summary, which replays nothing; expected one "
        "of them\n"
    )
