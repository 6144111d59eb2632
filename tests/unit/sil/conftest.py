"""A clean campaign and a log that several packages' tests judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.made_campaign import made, model_of
from tests.support.truck_logs import truck_log


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory):
    """A clean campaign."""
    return made(tmp_path_factory.mktemp("clean"))


@pytest.fixture(scope="session")
def clean_model(clean):
    """Its strokes ready to be fitted."""
    return model_of(clean)


@pytest.fixture(scope="session")
def nominal_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shifts of the nominal truck."""
    path = tmp_path_factory.mktemp("truck") / "nominal.log"
    truck_log(path, 3, 5, nominal=True)
    return path
