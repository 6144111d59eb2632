"""Texts out of a log, as a message shows them."""

from __future__ import annotations

import pytest

from sil.logs.report import Location, LogReport, printable


@pytest.mark.parametrize("text", ["can0 zwölf", "größe", "ß", "plain", "日本"])
def test_utf8_read_as_latin1_is_shown_as_utf8(text: str) -> None:
    read = text.encode().decode("latin-1")
    assert printable(read) == text
    assert str(Location(f"{read!r} is no line", line=3)) == f"line 3: '{text}' is no line"


def test_latin1_stays_and_control_characters_do_not() -> None:
    assert printable("zw\xf6lf\x07") == "zwölf?"


def test_what_is_not_whole_is_said_in_one_line() -> None:
    report = LogReport("a.log", "candump", frames=3)
    assert report.clean and report.faults == ""
    report.skip(Location("no frame", line=7))
    report.skip(Location("no frame", line=8))
    report.note("a remark")
    report.cut(Location("half a line", line=9))
    cut = "cut off at line 9: half a line"
    assert report.faults == f"{cut}; broken and skipped: 2, the first line 7: no frame"
    assert cut in LogReport.joined([report, report]).faults
