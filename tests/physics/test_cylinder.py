"""A cylinder stated by its dimensions against the equations solved by scipy; proportional valves; refusals."""

from __future__ import annotations

from math import pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plant.batch.prediction import Predictor
from plant.devices.spool import Spool
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import shift
from plant.errors import InputError
from plant.integrator.loop import Control
from plant.kernel.compiled import plain
from plant.kernel.layout import FixedState
from plant.parameters import load
from plant.parts.chamber import energy_source
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup, simulate
from sil.simulation import load_scenario
from tests.support.cylinder_model import VALUES, model

TIME_S = np.linspace(0.0, 0.3, 301)
P_ATM, SUPPLY = 101325.0, 7e5


def extend(supply_pa: float = SUPPLY) -> StrokeConditions:
    return StrokeConditions("fixed", supply_pa, ((0.01, "1", 0.98),))


def by_scipy(acting: float) -> np.ndarray:
    """Position of the extending cylinder [n] in m by a textbook; states: position, speed, mass and energy of each chamber."""
    v = {name: value for name, (value, _unit) in VALUES.items()}
    gas, t0 = load().value("gas.R_air"), 293.15
    kappa, b, h = 1.4, 0.5, 40.0
    cv = gas / (kappa - 1.0)
    bore, rod = pi / 4 * v["bore"] ** 2, pi / 4 * v["rod"] ** 2
    tube = pi / 4 * v["tube_diameter"] ** 2
    tube_cda = tube / sqrt(0.02 * v["tube_length"] / v["tube_diameter"] + 1.5)
    series = {k: 1 / sqrt(v[f"valve_cda_{k}"] ** -2 + tube_cda**-2) for k in ("in", "out")}
    held = tube * v["tube_length"]
    ring = 0.0 if acting == 1.0 else bore - rod

    def flow(up: float, t_up: float, down: float, t_down: float, cda: float) -> tuple[float, float]:
        """Mass flow and the temperature that it has."""
        if up < down:
            mass, kelvin = flow(down, t_down, up, t_up, cda)
            return -mass, kelvin
        beyond = max(0.0, (min(down / up, 0.999) - b) / (1 - b))
        return 0.6847314563772704 * cda * up * sqrt((1 - beyond**2) / (gas * t_up)), t_up

    def chamber(
        p: float, t: float, volume: float, dv: float, passed: tuple[float, float]
    ) -> list[float]:
        mass, kelvin = passed
        walls = 2 * bore + 4 * volume / v["bore"]
        heat = h * walls * (t0 - t)
        return [mass, mass * kappa * cv * kelvin - p * dv + heat]

    def rates(_t: float, y: np.ndarray) -> list[float]:
        x, speed, m1, u1, m2, u2 = y
        v1 = v["dead_volume_1"] + held + bore * x
        v2 = v["dead_volume_2"] + held + (bore - rod) * v["stroke"] - ring * x
        p1, p2 = (kappa - 1) * u1 / v1, (kappa - 1) * u2 / v2
        t1, t2 = u1 / (m1 * cv), u2 / (m2 * cv)
        force = (p1 - P_ATM) * bore - (p2 - P_ATM) * ring
        force -= v["spring_preload"] + v["spring_rate"] * x
        net = force - v["coulomb"] - v["viscous"] * speed
        moves = speed > 0.0 or force > v["breakaway"]
        out, kelvin = flow(p2, t2, P_ATM, t0, series["out"])
        one = chamber(p1, t1, v1, bore * speed, flow(SUPPLY, t0, p1, t1, series["in"]))
        two = chamber(p2, t2, v2, -ring * speed, (-out, kelvin))
        return [speed, net / v["mass"] if moves else 0.0, *one, *two]

    volumes = (v["dead_volume_1"] + held, v["dead_volume_2"] + held + (bore - rod) * v["stroke"])
    air = [
        x for volume in volumes for x in (P_ATM * volume / (gas * t0), P_ATM * volume / (kappa - 1))
    ]

    def arrives(_t: float, y: np.ndarray) -> float:
        return float(y[0] - v["stroke"])

    arrives.terminal = True  # type: ignore[attr-defined]
    begin = 0.01 + load().value("valve.D_rise")
    found = solve_ivp(
        rates, (begin, 0.3), [0.0, 0.0, *air], events=arrives, rtol=1e-8, atol=1e-12,
        max_step=1e-4, dense_output=True,
    )  # fmt: skip
    end = float(found.t_events[0][0])
    return np.array(
        [0.0 if t < begin else v["stroke"] if t >= end else found.sol(t)[0] for t in TIME_S]
    )


@pytest.mark.parametrize("acting", [1.0, 2.0])
def test_a_cylinder_moves_as_its_equations_say(tmp_path, acting) -> None:
    stroke = simulate(load(model(tmp_path, acting=acting)), extend(), TIME_S)
    assert stroke.balance.closed and stroke.impact is not None
    assert np.abs(stroke.position_m - by_scipy(acting)).max() < 5e-5


