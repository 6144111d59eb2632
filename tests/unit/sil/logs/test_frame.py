"""The frame record and what is possible on a bus."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_writer
from sil.logs.frame import DLC_LENGTHS, all_ordinary, frame_problem, ordinary_frame


def test_length_codes_of_the_standard() -> None:
    assert DLC_LENGTHS == (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
    for length in range(65):
        code = LogFrame(0, 0, bytes(length), fd=True).dlc
        assert DLC_LENGTHS[code] == min(each for each in DLC_LENGTHS if each >= length)


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (LogFrame(0, 1, b""), 0),
        (LogFrame(0, 1, bytes(8)), 8),
        (LogFrame(0, 1, bytes(8), raw_dlc=13), 13),
        (LogFrame(0, 1, bytes(12), fd=True), 9),
        (LogFrame(0, 1, bytes(64), fd=True), 15),
        (LogFrame(0, 1, b"", remote=True, raw_dlc=5), 5),
        (LogFrame(0, 1, b"", remote=True), 0),
    ],
)
def test_length_code_on_the_wire(frame: LogFrame, code: int) -> None:
    assert frame.dlc == code
    assert frame_problem(frame) is None


frames = st.builds(
    LogFrame,
    st.integers(-(2**64), 2**64),
    st.integers(-5, 2**29 + 5) | st.integers(0x7F0, 0x810),
    st.binary(max_size=10) | st.binary(min_size=60, max_size=66),
    *[st.booleans()] * 6,
    st.sampled_from(("", "can0", "a b", "ä")),
    st.sampled_from(("", "Rx", "Tx", "up")),
    st.integers(-1, 17),
)


@settings(deadline=None)
@given(st.lists(frames, min_size=1, max_size=4))
def test_the_quick_look_is_never_wrong(found: list[LogFrame]) -> None:
    if all_ordinary(found, {"", "can0"}):
        assert all(frame_problem(frame) is None for frame in found)


def test_the_quick_look_knows_the_ordinary() -> None:
    found = [
        LogFrame(0, 0x7FF, b"", False, channel="can0", direction="Rx"),
        LogFrame(2**63 - 1, 0x1FFFFFFF, bytes(8), direction="Tx"),
    ]
    assert all_ordinary(found, {"", "can0"})
    assert not all_ordinary(found, {""})
    assert not all_ordinary([found[0]._replace(can_id=0x800)], {"can0"})


def test_ordinary_frame_is_the_same_record() -> None:
    quick = ordinary_frame(5, 0x123, b"\x01", False, "can0", "Rx")
    assert quick == LogFrame(5, 0x123, b"\x01", False, channel="can0", direction="Rx")
    assert type(quick) is LogFrame


def test_refusal_names_the_place(tmp_path: Path) -> None:
    path = str(tmp_path / "a.asc")
    with (
        pytest.raises(
            InputError, match=r"a.asc: frame 1: standard identifier 0x800 .*; expected a CAN"
        ),
        open_writer(path) as writer,
    ):
        writer.write(LogFrame(0, 0x800, b"", False))
