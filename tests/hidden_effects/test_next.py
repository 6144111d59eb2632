"""What --next proposes, measured on the same unit by another implementation, settles what was open."""

from __future__ import annotations

import json

import pytest

from sil.campaign.campaign import load_campaign
from sil.cli import main
from tests.hidden_effects.campaign import Hidden, hide, measure_next
from tests.support.next_strokes import Outcome, first_campaign, table

KINDS = ("fixed", "N-B", "B-N", "N-F", "fixed", "N-B")


@pytest.mark.slow
def test_a_delay_at_one_supply_is_settled_by_the_strokes_proposed(tmp_path, capsys) -> None:
    hidden = Hidden(("valve_open_delay",), ("valve timing",), "easy", {"open_later_s": 0.004})
    first = first_campaign(tmp_path / "measured", KINDS, hidden, 71)
    out = tmp_path / "first"
    assert main(["diagnose", str(first), "--next", "--out", str(out), "--quiet"]) == 1
    before = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert any({"valve_open_delay", "valve_delay_pressure"} <= set(g) for g in before["rivals"])
    proposed = load_campaign(out / "next")
    assert before["next_campaign"] == str(out / "next" / "campaign.toml")
    assert {e.conditions.supply_pressure_pa for e in proposed.strokes} != {900000.0}
    printed = capsys.readouterr().out
    assert "next: to separate" in printed and proposed.strokes[0].label in printed
    assert "next.png" in {path.name for path in out.iterdir()}
    page = (out / "report.html").read_text(encoding="utf-8")
    assert proposed.strokes[0].label in page and "The stroke that tells most" in page

    measure_next(out / "next", hidden, 71)
    second = tmp_path / "second"
    folders = [str(first), str(out / "next")]
    assert main(["diagnose", *folders, "--out", str(second), "--quiet"]) == 1
    after = json.loads((second / "diagnosis.json").read_text(encoding="utf-8"))
    assert after["verdict"] == "named" and after["causes"][0]["id"] == "valve_open_delay"
    assert after["causes"][0]["probability"] > 0.9 and not after["rivals"]
    assert after["campaign"] == "measured + next"

    # what was measured is not lost: --next refuses the folder
    assert main(["diagnose", str(first), "--next", "--out", str(out), "--force"]) == 2
    assert "next: holds stroke_001.csv; expected another --out" in capsys.readouterr().err


def test_next_is_refused_where_it_does_not_apply(tmp_path, capsys) -> None:
    log = tmp_path / "truck.log"
    log.write_text("(0.000000) can0 123#00\n", encoding="ascii")
    force = tmp_path / "axis"
    force.mkdir()
    (force / "campaign.toml").write_text('name = "axis"\nrig = "force"\n', encoding="utf-8")
    hidden = hide((), "easy", 1)
    folder = first_campaign(tmp_path / "measured", KINDS[:1], hidden, 1)
    for arguments, expected in (
        ([str(log), "--next"], "--next: not with CAN logs; expected a campaign folder"),
        ([str(force), "--next"], '--next: not together with rig = "force"; expected none'),
        (
            [str(folder), "--next", "--new", str(tmp_path / "new")],
            "--next: not together with --new",
        ),
        ([str(folder), str(force)], 'axis: rig = "force" among other campaigns'),
        ([str(folder), str(folder)], "the same campaign twice; expected each once"),
        ([str(folder), str(log)], "truck.log: no campaign.toml; expected a campaign folder"),
    ):
        out = [] if "--new" in arguments else ["--out", str(tmp_path / "out")]
        assert main(["diagnose", *arguments, *out]) == 2
        said = capsys.readouterr().err
        assert expected in said and said.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_table_of_the_study() -> None:
    named, unsure = vars(Outcome("named", 0.9, 0.0)), vars(Outcome("ambiguous", 0.4, 0.5))
    wrong = vars(Outcome("named", 0.0, 0.95))
    rows = [
        {"first": named},
        {"first": unsure, "proposed": named, "repeated": unsure, "random": wrong},
    ]
    lines = list(table(rows))
    assert lines[0] == "2 campaigns of 4 strokes of one kind; 1 measured again"
    assert lines[3:] == [
        "| first | 0 of 1 | 0.40 | 0 |",
        "| proposed | 1 of 1 | 0.90 | 0 |",
        "| repeated | 0 of 1 | 0.40 | 0 |",
        "| random | 0 of 1 | 0.00 | 1 |",
    ]
