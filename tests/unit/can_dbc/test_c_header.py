"""The contract as C: every message of the control unit, with what the DBC says."""

from __future__ import annotations

import re

import cantools

from can_dbc.c_header import header
from can_dbc.contract import DBC_PATH


def test_every_message_of_the_control_unit_has_the_identifier_of_the_dbc() -> None:
    defined = {
        n: int(i, 16) for n, i in re.findall(r"#define OPC4_(\w+)_ID 0x(\w{8})u\n", header())
    }
    wanted = {
        re.sub(r"(?<!^)(?=[A-Z])", "_", message.name).upper(): message.frame_id
        for message in cantools.database.load_file(DBC_PATH).messages
        if "Opc4" in {*message.senders, *message.receivers} and "Lockstep" not in message.senders
        if "Lockstep" not in message.receivers
    }
    assert defined == wanted


def test_protected_messages_have_sixteen_data_ids() -> None:
    tables = re.findall(
        r"static const uint8_t opc4_(\w+)_data_ids\[16\] = \{ ([\d, ]+) \};", header()
    )
    assert {"shift_request", "valve_command"} <= {name for name, _ in tables}
    assert all(len(ids.split(", ")) == 16 for _, ids in tables)
