"""The store of a watch: nothing lost by a kill, nothing taken twice, damage named in one line."""

from __future__ import annotations

import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError, RunError
from plant.parameters import load
from sil.cli import main
from sil.files.output_folder import locked_folder
from sil.shift_diagnosis.store import STORE, Store, Taken
from sil.shift_diagnosis.track import Track
from tests.bench.truck_logs import by_reference
from tests.unit.sil.shift_diagnosis.test_watch import fleet, observations

KILLED_AT_STATEMENT = """
import os, signal, sqlite3, sys
left, connect = int(sys.argv[1]), sqlite3.connect
def counted(_statement):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), signal.SIGKILL)
def traced(*words, **options):
    connection = connect(*words, **options)
    connection.set_trace_callback(counted)
    return connection
sqlite3.connect = traced
from sil.cli import main
sys.exit(main(sys.argv[2:]))
"""


def content(out: Path) -> tuple[object, ...]:
    """Return watch.json and all rows of a store."""
    with closing(sqlite3.connect(out / STORE)) as store:
        assert store.execute("pragma integrity_check").fetchone() == ("ok",)
        rows = [store.execute(f"select * from {t}").fetchall() for t in ("log", "truck", "odd")]
    return json.loads((out / "watch.json").read_text()), *map(sorted, rows)


