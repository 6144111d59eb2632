"""Candump chunks that hold nothing but common lines, taken apart column by column.

`(1436509052.249713) can0 18FEF100#FFFF7D06FFFFFFFF R`, every line of a chunk with as many decimals
and with or without a direction: so are nearly all chunks of nearly all logs. Marks are made words
of their own, the chunk is split once, and each mark's column has to hold nothing but the mark; then
whole columns are converted. It gives the same frames as `candump_line`, three times faster.
"""

from __future__ import annotations

import re
from itertools import repeat
from operator import add
from typing import Final

from sil.logs.frame import MOST_KNOWN_IDS, LogFrame
from sil.logs.times import NS_PER_S

_IDENTIFIER: Final = re.compile(r"[01][0-9A-Fa-f]{7}\Z|[0-7][0-9A-Fa-f]{2}\Z")
_CHANNEL: Final = re.compile(r"[!-~]{1,64}\Z")
_DATA_LENGTHS: Final = frozenset(range(0, 17, 2))
_MOST_SECONDS: Final = 9_223_372_035
_DIRECTIONS: Final = {"R": "Rx", "T": "Tx"}


class PlainChunks:
    """Reads such chunks; keeps identifiers that were met before.

    Checked by: tests/unit/sil/logs/test_candump.py.
    """

    def __init__(self) -> None:
        self._ids: dict[str, int] = {}
        self._extended: dict[str, bool] = {}

    def frames(self, text: str, count: int) -> list[LogFrame] | None:
        """The frames of `count` lines of text, None when one of them is not a common line."""
        if "\r" in text:
            text = text.replace("\r\n", "\n")
        first = text[: text.find("\n")]
        directed = first.endswith((" R", " T"))
        words = _words(text, count, first, 10 if directed else 9)
        if words is None:
            return None
        step = 10 if directed else 9
        seconds = self._seconds(words[1::step])
        fractions = words[3::step]
        digits = words[6::step]
        data = words[8::step]
        channels = words[5::step]
        ways = words[9::step] if directed else None
        sound = (
            seconds is not None
            and set(map(len, fractions)) == {9}
            and "".join(fractions).isdigit()
            and _DATA_LENGTHS.issuperset(map(len, data))
            and all(map(_CHANNEL.match, set(channels)))
            and self._learn(set(digits))
            and (ways is None or _DIRECTIONS.keys() >= set(ways))
        )
        if not sound or seconds is None:
            return None
        try:
            payloads = list(map(bytes.fromhex, data))
        except ValueError:
            return None
        times_ns = map(add, map(seconds.__getitem__, words[1::step]), map(int, fractions))
        no = repeat(False)
        rows = zip(
            times_ns,
            map(self._ids.__getitem__, digits),
            payloads,
            map(self._extended.__getitem__, digits),
            *(no, no, no, no, no),
            channels,
            repeat("") if ways is None else map(_DIRECTIONS.__getitem__, ways),
            repeat(0),
            strict=False,
        )
        return list(map(tuple.__new__, repeat(LogFrame), rows))

    def _seconds(self, words: list[str]) -> dict[str, int] | None:
        """Nanoseconds of each number of seconds, None when one is no such number."""
        found = {}
        for word in set(words):
            if not (word.isdigit() and len(word) <= 10 and int(word) <= _MOST_SECONDS):
                return None
            found[word] = int(word) * NS_PER_S
        return found

    def _learn(self, digits: set[str]) -> bool:
        """Know the numbers of identifiers; False when one is none that a data frame can have."""
        new = digits - self._ids.keys()
        if not all(map(_IDENTIFIER.match, new)):
            return False
        if len(self._ids) > MOST_KNOWN_IDS:
            self._ids.clear()
            self._extended.clear()
            new = digits
        for word in new:
            self._ids[word] = int(word, 16)
            self._extended[word] = len(word) == 8
        return True


def _words(text: str, count: int, first: str, step: int) -> list[str] | None:
    """The words of the lines, `step` of each, or None when the marks stand elsewhere.

    The words are ( seconds . fraction ) channel identifier # data and, of ten, the direction.
    """
    point, closing = first.find("."), first.find(") ")
    if closing - point == 7:
        padding = "000 ) "
    elif closing - point == 10:
        padding = " ) "
    else:
        return None
    if first[:1] != "(":
        return None
    text = "( " + text[1:-1].replace("\n(", " ( ").replace(") ", padding)
    if not (text.isascii() and text.isprintable()):
        return None
    text = text.replace(".", " . ").replace("#", " # ")
    words = text.split(" ")
    if len(words) != step * count:
        return None
    marks = (("(", 0), (".", 2), (")", 4), ("#", 7))
    if all(words[at::step].count(mark) == count for mark, at in marks):
        return words
    return None
