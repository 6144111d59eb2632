"""The control frames that the transports exchange are those of opc4.dbc, as cantools encodes them."""

from __future__ import annotations

import pytest

from can_dbc import messages as m
from can_dbc.contract import DBC_PATH
from can_dbc.dbc import load_dbc
from can_dbc.frame import EDP_BIT
from sil.coupling.clock import NEVER_NS
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Kind

DATABASE = load_dbc(DBC_PATH)
DBC_NAME = {kind: kind.name.title().replace("_", "") for kind in Kind}


def test_both_know_the_same_kinds() -> None:
    in_dbc = {x.name: x.frame_id for x in DATABASE.messages if x.frame_id & EDP_BIT}
    assert {DBC_NAME[kind]: int(kind) for kind in Kind} == in_dbc


@pytest.mark.parametrize(
    ("kind", "signals", "record"),
    [
        (Kind.START, {"EndTime": 123}, {"value": 123}),
        (
            Kind.STOP,
            {"StopReason": m.StopReason.ABORTED, "StopTime": 5},
            {"participant": m.StopReason.ABORTED, "value": 5},
        ),
        (
            Kind.GRANT,
            {"Participant": 2, "Frames": 255, "GrantedTime": 10**13},
            {"participant": 2, "extra": 255, "value": 10**13},
        ),
        (
            Kind.BUS_TIME,
            {"Sender": 1, "Checksum": 0xAB, "ArrivalTime": 77},
            {"participant": 1, "extra": 0xAB, "value": 77},
        ),
        (
            Kind.BUS_TIME,
            {"Sender": 255, "Checksum": 0, "ArrivalTime": 77},
            {"extra": 0, "value": 77},
        ),
        (
            Kind.DONE,
            {"Participant": 1, "Frames": 3, "NextEvent": NEVER_NS},
            {"participant": 1, "extra": 3},
        ),
        (Kind.RELEASE, {"Participant": 3, "ReleaseTime": 9}, {"participant": 3, "value": 9}),
        (
            Kind.HELLO,
            {"Participant": 2, "Version": 1, "Nonce": 0xBEEF, "Scenario": 0x1234_5678},
            {"participant": 2, "extra": 1, "value": 0xBEEF | 0x1234_5678 << 16},
        ),
        (
            Kind.WELCOME,
            {"Participant": 2, "Version": 1, "WelcomeNonce": 0xBEEF},
            {"participant": 2, "extra": 1, "value": 0xBEEF},
        ),
        (
            Kind.REFUSED,
            {"Participant": 2, "RefusalReason": 4, "RefusedNonce": 0xBEEF},
            {"participant": 2, "extra": 4, "value": 0xBEEF},
        ),
        (
            Kind.REFUSED,
            {"Participant": 255, "RefusalReason": 5, "RefusedNonce": NEVER_NS},
            {"extra": 5},
        ),
        *(
            (kind, {"Participant": 2}, {"participant": 2})
            for kind in (Kind.FAILED, Kind.SYNC, Kind.ACK, Kind.RETIRE, Kind.SKIP)
        ),
        (Kind.MONITOR, {"Echo": 1}, {"extra": 1}),
    ],
)
def test_byte_by_byte(kind: Kind, signals: dict[str, int], record: dict[str, int]) -> None:
    ((can_id, payload),) = wire.split(wire.control(kind, **record))
    assert can_id == kind
    found = DATABASE.get_message_by_frame_id(can_id)
    assert found.decode(payload, decode_choices=False, scaling=False) == signals
    used = found.encode(signals, padding=True, scaling=False)
    assert used == payload


@pytest.mark.parametrize(
    ("name", "signal", "members"),
    [
        ("Stop", "StopReason", m.StopReason),
        *((name, "Participant", m.ParticipantId) for name in ("Grant", "Done", "Release")),
    ],
)
def test_value_tables_are_the_enums(name: str, signal: str, members: type[m.StopReason]) -> None:
    choices = DATABASE.get_message_by_name(name).get_signal_by_name(signal).choices
    assert {k: str(v) for k, v in choices.items()} == {x.value: x.name for x in members}
