"""Filters of a log by time, identifier, parameter group and channel."""

from __future__ import annotations

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, Selection

S = 10**9
START_NS = 1_600_000_000 * S
FRAMES = [
    LogFrame(START_NS, 0x18F00503, bytes(8), channel="can0"),
    LogFrame(START_NS + S, 0x123, b"", False, channel="can0"),
    LogFrame(START_NS + 2 * S, 0x123, b"", True, channel="can1"),
    LogFrame(START_NS + 3 * S, 0x0CF00203, bytes(8), channel="can1"),
    LogFrame(START_NS + 4 * S, 0x123, b"", False, error=True, channel="can1"),
]


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({}, [0, 1, 2, 3, 4]),
        ({"since": "1"}, [1, 2, 3, 4]),
        ({"since": "1.5", "until": "3"}, [2, 3]),
        ({"until": "2020-09-13T12:26:41"}, [0, 1]),
        ({"until": "2020-09-13T14:26:41+02:00"}, [0, 1]),
        ({"since": "1600000003"}, [3, 4]),
        ({"ids": ["123"]}, [1]),
        ({"ids": ["00000123"]}, [2]),
        ({"ids": ["123,0x18F00503"]}, [0, 1]),
        ({"pgns": ["61442", "0xF005"]}, [0, 3]),
        ({"pgns": ["61442"], "ids": ["123"]}, [1, 3]),
        ({"channels": ["can1"]}, [2, 3, 4]),
        ({"channels": ["can1"], "pgns": ["61442"]}, [3]),
    ],
)
def test_what_is_selected(options: dict[str, str], found: list[int]) -> None:
    selection = Selection.parse(**options)  # type: ignore[arg-type]
    blocks = selection.select(iter([FRAMES[:2], FRAMES[2:]]))
    assert [frame for block in blocks for frame in block] == [FRAMES[n] for n in found]
    assert bool(selection) is bool(options)
    assert list(selection.select(iter(()))) == []


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"since": "soon"}, "--since: 'soon'; expected seconds"),
        ({"until": "2020-13-01"}, "--until: '2020-13-01'; expected"),
        ({"ids": ["zz"]}, "--id: 'zz'; expected hex"),
        ({"ids": ["FFF"]}, "--id: 'FFF'"),
        ({"pgns": ["ETC1"]}, "--pgn: 'ETC1'; expected a parameter group"),
        ({"pgns": ["0x40000"]}, "--pgn"),
    ],
)
def test_bad_filters_are_refused(options: dict[str, str], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Selection.parse(**options)  # type: ignore[arg-type]


def test_a_date_needs_a_log_with_dates() -> None:
    relative = [frame._replace(time_ns=frame.time_ns - START_NS) for frame in FRAMES]
    with pytest.raises(InputError, match="a date, but the times of the log count from its start"):
        list(Selection.parse(since="2020-01-01").select(iter([relative])))


def test_an_end_before_the_beginning_is_refused() -> None:
    with pytest.raises(InputError, match="--until: 1; expected a time after --since, 2"):
        Selection.parse(since="2", until="1")
