"""The contract as C: every message of the DBC, with what the DBC says."""

from __future__ import annotations

import re
import runpy

import cantools
import pytest

from can_dbc import c_header
from can_dbc.c_header import header
from can_dbc.contract import DBC_PATH


def test_every_message_has_the_identifier_of_the_dbc() -> None:
    reported = {n: int(i, 16) for n, i in re.findall(r"#define (\w+) 0x([0-9A-F]{8})u\n", header())}
    wanted = {
        re.sub(r"(?<!^)(?=[A-Z])", "_", message.name).upper(): message.frame_id
        for message in cantools.database.load_file(DBC_PATH).messages
    }
    assert reported and reported.items() <= wanted.items()
    assert {"SHIFT_REQUEST", "POSITION_PULSE", "VALVE_COMMAND", "CONTROLLER_STATUS"} <= set(
        reported
    )


def test_protected_messages_have_sixteen_data_ids() -> None:
    tables = re.findall(r"static const uint8_t (\w+)_IDS\[16\] .* = \{ ([\d, ]+) \};", header())
    assert {"SHIFT_REQUEST", "VALVE_COMMAND"} <= {name for name, _ in tables}
    assert all(len(ids.split(", ")) == 16 for _, ids in tables)


def test_run_as_a_program_it_prints_the_header(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(c_header.__file__, run_name="__main__")
    assert capsys.readouterr().out == header()
