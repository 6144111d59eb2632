"""A cylinder stated by its dimensions: against the equations solved by scipy, and what is refused."""

from __future__ import annotations

from math import pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import InputError
from plant.parameters import load
from plant.systems.stroke import simulate
from sil.simulation import load_scenario

VALUES = {
    "acting": (1.0, "-"),
    "bore": (0.032, "m"),
    "rod": (0.012, "m"),
    "stroke": (0.05, "m"),
    "dead_volume_1": (5e-6, "m^3"),
    "dead_volume_2": (5e-6, "m^3"),
    "mass": (0.6, "kg"),
    "breakaway": (20.0, "N"),
    "coulomb": (15.0, "N"),
    "viscous": (30.0, "N s/m"),
    "spring_rate": (800.0, "N/m"),
    "spring_preload": (40.0, "N"),
    "valve_cda_in": (4e-6, "m^2"),
    "valve_cda_out": (5e-6, "m^2"),
    "tube_length": (1.0, "m"),
    "tube_diameter": (0.004, "m"),
}
TIME_S = np.linspace(0.0, 0.3, 301)
P_ATM, SUPPLY = 101325.0, 7e5


def model(folder: Path, **changes: float) -> Path:
    lines = ["[base]", 'model = "nominal"', "[cylinder]"]
    for name, (value, unit) in VALUES.items():
        lines.append(
            f'{name} = {{ value = {changes.get(name, value)!r}, unit = "{unit}", source = "test" }}'
        )
    path = folder / "cylinder.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def extend(supply_pa: float = SUPPLY) -> StrokeConditions:
    return StrokeConditions("fixed", supply_pa, ((0.01, "1", 0.98),))


def by_scipy(acting: float) -> np.ndarray:
    """Position of the extending cylinder [n] in m, from the equations as a textbook has them."""
    v = {name: value for name, (value, _unit) in VALUES.items()}
    nominal = load()
    gas, gamma, t = nominal.value("gas.R_air"), nominal.value("gas.gamma"), nominal.value("gas.T")
    am1, a1 = nominal.value("alpha.alpha_m1"), nominal.value("alpha.alpha_1")
    am2, a2 = nominal.value("alpha.alpha_m2"), nominal.value("alpha.alpha_2")
    bore, rod = pi / 4 * v["bore"] ** 2, pi / 4 * v["rod"] ** 2
    tube = pi / 4 * v["tube_diameter"] ** 2
    tube_cda = tube / sqrt(0.02 * v["tube_length"] / v["tube_diameter"] + 1.5)
    series = {k: 1 / sqrt(v[f"valve_cda_{k}"] ** -2 + tube_cda**-2) for k in ("in", "out")}
    held = tube * v["tube_length"]
    critical = (2 / (gamma + 1)) ** (gamma / (gamma - 1))

    def flow(up: float, down: float, cda: float) -> float:
        if up < down:
            return -flow(down, up, cda)
        r = max(down / up, critical)
        psi = sqrt(
            max(2 * gamma / (gamma - 1) * (r ** (2 / gamma) - r ** ((gamma + 1) / gamma)), 0.0)
        )
        return cda * up * sqrt(t / gas) * psi

    def rates(_t: float, y: np.ndarray) -> list[float]:
        x, speed, p1, p2 = y
        ring = 0.0 if acting == 1.0 else bore - rod
        force = (p1 - P_ATM) * bore - (p2 - P_ATM) * ring
        force -= v["spring_preload"] + v["spring_rate"] * x
        net = force - v["coulomb"] - v["viscous"] * speed
        moves = speed > 0.0 or force > v["breakaway"]
        v1 = v["dead_volume_1"] + held + bore * x
        v2 = v["dead_volume_2"] + held + (bore - rod) * (v["stroke"] - x)
        d1 = (gas * am1 * flow(SUPPLY, p1, series["in"]) - a1 * p1 * bore * speed) / v1
        d2 = (-gas * am2 * flow(p2, P_ATM, series["out"]) + a2 * p2 * ring * speed) / v2
        return [speed, net / v["mass"] if moves else 0.0, d1, d2]

    def arrives(_t: float, y: np.ndarray) -> float:
        return float(y[0] - v["stroke"])

    arrives.terminal = True  # type: ignore[attr-defined]
    begin = 0.01 + load().value("valve.D_rise")
    found = solve_ivp(
        rates, (begin, 0.3), [0.0, 0.0, P_ATM, P_ATM], events=arrives, rtol=1e-8, atol=1e-9,
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
