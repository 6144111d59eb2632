"""The length stroke over whole shifts and in faults: it ends, and stays within its stops."""

from __future__ import annotations

import numpy as np
import pytest

from plant.errors import InputError
from plant.kernel.layout import LengthState
from plant.systems.length_stroke import LengthStroke
from tests.physics.bare import MS, NOMINAL
from tests.physics.strokes import length_stroke

STROKE, FREE = 0.01285, 0.013
LOADS = {
    "free": {},
    "truck": {
        "mounted": True,
        "mesh_force_n": 800.0,
        "pull_force_n": 500.0,
        "sync_impulse_n_s": 18.0,
    },
    "damper": {"damper": "compressible"},
    "algebraic damper": {"damper": "incompressible"},
}


def within(actuator: LengthStroke, y: np.ndarray) -> None:
    """No stop is passed, no pressure negative, the balances close, the events are few."""
    assert np.abs(y[:, LengthState.x_s]).max() <= STROKE + 1e-9
    for piston, side in ((LengthState.x_1, -1.0), (LengthState.x_2, 1.0)):
        assert y[:, piston].min() >= -1e-9
        gap = y[:, piston] + side * y[:, LengthState.x_s]
        assert gap.min() >= -1e-9 and gap.max() <= FREE + 1e-9
    assert y[:, [LengthState.p_b, LengthState.p_n, LengthState.p_f]].min() > 5e4
    assert actuator.balance().closed
    assert len(actuator.events) < 400


def run(
    actuator: LengthStroke, until_ms: int, switches: list[tuple[int, int, float]]
) -> np.ndarray:
    """Advance in pieces of 10 ms as under lockstep; states every 0.2 ms."""
    rows = []
    for end in range(actuator.now_ns + 10 * MS, until_ms * MS + 1, 10 * MS):
        start = actuator.now_ns
        inside = [s for s in switches if start < s[0] <= end]
        wanted = np.arange(start + MS // 5, end + 1, MS // 5, dtype=np.int64)
        rows.append(actuator.advance(end, inside, wanted))
    return np.concatenate(rows)


@pytest.mark.parametrize("load", sorted(LOADS))
@pytest.mark.parametrize(("start", "first", "last"), [("B", 1, 2), ("F", 1, 0)])
def test_full_shift_through_neutral(load: str, start: str, first: int, last: int) -> None:
    actuator = length_stroke(NOMINAL, initial=start, **LOADS[load])
    switches = [
        (10 * MS, first, 1.0),
        (300 * MS, first, 0.0),
        (320 * MS, last, 1.0),
        (700 * MS, last, 0.0),
    ]
    y = run(actuator, 1300, switches)
    within(actuator, y)
    side = 1.0 if last == 0 else -1.0
    assert y[1480, LengthState.x_s] == pytest.approx(0.0, abs=1e-9)  # in neutral at 296 ms
    assert actuator.position_m == pytest.approx(side * STROKE, abs=1e-9)
    stops = [e for e in actuator.events if e.name == "stop" and e.speed_m_s > 0.05]
    assert [round(stop.position_m / STROKE) for stop in stops][:1] == [0]
    assert round(stops[-1].position_m / STROKE) == side
    assert actuator.pressures_pa == pytest.approx((101325.0,) * 3, rel=0.02)


@pytest.mark.parametrize("start", ["B", "N", "F"])
@pytest.mark.parametrize("load", sorted(LOADS))
def test_both_engaging_chambers_charged(load: str, start: str) -> None:
    actuator = length_stroke(NOMINAL, initial=start, **LOADS[load])
    y = run(actuator, 500, [(10 * MS, 0, 1.0), (15 * MS, 2, 1.0), (400 * MS, 0, 0.0)])
    within(actuator, y)
    # B and F push against each other: until B is vented nothing reaches the other end
    if start == "N":
        assert np.abs(y[:1900, LengthState.x_s]).max() < STROKE


def test_venting_neutral_in_the_middle_of_the_motion_and_charging_it_again() -> None:
    actuator = length_stroke(NOMINAL, initial="B", mounted=True, pull_force_n=900.0)
    y = run(
        actuator, 500, [(10 * MS, 1, 1.0), (45 * MS, 1, 0.0), (90 * MS, 1, 1.0), (400 * MS, 1, 0.0)]
    )
    within(actuator, y)
    assert actuator.position_m == pytest.approx(0.0, abs=1e-9)


def test_the_starting_place_and_the_properties() -> None:
    actuator = LengthStroke(NOMINAL, initial="F", charged=("F",), supply_pressure_pa=6e5)
    assert actuator.position_m == -STROKE
    assert actuator.pistons_m == (0.0, pytest.approx(STROKE + FREE))
    assert actuator.pressures_pa == (101325.0, 101325.0, 6e5)
    row = dict(zip(actuator.columns, actuator.row(), strict=True))
    assert row["position_m"] == -STROKE and row["pressure_F_pa"] == 6e5
    with pytest.raises(InputError, match="initial gear 'R'"):
        LengthStroke(NOMINAL, initial="R")
