"""The certified lower bound: known answers, its certificate checked apart, no policy below it."""

from __future__ import annotations

import copy
import csv
import json
import math
from typing import Any

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects import overridden
from plant.kernel.compiled import plain
from plant.kernel.layout import FlowMap
from plant.parameters import load as load_parameters
from plant.parts.flow import charge, discharge
from sil.studies.bound_figures import SHIPPED
from sil.studies.kinds.lower_bound import NEUTRAL
from sil.studies.lower_bound import HeldModel, Node, certificate
from sil.studies.lower_bound_enclosures import STEP_S, check_maps, stop_speed
from sil.studies.policies import GEARBOX, FamilyModel, Layout
from tests.unit.sil.studies.lower_bound_checker import arrival, flow_in, flow_out, uncovered

PARAMETERS = load_parameters("nominal")
CERTIFIED = {0.048: 0.83, 0.01: 0.76}
"""Results of the shipped study, m/s, by information delay in s."""


@pytest.fixture(scope="module")
def held() -> HeldModel:
    return HeldModel(PARAMETERS, 0.048, 0.03)


@pytest.fixture(scope="module")
def given(held: HeldModel) -> dict[str, Any]:
    leaves = held.prove(CERTIFIED[0.048])
    assert leaves is not None
    found: dict[str, Any] = json.loads(json.dumps(certificate(held, CERTIFIED[0.048], leaves)))
    return found


def commands_of(
    leaf: dict[str, Any], given: dict[str, Any], rng: np.random.Generator
) -> list[float] | None:
    """Return instants [s] of one command of a leaf; after its last cell valve N moves at random."""
    least = given["least_steps"]["n_open"], given["least_steps"]["n_closed"]
    latest = math.inf
    ends: list[float] = []
    for k in reversed(range(len(leaf["n"]))):
        latest = min(leaf["n"][k][1], latest - least[k % 2])
        ends.insert(0, latest)
    moves: list[float] = []
    for k, (begin, _end) in enumerate(leaf["n"]):
        first = max(begin, moves[-1] + least[(k + 1) % 2]) if moves else begin
        if first > ends[k]:
            return None  # coil and plunger allow no command of this leaf
        moves.append(rng.uniform(first, ends[k]))
    while not leaf["ended"][0] and len(moves) < 12:
        first = moves[-1] + least[(len(moves) + 1) % 2] if moves else 0.0
        moves.append(first + rng.exponential(40.0))
    return [given["begin_s"] + STEP_S * move for move in moves]


def test_a_constant_force_gives_the_closed_form(held: HeldModel) -> None:
    """Toy with a known answer: no flows, no change of pressure, no friction: v = sqrt(2 F s / m)."""
    air = *held.air[:2], np.zeros_like(held.air[2])
    path = np.zeros((5, 201))
    path[0], path[1], path[2] = np.linspace(0.0, 0.008, 201), 1.0, 1.0
    low_b, high_n = np.full(400, 6e5), np.full(400, 2e5)
    body = (2e-3, 1e-3, 0.0, 10.0, 0.0, 0.0, 0.0, 1e5)
    found = stop_speed(low_b, high_n, 0, 1, 0, held.rates[0], air, path, body)
    exact = math.sqrt(2.0 * (2e-3 * 6e5 - 1e-3 * 2e5) * 0.008 / 10.0)
    assert 0.99 * exact < found < exact
    body = (2e-3, 1e-3, 0.0, 10.0, 0.0, 0.0, 1001.0, 1e5)
    assert stop_speed(low_b, high_n, 0, 1, 0, held.rates[0], air, path, body) == 0.0


def test_without_commands_the_plain_push_is_enclosed(held: HeldModel) -> None:
    plain = FamilyModel(PARAMETERS, GEARBOX, 0.048, 0.03).plain.impact_stay_m_s.max()
    speed, load = held.hardest(Node(ended=True))
    assert 0.85 * plain < speed < plain
    assert load >= 3


def test_maps_are_those_of_the_model_and_monotone(held: HeldModel) -> None:
    supply_pa, atmosphere_pa, known = held.air
    flow = FlowMap(known.copy())
    for pressure in np.linspace(1.02e5, 8.9e5, 50):
        assert plain(charge)(pressure, supply_pa, flow) == pytest.approx(flow_in(pressure))
        assert plain(discharge)(pressure, atmosphere_pa, flow) == pytest.approx(flow_out(pressure))
    flow.charge_low[1] += 1e-5
    with pytest.raises(InputError, match="expected flow maps"):
        check_maps(flow, supply_pa, atmosphere_pa)


def test_every_command_is_in_a_leaf(given: dict[str, Any]) -> None:
    assert len(given["leaves"]) > 500
    assert uncovered(given) is None
    for k in (0, 7, len(given["leaves"]) - 1):
        broken = copy.deepcopy(given)
        del broken["leaves"][k]
        assert uncovered(broken) is not None


