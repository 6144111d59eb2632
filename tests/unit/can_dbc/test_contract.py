"""Our parser of opc4.dbc against cantools, and what the contract promises."""

from __future__ import annotations

import inspect
from types import ModuleType, UnionType
from typing import get_args

import pytest
from cantools.database.can import Database

from can_dbc import codec, dbc, e2e, lockstep
from can_dbc import contract as contract_module
from can_dbc import messages as m
from can_dbc.contract import DBC_PATH, contract, parse
from can_dbc.errors import InputError
from can_dbc.frame import DP_BIT, EDP_BIT, is_lockstep, split_id


@pytest.fixture(scope="module")
def database() -> Database:
    return dbc.load_dbc(DBC_PATH)


def test_parser_agrees_with_cantools(database: Database) -> None:
    ours = contract()
    assert [x.name for x in ours.messages] == [x.name for x in database.messages]
    for spec, theirs in zip(ours.messages, database.messages, strict=True):
        assert theirs.is_extended_frame
        assert theirs.protocol == "j1939"
        assert (spec.can_id, spec.length) == (theirs.frame_id, theirs.length)
        assert list(spec.senders) == theirs.senders
        assert spec.comment == theirs.comment
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
            assert signal.unit == (their.unit or "")
            assert list(signal.receivers) == their.receivers
            assert signal.comment == their.comment
            assert signal.choices == {k: str(v) for k, v in (their.choices or {}).items()}
            assert signal.spn == (their.spn or 0)
    assert ours.bitrate == database.dbc.attributes["Baudrate"].value == 500_000
    assert ours.addresses == {
        node.name: node.dbc.attributes["NmStationAddress"].value for node in database.nodes
    }


def test_everything_is_documented() -> None:
    for spec in contract().messages:
        assert spec.comment.endswith(".")
        for signal in spec.signals:
            assert signal.comment.endswith("."), signal.name
            assert signal.receivers != ("Vector__XXX",)


def test_nodes_and_addresses() -> None:
    assert contract().addresses == {
        "Opc4": 3,
        "ValveDriver": 0x90,
        "PositionSensor": 0x91,
        "Driveline": 0x92,
        "ShiftConsole": 5,
        "Recorder": 0xFB,
        "Lockstep": 0xF9,
    }
    for spec in contract().messages:
        bus = not spec.can_id & EDP_BIT
        if bus:
            assert len(spec.senders) == 1
            assert split_id(spec.can_id).source == contract().addresses[spec.senders[0]]


@pytest.mark.parametrize(
    ("message_type", "can_id", "cycle_ms"),
    [
        (m.ShiftRequest, 0x0CFF0005, 20),
        (m.ValveCommand, 0x08FF1003, 10),
        (m.SafetyBlow, 0x08FF1103, 10),
        (m.PositionPulse, 0x0CFF2091, 10),
        (m.DrivelineSpeeds, 0x0CFF2192, 10),
        (m.ControllerStatus, 0x10FF3003, 10),
        (m.Etc1, 0x0CF00203, 10),
        (m.Etc2, 0x18F00503, 10),
        (m.PlantMotion, 0x1CFF4090, 10),
        (m.PlantPressures, 0x1CFF4190, 10),
    ],
)
def test_identifiers_and_cycles(message_type: type, can_id: int, cycle_ms: int) -> None:
    spec = codec.spec_of(message_type)
    assert spec.can_id == codec.can_id_of(message_type) == can_id
    assert codec.message_type_of(can_id) is message_type
    assert spec.cycle_ns == cycle_ms * 1_000_000


@pytest.mark.parametrize(
    ("module", "union", "signals"),
    [(m, m.Message, codec.SIGNALS), (lockstep, lockstep.ControlMessage, lockstep.SIGNALS)],
)
def test_every_message_has_its_dataclass_and_every_signal_its_field(
    module: ModuleType, union: UnionType, signals: dict[type, tuple[str, ...]]
) -> None:
    types = get_args(union)
    classes = [x for _, x in inspect.getmembers(module, inspect.isclass)]
    defined = [x for x in classes if hasattr(x, "__dataclass_fields__")]
    specs = [spec for spec in contract().messages if is_lockstep(spec.can_id) == (module is not m)]
    assert {t.__name__ for t in types} == {spec.name for spec in specs}
    assert set(types) == set(defined) == set(signals)
    for message_type in types:
        spec = codec.spec_of(message_type)
        header = {"Crc", "Counter"} if message_type in e2e.PROTECTED else set()
        named = signals[message_type]
        assert len(named) == len(message_type.__dataclass_fields__) == len(set(named))
        assert set(named) | header == {s.name for s in spec.signals}
        assert not set(named) & header
        assert codec.message_type_of(spec.can_id) is message_type


def test_signals_neither_overlap_nor_leave_their_message() -> None:
    for spec in contract().messages:
        taken = 0
        for signal in spec.signals:
            mask = signal.mask << signal.start
            assert not taken & mask, signal.name
            taken |= mask
        assert taken < 1 << 8 * spec.length


