"""The healthy truck of a log: own loads, noise at rest, and which shifts are fitted first."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.healthy import (
    is_explained,
    loaded_fit,
    rest_noise_m,
    spread,
)
from sil.shift_diagnosis.linear import Noise
from sil.shift_diagnosis.model import (
    LEAST_NOISE_M,
    PlantModel,
)
from tests.support.truck_logs import by_reference
from tests.unit.sil.shift_diagnosis.fits import cut


def test_one_pulse_at_rest_shows_no_noise() -> None:
    time_s, position_m = np.array([0.03, 0.2]), np.array([0.001, 0.01])
    shift = SimpleNamespace(time_s=time_s, position_m=position_m)
    assert rest_noise_m([shift, shift]) == LEAST_NOISE_M


@pytest.mark.parametrize("layout", ["steady", "silent", "both"])
def test_shifts_of_another_implementation_are_explained(layout: str, tmp_path: Path) -> None:
    path = tmp_path / "truck.log"
    by_reference(path, 12, 8, None, layout)
    shifts = cut(path)
    assert all(np.isnan(s.difference_rad_s) == (layout != "steady") for s in shifts if s.end != "N")
    parameters = load("nominal")
    models = [PlantModel(parameters, mounted) for mounted in (True, False)]
    fitter, healthy, own = loaded_fit(models, shifts, Noise())
    assert fitter.model.mounted and is_explained(healthy)
    assert np.max(np.abs(healthy.values)) < 3.0
    varied = any(shift.load_n for shift in own)
    assert varied == (layout == "both")


@pytest.mark.parametrize("count", [13, 23, 67, 120])
def test_the_shifts_fitted_first_are_of_every_kind(count: int) -> None:
    """Into gear and out of it come in turn: every second shift was only of one kind."""
    ways = [("N", "B"), ("B", "N"), ("N", "F"), ("F", "N")]
    shifts = [
        SimpleNamespace(start=start, end=end, begin_s=float(k))
        for k, (start, end) in enumerate((ways * count)[:count])
    ]
    taken = spread(shifts, 12)
    assert len(taken) == 12
    assert taken == sorted(taken, key=lambda shift: shift.begin_s)
    found, given = (Counter((shift.start, shift.end) for shift in each) for each in (taken, shifts))
    for way, number in given.items():
        assert abs(found[way] - 12 * number / count) <= 1.5
    assert taken[-1].begin_s > 0.7 * count > 0.3 * count > taken[0].begin_s
    assert spread(shifts[:12], 12) == shifts[:12]
