"""Independent pieces of work on a few processes, results in order, the same on any number of them.

Checked by: tests/unit/sil/inference/test_workers.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sil.files.worker import Answer, Item, in_processes
from sil.inference.fit import Fitter, Refusals, Show, no_progress


class Stages:
    """Progress over stages of unlike length, each with a share of the whole."""

    def __init__(self, show: Show) -> None:
        """`show(done, size)` is called with a size of 100."""
        self._show = show
        self._begin = self._end = 0.0

    def until(self, percent: float) -> Show:
        """Begin the stage that ends at a percentage of the whole, and return its progress; a stage done again shows none."""
        self._begin, self._end = self._end, max(self._end, percent)
        self(0.0, 1.0)
        return self

    def __call__(self, done: float, size: float) -> None:
        """Show that `done` of `size` of the stage is done."""
        share = done / size if size > 0.0 else 1.0
        self._show(round(self._begin + (self._end - self._begin) * share), 100)


def spread_out(
    work: Callable[[Item], Answer],
    items: Sequence[Item],
    workers: int,
    progress: Show = no_progress,
) -> list[Answer]:
    """Return work(item) of every item; raises RunError if one of the forked processes dies, if `workers` are more than one."""
    answers: list[Answer] = []
    number = min(workers, len(items))
    for answer in in_processes(work, items, number) if number > 1 else map(work, items):
        answers.append(answer)
        progress(len(answers), len(items))
    return answers


def fitted(
    fitter: Fitter,
    work: Callable[[Item], Answer],
    items: Sequence[Item],
    workers: int,
    progress: Show = no_progress,
) -> list[Answer]:
    """Return what `spread_out` does of work with a fitter, whose refusals of all processes are joined."""

    def counted(item: Item) -> tuple[Answer, Refusals]:
        before, fitter.refusals = fitter.refusals, Refusals()
        try:
            return work(item), fitter.refusals
        finally:
            fitter.refusals = before

    answers = spread_out(counted, items, workers, progress)
    for _answer, refusals in answers:
        fitter.refusals.join(refusals)
    return [answer for answer, _refusals in answers]