@pytest.mark.parametrize(
    ("message_type", "field", "enum"),
    [
        (m.ShiftRequest, "target", m.Gear),
        (m.ValveCommand, "target", m.Gear),
        (m.SafetyBlow, "chamber", m.Chamber),
        (m.ControllerStatus, "state", m.ShiftState),
        (m.ControllerStatus, "confirmed", m.Gear),
        (lockstep.Stop, "reason", m.StopReason),
        (lockstep.Grant, "participant", m.ParticipantId),
        (lockstep.Done, "participant", m.ParticipantId),
        (lockstep.Release, "participant", m.ParticipantId),
    ],
)
def test_value_tables_are_the_enums(message_type: type, field: str, enum: type[m.Gear]) -> None:
    signals = codec.SIGNALS | lockstep.SIGNALS
    index = list(message_type.__dataclass_fields__).index(field)
    signal = codec.spec_of(message_type).signal(signals[message_type][index])
    assert signal.choices == {member.value: member.name for member in enum}


def test_protected_messages_carry_the_header_of_profile_2() -> None:
    with_header = set()
    for spec in contract().messages:
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
    all_ids = b"".join(spec.e2e_data_ids for spec in contract().messages)
    assert len(set(all_ids)) == len(all_ids) == 96


def test_lockstep_frames_stay_off_the_simulated_bus() -> None:
    for spec in contract().messages:
        if spec.name in {message_type.__name__ for message_type in lockstep.SIGNALS}:
            assert spec.can_id & EDP_BIT
            assert spec.can_id & DP_BIT
            assert spec.cycle_ns == 0
        else:
            assert not spec.can_id & (EDP_BIT | DP_BIT)
            assert spec.cycle_ns > 0


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("SG_MUL_VAL_ 1 A B 0-1;", "not a statement that the contract uses"),
        (' SG_ A : 7|8@0+ (1,0) [0|1] "" X', "not a statement"),  # big-endian
        (' SG_ A : 0|8@1+ (1,0) [0|1] "" X', "signal first"),
        ('CM_ BO_ 5 "x";', "message 5 is not declared above"),
        ('CM_ SG_ 5 A "x";', "message 5 is not declared above"),
        ("BO_TX_BU_ 5 : A;", "message 5 is not declared above"),
        ('VAL_ 5 A 0 "NO" ;', "message 5 is not declared above"),
        ('BA_ "SPN" SG_ 5 A 1;', "message 5 is not declared above"),
        ('BA_ "GenMsgCycleTime" BO_ 5 1;', "message 5 is not declared above"),
        ('CM_ "two', "not a statement"),
    ],
)
def test_other_statements_are_refused_with_their_line(statement: str, reason: str) -> None:
    with pytest.raises(InputError, match=f"^x.dbc: line 3: .*{reason}"):
        parse(f'VERSION ""\n\n{statement}\n', "x.dbc")


@pytest.mark.parametrize("value", ['"ABC"', '"XY"', '"XX"'])
def test_impossible_attributes_are_refused(value: str) -> None:
    text = f'BO_ 2147483649 M: 8 A\nBA_ "E2EDataIdList" BO_ 2147483649 {value};\n'
    with pytest.raises(InputError, match=r"^x.dbc: an attribute has an impossible value: "):
        parse(text, "x.dbc")


def test_names_that_do_not_exist() -> None:
    with pytest.raises(KeyError, match="no message Nothing"):
        contract().message("Nothing")
    with pytest.raises(KeyError, match="Etc1 has no signal Nothing"):
        contract().message("Etc1").signal("Nothing")


def test_the_file_is_read_once() -> None:
    assert contract() is contract()
    assert contract_module.DBC_PATH.endswith("opc4.dbc")


def test_defaults_of_what_a_message_leaves_out() -> None:
    text = 'BU_: A B\nBO_ 2147483649 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" B\n'
    (message,) = parse(text).messages
    assert (message.can_id, message.cycle_ns, message.jitter_ns) == (1, 0, 0)
    assert (message.comment, message.e2e_data_ids, message.senders) == ("", b"", ("A",))
    (signal,) = message.signals
    assert (signal.comment, signal.choices, signal.spn) == ("", {}, 0)
    assert isinstance(signal.factor, int)
    jitter = 'BA_ "GenMsgJitterUs" BO_ 2147483649 250;\n'
    assert parse(text + jitter).messages[0].jitter_ns == 250_000


def test_a_file_that_states_nothing_has_no_bit_rate_and_no_messages() -> None:
    assert parse("") == (0, {}, ())


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "BU_: A\n" + "x" * 70,
            f"opc4.dbc: line 2: '{'x' * 60}' is not a statement that the contract uses; expected a "
            "single-line DBC statement in the form of its neighbours",
        ),
        (
            ' SG_ Crc : 0|8@1+ (1,0) [0|255] "" OPC4',
            "opc4.dbc: line 1: signal first",
        ),
        (
            'CM_ BO_ 7 "lost";',
            "opc4.dbc: line 1: message 7 is not declared above",
        ),
    ],
)
def test_refusals_word_by_word(text: str, told: str) -> None:
    with pytest.raises(InputError) as caught:
        parse(text)
    assert str(caught.value) == told
