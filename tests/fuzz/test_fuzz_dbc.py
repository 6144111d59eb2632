"""Mutated DBC texts and frames: read, or refused in one line; never another exception, a hang or a false message."""

from __future__ import annotations

import random
import re
import time
from collections import Counter
from pathlib import Path

import pytest
from cantools.database.can import Message
from e2e.p02 import e2e_p02_check

from can_dbc import messages as m
from can_dbc.codec import can_id_of, decode, encode, spec_of
from can_dbc.contract import DBC_PATH
from can_dbc.dbc import load_dbc, parse_dbc
from can_dbc.e2e import PROTECTED, E2eStatus, Protector, Receiver, with_counter
from can_dbc.errors import CodecError, InputError
from can_dbc.frame import Frame
from sil.coupling.response_times import database_messages, response_times

FEW, MANY = 250, 4_000
SLOWEST_S = 60.0
"""A database that keeps the processor busy for longer counts as a hang."""
OURS = Path(DBC_PATH).read_bytes()
TOKENS = (
    *(b"0", b"-1", b"1e999", b"nan", b"99999999999999999999", b"4294967295", b"3221225472"),
    *(b'"', b";", b":", b"@", b"|", b"(", b"\n", b" ", b"\xff", b"\x81", b"\0", b"\r"),
    *(b"e99999999", b"1E+77777777", b"//", b'\\"', b'"9e9999999"', b"+", b"0x"),
    *(b"SG_ ", b"BO_ ", b"BA_ ", b"VAL_ ", b"EV_ ", b"CM_ ", b"BU_:", b"m0 ", b"M ", b"m3M "),
    b"SG_MUL_VAL_ 2164260867 A B 0-99999999;",
    b'BA_DEF_ "X" INT 5 1;',
    b"SIG_VALTYPE_ 2364575747 DutyB : 1;",
    b"SIG_GROUP_ 2364575747 G 1 : DutyB DutyN;",
)
NUMBERS = (b"0", b"64", b"65", b"-3", b"1e400", b"2147483648", b"99999", b"1.5", b"0x10")


def mutated(rng: random.Random) -> bytes:
    """Some of our lines with some of: tokens put in, cut, noise, copies, other numbers."""
    share = rng.choice((0.1, 0.4, 1.0))
    text = bytearray(b"\n".join(x for x in OURS.split(b"\n") if rng.random() < share))
    for _ in range(rng.randint(0, 4)):
        if not text:
            break
        kind, place = rng.randrange(6), rng.randrange(len(text))
        if kind == 0:
            text[place : place + rng.randint(0, 8)] = rng.choice(TOKENS)
        elif kind == 1:
            del text[place : place + rng.randint(1, 40)]
        elif kind == 2:
            text[place] = rng.randrange(256)
        elif kind == 3:
            start = rng.randrange(len(text))
            text[place:place] = text[start : start + rng.randint(1, 80)]
        elif kind == 4:
            numbers = list(re.finditer(rb"\d+", bytes(text)))
            if numbers:
                number = rng.choice(numbers)
                text[number.start() : number.end()] = rng.choice(NUMBERS)
        else:
            text = bytearray(rng.randbytes(rng.randint(0, 200)))
    return bytes(text)


def fuzz(seed: int, cases: int) -> Counter[str]:
    rng = random.Random(seed)
    outcome: Counter[str] = Counter()
    for _ in range(cases):
        content = mutated(rng)
        began = time.process_time()
        try:
            database = parse_dbc(content, "x.dbc")
        except InputError as error:
            line = str(error)
            assert re.match(r"x\.dbc: \S", line), line
            assert "\n" not in line
            assert len(line) < 400
            outcome["refused, line named" if ": line " in line else "refused"] += 1
        else:
            outcome["read"] += 1
            for message in database.messages:
                assert message.length <= 1785
            try:
                response_times(database_messages(database), 500_000)
            except InputError as error:
                assert "\n" not in str(error)
            else:
                outcome["analysed"] += 1
        assert time.process_time() - began < SLOWEST_S, content
    return outcome


@pytest.mark.parametrize(
    ("seed", "cases", "analysed"), [(1, FEW, 0), pytest.param(2, MANY, 50, marks=pytest.mark.slow)]
)
def test_mutated_databases(seed: int, cases: int, analysed: int) -> None:
    outcome = fuzz(seed, cases)
    assert outcome["refused, line named"] > cases // 4 and outcome["read"] > cases // 50
    assert outcome["analysed"] > analysed


TYPES = tuple(m.SIGNALS)
FEW_FRAMES, MANY_FRAMES = 1_500, 20_000


def mutated_frame(rng: random.Random, data: bytes) -> bytes:
    """A few of: flipped bits, bytes of zeros, ones or noise, torn or grown."""
    octets = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        kind = rng.randrange(6)
        place = rng.randrange(8)
        if kind < 2 and place < len(octets):
            octets[place] ^= 1 << rng.randrange(8)
        elif kind == 2 and place < len(octets):
            octets[place] = rng.choice((0x00, 0xFF, rng.randrange(256)))
        elif kind == 3:
            octets = bytearray(rng.randbytes(8))
        elif kind == 4 and rng.random() < 0.2:
            del octets[place:]
        elif kind == 5 and rng.random() < 0.2:
            octets += rng.randbytes(1)
    return bytes(octets)


