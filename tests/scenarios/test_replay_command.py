"""`opc4 replay` as a user calls it: on the log of a run, as it was and with a changed firmware."""

from __future__ import annotations

import gzip
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from sil.cli import main
from sil.log_replay.recorded_frames import OWN_IDS
from tests.conftest import ROOT
from tests.support.replay_cost import made_log, peak_memory

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_a_run_replayed_as_it_was_and_without_its_filter(opc4: Run, tmp_path: Path) -> None:
    assert opc4("run", "lab_n_b", "--out", "run", "--no-report").returncode == 0

    same = opc4("replay", "run/bus.log", "--out", "same")
    assert same.returncode == 0, same.stderr
    assert "no difference" in same.stdout
    output = json.loads((tmp_path / "same/diff.json").read_text())
    assert output["differs"] is False
    assert output["frames"]["accounted"] == output["frames"]["total"] > 500

    changed = opc4("replay", "run/bus.log", "--set", "controller.filter=false", "--out", "changed")
    assert changed.returncode == 1, changed.stderr
    assert "earlier" in changed.stdout and "samples" in changed.stdout
    for name in ("diff.json", "diff.txt", "report.html"):
        assert (tmp_path / "changed" / name).stat().st_size > 0
    assert "first difference" in (tmp_path / "changed/diff.txt").read_text()


def test_a_log_in_which_nothing_was_engaged_is_no_success(opc4: Run, tmp_path: Path) -> None:
    (tmp_path / "idle.log").write_text("(0000000000.000500) can0 123#00\n")
    refused = opc4("replay", "idle.log")
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1 and "idle.log" in refused.stderr


def test_a_log_with_other_identifiers_needs_their_database(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every identifier of ours moved to another source address, in the log and in the DBC."""
    dbc = Path(DBC_PATH).read_text(encoding="ascii")
    log = gzip.decompress((ROOT / "tests/golden/lab_n_b.log.gz").read_bytes()).decode()
    for can_id in OWN_IDS:
        other = can_id ^ 0x40
        dbc = dbc.replace(str(can_id | 1 << 31), str(other | 1 << 31))
        log = log.replace(f" {can_id:08X}#", f" {other:08X}#")
    database, recorded = tmp_path / "other.dbc", tmp_path / "other.log"
    database.write_text(dbc, encoding="ascii")
    recorded.write_text(log)
    call = ["replay", str(recorded), "--out", str(tmp_path / "out"), "--json"]
    assert main(call) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "truck"  # of whichever control unit
    assert main([*call, "--dbc", str(database), "--force"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["ticks"] == 70 and output["frames"]["foreign"] == 0


def test_tolerances_from_a_file_and_a_folder_that_is_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = tmp_path / "options.toml"
    options.write_text('ignore = ["*"]\n')
    log, out = str(ROOT / "tests/golden/lab_n_b.log.gz"), str(tmp_path / "out")
    what_if = ["replay", log, "--set", "controller.filter=false", "--out", out]
    assert main([*what_if, "--options", str(options)]) == 0
    assert main(what_if) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*what_if, "--force"]) == 1


def test_the_shifts_of_a_run_in_a_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        main(["replay", str(ROOT / "tests/golden/full_shift.log.gz"), "--summary", "--json"]) == 0
    )
    shifts = json.loads(capsys.readouterr().out)["shifts"]
    assert [(s["from_gear"], s["to_gear"]) for s in shifts] == [(2, 0), (0, 1)]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    short, long = (made_log(tmp_path / f"{s}.log", s) for s in (30, 90))
    for what in ("read", "replay"):
        (few, low), (many, high) = peak_memory(what, short), peak_memory(what, long)
        assert many == 3 * few
        assert high < 1.1 * low


def test_a_log_alone_says_what_is_missing_or_finds_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def replayed(name: str, log: bytes) -> tuple[int, str]:
        (tmp_path / f"{name}.log").write_bytes(log)
        code = main(["replay", str(tmp_path / f"{name}.log"), "--out", str(tmp_path / name)])
        return code, capsys.readouterr().out

    for name in ("filter_off", "truck_torque_to_torque"):
        golden = gzip.decompress((ROOT / f"tests/golden/{name}.log.gz").read_bytes())
        code, text = replayed(name, golden)
        assert code == 0 and f"found by trying the shipped ones: those of {name}" in text
    assert (
        main(
            [
                "run",
                "lab_n_b",
                "--set",
                "controller.windows.samples=7",
                "--out",
                str(tmp_path / "run"),
            ]
        )
        == 0
    )
    capsys.readouterr()
    code, text = replayed("own", (tmp_path / "run" / "bus.log").read_bytes())
    assert code == 1
    first = text.splitlines()[0]
    assert "nothing says which settings the recorded firmware had, and 11 shipped ones" in first
    assert first.index("cannot be compared") < first.index("ticks differ")
