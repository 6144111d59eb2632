"""Progress lines: late, rare, and none when not wanted."""

from __future__ import annotations

import io
import sys

import pytest

from sil.files import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "_silent", False)  # whatever command has run here with --quiet
    return now


def shown(clock: list[float], stream: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.Progress("rows") as report:
        for second in range(30):
            clock[0] = 100.0 + second
            report(second, 40)
    return stream.getvalue()


def test_a_line_after_two_seconds_and_then_every_ten(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = shown(clock, io.StringIO(), monkeypatch).splitlines()
    assert lines == [
        "rows: 5 % (2 of 40), 1/s, 38 s left",
        "rows: 30 % (12 of 40), 1/s, 28 s left",
        "rows: 55 % (22 of 40), 1/s, 18 s left",
    ]


def test_a_bar_on_a_terminal_that_is_removed_at_the_end(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = shown(clock, Terminal(), monkeypatch)
    bars = text.split("\r")
    assert "\n" not in text and len(bars) == 31
    assert bars[-3].startswith("[######################........] rows: 72 %") and bars[-1] == ""


def test_none_of_quick_work_and_none_when_silent(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.Progress("rows") as report:
        report(1, 2)
    assert stream.getvalue() == ""
    progress.silence()
    assert shown(clock, io.StringIO(), monkeypatch) == ""
