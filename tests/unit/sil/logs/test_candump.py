"""Every form of candump output, and the two ways of reading a common line agree."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_log, open_writer
from sil.logs.candump import look_like_deltas, parse_line, plain_frames, recognise
from sil.logs.format import NotAFrame
from sil.logs.frame import frame_problem
from tests.support.golden_logs import log_of, write

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"
START_S = 1_436_509_052


def frame(time_us: int, can_id: int, data: str, **other: object) -> LogFrame:
    plain = LogFrame(time_us * 1000, can_id, bytes.fromhex(data), False, channel="can0")
    return plain._replace(**other)


def at(microseconds: int) -> int:
    return START_S * 10**6 + microseconds


LOG_FORM = [
    frame(at(249713), 0x44, "2A366C2B"),
    frame(at(249900), 0x18FEF100, "FFFF7D06FFFFFFFF", extended=True),
    frame(at(250100), 0x123, "", remote=True, raw_dlc=5, channel="vcan1"),
    frame(at(250200), 0x123, "", remote=True),
    frame(at(250300), 0x4, "0004000000000000", error=True),
    frame(at(250400), 0x7FF, ""),
    frame(at(250500), 0x123, "112233445566778899AABBCC", fd=True, brs=True, esi=True),
    frame(at(250600), 0x123, "1122334455667788", raw_dlc=14),
    frame(at(250700), 0x123, "112233", extended=True),
]
SCREEN = [
    frame(at(249713), 0x44, "2A366C2B"),
    frame(at(449847), 0xF6, "7D3C1F12311C55"),
    frame(at(1050118), 0x18FEF100, "FFFF7D06FFFFFFFF", extended=True),
    frame(at(1050200), 0x123, ""),
    frame(at(1050300), 0x123, "", remote=True, raw_dlc=2),
    frame(at(1050400), 0x4, "0004000000000000", error=True),
    frame(at(1050500), 0x123, "112233445566778899AABBCC", fd=True),
]
EXTRA_US = 1_700_000_000 * 10**6
STEPS_US = [0, 100_012, 200_007, 299_998, 400_101]
FORMS: dict[str, tuple[str, list[LogFrame]]] = {
    "candump_log.log": ("absolute", LOG_FORM),
    "candump_nanoseconds.log": (
        "relative",
        [
            LogFrame(time_ns, can_id, bytes.fromhex(data), direction=way, channel="can0")
            for time_ns, can_id, data, way in (
                (1, 0x0CF00203, "CC0000FFF00000FF", "Rx"),
                (10_000_001, 0x0CF00203, "DC0000FFF00000FF", "Tx"),
                (20_000_002, 0x18F00503, "7D00007D4E204E43", "Rx"),
            )
        ],
    ),
    "screen_absolute.txt": ("absolute", [f._replace(channel="vcan0") for f in SCREEN]),
    "screen_zero.txt": (
        "relative",
        [frame(t, 0x123, f"11{0x22 + i:02X}") for i, t in enumerate(STEPS_US)],
    ),
    "screen_delta.txt": (
        "delta",
        [frame(t, 0x123, f"11{0x22 + i:02X}") for i, t in enumerate(STEPS_US)],
    ),
    "screen_dated.txt": (
        "absolute",
        [
            frame(EXTRA_US + 1, 0x123, "11"),
            frame(EXTRA_US, 0x123, "12", time_ns=EXTRA_US * 1000 + 123_456_789),
        ],
    ),
    "screen_no_times.txt": (
        "none",
        [
            frame(0, 0x123, "1122"),
            frame(0, 0x123, "1122"),
            frame(0, 0x1F334455, "7F", extended=True),
        ],
    ),
    "screen_extra.txt": (
        "absolute",
        [
            frame(EXTRA_US, 0x123, "1122334455667788", direction="Rx"),
            frame(
                EXTRA_US + 100,
                0x123,
                "000102030405060708090A0B0C0D0E0F",
                fd=True,
                brs=True,
                esi=True,
                direction="Tx",
            ),
            frame(EXTRA_US + 200, 0x123, "1122334455667788", raw_dlc=15, direction="Tx"),
        ],
    ),
    "screen_decorated.txt": (
        "absolute",
        [
            frame(EXTRA_US, 0x123, "4142434400012720"),
            frame(EXTRA_US + 100, 0x124, "41FF00"),
            frame(EXTRA_US + 200, 0x125, "112233"),
            frame(EXTRA_US + 300, 0x126, "7E", channel="can1"),
            frame(EXTRA_US + 400, 0x127, "112233"),
        ],
    ),
    "numbered.log": (
        "absolute",
        [
            frame(
                1612543138 * 10**6, 0x18EF000B, "0000001B000000B4", extended=True, channel="vcan0"
            ),
            frame(
                1612543138001 * 1000, 0x0CF00400, "0041FF20481400F0", extended=True, channel="vcan0"
            ),
        ],
    ),
    "remarks.log": (
        "absolute",
        [
            frame(1543509533000838, 0x10FDA300, "FFFF07FFFFFFFFFF", extended=True),
            frame(1543509533000915, 0x18FEE000, "FFFFFFFFB05C6800", extended=True),
        ],
    ),
    "many_decimals.txt": (
        "relative",
        [
            frame(0, 0x1CECFF00, "20220005FFE3FE00", extended=True, time_ns=14_944_704_056),
            frame(0, 0x1CEBFF00, "015014BB7A44B620", extended=True, time_ns=14_946_782_379),
        ],
    ),
    "truckdevil.txt": (
        "relative",
        [
            frame(1232, 0x18F0090B, "FFFFFFFFFFFFFFFF", extended=True, channel=""),
            frame(2661, 0x0CF00203, "CC0000FFF00000FF", extended=True, channel=""),
        ],
    ),
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_candump(name: str) -> None:
    time_base, expected = FORMS[name]
    reader = open_log(DATA / name)
    assert list(reader) == expected
    assert reader.report.time_base == time_base
    assert not reader.report.skipped


def test_words_that_are_no_frames_are_named() -> None:
    reader = open_log(DATA / "screen_absolute.txt")
    list(reader)
    assert reader.report.other == {"error frame explanation line": 1}
    reader = open_log(DATA / "truckdevil.txt")
    list(reader)
    assert reader.report.other == {"reassembled J1939 message": 1}


BROKEN = [
    "(1.0) can0 123",
    "(1.0) can0 #11",
    "(1.0) can0 1234#11",
    "(1.0) can0 800#11",
    "(1.0) can0 1234567G#11",
    "(1.0) can0 80000123#11",
    "(1.0) can0 F0000123#11",
    "(1.0) can0 123#1",
    "(1.0) can0 123#1G",
    "(1.0) can0 123#112233445566778899",
    "(1.0) can0 123##",
    "(1.0) can0 123##X11",
    "(1.0) can0 123##0112233445566778899",
    "(1.0) can0 123#R9",
    "(1.0) can0 123#11_9",
    "(1.0) can0 123#1122334455667788_8",
    "(1.0) can0 123#11 X",
    "(1.0) ca\x01n0 123#11",
    "(-1.0) can0 123#11",
    "(now) can0 123#11",
    "(99999999999.0) can0 123#11",
    "(2023-02-30 00:00:00.000000) can0 123#11",
    " (1.0)  can0  123   [2]  11",
    " (1.0)  can0  123   [2]  11 22 33",
    " (1.0)  can0  123   [9]  11 22 33 44 55 66 77 88 99",
    " (1.0)  can0  123   [2]  11 00100010",
    " (1.0)  can0  123   [2]  11 2",
    " (1.0)  can0  123  [09]  11 22 33 44 55 66 77 88 99",
    "(0.1) 18F0090B    06 F009 0B --> FF [0008] FFFFFFFFFFFFFF",
    "(0.1) 18F0090B    03 F009 0B --> FF [0001] FF",
    "(1.0)",
    "can0",
    "\x00" * 20,
]


@pytest.mark.parametrize("line", BROKEN)
def test_broken_lines_are_no_frames(line: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        raise ValueError(frame_problem(parse_line(line).frame) or "")


@pytest.mark.parametrize("line", ["", "   ", "# remark", "; remark"])
def test_lines_that_say_nothing(line: str) -> None:
    with pytest.raises(NotAFrame) as caught:
        parse_line(line)
    assert caught.value.name == ""


class TestDeltaTimes:
    """Differences and times from zero look alike; what tells them apart."""

    @pytest.mark.parametrize(
        ("times_us", "differences"),
        [
            ((0, 100, 90, 110, 95), True),
            ((0, 100, 100, 100, 100), True),
            ((0, 100, 200, 300, 400), False),
            ((*range(0, 2000, 100), 1450, *range(2100, 3000, 100)), False),
            ((5, 100, 90, 110, 95), False),
            ((0, 100), False),
        ],
        ids=["fall often", "equal steps", "clock", "one step back", "not from zero", "only two"],
    )
    def test_what_looks_like_differences(
        self, times_us: tuple[int, ...], differences: bool
    ) -> None:
        assert look_like_deltas([frame(t, 1, "") for t in times_us]) is differences

    def test_stated_times_are_used(self, tmp_path: Path) -> None:
        path = tmp_path / "log.txt"
        path.write_text("(000.000000) can0 123#11\n(000.100000) can0 123#11\n")
        assert [f.time_ns for f in open_log(path, times="delta")] == [0, 100_000_000]
        path.write_text((DATA / "screen_delta.txt").read_text())
        recorded = [f.time_ns // 1000 for f in open_log(path, times="recorded")]
        assert recorded == [0, 100_012, 99_995, 99_991, 100_103]

    def test_sums_go_on_over_chunks(self, tmp_path: Path) -> None:
        path = tmp_path / "log.txt"
        rest = "".join(f" (000.{100 + i * 5 % 11:06d})  can0  123   [1]  11\n" for i in range(5000))
        path.write_text(" (000.000000)  can0  123   [1]  11\n" + rest)
        times_ns = [f.time_ns for f in open_log(path)]
        expected = [0]
        for i in range(5000):
            expected.append(expected[-1] + (100 + i * 5 % 11) * 1000)
        assert times_ns == expected


def test_differences_that_add_up_to_no_time_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("(0.0) can0 123#11\n" + "(9000000000.0) can0 123#11\n" * 3)
    with pytest.raises(InputError, match=r"line 4: the differences add up to"):
        list(open_log(path))


def test_lines_of_the_other_kind_are_left_out(tmp_path: Path) -> None:
    reader = log_of(tmp_path / "log.txt", "can0 123#11\n(1.0) can0 123#12\ncan0 123#13\n")
    assert [f.data for f in reader] == [b"\x11", b"\x13"]
    assert reader.report.skipped == 1


class TestUnterminated:
    """A last line without a line end is taken only when a cut cannot have shortened it."""

    @pytest.mark.parametrize(
        ("before", "last", "kept"),
        [
            ("", "(1.0) can0 123#1122334455667788", True),
            ("", "(1.0) can0 123#11223344556677", False),
            ("", "(1.0) can0 123#11 R", True),
            ("(0.5) can0 123#11\n", "(1.0) can0 123#11", True),
            ("(0.5) can0 123#1122\n", "(1.0) can0 123#11", False),
            ("(0.5) can0 123#R4\n", "(1.0) can0 123#R", False),
            ("(0.5) can0 124#1122334455667788 R\n", "(1.0) can0 123#1122334455667788", False),
            ("", " (1.0)  can0  123   [2]  11 22", True),
            ("", " (1.0)  can0  123   [3]  11 22", False),
            ("", "(1.0) can0 123##0" + "11" * 64, True),
            ("", "(1.0) can0 123##0" + "11" * 8, False),
        ],
    )
    def test_kept(self, before: str, last: str, kept: bool, tmp_path: Path) -> None:
        reader = log_of(
            tmp_path / "log.log",
            f"(0.1) can0 7FF#1122334455667788\n{before}{last}".replace(
                "788\n", "788 R\n" if " R\n" in before else "788\n"
            ),
        )
        assert [f.can_id for f in reader if f.time_ns == 10**9] == ([0x123] if kept else [])
        assert reader.report.truncated is not kept


lines_of_logs = st.builds(
    lambda s, f, c, i, d, w: f"({s}.{f}) {c} {i}#{d}{w}",
    st.from_regex(r"\A[0-9]{1,11}\Z"),
    st.from_regex(r"\A[0-9]{6}([0-9]{3})?\Z"),
    st.sampled_from(("can0", "vcan12", "c#n", "a(b)", "a.b", "can\x010")),
    st.from_regex(r"\A([0-9A-Fa-f]{8}|[0-9A-F]{3}|[01][0-9A-F]{7}|[0-7][0-9A-F]{2})\Z"),
    st.from_regex(r"\A([0-9A-Fa-f]{2}){0,9}\Z"),
    st.sampled_from(("", " R", " T", " R", " X")),
)
accidents = st.tuples(st.integers(0, 60), st.sampled_from("()# .\t0R\x00\xa0é"))


@settings(deadline=None)
@given(st.lists(lines_of_logs, min_size=1, max_size=4), st.lists(accidents, max_size=2))
def test_column_reading_agrees_with_line_reading(
    lines: list[str], damage: list[tuple[int, str]]
) -> None:
    """What is taken apart by columns is what each line is by itself."""
    for index, character in damage:
        line = lines[0]
        if index < len(line):
            lines[0] = line[:index] + character + line[index + 1 :]
    quick = plain_frames("".join(f"{line}\n" for line in lines), len(lines))
    if quick is not None:
        assert quick == [parse_line(line).frame for line in lines]


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 2**62), st.integers(0, 2**29 - 1), st.binary(max_size=8)),
        min_size=1,
        max_size=6,
    ),
    st.sampled_from(("", " R", " T")),
    st.booleans(),
)
def test_common_lines_are_read_by_columns(
    rows: list[tuple[int, int, bytes]], way: str, nanoseconds: bool
) -> None:
    """No needless fall back to the slow way."""
    text = ""
    for time_ns, can_id, data in rows:
        fraction = f"{time_ns % 10**9:09d}" if nanoseconds else f"{time_ns % 10**9 // 1000:06d}"
        text += (
            f"({time_ns // 10**9:010d}.{fraction}) can0 {can_id:08X}#{data.hex().upper()}{way}\n"
        )
    frames = plain_frames(text, len(rows))
    assert frames is not None
    assert [(f.can_id, f.data) for f in frames] == [row[1:] for row in rows]
    step = 1 if nanoseconds else 1000
    assert [f.time_ns for f in frames] == [row[0] // step * step for row in rows]
    assert plain_frames(text.replace("\n", "\r\n"), len(rows)) == frames


def test_decimals_as_the_log_needs(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    first = LogFrame(1_000, 1, b"", False, channel="can0")
    write(path, [first])
    assert path.read_text() == "(0000000000.000001) can0 001#\n"
    write(path, [first, first._replace(time_ns=1_001, direction="Tx")])
    assert path.read_text() == (
        "(0000000000.000001000) can0 001#\n(0000000000.000001001) can0 001# T\n"
    )


def test_a_negative_time_is_refused(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "log.log")
    with pytest.raises(InputError, match="candump has no times below 0"), writer:
        writer.write(LogFrame(-1, 1, b""))


def test_numbered_channels_count_from_can0(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    write(path, [LogFrame(0, 1, b"", channel=channel) for channel in ("1", "2", "", "vcan3")])
    assert [f.channel for f in open_log(path)] == ["can0", "can1", "can0", "vcan3"]


@pytest.mark.parametrize(
    ("head", "found"),
    [
        (b"# x\nDROPCOUNT: dropped 7 CAN frames on 'can0' socket (total drops 7)\n", True),
        (b"my notes: DROPCOUNT: dropped 7 CAN frames\n", False),
        (b"DROPCOUNT: dropped all CAN frames\n", False),
    ],
)
def test_losses_alone_are_recognised_by_their_line(head: bytes, found: bool) -> None:
    assert recognise(head) is found
