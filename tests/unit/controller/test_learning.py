"""What a unit learns, and its memory: whole, or the defaults."""

from __future__ import annotations

import struct
import zlib
from math import log

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.clocks import Clocks
from controller.learning import (
    ALIKE,
    HEADER,
    MAGIC,
    METHODS,
    PASSED,
    STOPPED,
    STOPPED_PER_S,
    UNKNOWN_MESH,
    VERSION,
    Context,
    Sensitivities,
    heavier_by,
)

LARGE, SMALL = Context(0, 0.09, 0.9), Context(0, 0.015, 0.1)
names = pytest.mark.parametrize("name", list(METHODS))


def taught(name: str) -> bytes:
    method = METHODS[name]()
    for k in range(5):
        method.learn(LARGE if k % 2 else SMALL, 0.001 * k, 0.5)
        method.shifts += 1
    method.clocks.began(0, 0.03)
    method.clocks.aged(0.002)
    method.plain = 2
    method.note(0.002, 1e-6)
    return method.dump()


@names
def test_a_memory_comes_back_as_it_was(name: str) -> None:
    memory = taught(name)
    again = METHODS[name]()
    again.load(memory)
    assert again.dump() == memory != METHODS[name]().dump()
    assert (again.shifts, again.plain) == (5, 2)
    assert again.surprise == pytest.approx(1.0 if name == "search" else 1.1875)
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
    method.learn(LARGE, method.offset(LARGE).later_s, 0.5)


@names
@pytest.mark.parametrize(
    ("magic", "version", "number", "value", "surprise"),
    [
        (b"OPC5", VERSION, 0, 0.0, 1.0),
        (MAGIC, 3, 0, 0.0, 1.0),
        (MAGIC, VERSION + 1, 0, 0.0, 1.0),
        (MAGIC, VERSION, 99, 0.0, 1.0),
        (MAGIC, VERSION, 0, float("nan"), 1.0),
        (MAGIC, VERSION, 0, float("inf"), 1.0),
        (MAGIC, VERSION, 0, 1e9, 1.0),
        (MAGIC, VERSION, 0, 0.0, -0.1),
        (MAGIC, VERSION, 0, 0.0, 64.1),
        (MAGIC, VERSION, 0, 0.0, float("nan")),
    ],
)
def test_a_right_checksum_is_not_enough(
    name: str, magic: bytes, version: int, number: int, value: float, surprise: float
) -> None:
    method = METHODS[name]()
    values = [value] + [0.0] * (len(method.fresh) + len(Clocks.LARGEST) - 1)
    body = HEADER.pack(magic, version, number or method.number, 7, 0, 0, 0, surprise)
    body += struct.pack(f"<{len(values)}f", *values)
    method.load(body + struct.pack("<I", zlib.crc32(body)))
    assert method.dump() == METHODS[name]().dump()


def test_contexts_tell_friction_and_drag_apart() -> None:
    method = Sensitivities()
    contexts = [each._replace(drag=drag) for each in (LARGE, SMALL) for drag in (3.0, -3.0)]
    for k in range(120):
        context = contexts[k % 4]
        right_s = context.slope_s * (0.06 + 0.03 * context.drag)
        method.learn(context, right_s - method.offset(context).later_s, 0.5)
    friction, other, drag = method.values[:3]
    assert friction == pytest.approx(0.06, abs=0.005)
    assert drag == pytest.approx(0.03, abs=0.002)
    assert abs(other) < 0.001, "nothing was said of the other synchronizer"
    assert method.offset(LARGE).variance < 0.3 * Sensitivities().offset(LARGE).variance


def test_after_errors_to_one_side_friction_is_learned_faster() -> None:
    """As after a change of the oil."""
    method, plain = Sensitivities(), Sensitivities()
    plain.leaning = 1e9  # type: ignore[misc]
    for each in (method, plain):
        for k in range(60):
            right_s = LARGE.slope_s * (0.0 if k < 50 else 0.15)
            each.learn(LARGE, right_s - each.offset(LARGE).later_s, 0.5)
    assert method.values[0] > plain.values[0] + 0.005
    assert method.values[0] == pytest.approx(0.15, abs=0.015)


