"""The same answers on any number of processes."""

from __future__ import annotations

from sil.diagnosis.workers import spread_out


def test_answers_keep_their_order_and_do_not_depend_on_the_workers() -> None:
    offset, items = 3, list(range(17))

    def work(item: int) -> int:
        return item * item + offset

    alone = spread_out(work, items, 1)
    assert alone == [k * k + 3 for k in items]
    assert spread_out(work, items, 2) == alone
    assert spread_out(work, [], 2) == []
