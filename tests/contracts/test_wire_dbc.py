"""The control frames that the transports exchange are those of opc4.dbc."""

from __future__ import annotations

from typing import get_args

import pytest

from can_dbc import lockstep
from can_dbc.codec import can_id_of, decode, encode
from can_dbc.contract import contract
from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.clock import NEVER_NS
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Kind

DBC_NAME = {kind: kind.name.title().replace("_", "") for kind in Kind}


def test_both_know_the_same_kinds() -> None:
    in_dbc = {spec.name: spec.can_id for spec in contract().messages if spec.can_id & EDP_BIT}
    assert {DBC_NAME[kind]: int(kind) for kind in Kind} == in_dbc
    assert lockstep.NEVER_NS == NEVER_NS == 2**48 - 1
    assert lockstep.NOBODY == wire.NOBODY == 255


@pytest.mark.parametrize(
    ("message", "record"),
    [
        (lockstep.Start(123), wire.control(Kind.START, value=123)),
        (
            lockstep.Stop(StopReason.ABORTED, 5),
            wire.control(Kind.STOP, StopReason.ABORTED, value=5),
        ),
        (lockstep.Grant(2, 255, 10**13), wire.control(Kind.GRANT, 2, 255, 10**13)),
        (lockstep.BusTime(1, 0xAB, 77), wire.control(Kind.BUS_TIME, 1, 0xAB, 77)),
        (lockstep.BusTime(255, 0, 77), wire.control(Kind.BUS_TIME, wire.NOBODY, 0, 77)),
        (lockstep.Done(1, 3, NEVER_NS), wire.control(Kind.DONE, 1, 3, NEVER_NS)),
        (lockstep.Release(3, 9), wire.control(Kind.RELEASE, 3, value=9)),
        (
            lockstep.Hello(2, wire.VERSION, 0xBEEF, 0x1234_5678),
            wire.control(Kind.HELLO, 2, wire.VERSION, 0xBEEF | 0x1234_5678 << 16),
        ),
        (
            lockstep.Welcome(2, wire.VERSION, 0xBEEF),
            wire.control(Kind.WELCOME, 2, wire.VERSION, 0xBEEF),
        ),
        (lockstep.Refused(2, 4, 0xBEEF), wire.control(Kind.REFUSED, 2, 4, 0xBEEF)),
        (lockstep.Refused(255, 5), wire.control(Kind.REFUSED, extra=5)),
        (lockstep.Failed(2), wire.control(Kind.FAILED, 2)),
        (lockstep.Sync(2), wire.control(Kind.SYNC, 2)),
        (lockstep.Ack(2), wire.control(Kind.ACK, 2)),
        (lockstep.Retire(2), wire.control(Kind.RETIRE, 2)),
        (lockstep.Monitor(1), wire.control(Kind.MONITOR, extra=1)),
        (lockstep.Skip(2), wire.control(Kind.SKIP, 2)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_byte_by_byte(message: lockstep.ControlMessage, record: bytes) -> None:
    ((can_id, payload),) = wire.split(record)
    assert encode(message) == Frame(can_id, payload)
    assert decode(Frame(can_id, payload)) == message


def test_every_control_frame_has_its_identifier() -> None:
    for message_type in get_args(lockstep.ControlMessage):
        assert can_id_of(message_type) in set(Kind)
