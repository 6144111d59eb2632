"""The loop closes: one command runs a gear shift over CAN and leaves everything on disk."""

from __future__ import annotations

import csv
import gzip
import json
import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from can_dbc.codec import can_id_of, decode
from can_dbc.frame import Frame
from can_dbc.messages import ControllerStatus
from controller.shift import TRANSITIONS
from sil.simulation import load_scenario, runner
from tests import golden_replays
from tests.conftest import ROOT

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_full_shift_from_the_command_line(opc4: Run, tmp_path: Path) -> None:
    done = opc4("run", "full_shift", "--out", "first", "--json", "--junit", "junit.xml")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["passed"] is True
    assert result["complete"] is True
    assert result == json.loads((tmp_path / "first" / "result.json").read_text())

    shifts = result["metrics"]["shifts"]
    assert [(s["from_gear"], s["to_gear"]) for s in shifts] == [
        ("backward", "neutral"),
        ("neutral", "forward"),
    ]
    for shift in shifts:
        names = ["requested", "commanded", "valve_open", "first_motion", "arrived", "confirmed"]
        instants = [shift[f"{name}_s"] for name in names]
        assert instants == sorted(instants)
        assert 0.004 < shift["valve_open_s"] - shift["commanded_s"] < 0.0085
    assert all(check["passed"] for check in result["expectations"])

    with (tmp_path / "first" / "trace.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["position_m"]) == 0.01285
    assert float(rows[-1]["position_m"]) == -0.01285
    assert {r["valve_F"] for r in rows} == {"0", "1"}

    import can

    with can.LogReader(str(tmp_path / "first" / "bus.log")) as log:
        frames = list(log)
    assert len(frames) == result["metrics"]["frames"] > 500
    assert (tmp_path / "first" / "shift.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "first" / "report.html").read_text()
    assert "http://" not in page and "https://" not in page
    assert (tmp_path / "junit.xml").read_text().count("<testcase") == len(result["expectations"])


def test_same_run_twice_gives_the_same_bits(tmp_path: Path) -> None:
    hashes, loaded = [], load_scenario.load("full_shift")
    for number in ("1", "2"):
        (tmp_path / number).mkdir()
        hashes.append(runner.run(loaded, tmp_path / number).result.trace_sha256)
    assert hashes[0] == hashes[1] and len(hashes[0] or "") == 64
    for file in ("bus.log", "trace.csv", "events.jsonl"):
        assert (tmp_path / "1" / file).read_bytes() == (tmp_path / "2" / file).read_bytes()


FOLDER = ROOT / "tests" / "golden"
NAMES = sorted(load_scenario.shipped())


def test_there_is_one_small_log_for_every_shipped_scenario() -> None:
    files = sorted(FOLDER.iterdir())
    assert [f.name.removesuffix(golden_replays.SUFFIX) for f in files] == NAMES
    assert sum(f.stat().st_size for f in files) < 400_000


@pytest.mark.parametrize("name", NAMES)
def test_the_firmware_answers_as_it_did(name: str) -> None:
    """A wanted change: make golden_replays, which says what changed, and commit the logs with it."""
    found = golden_replays.check(FOLDER, name)
    assert not found.differs, found.comparison.first
    assert found.account.total() == found.frames > 200


@pytest.mark.parametrize("name", NAMES)
def test_the_firmware_changes_its_state_as_its_table_says(name: str) -> None:
    allowed = {(state, after) for (state, _), after in TRANSITIONS.items()}
    wanted = f"{can_id_of(ControllerStatus):08X}"
    log = gzip.decompress(golden_replays.golden_path(FOLDER, name).read_bytes()).decode()
    frames = (line.split()[2].split("#") for line in log.splitlines())
    statuses = [Frame(int(i, 16), bytes.fromhex(data)) for i, data in frames if i == wanted]
    found = set()
    for one, other in pairwise(statuses):
        states = decode(one), decode(other)
        assert isinstance(states[0], ControllerStatus) and isinstance(states[1], ControllerStatus)
        if (other.data[1] - one.data[1]) & 0xF == 1:  # none was lost between
            found.add((states[0].state, states[1].state))
    changes = {(before, after) for before, after in found if before is not after}
    assert len(changes) >= 2
    assert changes <= allowed


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_golden_log_is_what_its_scenario_gives_today(name: str) -> None:
    path = golden_replays.golden_path(FOLDER, name)
    assert gzip.decompress(golden_replays.record(name)) == gzip.decompress(path.read_bytes())


def test_an_update_tells_what_changed_and_records_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "lab_n_b"
    whole = golden_replays.golden_path(FOLDER, name).read_bytes()
    other = golden_replays.golden_path(FOLDER, "filter_off").read_bytes()  # the filter is new
    golden_replays.golden_path(tmp_path, name).write_bytes(other)
    golden_replays.golden_path(tmp_path, "gone").write_bytes(other)

    assert golden_replays.main([str(tmp_path), name]) == 1
    assert "valve B closes 3 samples (30 ms) later, once out of 1" in capsys.readouterr().out

    assert golden_replays.main([str(tmp_path), name, "--update"]) == 0
    output = capsys.readouterr().out
    assert "lab_n_b: recorded anew: 525 frames" in output
    assert "valve B closes 3 samples (30 ms) later, once out of 1" in output
    assert "gone.log.gz: removed, its scenario is gone" in output
    recorded = golden_replays.golden_path(tmp_path, name).read_bytes()
    assert gzip.decompress(recorded) == gzip.decompress(whole)  # zlib packs by its version

    assert golden_replays.main([str(tmp_path), name, "--update"]) == 0
    assert capsys.readouterr().out == "0 changed, 1 as they were\n"
    assert golden_replays.main([str(tmp_path), name]) == 0


def test_names_and_folders_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    assert golden_replays.main([str(tmp_path), "no_such"]) == 2
    assert golden_replays.main([str(tmp_path / "none")]) == 2
    assert golden_replays.main([str(tmp_path), "lab_n_b"]) == 2
