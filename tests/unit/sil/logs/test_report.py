"""Texts out of a log, as a message shows them."""

from __future__ import annotations

import pytest

from sil.logs.report import Location, printable


@pytest.mark.parametrize("text", ["can0 zwölf", "größe", "ß", "plain", "日本"])
def test_utf8_read_as_latin1_is_shown_as_utf8(text: str) -> None:
    read = text.encode().decode("latin-1")
    assert printable(read) == text
    assert str(Location(f"{read!r} is no line", line=3)) == f"line 3: '{text}' is no line"


def test_latin1_stays_and_control_characters_do_not() -> None:
    assert printable("zw\xf6lf\x07") == "zwölf?"
