"""The judgement of whole logs, and which causes are offered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.judge import judge_shifts, offered
from sil.shift_diagnosis.verdict import ALARM
from tests.support.truck_logs import truck_log
from tests.unit.sil.shift_diagnosis.fits import cut


@pytest.mark.slow
def test_a_cause_at_its_bound_is_not_given_to_the_healthy_truck(tmp_path: Path) -> None:
    """There a size changes nothing, and says nothing of how much worse a healthy truck is."""
    path = tmp_path / "truck.log"
    truck_log(path, 2, 5, {"effect.static_friction.factor": 10.0}, nominal=True)
    found = judge_shifts(cut(path), load("nominal"))
    assert found.probabilities["healthy"] < ALARM
    assert max(found.probabilities, key=found.probabilities.__getitem__) == "static_friction"


@pytest.mark.parametrize(
    ("supplies", "expected"), [((np.nan,) * 4, False), ((9e5,) * 4, False), ((6e5, 9e5) * 2, True)]
)
def test_a_cause_by_supply_is_offered_if_the_supply_varies(
    supplies: tuple[float, ...], expected: bool
) -> None:
    shifts = [SimpleNamespace(supply_pa=supply) for supply in supplies]
    ids = {cause.effect.id for cause in offered(shifts)}
    assert ("valve_delay_pressure" in ids) is expected
    assert "valve_open_delay" in ids
