"""Filters of a log: by time, identifier, parameter group and channel."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain

from can_dbc.errors import InputError
from can_dbc.frame import MAX_ID, split_id
from sil.logs.frame import MAX_STANDARD_ID, MAX_TIME_NS, LogFrame
from sil.logs.times import RELATIVE_BELOW_NS, parse_decimal_ns, utc_ns


@dataclass(frozen=True)
class Selection:
    """Which frames of a log are used; the empty one takes all.

    since_ns, until_ns: first and last time, from 1970 if after 1979, else from the log's first frame.
    ids: identifiers, each with whether it is extended; pgns: J1939 parameter groups; a frame has to be
    of one of the two. channels: names or numbers.
    """

    since_ns: int | None = None
    until_ns: int | None = None
    ids: frozenset[tuple[int, bool]] = frozenset()
    pgns: frozenset[int] = frozenset()
    channels: frozenset[str] = frozenset()

    @classmethod
    def parse(
        cls,
        *,
        since: str | None = None,
        until: str | None = None,
        ids: Sequence[str] = (),
        pgns: Sequence[str] = (),
        channels: Sequence[str] = (),
    ) -> Selection:
        """Return the selection of a command line: hex identifiers, several with commas between.

        Raises InputError that names the option.
        """
        since_ns = None if since is None else _time("--since", since)
        until_ns = None if until is None else _time("--until", until)
        if since_ns is not None and until_ns is not None:
            alike = (since_ns < RELATIVE_BELOW_NS) == (until_ns < RELATIVE_BELOW_NS)
            if alike and until_ns < since_ns:
                raise InputError(f"--until: {until}; expected a time after --since, {since}")
        return cls(
            since_ns,
            until_ns,
            frozenset(_identifier(word) for word in _words(ids)),
            frozenset(_group(word) for word in _words(pgns)),
            frozenset(_words(channels)),
        )

    def __bool__(self) -> bool:
        return self != Selection()

    def select(self, blocks: Iterator[list[LogFrame]]) -> Iterator[list[LogFrame]]:
        """Yield what the selection has of each block, in order.

        Raises InputError for a date if the log's times are not absolute.
        """
        first = next(blocks, None)
        if not first:
            return
        low_ns = self._bound(self.since_ns, first[0].time_ns, -MAX_TIME_NS)
        high_ns = self._bound(self.until_ns, first[0].time_ns, MAX_TIME_NS)
        timed = self.since_ns is not None or self.until_ns is not None
        for frames in chain((first,), blocks):
            if timed:
                frames = [frame for frame in frames if low_ns <= frame[0] <= high_ns]
            if self.channels:
                frames = [frame for frame in frames if frame[9] in self.channels]
            if self.ids or self.pgns:
                keys = {(frame[1], frame[3]) for frame in frames}
                by_pgn = {key for key in keys if key[1] and split_id(key[0]).pgn in self.pgns}
                wanted = by_pgn | (keys & self.ids)
                frames = [f for f in frames if (f[1], f[3]) in wanted and not f[5]]
            yield frames

    def _bound(self, bound_ns: int | None, first_ns: int, default_ns: int) -> int:
        if bound_ns is None:
            return default_ns
        if bound_ns < RELATIVE_BELOW_NS:
            return first_ns + bound_ns
        if first_ns < RELATIVE_BELOW_NS:
            raise InputError(
                "--since, --until: a date, but the times of the log count from its start; "
                "expected seconds from its first frame"
            )
        return bound_ns


def _words(texts: Sequence[str]) -> list[str]:
    return [word.strip() for text in texts for word in text.split(",")]


def _time(option: str, text: str) -> int:
    with suppress(ValueError):
        return parse_decimal_ns(text)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f"{option}: {text[:40]!r}; expected seconds from the first frame or from 1970, or a date "
            "such as 2026-01-31T12:00:00 (UTC)"
        ) from None
    moment = moment.replace(tzinfo=moment.tzinfo or UTC).astimezone(UTC)
    return utc_ns(*moment.timetuple()[:6], moment.microsecond * 1000)


def _identifier(text: str) -> tuple[int, bool]:
    match = re.match(r"(?:0x)?([0-9A-Fa-f]{1,8})\Z", text)
    if match is None or int(match[1], 16) > (MAX_STANDARD_ID if len(match[1]) < 4 else MAX_ID):
        raise InputError(
            f"--id: {text[:40]!r}; expected hex, up to 3 digits of a standard identifier, 4 to 8 of an "
            "extended one"
        )
    return int(match[1], 16), len(match[1]) > 3


def _group(text: str) -> int:
    try:
        group = int(text, 0)
    except ValueError:
        group = -1
    if not 0 <= group <= 0x3FFFF:
        raise InputError(f"--pgn: {text[:40]!r}; expected a parameter group, 61442 or 0xF002")
    return group
