"""A wrong force shows in the force balance alone, a wrong volume in one mass balance alone."""

from __future__ import annotations

import pytest

from plant.parameters import load
from sil.inference.campaign.one_equation import alone
from sil.inference.fit import Fitter
from tests.support.made_campaign import made, model_of

FORCE = "force balance of the stay"
CHAMBERS = ("mass balance of chamber 1", "mass balance of chamber 2")


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    model = model_of(made(tmp_path_factory.mktemp("clean"), count=1))
    return Fitter(model).fit(iterations=6)


def left(folder, healthy, **changes: float) -> dict[str, float]:
    parameters = load()
    path = {name.replace("__", "."): value for name, value in changes.items()}
    wrong = parameters.override({n: parameters.value(n) * v for n, v in path.items()})
    return alone(model_of(made(folder, wrong, count=1)), healthy, 0).rms()


def test_each_fault_stays_in_its_equation(tmp_path, healthy) -> None:
    clean = left(tmp_path / "a", healthy)
    assert clean[FORCE] < 1e-4 and max(clean[name] for name in CHAMBERS) < 2e3
    heavy = left(tmp_path / "b", healthy, fixed__m_s=2.0)
    assert heavy[FORCE] > 5.0 * clean[FORCE]
    assert all(heavy[name] < 1.5 * clean[name] for name in CHAMBERS)
    large = left(tmp_path / "c", healthy, fixed__V20=1.3)
    assert large[CHAMBERS[1]] > 3.0 * clean[CHAMBERS[1]]
    assert large[CHAMBERS[0]] < 1.5 * clean[CHAMBERS[0]]
    assert large[FORCE] < 2.0 * clean[FORCE]
