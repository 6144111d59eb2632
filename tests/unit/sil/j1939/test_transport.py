"""Long J1939 messages: split and put together, interleaved, with packets missing, late or aborted."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame, join_id
from sil.j1939.transport import PGN_CONTROL, PGN_DATA, Assembler, Message, broadcast
from sil.logs.frame import LogFrame

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
    lines = [
        "20220005FFE3FE00",
        "015014BB7A44B620",
        "021CD16022E1E02E",
        "03E1C044FFFF7509",
        "04C0440341DC7DE1",
        "057A440000FFFFFF",
    ]
    ids = [0x1CECFF00, *[0x1CEBFF00] * 5]
    frames = [Frame(i, bytes.fromhex(line)) for i, line in zip(ids, lines, strict=True)]
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
