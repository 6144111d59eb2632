"""The disturbed bus of the bench: what the intruder may not reach, and that runs repeat."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from tests.support import disturbed_bus


def test_every_scenario_is_in_the_table() -> None:
    assert {path.stem for path in disturbed_bus.SCENARIOS.glob("*.toml")} == set(
        disturbed_bus.NAMES
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", disturbed_bus.NAMES)
def test_no_coil_is_orphaned_and_nothing_forged_is_taken(name: str, tmp_path: Path) -> None:
    loaded = load_scenario.load(str(disturbed_bus.SCENARIOS / f"{name}.toml"))
    finished = runner.run(loaded, tmp_path)
    assert finished.result.complete
    safety = disturbed_bus.safety_of(finished, loaded)
    assert safety["orphan_energised_s"] == 0.0
    taken = sum(c["intruder's taken"] for c in finished.result.bus["end_to_end"].values())
    # A 4-bit counter comes round after 15 or 16 frames: then an old frame looks like the next one.
    assert taken == 0 or name == "replayed_300ms"
    assert run_in_memory(loaded).trace_sha256 == finished.result.trace_sha256


@pytest.mark.slow
def test_drifting_clocks_are_the_same_in_two_processes(tmp_path: Path) -> None:
    loaded = load_scenario.load(str(disturbed_bus.SCENARIOS / "drift.toml"))
    result = runner.run(loaded, tmp_path, transport="local").result
    assert result.trace_sha256 == run_in_memory(loaded).trace_sha256
