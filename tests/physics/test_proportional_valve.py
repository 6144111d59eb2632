"""Proportional valves: the spool against its closed forms, the flow against that of its opening."""

from __future__ import annotations

from math import pi, sqrt
from pathlib import Path

import numpy as np
import pytest

from plant.devices.spool import Spool
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import shift
from plant.errors import InputError
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup, simulate
from tests.physics.test_cylinder import P_ATM, SUPPLY
from tests.support.cylinder_model import model

SPOOL = {
    "valve_frequency": (40.0, "Hz"),
    "valve_damping": (0.7, "-"),
    "valve_dead_zone": (0.1, "-"),
}
TIME_S = np.linspace(0.0, 0.2, 401)
STUCK = {"breakaway": 1e9, "tube_length": 0.0, "wall_heat": 0.0}


def proportional(folder: Path, spool: dict[str, float] | None = None, **changes: float) -> Path:
    path = model(folder, **changes)
    with path.open("a", encoding="utf-8") as file:
        for name, (value, unit) in SPOOL.items():
            number = (spool or {}).get(name, value)
            file.write(f'{name} = {{ value = {number!r}, unit = "{unit}", source = "test" }}\n')
    return path


def path_of(spool: Spool, signal: list[tuple[int, float]], at_s: np.ndarray) -> np.ndarray:
    """Openings [n] at instants [n] in s, from the moves."""
    moves = list(spool.moves(signal, 0.0, 10**9, 0.0))
    out = np.zeros(len(at_s))
    for instant, opening, slope in moves:
        later = at_s >= instant * 1e-9
        out[later] = opening + slope * (at_s[later] - instant * 1e-9)
    return out


def test_a_spool_of_first_order_approaches_its_signal_exponentially() -> None:
    w = 2.0 * pi * 40.0
    found = path_of(Spool(40.0, 0.0, 0.0), [(0, 0.8)], TIME_S)
    assert found == pytest.approx(0.8 * (1.0 - np.exp(-w * TIME_S)), abs=5e-4)
    assert found[-1] == 0.8


@pytest.mark.parametrize("damping", [0.3, 0.7, 1.5])
def test_a_spool_of_second_order_follows_its_step_response(damping: float) -> None:
    w = 2.0 * pi * 40.0
    root = np.sqrt(complex(damping**2 - 1.0))
    one, two = -w * (damping - root), -w * (damping + root)
    step = 1.0 + (two * np.exp(one * TIME_S) - one * np.exp(two * TIME_S)) / (one - two)
    found = path_of(Spool(40.0, damping, 0.0), [(0, 0.6)], TIME_S)
    assert found == pytest.approx(0.6 * step.real, abs=1e-3)
    # a second command before the first has settled goes on from there
    again = path_of(Spool(40.0, damping, 0.0), [(0, 0.6), (5_000_000, 0.0)], TIME_S)
    late = np.interp(TIME_S - 0.005, TIME_S, step.real) * (TIME_S >= 0.005)
    assert again == pytest.approx(np.clip(0.6 * (step.real - late), 0.0, 1.0), abs=2e-3)


def test_the_dead_zone_keeps_the_valve_closed() -> None:
    spool = Spool(40.0, 0.7, 0.2)
    positions = np.array([0.0, 0.39, 0.41, 0.5, 0.59, 0.6, 0.8, 1.0])
    expected = [0.0, 0.4875, 0.5, 0.5, 0.5, 0.5, 0.75, 1.0]
    assert spool.opening(positions) == pytest.approx(expected)


@pytest.mark.parametrize("signal, share", [(0.775, 0.5), (1.0, 1.0), (0.54, 0.0), (0.3, 0.0)])
def test_a_stuck_cylinder_fills_at_the_choked_flow_of_the_opening(tmp_path, signal, share) -> None:
    parameters = load(proportional(tmp_path, dead_volume_1=2e-3, **STUCK))
    conditions = StrokeConditions(
        "fixed", SUPPLY, ((0.0, "1", signal),), atmosphere_pa=P_ATM, load="none"
    )
    stroke = simulate(parameters, conditions, TIME_S)
    gamma, gas = parameters.value("gas.gamma"), parameters.value("gas.R_air")
    choked = sqrt(gamma * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (gamma - 1.0)))
    flow = share * 4e-6 * SUPPLY * sqrt(parameters.value("gas.T") / gas) * choked
    rate = gas * parameters.value("cylinder.kappa") * flow / 2e-3
    rise = np.diff(stroke.pressure_pa("1")[300:]) / np.diff(TIME_S[300:])  # the spool has arrived
    assert rise == pytest.approx(rate, rel=1e-6, abs=1e-3)
    mass_kg = stroke.balance.air_in_kg
    assert mass_kg == pytest.approx(0.19 * flow / parameters.value("gas.T"), rel=0.06, abs=2e-6)
    assert stroke.balance.closed


def test_delays_and_a_slow_plunger_act_on_a_proportional_valve(tmp_path) -> None:
    conditions = StrokeConditions("fixed", SUPPLY, ((0.01, "1", 0.8),), atmosphere_pa=P_ATM)
    setup = make_setup(load(proportional(tmp_path)), conditions)
    later = setup.copy()
    shift(later, "rise", 0.02)
    plain, shifted = run_setup(setup, TIME_S).position_m, run_setup(later, TIME_S).position_m
    assert plain[200] > 0.0 and shifted[40:] == pytest.approx(plain[:-40], abs=1e-6)
    ramp = list(Spool(5000.0, 0.0, 0.0).moves([(0, 1.0)], 0.0, 10**8, 0.05))
    times, openings = np.array([(1e-9 * instant, opening) for instant, opening, _ in ramp]).T
    assert openings == pytest.approx(np.minimum(times / 0.05, 1.0), abs=2e-3)


@pytest.mark.parametrize(
    "text, message",
    [
        ("valve_frequency", "no cylinder.valve_damping; expected all of"),
        ("valve_dead_zone", "cylinder.valve_dead_zone: 1.5; expected less than 1"),
    ],
)
def test_what_a_proportional_valve_cannot_be_is_refused(tmp_path, text, message) -> None:
    if text == "valve_frequency":
        path = model(tmp_path)
        with path.open("a", encoding="utf-8") as file:
            file.write('valve_frequency = { value = 40.0, unit = "Hz", source = "test" }\n')
    else:
        path = proportional(tmp_path, {"valve_dead_zone": 1.5})
    with pytest.raises(InputError, match=message):
        load(path)
