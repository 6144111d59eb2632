"""Policies: the plungers move as the plant's valves do, and nothing is known before it is."""

from __future__ import annotations

import numpy as np
import pytest

from plant.devices.valve import ValveTiming, seconds_to_ns, switch_schedule
from sil.studies.bounds.policy import (
    ANSWER,
    STEM_SIZE,
    SwitchingDelays,
    at_releases,
    commands_of,
    edges_of,
    switches_of,
)

KNOTS_S = (0.07, 0.12, 0.2)
SIZE = STEM_SIZE + 2 * len(KNOTS_S) * sum(ANSWER.values())


def random_policies(count: int) -> np.ndarray:
    values = np.random.default_rng(3).uniform(-1.0, 8.0, (count, SIZE))
    values[:, STEM_SIZE:] *= 0.3
    return values


@pytest.mark.parametrize("fall_s", [0.035, 0.005])
def test_plungers_move_as_those_of_the_plant(fall_s: float) -> None:
    timing, count = SwitchingDelays(0.008, fall_s), 60
    releases_s = np.linspace(0.07, 0.2, count)[:, None]
    edges = edges_of(random_policies(count), KNOTS_S, releases_s, 0.005, timing)
    delays = (np.full((count, 3), each) for each in timing)
    switches = switches_of(edges, *delays)
    valve = ValveTiming(seconds_to_ns(0.008), seconds_to_ns(fall_s), 0.33, 0.35)
    for k, rows in enumerate(switches):
        commands = [(t, "BNF".index(v), duty) for t, v, duty in commands_of(edges, k)]
        expected = [(1e-9 * ns, c, u) for ns, c, u in switch_schedule(commands, valve, 3)]
        np.testing.assert_allclose(rows[np.isfinite(rows[:, 0]), :3], expected, atol=2e-9)


def test_until_the_release_is_known_all_loads_have_the_same_commands() -> None:
    values, timing = random_policies(1), SwitchingDelays(0.008, 0.035)
    edges = edges_of(values, KNOTS_S, np.array([[0.08, 0.15, 0.19]]), 0.048, timing)
    for k, known_s in ((0, 0.128), (1, 0.198)):
        first, last = (commands_of(edges, n) for n in (k, 2))
        assert [c for c in first if c[0] < known_s] == [c for c in last if c[0] < known_s]
    assert commands_of(edges, 0) != commands_of(edges, 1) != commands_of(edges, 2)


def test_an_answer_is_linear_between_knots_and_constant_outside() -> None:
    knots = np.array([[[0.0, 1.0], [2.0, 3.0]]])
    at = at_releases(knots, (0.1, 0.2), np.array([[0.05, 0.125, 0.3]]))
    np.testing.assert_allclose(at, [[[0.0, 1.0], [0.5, 1.5], [2.0, 3.0]]])