def valid_frame(rng: random.Random, message: Message) -> Frame:
    """A frame that cantools makes of raw values in range."""
    raws = {}
    for signal in message.signals:
        low, high = (
            round((limit - signal.offset) / signal.scale)
            for limit in (signal.minimum, signal.maximum)
        )
        raws[signal.name] = rng.choice((low, high, rng.randint(low, high)))
    data = message.encode(raws, scaling=False, padding=True, strict=False)
    return Frame(message.frame_id, data)


PUBLIC = (m.Etc1, m.Etc2, m.Tsc1, m.Tc1, m.Eec1, m.Eec2, m.Air1)
"""Messages of J1939."""


def in_range_for_cantools(message: Message, data: bytes) -> bool:
    """Whether every signal of the bytes lies within the limits of the DBC."""
    values = message.decode(data, decode_choices=False)
    return all(
        signal.minimum <= values[signal.name] <= signal.maximum for signal in message.signals
    )


def fuzz_codec(seed: int, cases: int) -> Counter[str]:
    rng = random.Random(seed)
    database = load_dbc(DBC_PATH)
    outcome: Counter[str] = Counter()
    for _ in range(cases):
        message_type = rng.choice(TYPES)
        theirs = database.get_message_by_name(message_type.__name__)
        frame = valid_frame(rng, theirs)
        frame = Frame(frame.can_id, mutated_frame(rng, frame.data))
        try:
            message = decode(frame)
        except CodecError as error:
            assert str(error).startswith(f"opc4.dbc: {message_type.__name__}")
            assert "\n" not in str(error)
            outcome["refused"] += 1
            if len(frame.data) == 8 and "unused bits" not in str(error):
                assert not in_range_for_cantools(theirs, frame.data) or "_range" in str(error)
            continue
        outcome["decoded"] += 1
        assert type(message) is message_type
        public = message_type in PUBLIC  # these may say: not available
        assert public or in_range_for_cantools(theirs, frame.data)
        again = encode(message)
        assert decode(again) == message
        if not public:
            protected = message_type in PROTECTED
            expected = int.from_bytes(frame.data, "little")
            if protected:
                expected &= ~0xFFF  # CRC and counter, which encode leaves 0
            assert int.from_bytes(again.data, "little") == expected
    return outcome


def fuzz_channel(seed: int, cases: int) -> Counter[E2eStatus]:
    """A frame with a wrong CRC or content is never anything but an ERROR."""
    rng = random.Random(seed)
    theirs = {t: load_dbc(DBC_PATH).get_message_by_name(t.__name__) for t in PROTECTED}
    ends = {t: (Protector(t), Receiver(t)) for t in PROTECTED}
    outcome: Counter[E2eStatus] = Counter()
    for now_ns in range(cases):
        message_type = rng.choice(PROTECTED)
        protector, receiver = ends[message_type]
        frame = protector.protect(decode(valid_frame(rng, theirs[message_type])))
        if rng.random() < 0.7:
            frame = Frame(frame.can_id, mutated_frame(rng, frame.data))
            if rng.random() < 0.2 and len(frame.data) == 8:
                frame = with_counter(message_type, frame, rng.randrange(16))
        before = receiver.message
        status = receiver.receive(now_ns, frame)
        outcome[status] += 1
        right = len(frame.data) == 8 and e2e_p02_check(
            frame.data, spec_of(message_type).e2e_data_ids, length=8
        )
        if right:
            try:
                expected = decode(frame)
            except CodecError:
                right = False
        assert (status is E2eStatus.ERROR) == (not right)
        accepted = status in (E2eStatus.OK, E2eStatus.OK_SOME_LOST)
        assert receiver.message == (expected if accepted else before)
    return outcome


@pytest.mark.parametrize(
    ("seed", "cases"), [(1, FEW_FRAMES), pytest.param(3, MANY_FRAMES, marks=pytest.mark.slow)]
)
def test_mutated_frames(seed: int, cases: int) -> None:
    outcome = fuzz_codec(seed, cases)
    assert outcome["decoded"] > cases // 10 and outcome["refused"] > cases // 10


@pytest.mark.parametrize(
    ("seed", "cases"), [(2, FEW_FRAMES), pytest.param(4, MANY_FRAMES, marks=pytest.mark.slow)]
)
def test_mutated_frames_on_a_channel(seed: int, cases: int) -> None:
    outcome = fuzz_channel(seed, cases)
    for status in (E2eStatus.OK, E2eStatus.ERROR, E2eStatus.OK_SOME_LOST, E2eStatus.SYNC):
        assert outcome[status] > cases // 200, status


def test_every_identifier_near_ours_is_refused() -> None:
    ours = {can_id_of(message_type) for message_type in TYPES}
    for can_id in ours:
        for bit in range(29):
            near = can_id ^ 1 << bit
            if near not in ours:
                with pytest.raises(CodecError, match="carries no message"):
                    decode(Frame(near, bytes(8)))
