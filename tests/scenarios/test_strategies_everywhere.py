"""Every strategy's scenario: in its own process on the local bus it gives the same bits."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.strategies import NAMES
from sil import cosim, scenario
from sil.bench.strategies import cost

STRATEGIES = [name for name in NAMES if name != "open_loop"]


def test_every_strategy_has_a_scenario() -> None:
    assert {f"strategy_{name}" for name in STRATEGIES} <= set(scenario.shipped())


TRANSPORTS = [
    pytest.param("local", marks=pytest.mark.slow),
    pytest.param("vcan0", marks=pytest.mark.vcan),
]


@pytest.mark.parametrize("elsewhere", TRANSPORTS)
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process(name: str, elsewhere: str, tmp_path: Path) -> None:
    hashes = []
    for transport in ("inproc", elsewhere):
        folder = tmp_path / transport
        folder.mkdir()
        finished = cosim.run(scenario.load(f"strategy_{name}"), folder, transport=transport)
        assert finished.result.passed
        assert finished.result.scenario["controller"]["strategy"] == name
        hashes.append(finished.result.trace_sha256)
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_step_costs_no_more_operations_than_it_says(name: str) -> None:
    """Bounded work: what each strategy's docstring states."""
    stated = {"blow_cut": 0, "air_cushion": 20, "sliding_mode": 20, "bang_bang": 60_000}
    _median_us, worst_us, counted = cost(name)
    assert 0 <= counted <= stated.get(name, 260_000)
    assert counted > 0 or name == "blow_cut"
    assert worst_us > 0.0
