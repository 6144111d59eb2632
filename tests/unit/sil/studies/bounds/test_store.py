"""Stored policies: read as written, and their strokes are those of the plant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from plant.systems.stroke import simulate
from sil.campaign.campaign import load_campaign
from sil.studies.bounds.search import SearchProgress
from sil.studies.bounds.store import read_progress, write_progress
from sil.studies.load_study import shipped

STORED = sorted((shipped()["bounds"].parent / "bounds").iterdir())


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    policy = read_progress(STORED[0])
    assert policy["cma"].values
    write_progress(tmp_path, policy)
    assert read_progress(tmp_path) == policy
    assert read_progress(tmp_path / "nothing") == {
        "cma": SearchProgress(),
        "linear": SearchProgress(),
    }


@pytest.mark.parametrize(
    "text",
    [
        "[cma]\nvalues = [1.0]\n",
        "[cma]\nvalues = ['x']\n",
        "[other]\nknots_s = []\n",
        "[cma]\nhistory = [[1.0, 2.0, 3.0]]\n",
    ],
)
def test_a_wrong_policy_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "policy.toml").write_text(text)
    with pytest.raises(InputError, match=r"policy\.toml: .*expected") as raised:
        read_progress(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("folder", STORED, ids=lambda path: path.name)
def test_the_plant_stops_as_the_label_says(folder: Path) -> None:
    campaign, parameters = load_campaign(folder), load(folder / "model.toml")
    stops_m_s = [float(stroke.label.split(": ")[1].split()[0]) for stroke in campaign.strokes]
    hardest = int(np.argmax(stops_m_s))
    stroke = simulate(parameters, campaign.strokes[hardest].conditions, np.array([0.0, 0.4]))
    assert stroke.impact is not None
    assert stroke.impact.speed_m_s == pytest.approx(stops_m_s[hardest], abs=1e-3)
    best = min(each.worst_m_s for each in read_progress(folder).values())
    assert max(stops_m_s) == pytest.approx(best, abs=1e-3)
