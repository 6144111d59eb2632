"""Fixtures shared by the diagnosis' tests."""

from __future__ import annotations

import pytest

from tests.support.made_campaign import made, model_of


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory):
    """A clean campaign."""
    return made(tmp_path_factory.mktemp("clean"))


@pytest.fixture(scope="session")
def clean_model(clean):
    """Its strokes ready to be fitted."""
    return model_of(clean)
