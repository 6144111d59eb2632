"""Detectability and isolability against hand cases and a brute-force definition."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sil.inference.campaign.structure import analyse, equations, overdetermined


def generic_rank(graph: dict[str, frozenset[str]]) -> int:
    """Largest matching, by the rank of a random matrix of that structure."""
    unknowns = sorted(set().union(*graph.values())) if graph else []
    generator = np.random.default_rng(3)
    matrix = np.zeros((len(graph), len(unknowns)))
    for i, name in enumerate(sorted(graph)):
        for unknown in graph[name]:
            matrix[i, unknowns.index(unknown)] = generator.uniform(1.0, 2.0)
    return int(np.linalg.matrix_rank(matrix)) if graph else 0


def by_definition(graph: dict[str, frozenset[str]]) -> frozenset[str]:
    """An equation is in the overdetermined part if removing it leaves the generic rank as it is."""
    whole = generic_rank(graph)
    return frozenset(
        name
        for name in graph
        if generic_rank({k: v for k, v in graph.items() if k != name}) == whole
    )


CHANNELS = ("position", "driving", "passive", "oil", "internal")


@pytest.mark.parametrize("count", range(len(CHANNELS) + 1))
@pytest.mark.parametrize("damper", [False, True])
def test_overdetermined_part_is_what_the_definition_says(count: int, damper: bool) -> None:
    for chosen in combinations(CHANNELS, count):
        graph = equations(chosen, damper)
        assert overdetermined(graph) == by_definition(graph)


def test_position_alone_tells_nothing_apart() -> None:
    structure = analyse(["position"], False)
    groups = structure.groups()
    assert len(groups) == 1 and len(groups[0]) == len(structure.detectable)
    assert "no two can be distinguished" in structure.sentence()


def test_more_channels_never_isolate_less() -> None:
    few = analyse(["position"], False)
    more = analyse(["position", "driving"], False)
    full = analyse(["position", "driving", "passive"], False)
    assert few.isolable <= more.isolable <= full.isolable
    assert len(few.isolable) < len(more.isolable) < len(full.isolable)
    assert ("force", "passive chamber") in full.isolable
