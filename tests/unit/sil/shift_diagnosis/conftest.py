"""Logs of drawn trucks, written once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.truck_logs import truck_log


@pytest.fixture(scope="session")
def late_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five shifts of a truck whose valves open 7 ms later."""
    path = tmp_path_factory.mktemp("truck") / "late.log"
    truck_log(path, 2, 6, {"effect.valve_open_delay.delay_s": 0.007})
    return path


@pytest.fixture(scope="session")
def nominal_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shifts of the nominal truck of the scenario full_shift, and of two more."""
    path = tmp_path_factory.mktemp("truck") / "nominal.log"
    truck_log(path, 3, 5, nominal=True)
    return path
