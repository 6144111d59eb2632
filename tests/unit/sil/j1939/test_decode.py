"""J1939: transport, signals decoded, and mappings of other databases."""

from __future__ import annotations

import csv
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.frame import Frame, join_id
from sil.j1939.decode import decode
from sil.j1939.mapping import ANY_SOURCE, LAYOUT, SHIPPED, SignalMapping
from sil.j1939.transport import PGN_CONTROL, PGN_DATA, Assembler, Message, broadcast
from sil.logs import LogFrame, open_writer
from tests.support.golden_logs import write

ENGINE, TRANSMISSION, TOOL = 0x00, 0x03, 0xF9
DM1 = 65226


def recorded(
    frames: Sequence[Frame], step_ns: int = 10_000_000, channel: str = ""
) -> list[LogFrame]:
    return [
        LogFrame(index * step_ns, frame.can_id, frame.data, channel=channel)
        for index, frame in enumerate(frames)
    ]


def negotiated(data: bytes, at_once: int = 16) -> list[Frame]:
    """The frames of ENGINE and TOOL that carry a message from the one to the other."""
    announcement, *packets = broadcast(DM1, ENGINE, data)
    to_tool, answer = (join_id(7, PGN_CONTROL, *way) for way in ((ENGINE, TOOL), (TOOL, ENGINE)))
    size, group = announcement.data[1:4], announcement.data[5:]
    found = [Frame(to_tool, bytes((16, *size, at_once, *group)))]
    for begin in range(0, len(packets), at_once):
        part = packets[begin : begin + at_once]
        found.append(Frame(answer, bytes((17, len(part), begin + 1, 0xFF, 0xFF, *group))))
        found += [Frame(join_id(7, PGN_DATA, ENGINE, TOOL), packet.data) for packet in part]
    return [*found, Frame(answer, bytes((19, *size, 0xFF, *group)))]


def assembled(frames: Sequence[LogFrame]) -> tuple[list[Message], Assembler]:
    assembler = Assembler()
    found = [message for frame in frames if (message := assembler.take(frame))]
    assembler.finish()
    return found, assembler


def test_a_broadcast_recorded_elsewhere_is_put_together() -> None:
    packets = bytes.fromhex(
        "20220005FFE3FE00 015014BB7A44B620 021CD16022E1E02E"
        "03E1C044FFFF7509 04C0440341DC7DE1 057A440000FFFFFF"
    )
    ids = [0x1CECFF00, *[0x1CEBFF00] * 5]
    frames = [Frame(i, packets[8 * k : 8 * k + 8]) for k, i in enumerate(ids)]
    found, assembler = assembled(recorded(frames))
    data = "5014bb7a44b6201cd16022e1e02ee1c044ffff7509c0440341dc7de17a440000ffff"
    assert found == [Message(50_000_000, 65251, 0, 255, bytes.fromhex(data)[:34])]
    assert assembler.lines() == ["1 message of the transport protocol put together"]
    assert broadcast(65251, 0, found[0].data) == frames


@given(data=st.binary(min_size=9, max_size=1785), at_once=st.integers(0, 255))
@settings(max_examples=30)
def test_every_payload_comes_back(data: bytes, at_once: int) -> None:
    frames = negotiated(data, at_once) if at_once else broadcast(DM1, ENGINE, data)
    found, assembler = assembled(recorded(frames))
    destination = TOOL if at_once else 255
    assert [message.data for message in found] == [data]
    assert (found[0].pgn, found[0].source, found[0].destination) == (DM1, ENGINE, destination)
    assert not assembler.lost


@pytest.mark.parametrize("size", [0, 8, 1786])
def test_payloads_that_the_protocol_does_not_carry(size: int) -> None:
    with pytest.raises(ValueError, match=f"{size} bytes; expected 9 to 1785"):
        broadcast(DM1, ENGINE, bytes(size))


