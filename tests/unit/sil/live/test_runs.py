"""The list of outputs, and runs over each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.live import runs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outputs = tmp_path_factory.mktemp("runs")
    for name, extra in (("one", []), ("two", ["--set", "valve.D_rise=0.02", "--strict"])):
        code = main(["run", "lab_n_b", "--out", str(outputs / name), "--no-report", *extra])
        assert code in (0, 1)
    (outputs / "begun").mkdir()
    (outputs / "begun" / "INCOMPLETE").write_text("opc4 whatif is writing\n", encoding="utf-8")
    (outputs / "begun" / "results.csv").write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    (outputs / "other").mkdir()
    (outputs / "loop").symlink_to(outputs / "one")
    return outputs


def test_all_outputs_are_listed_with_their_state(folder: Path) -> None:
    entries = {entry["name"]: entry for entry in runs.listed(folder)}
    assert set(entries) == {"one", "two", "begun"}
    assert entries["one"]["state"] == "passed" and entries["two"]["state"] == "failed"
    assert entries["one"]["figures"]["impact_speed_m_s"] == pytest.approx(0.94, abs=0.01)
    assert entries["begun"]["kind"] == "study" and entries["begun"]["rows"] == 2
    assert entries["begun"]["state"] == "opc4 whatif is writing"


def test_runs_are_drawn_over_each_other(folder: Path) -> None:
    drawn = runs.compared(folder, ["one", "two"])
    position = drawn["panels"][0]["series"]
    assert [series["label"] for series in position] == ["one", "two"]
    reached = [next(x for x, y in zip(drawn["x"], s["y"], strict=True) if y > 5) for s in position]
    assert reached[1] - reached[0] == pytest.approx(12.0, abs=0.6)


@pytest.mark.parametrize("names", [[], ["one"] * 7, ["../one"], ["loop"], ["one", "begun"]])
def test_other_names_are_refused(folder: Path, names: list[str]) -> None:
    with pytest.raises(InputError, match="runs: "):
        runs.compared(folder, names)


def test_a_study_is_drawn_as_far_as_it_is(folder: Path) -> None:
    rows = [
        "row,load,impact_speed_m_s,same,outcome",
        "0,a,0.5,1,passed",
        "1,b,0.75,1,passed",
        "2,c,0.",
    ]
    (folder / "begun" / "results.csv").write_text("\n".join(rows), encoding="utf-8")
    drawn = runs.compared(folder, ["begun"])
    assert [panel["title"] for panel in drawn["panels"]] == ["impact_speed_m_s"]
    assert drawn["panels"][0]["series"][0]["y"] == [0.5, 0.75]
    (folder / "begun" / "results.csv").write_text(rows[0] + "\n", encoding="utf-8")
    assert runs.compared(folder, ["begun"])["panels"][0]["title"] == "No numbers yet"


def test_no_folder_is_an_empty_list(tmp_path: Path) -> None:
    assert runs.listed(tmp_path / "none") == []
