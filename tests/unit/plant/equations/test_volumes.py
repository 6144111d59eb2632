"""A chamber that the pistons would empty is refused, with the parameter's name and its bound."""

from __future__ import annotations

import re

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import simulate

FIXED = StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),))
ENGAGE = StrokeConditions("N-B", 9e5, ((0.01, "B", 0.98), (0.01, "N", 0.0)), charged_before=("N",))
TIME_S = np.linspace(0.0, 0.1, 11)


@pytest.mark.parametrize(
    ("path", "value", "conditions"),
    [
        ("fixed.V20", 3e-5, FIXED),
        ("fixed.V20", 1e-6, FIXED),
        ("fixed.V10", 0.0, FIXED),
        ("length.V_N0", 6e-5, ENGAGE),
        ("length.V_F0", 4e-6, ENGAGE),
    ],
)
def test_a_chamber_without_volume_is_refused_with_its_bound(
    path: str, value: float, conditions: StrokeConditions
) -> None:
    with pytest.raises(InputError, match=rf"{re.escape(path)}: .* expected more than") as caught:
        simulate(load().override({path: value}), conditions, TIME_S)
    bound = float(str(caught.value).rsplit(" ", 1)[1])
    simulate(load().override({path: 1.05 * bound + 1e-7}), conditions, TIME_S)


def test_the_length_stroke_of_a_run_is_refused_too() -> None:
    with pytest.raises(InputError, match=r"length\.V_N0.*expected more than 6\.4968"):
        LengthStroke(load().override({"length.V_N0": 5e-5}))
    with pytest.raises(InputError, match=r"length\.V_F0"):
        LengthStroke(load().override({"length.V_F0": 1e-6}), initial="B")


def test_a_small_chamber_of_a_gear_that_is_not_used_is_no_matter() -> None:
    simulate(load().override({"length.V_B0": 2.8e-6}), ENGAGE, TIME_S)