def check_leaves(given: dict[str, Any], count: int) -> float:
    """Check random leaves of a certificate with a random command each; return the least excess, m/s."""
    rng = np.random.default_rng(1)
    excess = math.inf
    for leaf in rng.choice(given["leaves"], count, replace=False):
        assert leaf["speed_m_s"] is None or leaf["speed_m_s"] > given["bound_m_s"]
        moves_s = commands_of(leaf, given, rng)
        if moves_s is None:
            continue
        speed, time_s = arrival(given, moves_s, leaf["load"])
        if leaf["speed_m_s"] is None:
            assert time_s > given["limit_s"][leaf["load"]]
        elif time_s <= given["limit_s"][leaf["load"]]:
            excess = min(excess, speed - leaf["speed_m_s"])
    return excess


def test_leaves_hold_in_a_second_implementation(given: dict[str, Any]) -> None:
    assert 0.0 < check_leaves(given, 8) < 0.5


@pytest.mark.slow
def test_hundreds_of_leaves_hold_in_a_second_implementation(given: dict[str, Any]) -> None:
    assert 0.0 < check_leaves(given, 300) < 0.3


def hardest_of_random(delay_s: float, count: int, seed: int) -> float:
    """Return the softest of random policies of valve N, in m/s, run by the real kernel."""
    model = FamilyModel(PARAMETERS, GEARBOX, delay_s, 0.03)
    rng = np.random.default_rng(seed)
    layout = Layout("N", 3, 1)
    stems = np.zeros((count, 1, 6))
    stems[..., 0::2] = rng.uniform(4.3, 23.0, (count, 1, 3))
    stems[..., 1::2] = rng.uniform(-1.0, 3.0, (count, 1, 3))
    # the policy that was found at 48 ms, and others near it
    near = np.array([11.361, 1.633, 21.259, 9.0, 5.0, -1.0])
    stems[: count // 2, 0] = near + rng.normal(0.0, 0.3, (count // 2, 6)) * (near > 0.0)
    stems[0, 0] = near
    branches = np.zeros((count, 1, 5, 1, 3))
    branches[..., 0] = rng.uniform(-0.8, 1.0, branches.shape[:-1])
    branches[..., 1] = rng.uniform(-1.0, 3.0, branches.shape[:-1])
    branches[..., 2] = 30.0
    branches[0, ..., 1] = -1.0
    cost = model.fly(stems, branches, layout).cost_m_s
    return float(cost.max(axis=2).min())


@pytest.mark.parametrize("delay_s", CERTIFIED)
def test_no_random_policy_is_softer(delay_s: float) -> None:
    """The softest of them is not far above, so a bound that were too high would show."""
    softest = hardest_of_random(delay_s, 150, 3)
    assert CERTIFIED[delay_s] <= softest < CERTIFIED[delay_s] + 0.2


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", CERTIFIED)
def test_no_policy_of_thousands_is_softer(delay_s: float) -> None:
    for seed in range(5):
        assert hardest_of_random(delay_s, 1000, seed) >= CERTIFIED[delay_s]


def test_what_was_found_with_valve_n_is_above_the_proof_and_the_damper() -> None:
    """The shipped table holds both ends of the interval: a policy that exists, and above what is proven."""
    with open(SHIPPED.with_name("bounds_valves.csv"), encoding="utf-8", newline="") as file:
        found = [row for row in csv.DictReader(file) if row["variant"] == NEUTRAL]
    rows = [row for row in found if float(row["bound.delay_s"]) in CERTIFIED]
    assert len(rows) == len(CERTIFIED)
    for row in rows:
        found_m_s = float(row["bound_m_s"])
        assert CERTIFIED[float(row["bound.delay_s"])] <= found_m_s < float(row["open_loop_m_s"])
        assert found_m_s > float(row["damper_m_s"])


def test_nothing_is_proven_above_a_policy_that_exists(held: HeldModel) -> None:
    assert held.prove(0.93, most=20_000) is None


def test_less_is_proven_with_earlier_information() -> None:
    early = HeldModel(PARAMETERS, 0.01, 0.03)
    assert early.prove(CERTIFIED[0.048], most=20_000) is None


def test_what_the_proof_does_not_cover_is_refused() -> None:
    changed = overridden(PARAMETERS, {"effect.exhaust_clog.factor": 0.5})
    with pytest.raises(InputError, match="without effects"):
        HeldModel(changed, 0.048, 0.03)
    with pytest.raises(InputError, match="alpha_1 <= alpha_2"):
        HeldModel(PARAMETERS.override({"alpha.alpha_1": 1.2}), 0.048, 0.03)
