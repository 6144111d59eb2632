"""Causes with one size each: physical sizes, values, what is offered."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from sil.inference.truck.causes import Cause, catalogue, offered


def only(name: str) -> Cause:
    return next(cause for cause in catalogue() if cause.id == name)


def test_sizes_are_physical_and_of_both_signs_where_both_are() -> None:
    late, force, line = map(only, ("valve_open_delay", "external_force", "hose_droop"))
    assert late.sizes(1.5, 8.0) == [1.5, 8.0]
    assert force.sizes(1.5) == [1.5, -1.5]
    assert late.clipped(-1.0) == 0.0 and force.clipped(-99.0) == -30.0
    assert late.value(2.0) == pytest.approx(0.006)
    # a line is the narrower the larger the size
    assert line.value(4.0) < line.value(1.0) <= line.parameter.high


def test_a_size_that_changes_nothing_is_not_tried() -> None:
    assert only("piston_leak").sizes(0.1) == []


def test_values_hold_the_variant_and_its_other_parameters() -> None:
    bump = next(c for c in catalogue() if c.id == "friction_bump" and c.others[0] == -0.01)
    assert bump.values(1.0)["force_n"] == pytest.approx(100.0)
    assert -0.01 in bump.values(1.0).values()


def test_a_cause_travels_by_name() -> None:
    cause = only("valve_open_delay")
    assert pickle.loads(pickle.dumps(cause)).name == cause.name


@pytest.mark.parametrize(
    ("supplies", "expected"), [((np.nan,) * 4, False), ((9e5,) * 4, False), ((6e5, 9e5) * 2, True)]
)
def test_a_cause_by_supply_is_offered_if_the_supply_varies(
    supplies: tuple[float, ...], expected: bool
) -> None:
    ids = {c.id for c in offered([SimpleNamespace(supply_pa=supply) for supply in supplies])}
    assert ("valve_delay_pressure" in ids) is expected
    assert "valve_open_delay" in ids
