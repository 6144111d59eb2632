"""Fixtures shared by the diagnosis' tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from made_campaign import made, model_of


@pytest.fixture(scope="package")
def clean(tmp_path_factory: pytest.TempPathFactory):
    """A clean campaign."""
    return made(tmp_path_factory.mktemp("clean"))


@pytest.fixture(scope="package")
def clean_model(clean):
    """Its strokes ready to be fitted."""
    return model_of(clean)
