"""Studies of certified lower bounds: table, picture, certificate, refusals in one line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.studies import executor
from sil.studies.load_study import load_study
from tests.unit.sil.studies.lower_bound_checker import uncovered

STUDY = """
name = "proof"
kind = "lower_bound"
[bounds]
extra_s = 0.004
[[sweep]]
path = "bound.delay_s"
values = [0.048]
"""


def test_a_study_of_lower_bounds(tmp_path: Path) -> None:
    """With 4 ms to lose there is time for little: the bound is not far below the plain push."""
    (tmp_path / "proof.toml").write_text(STUDY)
    out = tmp_path / "out"
    assert main(["whatif", str(tmp_path / "proof.toml"), "--out", str(out)]) == 0
    with open(out / "results.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["damper_m_s"]) < 1.0 < float(row["certified_m_s"])
    assert float(row["certified_m_s"]) < float(row["open_loop_m_s"])
    given = json.loads((out / "certificate_0.json").read_text())
    assert given["bound_m_s"] == float(row["certified_m_s"])
    assert len(given["leaves"]) == float(row["leaves"])
    assert uncovered(given) is None
    assert (out / "lower_bound.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (STUDY.replace("[0.048]", "[-0.01]"), "delay_s.*expected 0 to 1 s"),
        (STUDY.replace("bound.delay_s", "bound.family"), "bound.family: unknown"),
        (STUDY.replace("kind =", 'scenario = "lab_n_b"\nkind ='), "no scenario"),
        (STUDY + '[[load]]\nname = "odd"\nset = { "alpha.alpha_1" = 1.3 }\n', "alpha_1 <= alpha_2"),
    ],
)
def test_what_cannot_be_proven_is_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        executor.run_chunk(load_study(str(path)), (0, 1))
    assert "\n" not in str(refused.value)
