"""Every strategy's scenario: in its own process on the local bus it gives the same bits."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.strategies import NAMES
from sil import cosim, scenario

STRATEGIES = [name for name in NAMES if name != "open_loop"]


def test_every_strategy_has_a_scenario() -> None:
    assert {f"strategy_{name}" for name in STRATEGIES} <= set(scenario.shipped())


@pytest.mark.slow
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process(name: str, tmp_path: Path) -> None:
    hashes = []
    for transport in ("inproc", "local"):
        folder = tmp_path / transport
        folder.mkdir()
        finished = cosim.run(scenario.load(f"strategy_{name}"), folder, transport=transport)
        assert finished.result.passed
        assert finished.result.scenario["controller"]["strategy"] == name
        hashes.append(finished.result.trace_sha256)
    assert hashes[0] == hashes[1]
