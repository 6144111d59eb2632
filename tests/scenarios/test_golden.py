"""Golden replays: the firmware answers the shipped scenarios' inputs as it did when they were recorded."""

from __future__ import annotations

import gzip
from itertools import pairwise
from pathlib import Path

import pytest

from can_dbc.codec import can_id_of, decode
from can_dbc.frame import Frame
from can_dbc.messages import ControllerStatus
from controller.shift import TRANSITIONS
from sil.simulation import load_scenario
from tests import golden_replays
from tests.conftest import ROOT

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
    assert found.account.total == found.frames > 200


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
    other = golden_replays.golden_path(
        FOLDER, "filter_off"
    ).read_bytes()  # as if the filter were new
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
