"""The study `bounds`: stored policies are as soft as they say, a search is stored and continues."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sil.cli import main
from sil.studies.bounds.store import read_progress
from sil.studies.load_study import load_study, shipped
from sil.studies.table import read_table

EASILY_REACHED_M_S = {
    "open_8_close_35_delay_48": 1.175,
    "open_8_close_35_delay_20": 1.175,
    "open_8_close_35_delay_10": 1.174,
    "open_8_close_35_delay_0": 1.132,
    "open_8_close_5_delay_5": 1.057,
    "open_2_close_2_delay_0": 1.021,
}
STORED = shipped()["bounds"].parent / "bounds"
ROW = """
name = "one"
kind = "bounds"
attempts = {attempts}
evaluations = 100
known_evaluations = 100
[[variant]]
name = "8/35 ms; 10 ms"
set = {{ opening_s = 0.008, closing_s = 0.035, delay_s = 0.01 }}
[[load]]
name = "1,300 N"
set = {{ mesh_n = [1300.0] }}
"""


def study_of_one_row(folder: Path, attempts: int) -> Path:
    path = folder / "one.toml"
    path.write_text(ROW.format(attempts=attempts))
    return path


@pytest.mark.parametrize("name", EASILY_REACHED_M_S)
def test_stored_policies_are_as_soft_as_a_first_attempt(name: str) -> None:
    progress = read_progress(STORED / f"{name}_mesh_1300")
    assert min(each.worst_m_s for each in progress.values()) <= EASILY_REACHED_M_S[name] + 1e-3


def test_stored_policies_are_judged_again(tmp_path: Path) -> None:
    path, name = study_of_one_row(tmp_path, 5), "open_8_close_35_delay_10_mesh_1300"
    shutil.copytree(STORED / name, tmp_path / "bounds" / name)
    out = tmp_path / "out"
    assert main(["whatif", str(path), "--rejudge", "--out", str(out)]) == 0
    numbers = read_table(load_study(str(path)), out).numbers
    best = min(each.worst_m_s for each in read_progress(STORED / name).values())
    assert numbers["worst_m_s"][0] == pytest.approx(best, abs=1e-4)
    assert numbers["fine_m_s"][0] == pytest.approx(best, abs=0.01)
    assert numbers["open_m_s"][0] == pytest.approx(1.365, abs=1e-3)
    assert numbers["damper_m_s"][0] == pytest.approx(0.602, abs=1e-3)
    assert "8/35 ms; 10 ms" in (out / "bounds.md").read_text()
    stored = (out / "policies" / name / "campaign.toml").read_text()
    assert stored == (STORED / name / "campaign.toml").read_text()


@pytest.mark.slow
def test_a_search_is_stored_and_continues(tmp_path: Path) -> None:
    out, name = tmp_path / "out", "open_8_close_35_delay_10_mesh_1300"
    assert main(["whatif", str(study_of_one_row(tmp_path, 1)), "--out", str(out)]) in (0, 1)
    first = read_progress(out / "policies" / name)
    assert [len(each.history) for each in first.values()] == [1, 1]
    shutil.copytree(out / "policies", tmp_path / "bounds")
    path = study_of_one_row(tmp_path, 2)
    assert main(["whatif", str(path), "--out", str(out), "--force"]) in (0, 1)
    second = read_progress(out / "policies" / name)
    for before, after in zip(first.values(), second.values(), strict=True):
        assert after.history[:1] == before.history and len(after.history) == 2
        assert after.worst_m_s <= before.worst_m_s


def test_other_studies_have_nothing_to_judge_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["whatif", "faults", "--rejudge"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "does not search" in line
