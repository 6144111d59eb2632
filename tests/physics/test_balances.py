"""Mechanical energy and gas of every kind of stroke under every load, and valve timing."""

from __future__ import annotations

import numpy as np
import pytest

from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import NOMINAL
from tests.physics.strokes import ALL, conditions_of

TIME_S = np.arange(0, 3001) * 1e-4


@pytest.mark.parametrize("name", sorted(ALL))
def test_energy_and_gas_are_balanced(name: str) -> None:
    stroke = simulate(NOMINAL, conditions_of(ALL[name]), TIME_S, internal=False)
    balance = stroke.balance
    assert balance.energy_scale_j > 1.0
    assert abs(balance.energy_residual_j) < 2e-6 * balance.energy_scale_j
    assert max(abs(r) for r in balance.gas_residual_j) < 2e-6 * balance.gas_scale_j
    assert balance.closed
    assert balance.friction_j > 0.0 and balance.impact_j > 0.0
    assert balance.air_in_kg > 1e-4 and balance.air_out_kg > 1e-4
    if ALL[name].damper:
        assert balance.damper_j > 1.0


def test_every_kind_and_load_is_there() -> None:
    kinds = {case.kind for case in ALL.values()}
    assert kinds == {"fixed", "N-B", "B-N", "N-F", "F-N"}
    assert any(case.spring_n_per_m for case in ALL.values())
    assert {case.damper for case in ALL.values()} == {None, "compressible", "incompressible"}
    assert any(case.sync_impulse_n_s and case.mesh_force_n for case in ALL.values())
    assert any(case.charged for case in ALL.values())


@pytest.mark.parametrize(("kind", "valve"), [("fixed", "1"), ("N-F", "F"), ("F-N", "N")])
def test_pressure_starts_to_move_8_ms_and_35_ms_after_the_commands(kind: str, valve: str) -> None:
    conditions = StrokeConditions(kind, 9e5, ((0.01, valve, 0.98), (0.2, valve, 0.0)))
    times = np.arange(0, 30001) * 1e-5
    pressure = simulate(NOMINAL, conditions, times, internal=False).pressure_pa(valve)
    rising = times[np.argmax(pressure > pressure[0] + 1.0)]
    assert rising == pytest.approx(0.018, abs=2e-5)
    falling = times[np.argmax(pressure)]
    assert falling == pytest.approx(0.235, abs=2e-5)