def filled(folder: Path, supply_pa: float, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    """Pressure [n] in Pa and mass [n] in kg of chamber 1, held in place, at `TIME_S`."""
    stroke = simulate(load(model(folder, breakaway=1e6, **changes)), extend(supply_pa), TIME_S)
    assert stroke.balance.closed and stroke.position_m.max() == 0.0
    return stroke.states[:, FixedState.p_1], stroke.states[:, FixedState.m_1]


@pytest.mark.parametrize("kappa", [1.4, 1.0])
def test_a_chamber_fills_by_the_choked_flow_of_the_conductance(tmp_path, kappa) -> None:
    changes = {"kappa": kappa, "wall_heat": 0.0, "valve_c_in": 2e-9, "tube_length": 0.0}
    pressure, mass = filled(tmp_path, SUPPLY, **changes)
    choked = (TIME_S > 0.02) & (pressure < 0.5 * SUPPLY)
    per_s = 2e-9 * 1.185 * SUPPLY  # C rho_0 p_1, at T_0
    slope = np.diff(mass[choked]) / np.diff(TIME_S[choked])
    assert slope == pytest.approx(per_s, rel=1e-6)
    gas, volume = load().value("gas.R_air"), 5e-6
    slope = np.diff(pressure[choked]) / np.diff(TIME_S[choked])
    # adiabatic: the air brings its enthalpy; kappa 1: it keeps the temperature
    assert slope == pytest.approx(kappa * gas * 293.15 * per_s / volume, rel=1e-6)


def test_a_filled_chamber_is_as_warm_as_its_energy_says_and_cools_to_the_walls(tmp_path) -> None:
    gas, volume = load().value("gas.R_air"), 5e-6 + pi / 4 * 0.004**2
    pressure, mass = filled(tmp_path, SUPPLY, wall_heat=0.0)
    before = P_ATM * volume / (gas * 293.15)
    cv = gas / 0.4
    energy = before * cv * 293.15 + (mass[-1] - before) * 1.4 * cv * 293.15
    kelvin = pressure[-1] * volume / (mass[-1] * gas)
    assert kelvin == pytest.approx(energy / (mass[-1] * cv), rel=1e-5) and kelvin > 350.0
    cooled = filled(tmp_path, SUPPLY, wall_heat=5e3)
    assert cooled[0][-1] * volume / (cooled[1][-1] * gas) == pytest.approx(293.15, abs=0.5)


def test_a_full_cylinder_at_rest_is_passed_in_long_steps(tmp_path) -> None:
    setup = make_setup(load(model(tmp_path, acting=2.0)), extend())
    instants_ns = np.rint(TIME_S * 1e9).astype(np.int64)
    exact = Predictor(instants_ns, 1e-11).states(setup)
    predictor = Predictor(instants_ns)
    assert predictor.states(setup) == pytest.approx(exact, rel=1e-5, abs=1e-6)
    assert predictor._control[Control.steps] < 300  # 0.2 s of them full
    full = exact[:, FixedState.p_1] > 0.99 * SUPPLY
    assert np.count_nonzero(full) > 100 and exact[full, FixedState.v].max() == 0.0


@pytest.mark.parametrize(("exponent", "ends"), [(0.0, 1.0), (0.5, 0.3), (1.0, 0.0)])
def test_the_walls_take_heat_by_a_power_of_the_density(tmp_path, exponent, ends) -> None:
    changes = {"wall_heat": 100.0, "wall_density": exponent, "wall_ends": ends}
    setup = Setup.of(load(model(tmp_path, **changes)), extend())
    thin, dense = (plain(energy_source)(0.0, 1e-5, mass, 350.0, setup.p) for mass in (2e-5, 8e-5))
    assert thin < 0.0 and dense == pytest.approx(4.0**exponent * thin)
    at_reference = plain(energy_source)(0.0, 1e-5, 1.185e-5, 350.0, setup.p)
    bore = pi / 4 * 0.032**2
    area = 2.0 * ends * bore + pi * 0.032 * 1e-5 / bore
    expected = 0.4 * 100.0 * area * (293.15 - 350.0) / load().value("gas.R_air")
    assert at_reference == pytest.approx(expected)


@pytest.mark.parametrize("b", [0.2, 0.5])
def test_the_flow_is_an_ellipse_beyond_the_critical_ratio(tmp_path, b) -> None:
    changes = {"kappa": 1.0, "wall_heat": 0.0, "valve_c_in": 2e-9, "tube_length": 0.0, "valve_b": b}
    pressure, mass = filled(tmp_path, SUPPLY, **changes)
    middle, ratio = np.gradient(mass, TIME_S), pressure / SUPPLY
    free = (ratio > b + 0.05) & (ratio < 0.95)
    expected = 2e-9 * 1.185 * SUPPLY * np.sqrt(1 - ((ratio[free] - b) / (1 - b)) ** 2)
    assert free.sum() > 5 and middle[free] == pytest.approx(expected, rel=5e-3)


def test_a_return_spring_brings_a_single_acting_cylinder_back(tmp_path) -> None:
    conditions = StrokeConditions(
        "fixed", SUPPLY, ((0.01, "1", 0.98), (0.15, "1", 0.0)), atmosphere_pa=P_ATM
    )
    stroke = simulate(load(model(tmp_path)), conditions, np.linspace(0.0, 1.0, 1001))
    assert stroke.position_m.max() == pytest.approx(0.05) and stroke.position_m[
        -1
    ] == pytest.approx(0.0)


def test_derived_values_follow_a_change(tmp_path) -> None:
    found = load(model(tmp_path)).override({"cylinder.bore": 0.04})
    assert found.value("fixed.A1") == pytest.approx(pi / 4 * 0.04**2)
    assert found.value("fixed.A2") == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"acting": 3.0}, "cylinder.acting: 3; expected 1 or 2"),
        ({"rod": 0.05}, "cylinder.rod: 0.05; expected less than bore, 0.032"),
        ({"bore": 0.0}, "cylinder.bore: 0; expected more than 0"),
        ({"tube_diameter": 0.0}, "cylinder.tube_diameter: 0; expected more than 0"),
        ({"kappa": 0.9}, "cylinder.kappa.*: 0.9; expected 1 to 1.7"),
        ({"mass": -1.0}, "cylinder.mass.*: -1; expected 1e-09"),
    ],
)
def test_an_impossible_cylinder_is_refused(tmp_path, changes, message) -> None:
    with pytest.raises(InputError, match=message):
        load(model(tmp_path, **changes))


