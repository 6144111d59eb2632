"""How late the controller's position is: thesis 2.2.4, averaged over the phase of the sampling."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sil.simulation import load_scenario, metrics, runner
from sil.simulation.in_memory import run_in_memory

PHASES_MS = range(10)


@cache
def lags(filtered: bool = True) -> dict[str, np.ndarray]:
    """Shift the sensor, the firmware stays: the stroke begins at ten phases of their raster."""
    rows = []
    for phase in PHASES_MS:
        loaded = load_scenario.load(
            "lab_n_b",
            settings={"controller.filter": filtered, "valve.D_rise": 0.008 + 1e-3 * phase},
        )
        (shift,) = run_in_memory(loaded).shifts
        rows.append(shift)
    names = ("position_lag_10", "position_lag_90", "bus_lag_10", "bus_lag_90")
    found = {n: np.array([getattr(r, f"{n}_s") for r in rows]) for n in names}
    for share in (10, 90):
        held = [getattr(r, f"position_lag_{share}_held_s") for r in rows]
        found[f"held_{share}"] = np.array(held)
    return found


@pytest.mark.parametrize(
    ("filtered", "at_10", "at_90"),
    [(True, 0.030, 0.040), (False, 0.010, 0.010)],
    ids=["filter", "no filter"],
)
def test_lag(filtered: bool, at_10: float, at_90: float) -> None:
    """The mean of the held lag over all phases is what the thesis tells, within 2.5 ms; the figure
    of a single run is that mean, within what its one phase can know; so is the bus log's."""
    found = lags(filtered)
    assert np.ptp(found["held_10"]) > 0.005  # a single held lag depends on the phase
    for share, expected in ((10, at_10), (90, at_90)):
        mean = float(np.mean(found[f"held_{share}"]))
        assert mean == pytest.approx(expected, abs=2.5e-3)
        for source in ("position", "bus"):
            single = found[f"{source}_lag_{share}"]
            assert float(np.mean(single)) == pytest.approx(mean, abs=1.2e-3)
            assert np.max(np.abs(single - mean)) < 3e-3


def test_the_filter_makes_it_three_times_slower_and_growing() -> None:
    with_filter = lags()
    without = lags(False)
    assert np.mean(with_filter["held_10"]) / np.mean(without["held_10"]) == pytest.approx(
        3, abs=0.5
    )
    assert np.mean(with_filter["held_90"] - with_filter["held_10"]) > 0.008
    assert abs(np.mean(without["held_90"] - without["held_10"])) < 0.002


def test_the_metric_is_the_shifts(tmp_path: Path) -> None:
    finished = runner.run(load_scenario.load("lab_n_b"), tmp_path)
    assert finished.shifts == run_in_memory(load_scenario.load("lab_n_b")).shifts
    figures, (shift,) = finished.result.metrics, finished.shifts
    assert figures["position_lag_10_s"] == shift.position_lag_10_s
    assert isinstance(shift, metrics.Shift)
