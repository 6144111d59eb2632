"""Backward and forward are mirror images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.kernel.layout import LengthState
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import NOMINAL
from tests.physics.strokes import ALL, conditions_of

TIME_S = np.arange(0, 3001) * 1e-4
SWAP = {"B": "F", "F": "B", "N": "N"}
MIRROR = [
    LengthState.x_s,
    LengthState.v_s,
    LengthState.x_2,
    LengthState.v_2,
    LengthState.x_1,
    LengthState.v_1,
    LengthState.p_f,
    LengthState.p_n,
    LengthState.p_b,
    LengthState.impulse,
    LengthState.p_oil,
    LengthState.p_line,
]
SIGN = np.array([-1.0, -1.0] + [1.0] * 10)
# The damper's kinks magnify rounding; forward differences of the stiff method are not symmetric.
LIMIT = {None: 1e-12, "incompressible": 1e-8, "compressible": 1e-5}
SCALE = np.array([1e-2, 1.0] * 3 + [1e5] * 3 + [10.0, 1e5, 1e5])


def mirrored(conditions: StrokeConditions) -> StrokeConditions:
    """The same stroke to the other side."""
    return replace(
        conditions,
        kind="-".join(SWAP[gear] for gear in conditions.kind.split("-")),
        commands=tuple((t, SWAP[valve], duty) for t, valve, duty in conditions.commands),
        charged_before=tuple(SWAP[name] for name in conditions.charged_before),
    )


@pytest.mark.parametrize("name", sorted(name for name, c in ALL.items() if "B" in c.kind))
def test_mirrored_stroke_is_the_same_stroke(name: str) -> None:
    conditions = conditions_of(ALL[name])
    one = simulate(NOMINAL, conditions, TIME_S, internal=False)
    other = simulate(NOMINAL, mirrored(conditions), TIME_S, internal=False)
    difference = np.abs(one.states - SIGN * other.states[:, MIRROR]) / SCALE
    limit = LIMIT[ALL[name].damper]
    assert difference.max() < limit
    swapped = str.maketrans("12", "21")
    assert [e.name for e in one.events] == [e.name.translate(swapped) for e in other.events]
    for a, b in zip(one.events, other.events, strict=True):
        assert a.time_s == pytest.approx(b.time_s, abs=limit)
        assert a.speed_m_s == pytest.approx(b.speed_m_s, abs=limit)
        assert a.position_m == pytest.approx(-b.position_m, abs=limit)