def test_an_incomplete_cylinder_is_refused(tmp_path) -> None:
    path = model(tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text("\n".join(x for x in text.splitlines() if "bore" not in x), encoding="utf-8")
    with pytest.raises(InputError, match=r"no cylinder\.bore; expected all of cylinder\.acting"):
        load(path)


def test_a_run_refuses_a_cylinder(tmp_path) -> None:
    with pytest.raises(InputError, match=r"states a \[cylinder\], which shifts no gears"):
        load_scenario.load("lab_n_b", model=str(model(tmp_path)))


SPOOL = {
    "valve_frequency": (40.0, "Hz"),
    "valve_damping": (0.7, "-"),
    "valve_dead_zone": (0.1, "-"),
}
SPOOL_TIME_S = np.linspace(0.0, 0.2, 401)
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
    found = path_of(Spool(40.0, 0.0, 0.0), [(0, 0.8)], SPOOL_TIME_S)
    assert found == pytest.approx(0.8 * (1.0 - np.exp(-w * SPOOL_TIME_S)), abs=5e-4)
    assert found[-1] == 0.8


@pytest.mark.parametrize("damping", [0.3, 0.7, 1.5])
def test_a_spool_of_second_order_follows_its_step_response(damping: float) -> None:
    w = 2.0 * pi * 40.0
    root = np.sqrt(complex(damping**2 - 1.0))
    one, two = -w * (damping - root), -w * (damping + root)
    step = 1.0 + (two * np.exp(one * SPOOL_TIME_S) - one * np.exp(two * SPOOL_TIME_S)) / (one - two)
    found = path_of(Spool(40.0, damping, 0.0), [(0, 0.6)], SPOOL_TIME_S)
    assert found == pytest.approx(0.6 * step.real, abs=1e-3)
    # a second command before the first has settled goes on from there
    again = path_of(Spool(40.0, damping, 0.0), [(0, 0.6), (5_000_000, 0.0)], SPOOL_TIME_S)
    late = np.interp(SPOOL_TIME_S - 0.005, SPOOL_TIME_S, step.real) * (SPOOL_TIME_S >= 0.005)
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
    stroke = simulate(parameters, conditions, SPOOL_TIME_S)
    gamma, gas = parameters.value("gas.gamma"), parameters.value("gas.R_air")
    choked = sqrt(gamma * (2.0 / (gamma + 1.0)) ** ((gamma + 1.0) / (gamma - 1.0)))
    flow = share * 4e-6 * SUPPLY * sqrt(parameters.value("gas.T") / gas) * choked
    rate = gas * parameters.value("cylinder.kappa") * flow / 2e-3
    rise = np.diff(stroke.pressure_pa("1")[300:]) / np.diff(
        SPOOL_TIME_S[300:]
    )  # the spool has arrived
    assert rise == pytest.approx(rate, rel=1e-6, abs=1e-3)
    mass_kg = stroke.balance.air_in_kg
    assert mass_kg == pytest.approx(0.19 * flow / parameters.value("gas.T"), rel=0.06, abs=2e-6)
    assert stroke.balance.closed


def test_delays_and_a_slow_plunger_act_on_a_proportional_valve(tmp_path) -> None:
    conditions = StrokeConditions("fixed", SUPPLY, ((0.01, "1", 0.8),), atmosphere_pa=P_ATM)
    setup = make_setup(load(proportional(tmp_path)), conditions)
    later = setup.copy()
    shift(later, "rise", 0.02)
    plain, shifted = (
        run_setup(setup, SPOOL_TIME_S).position_m,
        run_setup(later, SPOOL_TIME_S).position_m,
    )
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
