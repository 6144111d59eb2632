"""`opc4 watch`: a fleet by folders, resumed without loss, refused in one line."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from can_dbc.messages import DrivelineSpeeds
from plant.parameters import load
from sil.cli import main
from sil.logs import open_log, open_writer
from sil.shift_diagnosis import watch as watching
from sil.shift_diagnosis.linear import Linear, linearise
from sil.shift_diagnosis.loads import BARRIERS, CONE
from sil.shift_diagnosis.shifts import Shift
from sil.shift_diagnosis.store import STORE, Reference
from tests.bench.truck_logs import by_reference, trips, truck_log
from tests.unit.sil.shift_diagnosis.test_shifts import without
from tests.unit.sil.studies.test_executor import cluster


def observations(path: Path, sizes: np.ndarray, seed: int, begin: int = 0) -> None:
    generator = np.random.default_rng(seed)
    lines = ["time_s,valve_open_delay,valve_open_delay_sd,play,play_sd"]
    for k, (a, b) in enumerate(sizes + generator.normal(0.0, 0.5, sizes.shape)):
        lines.append(f"{(begin + k) * 60.0},{a:.5f},0.5,{b:.5f},0.5")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def fleet(folder: Path) -> None:
    sizes = np.zeros((2000, 2))
    for part in range(3):
        observations(folder / "one" / f"{part}.csv", sizes, part, 2000 * part)
    sizes[700:, 0] = 0.5
    observations(folder / "two" / "0.csv", 0.0 * sizes, 7)
    observations(folder / "two" / "1.csv", sizes, 8, 2000)


def test_a_few_shifts_are_not_called_steady(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs, out = tmp_path / "fleet" / "one", tmp_path / "out"
    for part, (shifts, verdict) in enumerate([(119, "cannot_tell"), (1, "steady")]):
        observations(logs / f"{part}.csv", np.zeros((shifts, 2)), part, 119 * part)
        assert main(["watch", str(tmp_path / "fleet"), "--out", str(out), "--json"]) == 0
        (truck,) = json.loads(capsys.readouterr().out)["trucks"]
        assert truck["verdict"] == verdict
        assert (truck["lines"] == ["a change can be found from 120 shifts on"]) is (part == 0)
        assert ("too few shifts to tell" in (out / "report.html").read_text()) is (part == 0)


def test_a_fleet_is_watched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet(tmp_path / "fleet")
    assert main(["watch", str(tmp_path / "fleet"), "--out", str(tmp_path / "out"), "--json"]) == 1
    one, two = json.loads(capsys.readouterr().out)["trucks"]
    assert (one["truck"], one["verdict"], one["shifts"]) == ("one", "steady", 6000)
    assert two["verdict"] == "changed"
    (change,) = two["changes"]
    assert abs(change["shift"] - 2700) <= 40
    assert change["before"]["high"] < 0.0004 < 0.001 < change["after"]["low"]  # s: 3 ms a size
    assert change["log"].endswith("two/1.csv") and any(change["log"] in x for x in two["lines"])
    assert any("next: measure" in line for line in two["lines"])
    assert "valve_open_delay" in (tmp_path / "out" / "report.html").read_text()


def test_killed_and_resumed_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet(tmp_path / "fleet")
    target = str(tmp_path / "fleet")
    main(["watch", target, "--out", str(tmp_path / "whole")])
    taken = watching.observed
    calls = []

    def killed(path: Path, track: object) -> object:
        calls.append(path)
        found = taken(path, track)  # type: ignore[arg-type]
        if len(calls) == 3:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(watching, "observed", killed)
    with pytest.raises(BaseException):  # noqa: B017 - however the command ends
        assert main(["watch", target, "--out", str(tmp_path / "out")]) == 0
    with closing(sqlite3.connect(tmp_path / "out" / STORE)) as store:
        assert store.execute("select count(*) from log").fetchone() == (2,)
    main(["watch", target, "--out", str(tmp_path / "out")])
    assert len(calls) == 6  # two were not read again
    whole, resumed = (
        json.loads((tmp_path / name / "watch.json").read_text()) for name in ("whole", "out")
    )
    assert whole == resumed


def test_a_store_of_another_version_or_kind_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    observations(tmp_path / "truck" / "a.csv", np.zeros((50, 2)), 3)
    command = ["watch", str(tmp_path / "truck"), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    store = tmp_path / "out" / STORE
    with sqlite3.connect(store) as connection:
        connection.execute("pragma user_version = 1")
    connection.close()
    before = store.read_bytes()
    capsys.readouterr()
    assert main(command) == 2
    assert "watch.sqlite: a store of version 1; expected" in capsys.readouterr().err
    assert store.read_bytes() == before
    store.write_text("no database, but long enough to be read as one " * 40)
    assert main(command) == 2
    assert "expected the store of a watch" in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["play=nan", "play", "pley=0.001"])
def test_a_limit_that_is_none_is_refused(
    limit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    observations(tmp_path / "truck" / "a.csv", np.zeros((50, 2)), 3)
    command = ["watch", str(tmp_path / "truck"), "--out", str(tmp_path / "out"), "--limit", limit]
    assert main(command) == 2
    assert f"--limit {limit.partition('=')[0]}" in capsys.readouterr().err


def test_a_drift_is_extrapolated_to_the_stated_limit(tmp_path: Path) -> None:
    sizes = np.zeros((8000, 2))
    sizes[3000:, 0] = np.arange(5000) / 5000.0
    observations(tmp_path / "truck" / "a.csv", sizes, 3)
    out = tmp_path / "out"
    limit = "valve_open_delay=0.006"
    assert main(["watch", str(tmp_path / "truck"), "--out", str(out), "--limit", limit]) == 1
    (truck,) = json.loads((out / "watch.json").read_text())["trucks"]
    (forecast,) = truck["forecast"]
    assert truck["verdict"] == "drifting"
    assert forecast["limit"] == 0.006
    assert forecast["low"] < 5000 < forecast["high"]
    assert forecast["low"] > 4000 and forecast["high"] < 6000


@pytest.mark.slow
def test_a_healthy_truck_of_two_logs_has_usual_delays(nominal_log: Path, tmp_path: Path) -> None:
    (tmp_path / "truck").mkdir()
    for hour in range(2):
        with open_writer(tmp_path / "truck" / f"{hour}.log") as writer:
            for frame in open_log(nominal_log):
                writer.write(frame._replace(time_ns=frame.time_ns + hour * 3_600 * 10**9))
    out = tmp_path / "out"
    assert main(["watch", str(tmp_path / "truck"), "--out", str(out)]) == 0
    (truck,) = json.loads((out / "watch.json").read_text())["trucks"]
    assert truck["shifts"] >= 8 and truck["logs"] == 2
    delays = {row["name"]: row for row in truck["parameters"]}["valve_open_delay"]
    assert delays["low"] < 0.0005 and delays["high"] > -0.0005


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.002])
def test_what_differs_from_trip_to_trip_is_no_change(delay_s: float, tmp_path: Path) -> None:
    """Phase of the sensor's sampling and speed difference differ; valves are late from trip 8 on."""
    cause = {"effect.valve_open_delay.delay_s": delay_s} if delay_s else {}
    trips(tmp_path / "truck", 12 if cause else 11, 12, 20, 8, cause)
    out = tmp_path / "out"
    assert main(["watch", str(tmp_path / "truck"), "--out", str(out)]) == (1 if cause else 0)
    (truck,) = json.loads((out / "watch.json").read_text())["trucks"]
    assert truck["shifts"] > 220 and truck["left_out"] < 10
    assert truck["verdict"] == ("changed" if cause else "steady")
    if cause:
        (change,) = truck["changes"]
        assert change["low"] <= 160 <= change["high"]
        assert "valve_open_delay" in (change["name"], *change["alike"])


