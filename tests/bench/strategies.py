"""What a step of each strategy costs: microseconds here, and arithmetic operations anywhere."""

from __future__ import annotations

from collections.abc import Iterator

from controller.strategies import NAMES
from tests.support.step_cost import cost


def measure() -> Iterator[str]:
    yield "strategy       median us   worst us   operations a step at most"
    for name in NAMES:
        median_us, worst_us, counted = cost(name)
        yield f"{name:14} {median_us:9.1f} {worst_us:10.1f} {counted:12,d}"