def test_interleaved_senders_receivers_and_channels() -> None:
    transfers = [
        recorded(broadcast(DM1, ENGINE, b"engine to all"), channel="1"),
        recorded(broadcast(DM1, TRANSMISSION, b"transmission to all"), channel="1"),
        recorded(negotiated(b"engine to the tool"), channel="1"),
        recorded(broadcast(DM1, ENGINE, b"engine of the other bus"), channel="2"),
    ]
    frames = sorted((frame for one in transfers for frame in one), key=lambda frame: frame.time_ns)
    found, assembler = assembled(frames)
    assert {message.data for message in found} == {
        b"engine to all",
        b"transmission to all",
        b"engine to the tool",
        b"engine of the other bus",
    }
    assert not assembler.lost


def test_frames_of_other_groups_and_kinds_are_passed_over() -> None:
    long = recorded(broadcast(DM1, ENGINE, bytes(9)))
    odd = [LogFrame(5, 0x0CF00400, bytes(8)), long[0]._replace(remote=True, data=b"")]
    found, assembler = assembled([*odd, *long])
    assert [message.pgn for message in found] == [DM1] and not assembler.lost


def lost(frames: Sequence[LogFrame]) -> dict[str, int]:
    found, assembler = assembled(frames)
    assert not found
    assert assembler.assembled == 0
    assert len(assembler.locations) == assembler.lost.total()
    return dict(assembler.lost)


BROADCAST = recorded(broadcast(DM1, ENGINE, bytes(range(30))))
NEGOTIATED = recorded(negotiated(bytes(range(30))))


def test_a_lost_packet_is_reported_with_time_and_sender() -> None:
    _, assembler = assembled([*BROADCAST[:2], *BROADCAST[3:]])
    assert assembler.lost == {"packet missing": 1, "packet without an announcement": 2}
    assert assembler.locations[0] == (
        "at 0.030000 s: PGN 65226 of 30 bytes, source 0x00 to 0xff: packet missing"
    )


def test_what_ends_before_its_last_packet() -> None:
    assert lost(BROADCAST[:3]) == {"end of the log": 1}
    assert lost([*NEGOTIATED[:4], NEGOTIATED[-1]]) == {"packet missing": 1}
    abort = LogFrame(60_000_000, 0x1CEC00F9, bytes.fromhex("FF01FFFFFFCAFE00"))
    assert lost([*NEGOTIATED[:4], abort]) == {"aborted": 1}
    assert lost([BROADCAST[0], BROADCAST[0]._replace(time_ns=1)]) == {
        "new announcement before the end": 1,
        "end of the log": 1,
    }


def test_a_pause_longer_than_the_timeout() -> None:
    late = [frame._replace(time_ns=frame.time_ns + 750_000_000) for frame in BROADCAST[2:]]
    assert lost([*BROADCAST[:2], *late]) == {"timeout": 1, "packet without an announcement": 4}
    found, assembler = assembled(
        [*NEGOTIATED[:2], *[f._replace(time_ns=10**9) for f in NEGOTIATED[2:]]]
    )
    assert len(found) == 1 and not assembler.lost  # a negotiated one may pause for 1.25 s
    other = LogFrame(5 * 10**9, 0x1CEC0303, bytes.fromhex("1100000000000000"))
    assert lost([*BROADCAST[:2], other]) == {"timeout": 1}


def test_packets_again_and_in_another_order() -> None:
    again = [*NEGOTIATED[:4], NEGOTIATED[3], NEGOTIATED[2], *NEGOTIATED[4:], NEGOTIATED[3]]
    found, assembler = assembled(again[:-1])
    assert [message.data for message in found] == [bytes(range(30))]
    assert not assembler.lost
    found, _ = assembled([*BROADCAST[:2], BROADCAST[1], *BROADCAST[2:]])
    assert len(found) == 1


def test_announcements_that_contradict_themselves_and_short_frames() -> None:
    wrong = BROADCAST[0]._replace(data=bytes.fromhex("201E0004FFCAFE00"))
    assert lost([wrong]) == {"announcement that contradicts itself": 1}
    assert lost([BROADCAST[0]._replace(data=bytes(3))]) == {"frame of fewer than 8 bytes": 1}


