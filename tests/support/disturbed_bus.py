"""Two shifts on a bus that others disturb: the scenarios of `disturbed/`, as a user writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sil.simulation.runner import Finished
from sil.simulation.safety import figures

SCENARIOS = Path(__file__).parent / "disturbed"
NAMES = (
    *[
        "quiet",
        "load_50",
        "load_70",
        "load_90",
        "load_120",
        "babbling",
        "babbling_for_good",
        "bus_off",
    ],
    *["error_frames", "spoofed", "spoofed_at_rest", "replayed", "replayed_300ms", "drift"],
)


def safety_of(finished: Finished, loaded: Any) -> dict[str, float]:
    """The safety figures of a run; all fault bits count, whenever they were reported."""
    assert finished.record is not None
    return figures(finished.record, loaded.scenario)
