"""The bounds: their search on known answers, and no random controller below them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from plant.parameters import load as load_parameters
from sil.whatif import bounds
from sil.whatif.bounds import LOADS, Arrival, Best, Commands, Shooter

PARAMETERS = load_parameters("nominal")
LAB = LOADS[0]
EXTRA_S = 0.034
"""What the oil damper costs in the laboratory."""


def open_loop(case: bounds.LoadCase) -> Arrival:
    return Shooter(PARAMETERS, case, 1.0).arrival(Commands())


def test_commands_alternate_from_driving_on_and_neutral_off() -> None:
    commands = Commands((0.01, 0.02), (0.005, 0.03))
    assert [(w, t, d > 0.5) for t, w, d in commands.rows()] == [
        ("B", 0.0, True),
        ("N", 0.005, True),
        ("B", 0.01, False),
        ("B", 0.02, True),
        ("N", 0.03, False),
    ]
    assert commands.switches == 4
    assert commands.until(0.01) == Commands((0.01,), (0.005,))


def test_patterns_are_all_up_to_six_changes() -> None:
    found = list(bounds.patterns(6))
    assert len(found) == len(set(found)) == 28
    assert max(a + b for a, b in found) == 6


@pytest.mark.parametrize("pattern", [(0, 0), (1, 0), (1, 1), (3, 3)])
def test_coarse_sequences_are_ordered_and_within_their_span(pattern: tuple[int, int]) -> None:
    found = list(bounds.coarse(pattern, 0.01, 0.05, 100, np.random.default_rng(1)))
    assert 1 <= len(found) <= 100
    for commands in found:
        assert (len(commands.driving_s), len(commands.braking_s)) == pattern
        for times in (commands.driving_s, commands.braking_s):
            assert list(times) == sorted(times)
            assert all(0.01 <= t <= 0.05 for t in times)


def test_refinement_finds_the_lowest_point_of_a_known_function() -> None:
    class Bowl(Shooter):
        def arrival(self, commands: Commands) -> Arrival:
            self.runs += 1
            (a,), (b,) = commands.driving_s, commands.braking_s
            return Arrival(1.0 + (100.0 * (a - 0.013)) ** 2 + (100.0 * (b - 0.027)) ** 2, 0.05)

    start = Commands((0.03,), (0.01,))
    bowl = Bowl(PARAMETERS, LAB, 0.1)
    best = bounds.refine(bowl, Best(start, bowl.arrival(start), 1), 0.0, 0.01, 1e-5)
    assert best.commands.driving_s[0] == pytest.approx(0.013, abs=2e-5)
    assert best.commands.braking_s[0] == pytest.approx(0.027, abs=2e-5)
    assert best.arrival.speed_m_s == pytest.approx(1.0, abs=1e-5)


def test_without_changes_the_arrival_is_the_open_loop_s() -> None:
    arrival = open_loop(LAB)
    assert arrival.speed_m_s == pytest.approx(0.9412, abs=1e-3)
    assert arrival.time_s == pytest.approx(0.04075, abs=1e-4)
    assert Shooter(PARAMETERS, LAB, 0.03).arrival(Commands()).speed_m_s == math.inf


@pytest.fixture(scope="module")
def lab() -> Best:
    return bounds.clairvoyant(
        PARAMETERS, LAB, open_loop(LAB).time_s + EXTRA_S, most_switches=4, budget=60
    )


def test_with_everything_known_the_lab_stop_is_softer_than_the_damper_s(lab: Best) -> None:
    assert lab.arrival.speed_m_s < 0.18
    assert lab.arrival.time_s <= open_loop(LAB).time_s + EXTRA_S
    assert lab.commands.switches <= 4
    again = Shooter(PARAMETERS, LAB, 0.2).arrival(lab.commands)
    assert again.speed_m_s == pytest.approx(lab.arrival.speed_m_s, rel=1e-6)


def test_no_random_sequence_is_below_the_clairvoyant_bound(lab: Best) -> None:
    rng = np.random.default_rng(7)
    shooter = Shooter(PARAMETERS, LAB, open_loop(LAB).time_s + EXTRA_S)
    softest = math.inf
    for _ in range(1000):
        d, b = (int(k) for k in rng.integers(0, 4, size=2))
        commands = Commands(
            tuple(sorted(float(t) for t in rng.uniform(0.0, shooter.until_s, d))),
            tuple(sorted(float(t) for t in rng.uniform(0.0, shooter.until_s, b))),
        )
        softest = min(softest, shooter.arrival(commands).speed_m_s)
    assert lab.arrival.speed_m_s <= softest < 0.9


def test_late_information_leaves_the_worst_case_near_the_open_loop() -> None:
    """With 48 ms the lab's stop is over before anything is known; with none it need not be hit."""
    cases = (LOADS[0], LOADS[3])
    line = bounds.line_over_delay(
        PARAMETERS, cases, (0.0, 0.048), EXTRA_S, levels=3, budget=8, most_switches=3
    )
    (early_s, early_m_s), (late_s, late_m_s) = line
    assert (early_s, late_s) == (0.0, 0.048)
    assert early_m_s < late_m_s <= max(open_loop(case).speed_m_s for case in cases)


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.048])
def test_no_random_policy_is_below_the_bound_for_late_information(delay_s: float) -> None:
    """Random shared beginnings; after the reveal each load's commands may differ."""
    cases = (LOADS[0], LOADS[3])
    shared = bounds.non_anticipating(
        PARAMETERS, cases, delay_s, EXTRA_S, levels=5, budget=20, most_switches=4
    )
    shooters = [Shooter(PARAMETERS, c, open_loop(c).time_s + EXTRA_S) for c in cases]
    rng = np.random.default_rng(11)

    def some(low_s: float, high_s: float) -> tuple[float, ...]:
        drawn = rng.uniform(low_s, high_s, int(rng.integers(0, 3)))
        return tuple(sorted(float(t) for t in drawn))

    softest = math.inf
    for _ in range(1000):
        prefix = Commands(some(0.0, shared.revealed_s), some(0.0, shared.revealed_s))
        worst_m_s = 0.0
        for shooter in shooters:
            low_s, high_s = shared.revealed_s, max(shared.revealed_s, shooter.until_s)
            commands = Commands(
                prefix.driving_s + some(low_s, high_s), prefix.braking_s + some(low_s, high_s)
            )
            worst_m_s = max(worst_m_s, shooter.arrival(commands).speed_m_s)
        softest = min(softest, worst_m_s)
    assert shared.worst_m_s <= softest < math.inf


def test_a_shared_beginning_is_kept_by_every_load() -> None:
    shared = bounds.non_anticipating(
        PARAMETERS, LOADS[:2], 0.0, EXTRA_S, levels=2, budget=6, most_switches=3
    )
    assert shared.revealed_s == pytest.approx(0.0195, abs=0.002)
    for best in shared.per_load:
        assert best.commands.until(shared.revealed_s) == shared.prefix.until(shared.revealed_s)
    assert shared.worst_m_s == max(best.arrival.speed_m_s for best in shared.per_load)
