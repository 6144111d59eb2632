"""The catalogue as candidates: complete, neutral at rest, signs."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from plant.effects import CATALOGUE
from plant.kernel.layout import Parameters
from plant.parameters import load
from plant.systems.setup import make_setup
from sil.inference.candidate import candidates, compatible
from tests.support.made_campaign import conditions_of

INERT = (
    Parameters.bump_x,
    Parameters.bump_width,
    Parameters.detent_width,
    Parameters.alpha_v0,
)
ALL = candidates(("damper", "internal position", "length stroke", "process exponents"))


def test_every_named_cause_stands_in_the_search() -> None:
    assert {item.id for item in ALL} == set(CATALOGUE) - {"unnamed"}
    assert len({item.name for item in ALL}) == len(ALL)


@pytest.mark.parametrize("item", ALL, ids=lambda item: item.name)
def test_neutral_changes_nothing_and_starts_are_within_bounds(item) -> None:
    if item.id != "hose_droop":
        setup = make_setup(load(), conditions_of("N-B", 900000.0))
        changed = setup.copy()
        item.change(changed, {p.name: p.neutral for p in item.parameters})
        acting = [k for k in range(Parameters.size) if k not in INERT]
        assert np.array_equal(changed.p.array[acting], setup.p.array[acting])
    for start in item.starts:
        assert len(start) == len(item.parameters)
        for value, parameter in zip(start, item.parameters, strict=True):
            assert parameter.low <= value <= parameter.high
        assert item.physical(dict(zip([p.name for p in item.parameters], start, strict=True)))


def test_candidates_travel_by_name_and_variants_exclude_each_other() -> None:
    twin = pickle.loads(pickle.dumps(ALL[0]))
    assert twin == ALL[0]
    variants = [item for item in ALL if item.id == "residual_pressure"]
    assert len(variants) > 1 and not compatible(variants[1], (variants[0],))
    assert compatible(variants[1], (ALL[0],))


def test_fewer_channels_mean_fewer_candidates() -> None:
    few = {item.id for item in candidates(())}
    assert not few & {"oil_aeration", "sensor_gain", "clock_skew", "free_play"}


def test_a_clock_may_be_off_without_drifting_at_half_the_prior() -> None:
    """As simple as the sensor's delay that looks the same: neither is preferred for its form."""
    clock = [item for item in candidates(("internal position",)) if item.id == "clock_skew"]
    assert [len(item.parameters) for item in clock] == [2, 1]
    assert sum(item.prior for item in clock) == 1.0
