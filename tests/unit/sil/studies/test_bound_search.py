"""The bounds: their search on known answers, and no random controller below them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.parameters import load as load_parameters
from plant.systems.stroke import simulate
from sil.studies import bound_search as bounds
from sil.studies.bound_search import Best, Bound
from sil.studies.kinds.bounds import envelope
from sil.studies.shooting import FAMILIES, GEARBOX, LABORATORY, Arrivals, Commands, Family, Shooter

PARAMETERS = load_parameters("nominal")
QUICK = PARAMETERS.override({"valve.D_fall": 0.005})
EXTRA_S = 0.03
LAB = LABORATORY.cases[-1]


def test_a_shot_is_the_stroke_that_the_plant_makes() -> None:
    case = replace(GEARBOX.cases[2])
    commands = Commands((0.09, 0.1), (0.08, 0.11))
    found = Shooter(PARAMETERS, case, 0.3).shoot([Commands(), commands])
    stroke = simulate(
        PARAMETERS,
        StrokeConditions(
            "N-B",
            case.supply_pressure_pa,
            (
                (0.0, "B", FULL_DUTY),
                (0.08, "N", FULL_DUTY),
                (0.09, "B", 0.0),
                (0.1, "B", FULL_DUTY),
                (0.11, "N", 0.0),
            ),
            mounted=True,
            mesh_force_n=case.mesh_force_n,
            sync_impulse_n_s=case.sync_impulse_n_s,
        ),
        np.array([0.0, 0.3]),
        internal=False,
    )
    assert stroke.impact is not None
    revealed = next(event.time_s for event in stroke.events if event.name == "unblock")
    assert found.speed_m_s[1] == pytest.approx(stroke.impact.speed_m_s, rel=1e-3)
    assert found.time_s[1] == pytest.approx(stroke.impact.time_s, abs=1e-6)
    assert found.revealed_s[1] == pytest.approx(revealed, abs=1e-6)
    assert found.speed_m_s[0] != pytest.approx(found.speed_m_s[1], rel=1e-2)


def test_an_arrival_beyond_the_limit_is_none() -> None:
    assert Shooter(PARAMETERS, LAB, 0.03).shoot([Commands()]).speed_m_s[0] == math.inf
    speed_m_s, time_s = bounds.plain_push(PARAMETERS, LAB, LABORATORY.revealed_by)
    assert speed_m_s == pytest.approx(0.9412, abs=1e-3)
    assert time_s == pytest.approx(0.04075, abs=1e-4)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))
def test_before_a_load_tells_it_moves_like_the_others(family: Family) -> None:
    """Up to the first telling instant of the family the stay is at the same place."""
    revealed = [
        float(Shooter(PARAMETERS, case, 0.4, family.revealed_by).shoot([Commands()]).revealed_s[0])
        for case in family.cases
    ]
    assert revealed == sorted(revealed, reverse=family is LABORATORY)
    first_s = min(revealed)
    times = np.linspace(0.0, first_s - 1e-4, 50)
    positions = [
        simulate(
            PARAMETERS,
            StrokeConditions(
                "N-B",
                case.supply_pressure_pa,
                ((0.0, "B", FULL_DUTY),),
                mounted=case.mounted,
                mesh_force_n=case.mesh_force_n,
                sync_impulse_n_s=case.sync_impulse_n_s,
            ),
            times,
            internal=False,
        ).position_m
        for case in family.cases
    ]
    for position_m in positions:
        assert np.max(np.abs(position_m - positions[0])) < 1e-6


def test_patterns_are_all_up_to_six_changes() -> None:
    found = list(bounds.patterns(6))
    assert len(found) == len(set(found)) == 28
    assert max(a + b for a, b in found) == 6


def test_starting_sequences_are_ordered_and_within_their_span() -> None:
    found = bounds.starts(0.01, 0.05, 4, 10, np.random.default_rng(1))
    assert len(found) == 1 + 14 * 11
    first = bounds.best_of_patterns(found, np.arange(len(found), 0.0, -1.0))
    kinds = [(len(found[k].driving_s), len(found[k].braking_s)) for k in first]
    assert sorted(kinds) == sorted(bounds.patterns(4)) and first[0] == len(found) - 1
    for commands in found:
        for times in (commands.driving_s, commands.braking_s):
            assert list(times) == sorted(times)
            assert all(0.01 <= t <= 0.05 for t in times)


def test_refinement_finds_the_lowest_point_of_a_known_function() -> None:
    class Bowl(Shooter):
        def shoot(self, sequences: list[Commands]) -> Arrivals:  # type: ignore[override]
            speeds = []
            for commands in sequences:
                (a,), (b,) = commands.driving_s, commands.braking_s
                speeds.append(1.0 + (100.0 * (a - 0.013)) ** 2 + (100.0 * (b - 0.027)) ** 2)
            times = np.full(len(sequences), 0.05)
            return Arrivals(np.array(speeds), times, times)

    start = Best(Commands((0.03,), (0.01,)), 10.0, 0.05)
    bowl, rng = Bowl(PARAMETERS, LAB, 0.1), np.random.default_rng(3)
    for best in (
        bounds.refined(bowl, start, Commands(), 0.0, 0.01),
        bounds.scattered(bowl, start, 0.01, rng),
    ):
        assert best.commands.driving_s[0] == pytest.approx(0.013, abs=1e-4)
        assert best.commands.braking_s[0] == pytest.approx(0.027, abs=1e-4)
        assert best.speed_m_s == pytest.approx(1.0, abs=1e-3)


def test_late_information_holds_for_earlier_information() -> None:
    delay_s = np.array([0.01, -0.01, 0.0, 0.02])
    assert list(envelope(delay_s, np.array([0.5, 0.3, 0.9, 0.7]))) == [0.5, 0.3, 0.5, 0.7]


def searched(family: Family, delay_s: float) -> Bound:
    return bounds.bound(QUICK, family, delay_s, EXTRA_S, budget=20, stems=3, seed=2)


@pytest.fixture(scope="module")
def gearbox() -> dict[float, Bound]:
    return {delay_s: searched(GEARBOX, delay_s) for delay_s in (-0.02, 0.0, 0.048)}


@pytest.mark.slow
def test_searches_from_other_starts_find_the_same() -> None:
    """Not a proof that (a) is the least there is, but no start found a much softer stop."""
    hardest = bounds.shooters_of(PARAMETERS, GEARBOX, EXTRA_S)[-1]
    found_m_s = [bounds.clairvoyant(hardest, seed=seed).speed_m_s for seed in (1, 2)]
    assert found_m_s[1] == pytest.approx(found_m_s[0], abs=0.03)


def test_the_gap_that_makes_feedback_fail(gearbox: dict[float, Bound]) -> None:
    """On the gearbox, known 20 ms ahead the stop is softer than the damper's; seen, it is not."""
    late = gearbox[0.048]
    assert late.open_loop_m_s == pytest.approx(1.365, abs=0.005)
    assert late.damper_m_s == pytest.approx(0.602, abs=0.005)
    assert gearbox[-0.02].non_anticipating_m_s < late.damper_m_s
    assert late.clairvoyant_m_s < 0.5 * late.damper_m_s
    assert gearbox[0.0].non_anticipating_m_s > 1.2 * late.damper_m_s
    assert gearbox[0.0].non_anticipating_m_s <= late.non_anticipating_m_s + 1e-9
    assert late.non_anticipating_m_s <= late.open_loop_m_s
    for found in gearbox.values():
        assert found.clairvoyant_m_s <= found.non_anticipating_m_s


