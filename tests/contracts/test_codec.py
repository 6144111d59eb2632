"""The codec against cantools, the authority on opc4.dbc, its strictness; control frames of the transports."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import fields, replace
from enum import IntEnum, IntFlag
from fractions import Fraction
from functools import cache
from typing import Any, get_args, get_type_hints

import pytest
from cantools.database.can import Message
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc import codec
from can_dbc import messages as m
from can_dbc.codec import can_id_of, decode, encode, message_type_of
from can_dbc.contract import DBC_PATH
from can_dbc.dbc import load_dbc
from can_dbc.errors import CodecError, InputError
from can_dbc.frame import EDP_BIT, Frame
from sil.coupling.clock import NEVER_NS
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Kind

TYPES = tuple(m.SIGNALS)
SIGNALS = {
    kind: dict(zip(get_type_hints(kind), names, strict=True))
    for kind, names in codec.SIGNALS.items()
}
NAMES = [message_type.__name__ for message_type in TYPES]
every_message = pytest.mark.parametrize("message_type", TYPES, ids=NAMES)

SI_PER_UNIT = {
    "%": 1 / 100, "ms": 1e-3, "mm/s": 1e-3, "us": 1e-6, "um": 1e-6, "rpm": 2 * math.pi / 60,
    "kPa": 1e3,
}  # fmt: skip


@cache
def their(message_type: type) -> Message:
    """The message as cantools sees it."""
    return load_dbc(DBC_PATH).get_message_by_name(message_type.__name__)


def signal_of(message_type: type, field: str) -> Any:
    return their(message_type).get_signal_by_name(SIGNALS[message_type][field])


def kind_of(message_type: type, field: str) -> tuple[type, bool]:
    hint = get_type_hints(message_type)[field]
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not type(None)]
    return kinds[0], type(None) in get_args(hint)


def si(message_type: type, field: str, physical: float) -> Any:
    """The value of a field when cantools reads `physical` in the unit of the DBC."""
    kind, _ = kind_of(message_type, field)
    if kind is str:
        return chr(int(physical) & 0xFF) + chr(int(physical) >> 8)
    if kind is float:
        return physical * SI_PER_UNIT.get(signal_of(message_type, field).unit or "", 1.0)
    return kind(physical)


def raw_limits(message_type: type, field: str) -> tuple[int, int]:
    signal = signal_of(message_type, field)
    offset, scale = Fraction(str(signal.offset)), Fraction(str(signal.scale))
    low = (Fraction(str(signal.minimum)) - offset) / scale
    high = (Fraction(str(signal.maximum)) - offset) / scale
    assert low.denominator == high.denominator == 1, "the limits lie on the grid"
    return int(low), int(high)


def raws(message_type: type) -> st.SearchStrategy[dict[str, int]]:
    """Raw values that all mean something, by field."""

    def raw(field: str) -> st.SearchStrategy[int]:
        low, high = raw_limits(message_type, field)
        if kind_of(message_type, field)[0] is str:
            character = st.integers(0, 254)
            return st.builds(lambda a, b: a | b << 8, character, character)
        return st.integers(low, high) | st.sampled_from((low, high))

    return st.fixed_dictionaries({field: raw(field) for field in SIGNALS[message_type]})


def their_frame(message_type: type, values: dict[str, int]) -> Frame:
    """The frame that cantools makes of raw values, header of the protection 0."""
    signals = {SIGNALS[message_type][field]: raw for field, raw in values.items()}
    message = their(message_type)
    for name in ("Crc", "Counter"):
        if any(signal.name == name for signal in message.signals):
            signals[name] = 0
    data = message.encode(signals, scaling=False, padding=True, strict=False)
    return Frame(message.frame_id, data)


def assert_close(got: Any, expected: Any) -> None:
    assert type(got) is type(expected)
    if isinstance(expected, float):
        assert got == pytest.approx(expected, rel=4e-16, abs=0.0)
    else:
        assert got == expected


@every_message
@given(draw=st.data())
@settings(max_examples=30, deadline=None)
def test_decodes_what_cantools_encodes(message_type: type, draw: st.DataObject) -> None:
    values = draw.draw(raws(message_type))
    frame = their_frame(message_type, values)
    message = decode(frame)
    assert type(message) is message_type
    physical = their(message_type).decode(frame.data, decode_choices=False)
    for field in values:
        expected = si(message_type, field, physical[SIGNALS[message_type][field]])
        assert_close(getattr(message, field), expected)
    assert encode(message) == frame


@every_message
@given(draw=st.data())
@settings(max_examples=30, deadline=None)
def test_encodes_off_the_grid_like_cantools(message_type: type, draw: st.DataObject) -> None:
    values = draw.draw(raws(message_type))
    message = decode(their_frame(message_type, values))
    moved = {}
    signals = dict.fromkeys(("Crc", "Counter"), 0)
    for field, raw in values.items():
        signal = signal_of(message_type, field)
        signals[signal.name] = raw
        if kind_of(message_type, field)[0] is float:
            shift = draw.draw(st.floats(-0.49, 0.49))
            physical = signal.offset + (raw + shift) * signal.scale
            low, high = signal.minimum, signal.maximum
            physical = min(max(physical, low), high)
            signals[signal.name] = physical
            moved[field] = si(message_type, field, physical)
        elif kind_of(message_type, field)[0] is int:
            signals[signal.name] = raw + signal.offset
    signal_names = {signal.name for signal in their(message_type).signals}
    expected = their(message_type).encode(
        {name: value for name, value in signals.items() if name in signal_names}, padding=True
    )
    assert encode(replace(message, **moved)) == Frame(can_id_of(message_type), expected)


@every_message
@given(draw=st.data())
@settings(max_examples=40, deadline=None)
def test_any_bytes_are_a_message_or_refused(message_type: type, draw: st.DataObject) -> None:
    data = draw.draw(st.binary(min_size=8, max_size=8) | st.binary(max_size=9))
    check_bytes(message_type, data)


def check_bytes(message_type: type, data: bytes) -> bool:
    """Decode; whatever comes out is in range and survives another round. Whether it decoded."""
    try:
        message = decode(Frame(can_id_of(message_type), data))
    except CodecError as error:
        assert str(error).startswith("opc4.dbc: ")
        assert "\n" not in str(error)
        return False
    assert len(data) == 8
    for field in fields(message):
        kind, optional = kind_of(message_type, field.name)
        value = getattr(message, field.name)
        if value is None:
            assert optional
            continue
        assert type(value) is kind
        if kind is float:
            signal = signal_of(message_type, field.name)
            low, high = (si(message_type, field.name, x) for x in (signal.minimum, signal.maximum))
            assert low - 1e-12 <= value <= high * (1 + 1e-15)
    assert decode(encode(message)) == message
    return True


def test_numbers_of_the_enums_stay_what_recorded_logs_mean() -> None:
    assert [gear.name for gear in m.Gear] == ["NEUTRAL", "BACKWARD", "FORWARD", "UNKNOWN"]
    assert [*m.Gear] == [*m.Chamber] == [0, 1, 2, 3]
    assert [*m.ShiftState] == [0, 1, 2, 3, 4, 5, 6, 7]
    assert [fault.value for fault in m.Fault] == [1, 2, 4, 8, 16, 32, 64, 128]
    assert [*m.ParticipantId] == [0, 1, 2, 3]
    assert (m.StopReason.END, m.StopReason.ABORTED, m.GEAR_PARK) == (0, 1, 126)


@every_message
def test_lengths_other_than_8_are_refused(message_type: type) -> None:
    for length in (0, 1, 7, 9):
        with pytest.raises(CodecError, match=f"{length} bytes; expected 8"):
            decode(Frame(can_id_of(message_type), bytes(length)))


def test_unknown_identifiers_are_refused() -> None:
    with pytest.raises(CodecError, match="0x00000123 carries no message"):
        decode(Frame(0x123, bytes(8)))
    offered = can_id_of(m.ValveCommand) | 1 << 25
    assert message_type_of(offered) is None
    with pytest.raises(CodecError, match="0x0aff1003 carries no message"):
        decode(Frame(offered, bytes(8)))


def test_other_objects_are_refused() -> None:
    with pytest.raises(CodecError, match=r"int is not a message; expected one of ShiftRequest, "):
        encode(3)  # type: ignore[arg-type]


COMMAND = m.ValveCommand(0.98, 0.33, 0.35, m.Gear.FORWARD)
BLOW = m.SafetyBlow(m.Chamber.N, True, 0.15)
PULSE = m.PositionPulse(0.9e-3, 293.15, 255)
SPEEDS = m.DrivelineSpeeds(-12.5, 100.0)
STATUS = m.ControllerStatus(m.ShiftState.BLOW, m.Gear.NEUTRAL, -0.01285, m.Fault.INTERNAL)


@pytest.mark.parametrize(
    ("message", "field", "value"),
    [
        (COMMAND, "duty_b", math.nan),           (COMMAND, "duty_b", math.inf),
        (COMMAND, "duty_n", -math.inf),          (COMMAND, "duty_f", -0.0001),
        (COMMAND, "duty_b", 1.0001),             (COMMAND, "duty_b", 1e300),
        (COMMAND, "duty_b", None),               (COMMAND, "duty_b", "0.5"),
        (COMMAND, "target", 2),                  (COMMAND, "target", m.Chamber.F),
        (COMMAND, "target", None),               (BLOW, "active", None),
        (BLOW, "active", 2),                     (BLOW, "active", []),
        (BLOW, "remaining_s", 4.0961),           (PULSE, "pulse_s", -1e-6),
        (PULSE, "coil_temperature_k", 1000.1),   (PULSE, "sample_index", 256),
        (PULSE, "sample_index", -1),             (PULSE, "sample_index", 1.0),
        (SPEEDS, "input_rad_s", 1000.001),       (SPEEDS, "output_rad_s", -1000.001),
        (STATUS, "estimate_m", 0.5001),          (STATUS, "estimate_m", -0.5001),
        (STATUS, "faults", 3),                   (STATUS, "state", m.Gear.NEUTRAL),
        (m.Etc1(), "output_shaft_rad_s", 842.0), (m.Etc1(), "clutch_slip", math.nan),
        (m.Etc1(), "controlling_address", 254),  (m.Etc2(), "current_gear", 127),
        (m.Etc2(), "current_gear", -126),        (m.Etc2(), "requested_range", "N"),
        (m.Etc2(), "requested_range", "N12"),    (m.Etc2(), "requested_range", "\xff1"),
        (m.Etc2(), "requested_range", "1\xff"),  (m.Etc2(), "requested_range", "€1"),
    ],
)  # fmt: skip
def test_what_cannot_be_sent_is_refused_by_field(message: Any, field: str, value: object) -> None:
    encode(message)
    wrong = replace(message, **{field: value})
    name = type(message).__name__
    with pytest.raises(CodecError, match=rf"^opc4.dbc: {name}\.{field}: .* cannot be sent; exp"):
        encode(wrong)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (replace(COMMAND, duty_b=1.5), "ValveCommand.duty_b: 1.5 cannot be sent; expected 0 to 1"),
        (
            replace(PULSE, sample_index=256),
            "PositionPulse.sample_index: 256 cannot be sent; expected a whole number from 0 to 255",
        ),
        (replace(COMMAND, target=1), "ValveCommand.target: 1 cannot be sent; expected a Gear"),
        (replace(BLOW, active=None), "SafetyBlow.active: None cannot be sent; expected a bool"),
        (
            m.Etc1(shift_in_process=7),
            "Etc1.shift_in_process: 7 cannot be sent; expected a bool or None",
        ),
        (
            m.Etc1(output_shaft_rad_s=900.0),
            "Etc1.output_shaft_rad_s: 900.0 cannot be sent; expected 0 to 841.096 or None",
        ),
        (
            m.Etc2(current_range=""),
            "Etc2.current_range: '' cannot be sent; "
            "expected two characters of codes 0 to 254 or None",
        ),
    ],
)
def test_refusals_word_by_word(message: Any, reason: str) -> None:
    with pytest.raises(CodecError) as caught:
        encode(message)
    assert str(caught.value) == f"opc4.dbc: {reason}"
    assert issubclass(CodecError, InputError)


def with_bits(frame: Frame, start: int, length: int, raw: int) -> Frame:
    word = int.from_bytes(frame.data, "little") & ~((1 << length) - 1 << start) | raw << start
    return Frame(frame.can_id, word.to_bytes(8, "little"))


@pytest.mark.parametrize(
    ("message", "start", "length", "raw", "reason"),
    [
        (COMMAND, 16, 16, 12801, "duty_b: raw value 0x3201 has no meaning; expected 0 to 1"),
        (COMMAND, 14, 2, 0b01, "unused bits of 00 .* are not all 1"),
        (BLOW, 14, 2, 2, "active: raw value 0x2 has no meaning; expected a bool"),
        (PULSE, 32, 16, 32001, "coil_temperature_k"),
        (PULSE, 56, 8, 0x7F, "unused bits"),
        (SPEEDS, 16, 24, 1_024_001, "input_rad_s"),
        (SPEEDS, 40, 24, (1 << 24) - 1_024_001, "output_rad_s"),
        (STATUS, 12, 4, 8, "state: raw value 0x8 has no meaning; expected a ShiftState"),
        (STATUS, 32, 24, 8_000_001, "estimate_m"),
        (m.Etc1(), 8, 16, 0xFB00, "output_shaft_rad_s: raw value 0xfb00 has no meaning"),
        (m.Etc1(), 24, 8, 0xFB, "clutch_slip"),
        (m.Etc2(), 0, 8, 0xFC, "selected_gear"),
        (m.Etc2(), 32, 16, 0xFF20, "requested_range"),
        (m.Etc2(), 48, 16, 0x20FF, "current_range"),
    ],
)
def test_what_has_no_meaning_is_refused(
    message: Any, start: int, length: int, raw: int, reason: str
) -> None:
    frame = with_bits(encode(message), start, length, raw)
    with pytest.raises(CodecError, match=rf"^opc4.dbc: {type(message).__name__}.*{reason}"):
        decode(frame)
    limit = with_bits(encode(message), start, length, raw - 1)
    if raw in (12801, 32001, 1_024_001, 8_000_001, 8, 0xFB00, 0xFB, 0xFC):
        decode(limit)


def test_duties_and_delays_of_the_thesis_are_exact() -> None:
    for duty in (0.0, 0.33, 0.34, 0.35, 0.98, 1.0):
        command = m.ValveCommand(duty, duty, duty, m.Gear.NEUTRAL)
        assert decode(encode(command)) == command
    for seconds in (0.0, 0.0025, 0.01, 0.15):
        blow = m.SafetyBlow(m.Chamber.N, True, seconds)
        assert decode(encode(blow)) == blow
    pulse = m.PositionPulse(0.9e-3, 293.15625, 0)
    assert decode(encode(pulse)) == pulse
    for microseconds in range(0, 4096, 7):
        pulse = replace(pulse, pulse_s=microseconds / 1e6)
        assert decode(encode(pulse)) == pulse


def test_every_unit_by_hand() -> None:
    """Raw value = SI value over factor, in the unit of the DBC: %, ms, us, K, rad/s, um, mm/s, Pa."""
    for message, field, raw in (
        (replace(COMMAND, duty_b=0.5), "duty_b", 6400),
        (m.Etc1(clutch_slip=0.2), "clutch_slip", 50),
        (replace(BLOW, remaining_s=0.15), "remaining_s", 2400),
        (replace(PULSE, pulse_s=0.9e-3), "pulse_s", 14400),
        (replace(PULSE, coil_temperature_k=293.15625), "coil_temperature_k", 9381),
        (replace(SPEEDS, input_rad_s=-100.0), "input_rad_s", 2**24 - 102400),
        (replace(STATUS, estimate_m=-0.01), "estimate_m", 2**24 - 160000),
        (m.PlantMotion(0.032767, -0.5, 0.0, 0.0), "position_m", 32767),
        (m.PlantMotion(0.032767, -0.5, 0.0, 0.0), "velocity_m_s", 2**16 - 1000),
        (m.PlantPressures(9e5, 0.0, 0.0, 0.0), "pressure_b_pa", 18000),
        (m.Etc2(gear_ratio=3.5), "gear_ratio", 3500),
        (m.Etc1(input_shaft_rad_s=100 * math.pi), "input_shaft_rad_s", 24000),
    ):
        spec = codec.spec_of(type(message)).signal(SIGNALS[type(message)][field])
        frame = encode(message)
        assert int.from_bytes(frame.data, "little") >> spec.start & spec.mask == raw, field
        assert getattr(decode(frame), field) == pytest.approx(getattr(message, field), rel=1e-15)


def test_rounding_is_half_to_even() -> None:
    resolution = 50.0
    for raw, expected in ((0.5, 0), (1.5, 2), (2.5, 2), (2.51, 3), (3.49, 3)):
        sent = m.PlantPressures(raw * resolution, 0.0, 0.0, 0.0)
        assert decode(encode(sent)) == m.PlantPressures(expected * resolution, 0.0, 0.0, 0.0)
    for raw, expected in ((-0.5, 0), (-1.5, -2), (-2.5, -2)):
        motion = m.PlantMotion(0.0, raw * 0.5e-3, 0.0, 0.0)
        assert decode(encode(motion)) == m.PlantMotion(0.0, expected * 0.5e-3, 0.0, 0.0)


def test_etc1_as_other_tools_lay_it_out() -> None:
    """Bytes worked by hand from SAE J1939-71: shift in process, 1000 rpm out, 1200 rpm in."""
    sent = m.Etc1(
        driveline_engaged=True,
        shift_in_process=True,
        output_shaft_rad_s=1000 * 2 * math.pi / 60,
        clutch_slip=0.2,
        input_shaft_rad_s=1200 * 2 * math.pi / 60,
        controlling_address=3,
    )
    assert encode(sent) == Frame(0x0CF00203, bytes.fromhex("DD 40 1F 32 FF 80 25 03"))


def test_etc2_as_other_tools_lay_it_out() -> None:
    sent = m.Etc2(
        selected_gear=-1, gear_ratio=3.5, current_gear=0, requested_range="R1", current_range=" N"
    )
    frame = encode(sent)
    assert frame == Frame(0x18F00503, bytes.fromhex("7C AC 0D 7D 52 31 20 4E"))
    assert decode(frame) == sent


def test_missing_values_of_j1939() -> None:
    assert encode(m.Etc1()).data == encode(m.Etc2()).data == b"\xff" * 8
    assert decode(Frame(0x0CF00203, b"\xff" * 8)) == m.Etc1()
    assert decode(Frame(0x18F00503, b"\xff" * 8)) == m.Etc2()
    assert decode(Frame(0x0CF00203, bytes.fromhex("AA 00 FE FE 2A FF FE FE"))) == m.Etc1()
    park = with_bits(encode(m.Etc2()), 24, 8, 0xFB)
    assert decode(park) == m.Etc2(current_gear=m.GEAR_PARK)


def test_bits_that_later_editions_may_assign_are_ignored_in_public_groups_only() -> None:
    public = with_bits(encode(m.Etc1()), 38, 2, 0)
    assert decode(public) == m.Etc1()
    with pytest.raises(CodecError, match="unused bits"):
        decode(with_bits(encode(m.ShiftRequest(m.Gear.FORWARD)), 38, 2, 0))


def test_every_unused_bit_of_our_own_messages_is_looked_at() -> None:
    looked = 0
    for message_type in codec.SIGNALS:
        if message_type in (m.Etc1, m.Etc2, *m.TRUCK):
            continue
        values = {field: raw_limits(message_type, field)[0] for field in SIGNALS[message_type]}
        frame = their_frame(message_type, values)
        used = sum(
            (1 << signal.length) - 1 << signal.start for signal in their(message_type).signals
        )
        decode(frame)
        for bit in range(64):
            if not used >> bit & 1:
                looked += 1
                with pytest.raises(
                    CodecError, match=r"unused bits of .* are not all 1; expected 1$"
                ):
                    decode(with_bits(frame, bit, 1, 0))
    assert looked > 100


def test_truth_values_of_numpy_and_flags() -> None:
    import numpy as np

    blow = replace(BLOW, active=np.bool_(True), remaining_s=np.float64(0.15))  # type: ignore[arg-type]
    assert encode(blow) == encode(BLOW)
    pulse = replace(PULSE, sample_index=np.int64(255))  # type: ignore[arg-type]
    assert encode(pulse) == encode(PULSE)
    both = replace(STATUS, faults=m.Fault.POSITION_LOST | m.Fault.SPEEDS_LOST)
    again = decode(encode(both))
    assert isinstance(again, m.ControllerStatus)
    assert again.faults == m.Fault(9)
    assert isinstance(again.faults, IntFlag) and isinstance(again.state, IntEnum)


def test_a_codec_that_contradicts_itself_says_so() -> None:
    with pytest.raises(AssertionError, match="although every field can be sent"):
        codec._MessageCodec(m.ShiftRequest).refuse_message(m.ShiftRequest(m.Gear.FORWARD))


def in_new_process(code: str) -> str:
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    return run.stdout.strip()


def test_the_hot_path_does_without_cantools() -> None:
    loaded = in_new_process(
        "import sys\n"
        "from can_dbc import codec, e2e, messages as m\n"
        "codec.decode(e2e.Protector(m.ShiftRequest).protect(m.ShiftRequest(m.Gear.FORWARD)))\n"
        "print(*{name.split('.')[0] for name in sys.modules})\n"
    ).split()
    assert "e2e" in loaded
    assert not {"cantools", "can", "numpy", "bitstruct", "textparser"} & set(loaded)


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
