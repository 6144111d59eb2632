"""What a step of a strategy costs: microseconds here, and arithmetic operations anywhere."""

from __future__ import annotations

import dis
import statistics
import sys
import time
from collections.abc import Iterator
from types import CodeType, FrameType
from typing import Any

from controller.strategies import NAMES, Strategy, strategy_class
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load

ARITHMETIC = frozenset(("BINARY_OP", "UNARY_NEGATIVE", "COMPARE_OP"))
MOST_COUNTED = 1_500_000
"""Operations after which no more steps are counted: it takes long; the greatest step counts."""


def operations(call: Any, *arguments: Any) -> tuple[Any, int]:
    """The answer of a call, and operations and comparisons executed in controller/ (roots: none)."""
    counted = 0
    wanted: dict[CodeType, frozenset[int]] = {}

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal counted
        code = frame.f_code
        if event == "call":
            if "/controller/" not in code.co_filename:
                return None
            frame.f_trace_opcodes = True
            frame.f_trace_lines = False
            if code not in wanted:
                wanted[code] = frozenset(
                    item.offset for item in dis.get_instructions(code) if item.opname in ARITHMETIC
                )
        elif event == "opcode" and frame.f_lasti in wanted[code]:
            counted += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        answer = call(*arguments)
    finally:
        sys.settrace(before)
    return answer, counted


def cost(name: str) -> tuple[float, float, int]:
    """Median and greatest microseconds of a step of a push, and its greatest count of operations."""
    kind: type[Strategy] = strategy_class(name)
    plain = kind.command
    spent_s: list[float] = []
    counts: list[int] = []
    scenario = load("lab_n_b" if name == "open_loop" else f"strategy_{name}")

    def timed(self: Strategy, *arguments: Any) -> Any:
        begin = time.perf_counter()
        answer = plain(self, *arguments)
        spent_s.append(time.perf_counter() - begin)
        return answer

    def counting(self: Strategy, *arguments: Any) -> Any:
        if sum(counts) >= MOST_COUNTED:
            return plain(self, *arguments)
        answer, counted = operations(plain, self, *arguments)
        counts.append(counted)
        return answer

    try:
        for wrapper in (timed, counting):
            setattr(kind, "command", wrapper)  # noqa: B010
            run_in_memory(scenario)
    finally:
        setattr(kind, "command", plain)  # noqa: B010
    return 1e6 * statistics.median(spent_s), 1e6 * max(spent_s), max(counts)


def measure() -> Iterator[str]:
    """Yield a line for each strategy."""
    yield "strategy       median us   worst us   operations a step at most"
    for name in NAMES:
        median_us, worst_us, counted = cost(name)
        yield f"{name:14} {median_us:9.1f} {worst_us:10.1f} {counted:12,d}"
