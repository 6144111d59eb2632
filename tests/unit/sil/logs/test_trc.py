"""TRC: every version, kinds of lines, start times exact to the nanosecond."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_log

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"
NOON_NS = 1_639_828_800 * 10**9
"""44548.5 days after 1899-12-30: 2021-12-18 12:00."""

PCAN_NS = 1_639_837_687_062_000_960
"""44548.6028595139 days, exactly."""

OFFSET_NS = 17_535_400_000


def tx(time_ns: int, data: str, channel: str = "") -> LogFrame:
    return LogFrame(time_ns, 0x100, bytes.fromhex(data), channel=channel, direction="Tx")


def remote(time_ns: int, channel: str = "", direction: str = "Rx") -> LogFrame:
    return LogFrame(
        time_ns, 0x704, b"", False, remote=True, channel=channel, direction=direction, raw_dlc=1
    )


FD = LogFrame(
    NOON_NS + 17_541_300_000, 0x123, bytes(range(12)), False, fd=True, brs=True, direction="Rx"
)
ERROR = LogFrame(
    NOON_NS + 17_542_300_000, 0, bytes.fromhex("04000200"), False, error=True, direction="Rx"
)
LAST_NS = NOON_NS + 17_700_000_000

VERSIONS = {
    "version_1_0.trc": [
        LogFrame(17_535_000_000, 0x100, bytes.fromhex("0011223344556677")),
        remote(17_700_000_000, direction=""),
        LogFrame(17_710_000_000, 0x123, b"\x01\x02", False),
    ],
    "version_1_1.trc": [
        tx(PCAN_NS + OFFSET_NS, "0011223344556677"),
        LogFrame(PCAN_NS + 17_550_000_000, 8, bytes.fromhex("00190808"), False, error=True),
        remote(PCAN_NS + 17_700_000_000),
    ],
    "version_1_2.trc": [tx(NOON_NS + OFFSET_NS, "0102", "1"), remote(LAST_NS, "2")],
    "version_1_3.trc": [tx(NOON_NS + OFFSET_NS, "0102", "1"), remote(LAST_NS, "2")],
    "version_2_0.trc": [tx(NOON_NS + OFFSET_NS, "0102"), FD, ERROR, remote(LAST_NS)],
    "version_2_1.trc": [
        tx(NOON_NS + OFFSET_NS, "0102", "1"),
        FD._replace(esi=True, channel="1"),
        ERROR._replace(data=bytes.fromhex("0400020000"), channel="1"),
        LogFrame(
            NOON_NS + 17_543_300_000,
            0x123,
            bytes(range(8)),
            False,
            channel="1",
            direction="Rx",
            raw_dlc=12,
        ),
        remote(LAST_NS, "2"),
    ],
}


@pytest.mark.parametrize("name", VERSIONS)
def test_every_version(name: str) -> None:
    reader = open_log(DATA / name)
    assert list(reader) == VERSIONS[name]
    report = reader.report
    assert report.other == ({} if "1_2" in name else {"status line": 1})
    assert report.skipped == (2 if "2_1" in name else 0)
    assert report.start_ns is None or report.start_ns > 10**18 or "1_2" in name


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (";$FILEVERSION=3.0\n", "TRC version '3.0'; expected one from 1.0 to 2.1"),
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T\n", "expected N,O,T,B,I,d,R,L,D"),
    ],
)
def test_unknown_kinds_are_refused(header: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "log.trc"
    path.write_text(header + "      1     17535.400 DT 1  00000100 Tx -  2    01 02\n")
    with pytest.raises(InputError, match=expected):
        list(open_log(path))


def test_without_a_start_time_times_are_relative(tmp_path: Path) -> None:
    path = tmp_path / "log.trc"
    path.write_text(";$FILEVERSION=1.1\n     1)     17535.4  Tx     00000100  1  00\n")
    reader = open_log(path)
    assert [f.time_ns for f in reader] == [OFFSET_NS]
    assert any("STARTTIME" in note for note in reader.report.notes)


@pytest.mark.parametrize(
    "line",
    [
        "1 17535.400 DT 1 00000100 Tx - 2 01",
        "1 17535.400 DT 1 00000100 Tx - 2 01 02 03",
        "1 17535.400 DT 1 00000100 Tx - 2 01 2",
        "1 17535.400 DT 1 GG000100 Tx - 1 01",
        "1 17535.400 DT x 00000100 Tx - 1 01",
        "1 17535.400 DT 1 0800 Tx - 1 01",
        "1 17535.400 DT 1 00000100 Up - 1 01",
        "1 17535.400 DT 1 00000100 Tx - 16 01",
        "1 17535,400 DT 1 00000100 Tx - 1 01",
        "1 17535.400 DT",
        "rubbish",
    ],
)
def test_broken_lines(line: str, tmp_path: Path) -> None:
    path = tmp_path / "log.trc"
    sound = "1 17000.000 DT 1 00000100 Tx - 1 01"
    path.write_text(f";$FILEVERSION=2.1\n;$STARTTIME=44548.5\n{sound}\n{line}\n")
    reader = open_log(path)
    assert len(list(reader)) == 1
    assert reader.report.skipped_locations[0].line == 4


common = st.tuples(
    st.integers(0, 10**10),
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
    st.binary(max_size=8),
    st.sampled_from(("Rx", "Tx")),
)


@pytest.mark.parametrize("version", ["1.1", "2.1"])
@given(rows=st.lists(common, min_size=1, max_size=30), data=st.data())
@settings(max_examples=50, deadline=None)
def test_common_and_other_lines_mixed(
    version: str,
    rows: list[tuple[int, int, bool, bytes, str]],
    data: st.DataObject,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """The quick reading of chunks gives what each line gives by itself."""
    bus = "" if version == "1.1" else "3"
    frames = [
        LogFrame(NOON_NS + t * 1000, i if x else i & 0x7FF, d, x, channel=bus, direction=w)
        for t, i, x, d, w in rows
    ]
    lines = []
    for number, (row, f) in enumerate(zip(rows, frames, strict=True), 1):
        digits = f"{f.can_id:08X}" if f.extended else f"{f.can_id:04X}"
        stamp = f"{row[0] // 1000}.{row[0] % 1000:03d}"
        shown = f"{len(f.data)}  {f.data.hex(' ').upper()}"
        if version == "1.1":
            lines.append(f"{number:>6})  {stamp:>9}  {f.direction}  {digits:>8}  {shown} ")
        else:
            lines.append(f"{number:>7} {stamp:>13} DT 3 {digits:>8} {f.direction} -  {shown}")
    for _ in range(data.draw(st.integers(0, 3))):
        index = data.draw(st.integers(0, len(lines)))
        lines.insert(index, data.draw(st.sampled_from(("", ";remark", "rubbish"))))
    path = tmp_path_factory.mktemp("trc") / "log.trc"
    header = f";$FILEVERSION={version}\n;$STARTTIME=44548.5\n"
    path.write_text(header + f";{'x' * 1000}\n" * 40 + "\n".join(lines) + "\n")
    reader = open_log(path)
    assert list(reader) == frames
    assert reader.report.skipped == lines.count("rubbish")