START_NS = 1_600_000_000 * 10**9
DBC = """\
VERSION ""
BU_: A
BO_ 2364540158 EEC1: 8 A
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A
 SG_ Torque : 16|8@1+ (1,-125) [-125|125] "%" A
BO_ 2566838526 Long: 12 A
 SG_ Last : 88|8@1+ (1,0) [0|255] "" A
BO_ 291 Plain: 2 A
 SG_ Mode : 0|8@1+ (1,0) [0|255] "" A
 SG_ Value : 8|8@1- (0.5,0) [-64|63.5] "V" A
VAL_ 291 Mode 0 "off, idle" 1 "on" ;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2364540158 3;
"""


def eec1(source: int, rpm: float, torque: int = 125) -> tuple[int, bytes]:
    raw = round(8 * rpm).to_bytes(2, "little")
    return 0x0CF00400 | source, bytes((0xFF, 0xFF, torque)) + raw + b"\xff" * 3


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "truck.dbc").write_text(DBC)
    frames = [
        LogFrame(0, *eec1(0x00, 700.0, 135)),
        LogFrame(0, *eec1(0x0F, 1500.0)),
        LogFrame(0, 0x0CF00400, b"\xff" * 8),
        LogFrame(0, 0x123, bytes((0, 0xFE)), False),
        LogFrame(0, 0x123, bytes((1, 0x02)), False),
        LogFrame(0, 0x124, b"", False),
        LogFrame(0, 0x18FEF100, bytes(8)),
        *(LogFrame(0, frame.can_id, frame.data) for frame in broadcast(65240, 3, bytes(range(12)))),
        LogFrame(0, *eec1(0x00, 710.0, 140)),
    ]
    timed = enumerate(f._replace(channel="can0") for f in frames)
    log = (frame._replace(time_ns=START_NS + n * 10_000_000) for n, frame in timed)
    return write(tmp_path / "a.log", log)


