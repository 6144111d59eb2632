"""The same answers on any number of processes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from can_dbc.errors import RunError
from sil.inference.workers import spread_out
from tests.conftest import ROOT

WAITING = """
import os, time
from sil.inference.workers import spread_out

def work(item):
    os.write(1, b"%d\\n" % os.getpid())
    time.sleep(600.0)

spread_out(work, [0, 1], 2)
"""


def test_answers_keep_their_order_and_do_not_depend_on_the_workers() -> None:
    offset, items = 3, list(range(17))

    def work(item: int) -> int:
        return item * item + offset

    alone = spread_out(work, items, 1)
    assert alone == [k * k + 3 for k in items]
    assert spread_out(work, items, 2) == alone
    assert spread_out(work, [], 2) == []


def test_the_death_of_a_worker_is_an_error_in_one_line() -> None:
    with pytest.raises(RunError, match=r"\Aa worker process died\Z"):
        spread_out(lambda _item: os._exit(1), [0, 1], 2)


def test_workers_end_when_their_parent_is_killed() -> None:
    command = [sys.executable, "-c", WAITING]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        try:
            pids = [int(parent.stdout.readline()) for _ in range(2)]
        finally:
            parent.kill()
        assert len({*pids, parent.pid}) == 3
        # ends when no worker holds the pipe any more
        assert parent.communicate(timeout=60.0) == ("", None)
