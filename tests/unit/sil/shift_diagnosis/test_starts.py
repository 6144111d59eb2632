"""Where fits begin: the size of a large cause is found from a usual truck."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.fit import Fitter
from sil.shift_diagnosis.model import Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import RecordedShift, shifts_of
from sil.shift_diagnosis.starts import starts_around
from tests.support.truck_logs import truck_log


def shifts_with(path: Path, cause: dict[str, float]) -> list[RecordedShift]:
    truck_log(path, 2, 5, cause, nominal=True)
    return list(shifts_of(str(path), load("nominal"), None, Counter()))


def only(name: str) -> Cause:
    return next(cause for cause in catalogue() if cause.effect.id == name)


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> list[RecordedShift]:
    """Shifts of a nominal truck whose supply is 30 % low."""
    path = tmp_path_factory.mktemp("truck") / "weak.log"
    return shifts_with(path, {"effect.supply_low.deficit": 0.3})


def test_a_large_cause_begins_near_its_size(weak: list[RecordedShift]) -> None:
    fitter = Fitter(PlantModel(load("nominal"), True), weak)
    supply, play = only("supply_low"), only("free_play")
    found = starts_around(fitter, [supply, play], 1e-3)
    assert 0.2 < supply.value(found[supply][0][1][-1]) < 0.45
    assert found[supply][0][0] < 0.3 * found[play][0][0]
    assert np.all(np.abs(found[supply][0][1][:-1]) < 3.0)
