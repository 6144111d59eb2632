"""Every strategy's scenario: in its own process on the local bus it gives the same bits."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.strategies import NAMES
from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from tests.support.step_cost import cost

STRATEGIES = [name for name in NAMES if name != "open_loop"]


def test_every_strategy_has_a_scenario() -> None:
    assert {f"strategy_{name}" for name in STRATEGIES} <= set(load_scenario.shipped())


@pytest.mark.slow
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process(name: str, tmp_path: Path) -> None:
    memory = run_in_memory(load_scenario.load(f"strategy_{name}"))
    finished = runner.run(load_scenario.load(f"strategy_{name}"), tmp_path, transport="local")
    assert finished.result.passed
    assert finished.result.scenario["controller"]["strategy"] == name
    assert finished.result.trace_sha256 == memory.trace_sha256


@pytest.mark.vcan
@pytest.mark.parametrize("name", STRATEGIES)
def test_same_bits_in_its_own_process_over_vcan(name: str, tmp_path: Path) -> None:
    """Up to the stop and a little beyond: there the strategy has done all that it does."""
    gearbox = name in ("blow_cut", "synchro_brake", "fixed_programme")
    table, _path = load_scenario.read(f"strategy_{name}")
    table["duration_s"], table["request"] = 0.4 if gearbox else 0.2, table["request"][:1]
    loaded = load_scenario.from_table(table, name)
    memory = run_in_memory(loaded)
    finished = runner.run(loaded, tmp_path, transport="vcan0")
    assert memory.shifts[-1].arrived_s is not None
    assert finished.result.metrics == memory.metrics
    assert finished.result.trace_sha256 == memory.trace_sha256


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "predictive" else n for n in STRATEGIES],
)
def test_a_step_costs_no_more_operations_than_it_says(name: str) -> None:
    """Bounded work: what each strategy's docstring states."""
    stated = {
        "blow_cut": 0,
        "air_cushion": 20,
        "sliding_mode": 20,
        "synchro_brake": 60,
        "fixed_programme": 20,
        "bang_bang": 60_000,
        "predictive": 260_000,
    }
    _median_us, worst_us, counted = cost(name)
    assert 0 <= counted <= stated[name]
    assert counted > 0 or name == "blow_cut"
    assert worst_us > 0.0