@pytest.mark.parametrize("delay_s", [-0.02, 0.0, 0.048])
def test_the_stem_is_shared_until_the_load_has_told(
    delay_s: float, gearbox: dict[float, Bound]
) -> None:
    found = gearbox[delay_s]
    for case, best in zip(GEARBOX.cases, found.per_load, strict=True):
        limit_s = bounds.plain_push(QUICK, case, GEARBOX.revealed_by)[1] + EXTRA_S
        shooter = Shooter(QUICK, case, limit_s)
        revealed_s = float(shooter.shoot([found.stem]).revealed_s[0])
        free_s = revealed_s + delay_s
        assert best.commands.until(free_s - 1e-9) == found.stem.until(free_s - 1e-9)
        again = shooter.shoot([best.commands])
        assert again.speed_m_s[0] == best.speed_m_s <= found.non_anticipating_m_s
        assert again.time_s[0] <= limit_s


def random_policies(
    family: Family, delay_s: float, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Worst impact of random stems with random endings; and of random sequences, all known."""
    rng = np.random.default_rng(seed)
    shooters = bounds.shooters_of(QUICK, family, EXTRA_S)
    last_s = max(shooter.limit_s for shooter in shooters)

    def some(low_s: float, high_s: float, most: int = 3) -> Commands:
        def instants() -> tuple[float, ...]:
            drawn = rng.uniform(low_s, max(low_s, high_s), int(rng.integers(0, most + 1)))
            return tuple(sorted(map(float, drawn)))

        return Commands(instants(), instants())

    stems = [some(0.0, last_s) if k % 4 else Commands() for k in range(count)]
    worst = np.zeros(count)
    alone = np.zeros(count)
    for shooter in shooters:
        revealed_s = shooter.shoot(stems).revealed_s
        policies = []
        for stem, at_s in zip(stems, revealed_s, strict=True):
            free_s = max(0.0, min(float(at_s), last_s) + delay_s)
            policies.append(stem.until(free_s).then(some(free_s, shooter.limit_s, 2)))
        worst = np.maximum(worst, shooter.shoot(policies).speed_m_s)
        known = [some(0.0, shooter.limit_s) for _ in range(count)]
        alone = np.maximum(alone, shooter.shoot(known).speed_m_s)
    return worst, alone


@pytest.mark.parametrize(
    "delay_s", [0.048, *(pytest.param(d, marks=pytest.mark.slow) for d in (-0.02, 0.0))]
)
def test_no_random_policy_is_below_the_bound_on_the_gearbox(
    delay_s: float, gearbox: dict[float, Bound]
) -> None:
    worst, alone = random_policies(GEARBOX, delay_s, 1000, 11)
    found = gearbox[delay_s]
    assert np.isfinite(worst).sum() > 50
    assert found.non_anticipating_m_s <= np.min(worst)
    assert found.clairvoyant_m_s <= np.min(alone)


@pytest.mark.parametrize(
    "delay_s", [0.01, *(pytest.param(d, marks=pytest.mark.slow) for d in (0.0, 0.048))]
)
def test_no_random_policy_is_below_the_bound_in_the_laboratory(delay_s: float) -> None:
    found = searched(LABORATORY, delay_s)
    worst, alone = random_policies(LABORATORY, delay_s, 1000, 12)
    assert np.isfinite(worst).sum() > 50
    assert found.non_anticipating_m_s <= np.min(worst)
    assert found.clairvoyant_m_s <= np.min(alone)