def test_a_folder_without_logs_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_truck_without_speeds_on_its_bus_is_watched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "fleet" / "silent" / "1.log"
    log.parent.mkdir(parents=True)
    by_reference(log, 12, 16, None, "silent")
    assert main(["watch", str(tmp_path / "fleet"), "--out", str(tmp_path / "out"), "--json"]) == 0
    (truck,) = json.loads(capsys.readouterr().out)["trucks"]
    assert truck["shifts"] >= 15
    with closing(sqlite3.connect(tmp_path / "out" / "watch.sqlite")) as store:
        (reference,) = store.execute("select reference from truck").fetchone()
        assert store.execute("select count(*) from odd").fetchone() == (0,)
    reference = msgspec.msgpack.decode(reference, type=Reference)
    assert reference.loads == CONE
    assert reference.chi2 < 1.5


def test_a_truck_that_no_longer_sends_its_speeds_is_watched(
    nominal_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = without(DrivelineSpeeds, nominal_log, tmp_path / "silent.log")
    reference = Reference(True, [0.0] * 17, 2e-5, 1.0, 1.0, 24, BARRIERS)
    asked: list[tuple[str, ...]] = []

    def watched(model: object, shifts: list[Shift], *rest: object, **options: object) -> Linear:
        asked.append(options["noise"].loads)  # type: ignore[attr-defined]
        assert not any(np.isnan(shift.difference_rad_s) for shift in shifts)
        return linearise(model, shifts, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(watching, "linearise", watched)
    found = watching.LogJudge(load("nominal"), None)(("a", silent, None, reference))
    after, taken = found.reference, found.taken
    assert asked == [BARRIERS + CONE]
    assert (after, taken.shifts) == (reference, 5)


def test_logs_that_are_not_whole_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "truck" / "1.log"
    log.parent.mkdir()
    by_reference(log, 12, 4, None)
    log.write_bytes(log.read_bytes()[:-20])
    assert main(["watch", str(log), "--out", str(tmp_path / "out")]) == 0
    fault = f"{log}: cut off at line "
    assert f"  {fault}" in capsys.readouterr().out
    (truck,) = json.loads((tmp_path / "out" / "watch.json").read_text())["trucks"]
    ((name, text),) = [row.values() for row in truck["faulty_logs"]]
    assert f"{name}: {text}".startswith(fault)


def test_what_the_shifts_do_not_show_has_no_value(tmp_path: Path) -> None:
    """A valve that closes later shows in no pulse: its deviation is thousands of typical sizes."""
    log = tmp_path / "truck" / "1.log"
    log.parent.mkdir()
    by_reference(log, 12, 4, None)
    assert main(["watch", str(log), "--out", str(tmp_path / "out")]) == 0
    (truck,) = json.loads((tmp_path / "out" / "watch.json").read_text())["trucks"]
    values = {row["name"]: row["value"] for row in truck["parameters"]}
    assert values["valve_slow_close"] is None
    assert values["valve_open_delay"] is not None
    assert "not shown by these shifts" in (tmp_path / "out" / "report.html").read_text()


def stored(out: Path) -> list[list[tuple[object, ...]]]:
    """Return what a store holds, in an order that does not depend on who was judged first."""
    with closing(sqlite3.connect(out / STORE)) as store:
        return [
            sorted(store.execute(f"select * from {table}").fetchall(), key=repr)
            for table in ("model", "log", "truck", "odd")
        ]


def two_trucks(folder: Path) -> Path:
    """A fleet of recorded shifts and of observations, of two logs and one each."""
    fleet(folder)
    for seed in (3, 5):
        (folder / f"truck-{seed}").mkdir()
        truck_log(folder / f"truck-{seed}" / "0.log", seed, 6)
    return folder


def test_trucks_judged_side_by_side_give_the_same_store(tmp_path: Path) -> None:
    """By processes and by a cluster, also if a part was taken before."""
    logs = two_trucks(tmp_path / "fleet")
    ways = {"alone": [], "two": ["--workers", "2"]}
    with cluster(tmp_path, workers=2) as address:
        ways["cluster"] = ["--cluster", address]
        for name, options in ways.items():
            if name == "two":
                main(["watch", str(logs / "one" / "0.csv"), "--out", str(tmp_path / name)])
            assert main(["watch", str(logs), "--out", str(tmp_path / name), *options]) == 1
    alone, *others = ([stored(tmp_path / name), watched(tmp_path / name)] for name in ways)
    assert len(alone[0][1]) == 7 and len(alone[1]["trucks"]) == 4
    assert all(other == alone for other in others)


def watched(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "watch.json").read_text())
    return found


def test_what_other_processes_refuse_is_one_line_and_the_rest_is_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "fleet"
    fleet(logs)
    (logs / "two" / "0.csv").write_text("time_s,a,a_sd\n0,1,none\n")
    out = tmp_path / "out"
    assert main(["watch", str(logs), "--out", str(out), "--workers", "2"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "two/0.csv: line 2" in error and "Traceback" not in error
    assert [Path(row[0]).name for row in stored(out)[1]] == ["0.csv"]
    assert main(["watch", str(logs), "--out", str(out), "--workers", "0"]) == 2
    new = tmp_path / "new"
    assert main(["watch", str(logs), "--out", str(new), "--cluster", "tcp://127.0.0.1:9"]) == 3
    assert "cannot be reached" in capsys.readouterr().err and not new.exists()
