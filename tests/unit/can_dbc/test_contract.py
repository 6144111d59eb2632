"""Our reader of opc4.dbc against cantools, what the contract promises, the contract as C, and frames."""

from __future__ import annotations

import inspect
import re
from zlib import crc32

import cantools
import pytest
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from can_dbc import codec, dbc, e2e
from can_dbc import messages as m
from can_dbc.c_header import header
from can_dbc.contract import DBC_PATH, contract
from can_dbc.frame import DP_BIT, EDP_BIT, MAX_ID, MAX_LENGTH, J1939Id, checksum, join_id, split_id


@pytest.fixture(scope="module")
def database() -> Database:
    return dbc.load_dbc(DBC_PATH)


def test_reader_agrees_with_cantools(database: Database) -> None:
    ours = contract()
    assert contract() is ours, "read once"
    assert list(ours) == [x.name for x in database.messages]
    for spec, theirs in zip(ours.values(), database.messages, strict=True):
        assert theirs.is_extended_frame and theirs.protocol == "j1939"
        assert (spec.name, spec.can_id, spec.length) == (
            theirs.name,
            theirs.frame_id,
            theirs.length,
        )
        assert list(spec.senders) == theirs.senders
        assert spec.receivers == theirs.receivers
        assert spec.cycle_ns == (theirs.cycle_time or 0) * 1_000_000
        assert spec.jitter_ns == 0
        attributes = theirs.dbc.attributes
        ids = attributes["E2EDataIdList"].value if "E2EDataIdList" in attributes else ""
        assert spec.e2e_data_ids == bytes.fromhex(ids)
        profile = attributes["E2EProfile"].value if "E2EProfile" in attributes else 0
        assert profile == (1 if spec.e2e_data_ids else 0)
        assert {s.name for s in spec.signals} == {s.name for s in theirs.signals}
        for signal in spec.signals:
            their = theirs.get_signal_by_name(signal.name)
            assert their.byte_order == "little_endian"
            assert (signal.start, signal.length, signal.signed) == (
                their.start,
                their.length,
                their.is_signed,
            )
            assert (signal.factor, signal.offset) == (their.scale, their.offset)
            assert (signal.minimum, signal.maximum) == (their.minimum, their.maximum)
            assert isinstance(signal.factor, float if "." in str(their.scale) else int)
            assert signal.unit == (their.unit or "")
            assert spec.signal(signal.name) is signal
    assert database.dbc.attributes["Baudrate"].value == 500_000


def test_everything_is_documented(database: Database) -> None:
    for message in database.messages:
        assert message.comment.endswith(".")
        for signal in message.signals:
            assert signal.comment.endswith("."), signal.name
            assert signal.receivers


def test_nodes_and_addresses(database: Database) -> None:
    addresses = {
        node.name: node.dbc.attributes["NmStationAddress"].value for node in database.nodes
    }
    assert addresses == {
        "Opc4": 3,
        "ValveDriver": 0x90,
        "PositionSensor": 0x91,
        "Driveline": 0x92,
        "ShiftConsole": 5,
        "Engine": 0,
        "Pneumatics": 48,
        "Recorder": 0xFB,
        "Lockstep": 0xF9,
    }
    for spec in contract().values():
        if not spec.can_id & EDP_BIT:
            assert len(spec.senders) == 1
            assert split_id(spec.can_id).source == addresses[spec.senders[0]]


@pytest.mark.parametrize(
    ("message_type", "can_id", "cycle_ms"),
    [
        (m.ShiftRequest, 0x0CFF0005, 20),     (m.ValveCommand, 0x08FF1003, 10),
        (m.SafetyBlow, 0x08FF1103, 10),       (m.PositionPulse, 0x0CFF2091, 10),
        (m.DrivelineSpeeds, 0x0CFF2192, 10),  (m.ControllerStatus, 0x10FF3003, 10),
        (m.Etc1, 0x0CF00203, 10),             (m.Etc2, 0x18F00503, 10),
        (m.PlantMotion, 0x1CFF4090, 10),      (m.PlantPressures, 0x1CFF4190, 10),
    ],
)  # fmt: skip
def test_identifiers_and_cycles(message_type: type, can_id: int, cycle_ms: int) -> None:
    spec = codec.spec_of(message_type)
    assert spec.can_id == codec.can_id_of(message_type) == can_id
    assert codec.message_type_of(can_id) is message_type
    assert spec.cycle_ns == cycle_ms * 1_000_000


def test_every_message_has_its_dataclass_and_every_signal_its_field() -> None:
    types = list(m.SIGNALS)
    classes = [x for _, x in inspect.getmembers(m, inspect.isclass)]
    defined = [x for x in classes if hasattr(x, "__dataclass_fields__")]
    on_the_bus = {name for name, spec in contract().items() if not spec.can_id & EDP_BIT}
    assert {t.__name__ for t in types} == on_the_bus
    assert set(types) == set(defined)
    assert all(issubclass(t, m.Message) for t in types)
    for message_type in types:
        spec = codec.spec_of(message_type)
        header = {"Crc", "Counter"} if message_type in e2e.PROTECTED else set()
        named = m.SIGNALS[message_type]
        assert len(named) == len(message_type.__dataclass_fields__) == len(set(named))
        assert set(named) | header == {s.name for s in spec.signals}
        assert not set(named) & header
        assert codec.message_type_of(spec.can_id) is message_type


