"""Logs of drawn trucks, written once, and a fitter for their shifts."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from plant.parameters import load
from sil.inference.truck.diagnosis import rest_noise_m
from sil.inference.truck.fit import FINE_M, Fit, Fitter
from sil.inference.truck.simulator import ShiftModel
from sil.log_replay.recorded_shifts import RecordedShift, shifts_of


@pytest.fixture(scope="session")
def shifts(nominal_log: Path) -> list[RecordedShift]:
    """The shifts of that log."""
    return list(shifts_of(str(nominal_log), load("nominal"), None, Counter()))


@pytest.fixture(scope="session")
def fitter(shifts: list[RecordedShift]) -> Fitter:
    """A fitter for them, on a gearbox."""
    return Fitter(ShiftModel(shifts, load("nominal")), rest_noise_m(shifts))


@pytest.fixture(scope="session")
def usual(fitter: Fitter) -> Fit:
    """The usual truck, not yet fitted."""
    return fitter.evaluated(fitter.start(), FINE_M)
