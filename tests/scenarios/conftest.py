"""Shipped scenarios as they are, run once for all tests that only look at what they left."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sil.simulation import load_scenario, runner

ShippedRun = Callable[[str], tuple[runner.Finished, Path]]


@pytest.fixture(scope="session")
def shipped_run(tmp_path_factory: pytest.TempPathFactory) -> ShippedRun:
    """The finished run of a shipped scenario in one process, and its folder: not to be changed."""
    known: dict[str, tuple[runner.Finished, Path]] = {}

    def of(name: str) -> tuple[runner.Finished, Path]:
        if name not in known:
            folder = tmp_path_factory.mktemp(name)
            known[name] = runner.run(load_scenario.load(name), folder), folder
        return known[name]

    return of