@pytest.mark.parametrize(
    ("message_type", "field", "enum"),
    [
        (m.ShiftRequest, "target", m.Gear),
        (m.ValveCommand, "target", m.Gear),
        (m.SafetyBlow, "chamber", m.Chamber),
        (m.ControllerStatus, "state", m.ShiftState),
        (m.ControllerStatus, "confirmed", m.Gear),
    ],
)
def test_value_tables_are_the_enums(
    database: Database, message_type: type, field: str, enum: type[m.Gear]
) -> None:
    index = list(message_type.__dataclass_fields__).index(field)
    message = database.get_message_by_name(message_type.__name__)
    choices = message.get_signal_by_name(m.SIGNALS[message_type][index]).choices
    assert {k: str(v) for k, v in choices.items()} == {x.value: x.name for x in enum}


def test_protected_messages_carry_the_header_of_profile_2() -> None:
    with_header = set()
    for spec in contract().values():
        names = {signal.name for signal in spec.signals}
        if names & {"Crc", "Counter"} or spec.e2e_data_ids:
            crc, counter = spec.signal("Crc"), spec.signal("Counter")
            assert (crc.start, crc.length, counter.start, counter.length) == (0, 8, 8, 4)
            assert len(spec.e2e_data_ids) == 16
            with_header.add(codec.message_type_of(spec.can_id))
    assert with_header == set(e2e.PROTECTED)
    assert " ".join(kind.__name__ for kind in e2e.PROTECTED) == (
        "ShiftRequest ValveCommand SafetyBlow PositionPulse DrivelineSpeeds ControllerStatus"
    )
    all_ids = b"".join(spec.e2e_data_ids for spec in contract().values())
    assert len(set(all_ids)) == len(all_ids) == 96


def test_lockstep_frames_stay_off_the_simulated_bus() -> None:
    on_the_bus = {message_type.__name__ for message_type in m.SIGNALS}
    for spec in contract().values():
        page = spec.can_id & (EDP_BIT | DP_BIT)
        assert page == (0 if spec.name in on_the_bus else EDP_BIT | DP_BIT)
        assert (spec.cycle_ns > 0) == (spec.name in on_the_bus)


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


@pytest.mark.parametrize(
    ("can_id", "parts"),
    [
        (0x0CF00203, J1939Id(3, 61442, 3, 255)),  # ETC1 of a transmission
        (0x18F00503, J1939Id(6, 61445, 3, 255)),  # ETC2
        (0x0CF00400, J1939Id(3, 61444, 0, 255)),  # EEC1 of an engine
        (0x0C000003, J1939Id(3, 0, 3, 0)),  # TSC1, destination engine
        (0x18EAFF17, J1939Id(6, 59904, 0x17, 255)),  # request to all
        (0x18EF3112, J1939Id(6, 61184, 0x12, 0x31)),  # proprietary A, PDU format 239
        (0x1CFF4090, J1939Id(7, 0xFF40, 0x90, 255)),
        (0x1FFF02F9, J1939Id(7, 0x3FF02, 0xF9, 255)),
        (0, J1939Id(0, 0, 0, 0)),
        (MAX_ID, J1939Id(7, 0x3FFFF, 255, 255)),
    ],
)
def test_known_identifiers(can_id: int, parts: J1939Id) -> None:
    assert split_id(can_id) == parts
    assert join_id(*parts) == can_id


def test_classic_frames_with_29_bits_and_at_most_8_bytes() -> None:
    assert (MAX_ID, MAX_LENGTH) == (2**29 - 1, 8)


def test_the_checksum_is_that_of_the_frame_as_linux_has_it() -> None:
    whole = bytes.fromhex("9120ff8c 03000000 0102030000000000")  # flag of 29 bits in the identifier
    assert checksum(0x0CFF2091, bytes([1, 2, 3])) == crc32(whole) & 0xFF
    assert checksum(0x0CFF2091, bytes([1, 2, 4])) != checksum(0x0CFF2091, bytes([1, 2, 3]))


def test_groups_without_a_destination_are_for_everybody() -> None:
    assert join_id(6, 0xEA00, 0x17) == 0x18EAFF17


@given(st.integers(0, MAX_ID))
def test_join_inverts_split(can_id: int) -> None:
    assert join_id(*split_id(can_id)) == can_id


@pytest.mark.parametrize("can_id", [-1, MAX_ID + 1])
def test_split_refuses_what_is_not_29_bits(can_id: int) -> None:
    with pytest.raises(ValueError, match="29-bit"):
        split_id(can_id)


@pytest.mark.parametrize(
    "parts",
    [
        (8, 0, 0, 0),
        (-1, 0, 0, 0),
        (0, 0x40000, 0, 0),
        (0, -1, 0, 0),
        (0, 0, 256, 0),
        (0, 0, -1, 0),
        (0, 0, 0, 256),
        (0, 0, 0, -1),
        (0, 1, 0, 0),  # a destination-specific group whose low byte is not 0
    ],
)
def test_join_refuses_parts_that_do_not_fit(parts: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match=r"J1939|destination"):
        join_id(*parts)