def test_a_row_for_each_value(log: Path) -> None:
    report = decode([log], log.with_name("s.csv"), log.with_name("truck.dbc"))
    with log.with_name("s.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = [(r["message"], r["source"], r["signal"], float(r["value"]), r["text"]) for r in rows]
    assert found == [
        ("EEC1", "0", "Torque", 10.0, ""),
        ("EEC1", "0", "EngineSpeed", 700.0, ""),
        ("EEC1", "15", "Torque", 0.0, ""),
        ("EEC1", "15", "EngineSpeed", 1500.0, ""),
        ("Plain", "", "Mode", 0.0, "off, idle"),
        ("Plain", "", "Value", -1.0, ""),
        ("Plain", "", "Mode", 1.0, "on"),
        ("Plain", "", "Value", 1.0, ""),
        ("Long", "3", "Last", 11.0, ""),
        ("EEC1", "0", "Torque", 15.0, ""),
        ("EEC1", "0", "EngineSpeed", 710.0, ""),
    ]
    assert rows[0]["time_s"] == "1600000000.000000000"
    assert rows[-1]["time_s"] == "1600000000.100000000"
    assert rows[1]["unit"] == "rpm"
    assert report.unknown == {"124": 1, "18FEF100": 1}
    text = "\n".join(report.lines())
    assert "2 frames of 2 identifiers: 124 (1), 18FEF100 (1)" in text
    assert "1 message of the transport protocol put together" in text


def test_the_same_values_in_mf4(log: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    decode([log], log.with_name("s.mf4"), log.with_name("truck.dbc"))
    with asammdf.MDF(log.with_name("s.mf4")) as mdf:
        names = [group.channel_group.acq_name for group in mdf.groups]
        senders = ("EEC1 of 0x00", "EEC1 of 0x0f", "Plain", "Long of 0x03")
        assert names == [f"{sender} on can0" for sender in senders]
        speed = mdf.get("EngineSpeed", group=0)
        assert (
            speed.samples.tolist()[::2] == [700.0, 710.0] and speed.samples[1] != speed.samples[1]
        )
        assert speed.timestamps.tolist() == [0.0, 0.02, 0.1]
        assert speed.unit == "rpm"


def test_parquet_without_its_library_is_one_line(log: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="needs pyarrow, which is not installed") as refused:
        decode([log], log.with_name("s.parquet"), log.with_name("truck.dbc"))
    assert "\n" not in str(refused.value)
    assert not log.with_name("s.parquet").exists()


def test_parquet_holds_the_same_rows(log: Path) -> None:
    parquet = importlib.import_module("pyarrow.parquet")
    decode([log], log.with_name("s.parquet"), log.with_name("truck.dbc"))
    rows = parquet.read_table(log.with_name("s.parquet")).to_pylist()
    assert [row["value"] for row in rows][:3] == [10.0, 700.0, 0.0]


def test_what_cannot_be_decoded_is_refused_or_counted(log: Path) -> None:
    dbc = log.with_name("truck.dbc")
    with pytest.raises(InputError, match=r"expected OUT \.csv, \.csv\.gz, \.mf4 or \.parquet"):
        decode([log], log.with_name("s.asc"), dbc)
    dbc.write_text(DBC.split("BO_ 2364540158")[0] + "BO_ 5 Other: 8 A\n")
    with pytest.raises(InputError, match="none of its 11 frames is of a message in"):
        decode([log], log.with_name("s.csv"), dbc)
    assert not log.with_name("s.csv").exists()


ODD = """\
VERSION ""
BU_: A
BO_ 291 Over: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ Y : 4|8@1+ (1,0) [0|255] "" A
BO_ 292 Out: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ Z : 12|8@1+ (1,0) [0|255] "" A
BO_ 293 Twice: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ X : 8|8@1+ (1,0) [0|255] "" A
BO_ 294 Big: 8 A
 SG_ N : 0|64@1+ (1,0) [0|1] "" A
BO_ 2566844926 Flags: 2 A
 SG_ One : 0|1@1+ (1,0) [0|1] "" A
 SG_ Two : 1|2@1+ (1,0) [0|3] "" A
 SG_ Three : 3|3@1+ (1,0) [0|7] "" A
 SG_ Named : 6|2@1+ (1,0) [0|3] "" A
 SG_ Byte : 8|8@1+ (1,0) [0|250] "" A
VAL_ 2566844926 Named 3 "locked" ;
"""


def test_a_database_that_contradicts_itself_is_decoded_as_far_as_it_goes(tmp_path: Path) -> None:
    (tmp_path / "odd.dbc").write_text(ODD)
    frames = [(0x123, b"\x12\x34"), (0x124, b"\x12\x34"), (0x125, b"\x12\x34")]
    frames += [(0x126, (2**63 + 1).to_bytes(8, "little")), (0x123, b"\x12")]
    with open_writer(tmp_path / "a.log") as writer:
        for n, (can_id, data) in enumerate(frames):
            writer.write(LogFrame(n, can_id, data, False))
        writer.write(LogFrame(9, 0x18FF0F00 | 0x03, b"\xff\xff"))
    (tmp_path / "odd.dbc").write_text(ODD.replace("2566844926", str(0x98FF0FFE)))
    report = decode([tmp_path / "a.log"], tmp_path / "s.csv", tmp_path / "odd.dbc")
    with (tmp_path / "s.csv").open() as file:
        rows = [(r["message"], r["signal"], r["value"], r["text"]) for r in csv.DictReader(file)]
    assert rows == [
        ("Over", "X", "18", ""),
        ("Over", "Y", "65", ""),
        ("Out", "X", "18", ""),
        ("Twice", "X", "18", ""),
        ("Twice", "X (bit 8)", "52", ""),
        ("Big", "N", str(2**63 + 1), ""),
        ("Over", "X", "18", ""),
        ("Flags", "One", "1", ""),
        ("Flags", "Three", "7", ""),
        ("Flags", "Named", "3", "locked"),
    ]
    text = "\n".join(report.lines())
    assert "signal Z of Out is not decoded: it leaves the message's 2 bytes" in text
    assert "a second signal X of Twice: as 'X (bit 8)'" in text
    assert "too short: 1 Over of 1 bytes in place of 2" in text
    assert "not available, left out: 2 values: Flags.Two (1), Flags.Byte (1)" in text


CONTRACT = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Shafts: 8 X
 SG_ Out : 7|16@0+ (0.5,0) [0|0] "rpm" X
 SG_ In : 16|16@1- (1,0) [-1000|1000] "rpm" X
BO_ 2566844675 Proprietary: 2 X
 SG_ Gear : 0|8@1+ (1,-125) [0|0] "" X
BO_ 2565867262 AnySender: 8 X
 SG_ Pressure : 0|8@1+ (8,0) [0|0] "kPa" X
 SG_ Real : 32|32@1- (1,0) [0|0] "" X
SIG_VALTYPE_ 2565867262 Real : 1;
"""


def mapping(tmp_path: Path, *rows: tuple[str, str, str, str]) -> SignalMapping:
    """A mapping of rows (meaning, message, signal, further keys) to the CONTRACT above."""
    text = "".join(
        f'[[signal]]\nmeaning = "{meaning}"\nmessage = "{message}"\nsignal = "{signal}"\n{more}\n'
        for meaning, message, signal, more in rows
    )
    (tmp_path / "map.toml").write_text(text)
    (tmp_path / "layout.dbc").write_text(CONTRACT)
    return SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "layout.dbc"))


def values(found: SignalMapping, can_id: int, data: str, extended: bool = True) -> dict[str, float]:
    sender = found.sender("", can_id, extended)
    assert sender is not None
    read = found.values(sender, bytes.fromhex(data))
    return {found.rows[k].meaning: value for k, value in read.items()}


def test_the_shipped_mapping_reads_the_standard() -> None:
    found = SignalMapping()
    assert found.is_standard
    etc1 = values(found, 0x0CF00203, "DC401F FF FF 803E 03".replace(" ", ""))
    assert etc1 == pytest.approx(
        {
            "shift_in_process": 1.0,
            "output_shaft_rad_s": 104.71975512,
            "input_shaft_rad_s": 209.4395102,
        }
    )
    assert values(found, 0x18F00503, "81FFFF7EFFFFFFFF") == {"selected_gear": 4, "current_gear": 1}
    assert values(found, 0x18F00503, "FBFFFF00FFFFFFFF") == {
        "selected_gear": 126,
        "current_gear": -125,
    }
    engine = values(found, 0x0CF00400, "FFFFAF40 1F FFFFFF".replace(" ", ""))
    assert engine == pytest.approx({"engine_torque_share": 0.5, "engine_rad_s": 104.71975512})
    assert values(found, 0x18FEAE30, "69FFFFFFFFFFFFFF") == {"supply_pressure_pa": 941325.0}


@pytest.mark.parametrize("data", ["FF" * 8, "FE" * 8])
@pytest.mark.parametrize("can_id", [0x0CF00203, 0x18F00503, 0x0CF00400, 0x18FEAE30])
def test_not_available_and_error_are_no_values(can_id: int, data: str) -> None:
    assert values(SignalMapping(), can_id, data) == {}


def test_the_largest_speed_is_valid_and_the_next_is_none() -> None:
    found = values(SignalMapping(), 0x0CF00203, "EFFFFAFFFF00FBFF")
    assert found == {"output_shaft_rad_s": pytest.approx(841.096, abs=0.001)}


def test_frames_are_found_whatever_priority_and_source() -> None:
    found = SignalMapping()
    for priority in range(8):
        for source in (0, 3, 0x85, 0xFD):
            can_id = priority << 26 | 61442 << 8 | source
            assert found.sender("b", can_id, True) == ("ETC1", "b", source)
    assert found.sender("b", 0x203, False) is None
    assert found.sender("b", 0x0DF00203, True) is None  # the same group in another data page


def test_other_layouts_with_their_own_numbers(tmp_path: Path) -> None:
    found = mapping(
        tmp_path,
        ("output_shaft_rad_s", "Shafts", "Out", "scale = 2.0\noffset = 1.0"),
        ("input_shaft_rad_s", "Shafts", "In", ""),
        ("current_gear", "Proprietary", "Gear", ""),
        ("supply_pressure_pa", "AnySender", "Pressure", "scale = 1000\nsource = 7"),
        ("engine_rad_s", "AnySender", "Real", ""),
    )
    assert not found.is_standard
    assert values(found, 0x100, "0102FFFF00000000", extended=False) == {
        "output_shaft_rad_s": 2.0 * 0.5 * 0x0102 + 1.0,
        "input_shaft_rad_s": -1.0,
    }
    assert values(found, 0x100, "FFFF007000000000", extended=False) == {
        "output_shaft_rad_s": 65536.0  # no J1939 message, so no value means "not available"
    }
    shafts = found.sender("", 0x100, False)
    assert shafts is not None and shafts.source == ANY_SOURCE
    assert values(found, 0x04FEF103, "7E00")["current_gear"] == 1.0  # another priority
    assert found.sender("", 0x18FEF104, True) is None  # another source
    assert values(found, 0x18F00607, "0A000000 0000C03F".replace(" ", "")) == {
        "supply_pressure_pa": 80_000.0,
        "engine_rad_s": 1.5,
    }
    assert values(found, 0x18F00608, "0A0000000000C03F") == {"engine_rad_s": 1.5}


GOOD = 'meaning = "current_gear"\nmessage = "ETC2"\nsignal = "TransCurrentGear"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "map.toml: signal: missing"),
        ("signal = []", "map.toml: signal: [] is wrong"),
        (
            "[[signal]]\n" + GOOD.replace("ETC2", "ECT2"),
            "signal[0].message: 'ECT2' is unknown; expected one of",
        ),
        (
            "[[signal]]\n" + GOOD.replace("TransCurrentGear", "CurrentGear"),
            "one of TransCurrentGear",
        ),
        (
            "[[signal]]\n" + GOOD.replace("current_gear", "gear"),
            "signal[0].meaning: 'gear' is unknown",
        ),
        ("[[signal]]\n" + GOOD + "scale = 0", "signal[0].scale: 0 makes"),
        ("[[signal]]\n" + GOOD + "scale = nan", "signal[0].scale: nan is wrong"),
        ("[[signal]]\n" + GOOD + 'scale = "1"', "signal[0].scale: '1' is wrong"),
        ("[[signal]]\n" + GOOD + "source = 254", "signal[0].source: 254 is wrong"),
        ("[[signal]]\n" + GOOD + "factor = 2", "signal[0].factor: unknown"),
        (
            "[[signal]]\n" + GOOD + "[gearbox]\nrange_ratio = 0.5",
            "gearbox.range_ratio: 0.5 is wrong",
        ),
        ("[[signal]\n", "map.toml:"),
    ],
)
def test_a_wrong_mapping_is_one_line(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError) as raised:
        SignalMapping(str(tmp_path / "map.toml"))
    assert expected in str(raised.value) and "\n" not in str(raised.value)
    assert "map.toml" in str(raised.value)


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"path": "missing.toml"}, "missing.toml"),
        ({"path": str(SHIPPED), "dbc": "missing.dbc"}, "missing.dbc"),
        ({"path": str(LAYOUT)}, "j1939.dbc"),
        ({"dbc": str(SHIPPED)}, "j1939.toml"),
    ],
)
def test_a_wrong_file_is_named(keywords: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        SignalMapping(**keywords)


def test_a_message_of_several_frames_is_refused(tmp_path: Path) -> None:
    long = CONTRACT + '\nBO_ 2566844926 Long: 70 X\n SG_ Gear : 0|8@1+ (1,0) [0|0] "" X\n'
    (tmp_path / "long.dbc").write_text(long)
    (tmp_path / "map.toml").write_text(
        '[[signal]]\nmeaning = "current_gear"\nmessage = "Long"\nsignal = "Gear"\n'
    )
    with pytest.raises(InputError, match="Long has 70 bytes; expected one frame"):
        SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "long.dbc"))