@pytest.mark.slow
def test_killed_at_any_statement_and_resumed_the_store_is_the_same(tmp_path: Path) -> None:
    fleet(tmp_path / "fleet")
    words = ["watch", str(tmp_path / "fleet"), "--quiet", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 1
    codes = []
    for statement in range(200):
        command = [sys.executable, "-c", KILLED_AT_STATEMENT, str(statement), *words]
        ended = subprocess.run([*command, str(tmp_path / "out")], capture_output=True, text=True)
        codes.append(ended.returncode)
        if ended.returncode != -signal.SIGKILL:
            break
    assert codes[-1] == 1, ended.stderr
    assert len(codes) > 15
    assert content(tmp_path / "out") == content(tmp_path / "whole")


@pytest.mark.slow
def test_killed_while_logs_are_judged_and_resumed_the_store_is_the_same(tmp_path: Path) -> None:
    (tmp_path / "fleet" / "truck").mkdir(parents=True)
    for seed in (16, 17, 18):  # other loads, the same as another day
        by_reference(tmp_path / "fleet" / "truck" / f"{seed}.log", seed, 6, None)
    words = ["watch", str(tmp_path / "fleet"), "--quiet", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    out = tmp_path / "out"
    for _ in range(4):  # each when the store is written next, or a little after
        journal, running = out / f"{STORE}-journal", True
        with subprocess.Popen([sys.executable, "-m", "sil.cli", *words, str(out)]) as watching:
            while running and not journal.exists():
                running = watching.poll() is None
                time.sleep(0.001)
            watching.kill()
    assert main([*words, str(out)]) == 0
    assert content(out) == content(tmp_path / "whole")


def watch(folder: Path, out: Path, *more: str) -> int:
    return main(["watch", str(folder), "--quiet", "--out", str(out), *more])


def one_truck(tmp_path: Path) -> tuple[Path, Path]:
    """Write a truck with two logs and watch it; return its folder and that of the watch."""
    truck, out = tmp_path / "fleet" / "truck", tmp_path / "out"
    for part in range(2):
        observations(truck / f"{part}.csv", np.zeros((70, 2)), part, 70 * part)
    assert watch(tmp_path / "fleet", out) == 0
    return truck, out


def test_logs_one_by_one_are_as_all_at_once(tmp_path: Path) -> None:
    fleet(tmp_path / "fleet")
    watch(tmp_path / "fleet", tmp_path / "whole")
    for log in sorted((tmp_path / "fleet").rglob("*.csv")):
        watch(log, tmp_path / "out")
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_a_log_is_taken_once_by_whatever_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truck, out = one_truck(tmp_path)
    before = content(out)
    (tmp_path / "link").symlink_to(tmp_path / "fleet")
    monkeypatch.chdir(truck)
    assert watch(Path("0.csv"), out) == 0
    assert watch(Path("..", "..", "link"), out) == 0
    assert content(out)[1:] == before[1:]
    shutil.copy("0.csv", "copy.csv")
    Path("1.csv").rename("moved.csv")
    assert watch(tmp_path / "fleet", out) == 0
    logs, *rest = content(out)[1:]
    assert rest == list(before[2:])
    assert sorted(Path(row[0]).name for row in logs) == ["copy.csv", "moved.csv"]  # type: ignore[attr-defined]


def test_odd_shifts_are_where_their_log_is_now(tmp_path: Path) -> None:
    log, moved = tmp_path / "a.log", tmp_path / "b.log"
    log.write_text("a drive")
    with closing(Store(tmp_path / STORE, load("nominal"))) as store:
        store.add_odd("truck", 3, 0.5, log, 99.0)
        store.add_log("truck", log, 0, Taken(shifts=5))
        store.put_truck("truck", Track.of(("play",)), None)
        log.rename(moved)
        assert not store.has_path("truck", moved)
        assert store.has_content("truck", moved) and store.has_path("truck", moved)
        (truck,) = store.trucks()
    assert truck.odd == [(3, 0.5, str(moved), 99.0)]


def test_what_cannot_be_taken_is_named_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truck, out = one_truck(tmp_path)
    before = content(out)

    def refused(folder: Path, *more: str) -> str:
        capsys.readouterr()
        assert watch(folder, out, *more) == 2
        assert content(out) == before
        (line,) = capsys.readouterr().err.splitlines()
        return line

    other = tmp_path / "fleet" / "other"
    other.mkdir()
    shutil.copy(truck / "0.csv", other)
    assert "a log of truck other, taken before as one of truck truck" in refused(other)
    model = tmp_path / "model.toml"
    model.write_text(
        '[base]\nmodel = "nominal"\n[valve]\n'
        'D_rise = { value = 0.009, unit = "s", source = "a test" }\n'
    )
    assert "a watch with another model" in refused(truck, "--model", str(model))
    with (truck / "0.csv").open("a") as file:
        file.write("9000.0,0.0,0.5,0.0,0.5\n")
    assert "expected a log that is complete" in refused(truck)


def test_a_damaged_store_is_named_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truck, out = one_truck(tmp_path)
    observations(truck / "2.csv", np.zeros((70, 2)), 2, 140)
    whole = (out / STORE).read_bytes()
    with closing(sqlite3.connect(out / STORE)) as store:
        (track,) = store.execute("select track from truck").fetchone()
    at = whole.index(track[:100]) + 50
    damaged = {
        "truck truck is damaged": whole[:at] + b"\x00" + whole[at + 1 :],
        "malformed": whole[: len(whole) // 2],
        "not a database": b"no store" + whole[8:],
    }
    for what, bytes_of in damaged.items():
        (out / STORE).write_bytes(bytes_of)
        capsys.readouterr()
        assert watch(truck, out) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert what in line and "expected" in line
        assert (out / STORE).read_bytes() == bytes_of


def test_a_store_that_another_process_writes_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / STORE
    with closing(Store(path, load("nominal"))) as store:
        store._connection.execute("pragma busy_timeout = 1")
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("begin immediate")
            expected = "locked; expected the end of the other watch"
            with pytest.raises(InputError, match=expected), store.transaction():
                pass
    with closing(Store(path, load("nominal"))) as store:
        store._connection.execute("pragma max_page_count = 1")
        with pytest.raises(RunError, match="full"), store.transaction():
            for number in range(1000):
                store.add_odd("truck", number, 0.0, path, 1.0)
        assert store.is_empty


def test_two_watches_do_not_write_one_store_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truck, out = one_truck(tmp_path)
    with locked_folder(out):
        assert watch(truck, out) == 2
    assert "another run is writing here" in capsys.readouterr().err


def test_a_store_that_cannot_be_opened_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truck, _out = one_truck(tmp_path)
    (tmp_path / "other" / STORE).mkdir(parents=True)
    capsys.readouterr()
    assert watch(truck, tmp_path / "other") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("unable to open database file; expected a file and a folder to write in")


def test_logs_out_of_order_in_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In one call they are sorted; of separate calls the later one is reported."""
    day = 24 * 60
    for name, begin in (("b", 28_333_333), ("a", 28_333_333 + day)):
        observations(tmp_path / "truck" / f"{name}.csv", np.zeros((70, 2)), ord(name), begin)
    watch(tmp_path / "truck", tmp_path / "sorted", "--json")
    (truck,) = json.loads(capsys.readouterr().out)["trucks"]
    assert truck["late_logs"] == []
    _values, logs, *_rest = content(tmp_path / "sorted")
    assert [Path(row[0]).name for row in sorted(logs, key=lambda row: row[6])] == ["b.csv", "a.csv"]  # type: ignore[call-overload]
    for name in ("a", "b"):
        watch(tmp_path / "truck" / f"{name}.csv", tmp_path / "out")
    printed = capsys.readouterr().out
    assert "b.csv begins before the log taken before ends" in printed
    (truck,) = json.loads((tmp_path / "out" / "watch.json").read_text())["trucks"]
    assert [Path(path).name for path in truck["late_logs"]] == ["b.csv"]
