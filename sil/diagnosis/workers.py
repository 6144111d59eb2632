"""Independent pieces of work on a few processes, results in order, the same on any number of them.

Checked by: tests/unit/sil/diagnosis/test_workers.py
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_WORK: list[Callable[[Any], Any]] = []


def _call(item: Any) -> Any:
    return _WORK[-1](item)


def spread_out(work: Callable[[Item], Answer], items: Sequence[Item], workers: int) -> list[Answer]:
    """work(item) of every item; in `workers` forked processes if that is more than one.

    The work may hold anything (it is inherited by the fork); items and answers are pickled.
    """
    if workers <= 1 or len(items) <= 1:
        return [work(item) for item in items]
    _WORK.append(work)
    try:
        context = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(min(workers, len(items)), mp_context=context) as pool:
            return list(pool.map(_call, items))
    finally:
        _WORK.pop()
