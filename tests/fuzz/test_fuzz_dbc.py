"""Mutated DBC texts: read, or refused in one line; never another exception, never a hang.

The slow run takes 10,000 of them.
"""

from __future__ import annotations

import random
import re
import time
from collections import Counter
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.dbc import parse_dbc
from can_dbc.errors import InputError
from sil.coupling.response_times import database_messages, response_times

FEW, MANY = 250, 10_000
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
    assert outcome["refused, line named"] > cases // 4
    assert outcome["read"] > cases // 50
    assert outcome["analysed"] > analysed