def test_the_meshing_force_of_each_direction() -> None:
    method = Sensitivities()
    method.resisted(1, 0.06, 0.026**2)
    assert method.heavier(1)[0] == pytest.approx(0.03), "one alone counts half"
    for _ in range(3):
        method.resisted(1, 0.06, 0.026**2)
    assert method.heavier(1) == pytest.approx((0.0531, ALIKE**2), abs=2e-4)
    assert method.heavier(0) == METHODS["map"]().heavier(0) == (0.0, UNKNOWN_MESH**2)
    for _ in range(40):
        method.resisted(1, 0.06, 0.026**2)
    assert method.heavier(1) == pytest.approx((0.06, ALIKE**2), abs=2e-4), (
        "what all have in common stays"
    )


def test_heavier_teeth_stop_a_push_for_longer() -> None:
    found = [heavier_by(log(18.0), travel_s, 9e5) for travel_s in (0.016, 0.02, 0.065, 0.075)]
    light, usual, stopped, longer = (each for each in found if each is not None)
    assert light[0] < usual[0] < stopped[0] < longer[0] < 0.2
    assert longer[0] - stopped[0] == pytest.approx(STOPPED_PER_S * 0.01)
    assert [each[1] for each in (light, stopped)] == [PASSED**2, STOPPED**2]
    assert heavier_by(log(18.0), 0.0139, 9e5) is None, "no resistance"
    assert heavier_by(log(31.0), 0.05, 9e5) is None, "a large impulse"
    weaker = heavier_by(log(18.0), 0.02, 8e5)
    assert weaker is not None and weaker[0] < usual[0], "under less pressure it takes less to stop"


@pytest.mark.parametrize("name", ["sensitivities", "map", "iterative"])
def test_a_constant_error_is_learned(name: str) -> None:
    method = METHODS[name]()
    for _ in range(20):
        method.learn(LARGE, 0.003 - method.offset(LARGE).later_s, 0.5)
    assert method.offset(LARGE).later_s == pytest.approx(0.003, abs=1e-4)


def test_a_context_that_was_not_met_takes_the_nearest() -> None:
    method = METHODS["map"]()
    assert method.offset(LARGE).later_s == 0.0
    method.learn(LARGE, 0.004, 0.5)
    method.learn(Context(0, 0.02, 0.3), -0.004 - 0.002, 0.5)
    assert method.offset(SMALL).later_s == pytest.approx(-0.002)


def test_a_search_moves_to_the_softer_side() -> None:
    method = METHODS["search"]()
    for _ in range(40):
        offset_s = method.offset(LARGE).later_s
        method.learn(LARGE, 0.0, 0.4 + abs(offset_s - 0.006) * 50.0)
    offset_s = method.offset(LARGE).later_s
    assert offset_s == pytest.approx(0.006, abs=0.0025)
    assert METHODS["search"]().offset(LARGE).later_s == pytest.approx(0.001)


def test_the_surprise_is_the_mean_square_of_the_latest_errors_limited() -> None:
    method = Sensitivities()
    for _ in range(200):
        method.note(0.003, 4e-6)
    assert method.surprise == pytest.approx(2.25, abs=0.01)
    method.note(1.0, 4e-6)
    assert method.surprise == pytest.approx(2.25 + (6.0 - 2.25) / 16.0, abs=0.01)
    method.surprise = 1.0
    method.note(0.0088, 4e-6, is_outlier=True)
    assert method.surprise == pytest.approx(1.0 + (4.4**2 - 1.0) / 16.0)
    method.note(1.0, 4e-6, is_outlier=True)
    assert method.surprise == pytest.approx(2.1475 + (20.0 - 2.1475) / 16.0)
    for _ in range(200):
        method.note(0.0, 4e-6)
    assert method.surprise < 1e-4


def test_outliers_on_one_side_are_evidence_and_others_are_not() -> None:
    method = Sensitivities()
    method.learn(LARGE, 0.005, 0.5)
    other = Context(1, 0.09, 0.9)
    method.learn(other, 0.005, 0.5)
    for error_s in (0.02, -0.02, 0.02, 0.02):
        assert not method.is_evidence(0, error_s, 3)
    assert method.offset(LARGE).later_s > 0.0
    assert method.is_evidence(0, 0.02, 3)
    assert method.offset(LARGE).later_s == 0.0
    assert not method.is_evidence(0, 0.02, 3), "counted anew"


def test_outliers_make_a_map_forget_one_direction() -> None:
    method = METHODS["map"]()
    for direction in (0, 1):
        method.learn(LARGE._replace(direction=direction), 0.004, 0.5)
    assert method.is_evidence(0, 0.02, 1)
    assert method.offset(LARGE).later_s == 0.0
    assert method.offset(LARGE._replace(direction=1)).later_s == pytest.approx(0.004)
