"""What a unit learns, and its memory: whole, or the defaults."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.learning import HEADER, MAGIC, METHODS, VERSION, Context, Sensitivities

LARGE, SMALL = Context(0, 0.09, 0.9), Context(0, 0.015, 0.1)
names = pytest.mark.parametrize("name", list(METHODS))


def taught(name: str) -> bytes:
    method = METHODS[name]()
    for k in range(5):
        method.learn(LARGE if k % 2 else SMALL, 0.001 * k, 0.5)
        method.shifts += 1
    method.plain = 2
    return method.dump()


@names
def test_a_memory_comes_back_as_it_was(name: str) -> None:
    memory = taught(name)
    again = METHODS[name]()
    again.load(memory)
    assert again.dump() == memory != METHODS[name]().dump()
    assert (again.shifts, again.plain) == (5, 2)
    assert len(memory) <= 4096


@names
@given(at=st.integers(0, 10_000), bit=st.integers(0, 7), cut=st.integers(0, 3))
def test_a_memory_with_any_bit_changed_or_bytes_missing_is_the_default(
    name: str, at: int, bit: int, cut: int
) -> None:
    memory = bytearray(taught(name))
    memory[at % len(memory)] ^= 1 << bit
    method = METHODS[name]()
    for damaged in (bytes(memory), taught(name)[: len(memory) - 1 - cut], taught(name) + b"\0"):
        method.load(damaged)
        assert method.dump() == METHODS[name]().dump()


@names
@given(memory=st.binary(max_size=4096))
def test_any_bytes_are_survived(name: str, memory: bytes) -> None:
    method = METHODS[name]()
    method.load(memory)
    method.learn(LARGE, method.offset_s(LARGE)[0], 0.5)


@names
@pytest.mark.parametrize(
    ("magic", "version", "number", "value"),
    [
        (b"OPC5", VERSION, 0, 0.0),
        (MAGIC, VERSION + 1, 0, 0.0),
        (MAGIC, VERSION, 99, 0.0),
        (MAGIC, VERSION, 0, float("nan")),
        (MAGIC, VERSION, 0, float("inf")),
        (MAGIC, VERSION, 0, 1e9),
    ],
)
def test_a_right_checksum_is_not_enough(
    name: str, magic: bytes, version: int, number: int, value: float
) -> None:
    method = METHODS[name]()
    values = [value] + [0.0] * (len(method.fresh) - 1)
    body = HEADER.pack(magic, version, number or method.number, 7, 0)
    body += struct.pack(f"<{len(values)}f", *values)
    method.load(body + struct.pack("<I", zlib.crc32(body)))
    assert method.dump() == METHODS[name]().dump()


def test_two_contexts_tell_friction_from_delay() -> None:
    method = Sensitivities()
    for k in range(60):
        context = LARGE if k % 2 else SMALL
        right_s = 0.06 * context.slope_s + 0.002
        method.learn(context, right_s - method.offset_s(context)[0], 0.5)
    gain, delay_s = method.values[:2]
    assert gain == pytest.approx(0.06, abs=0.002)
    assert delay_s == pytest.approx(0.002, abs=1e-4)
    assert method.offset_s(Context(1, 0.09, 0.9)) == (0.0, 0.0), "the other direction"


@pytest.mark.parametrize("name", ["sensitivities", "map", "iterative"])
def test_a_constant_error_is_learned(name: str) -> None:
    method = METHODS[name]()
    for _ in range(20):
        method.learn(LARGE, 0.003 - method.offset_s(LARGE)[0], 0.5)
    assert method.offset_s(LARGE)[0] == pytest.approx(0.003, abs=1e-4)


def test_a_context_that_was_not_met_takes_the_nearest() -> None:
    method = METHODS["map"]()
    assert method.offset_s(LARGE) == (0.0, 0.0)
    method.learn(LARGE, 0.004, 0.5)
    method.learn(Context(0, 0.02, 0.3), -0.004 - 0.002, 0.5)
    assert method.offset_s(SMALL)[0] == pytest.approx(-0.002)


def test_a_search_moves_to_the_softer_side() -> None:
    method = METHODS["search"]()
    for _ in range(40):
        offset_s, _ = method.offset_s(LARGE)
        method.learn(LARGE, 0.0, 0.4 + abs(offset_s - 0.006) * 50.0)
    offset_s = method.offset_s(LARGE)[0]
    assert offset_s == pytest.approx(0.006, abs=0.0025)
    assert METHODS["search"]().offset_s(LARGE)[0] == pytest.approx(0.001)


def test_outliers_on_one_side_are_evidence_and_others_are_not() -> None:
    method = Sensitivities()
    method.learn(LARGE, 0.005, 0.5)
    other = Context(1, 0.09, 0.9)
    method.learn(other, 0.005, 0.5)
    for error_s in (0.02, -0.02, 0.02, 0.02):
        assert not method.is_evidence(0, error_s, 3)
    assert method.offset_s(LARGE)[0] > 0.0
    assert method.is_evidence(0, 0.02, 3)
    assert method.offset_s(LARGE) == (0.0, 0.0)
    assert method.offset_s(other)[0] > 0.0
    assert not method.is_evidence(0, 0.02, 3), "counted anew"
