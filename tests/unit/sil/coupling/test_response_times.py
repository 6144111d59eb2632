"""Worst-case response times: the paper's case, one worked by hand, and the bus model as witness."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import spec_of
from can_dbc.contract import DBC_PATH
from can_dbc.dbc import load_dbc, parse_dbc
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import TRUCK
from sil.coupling.bus import BusModel
from sil.coupling.frame_bits import (
    INTERMISSION_BITS,
    crc15,
    frame_bits,
    longest_frame_bits,
    shortest_frame_bits,
)
from sil.coupling.response_times import (
    PeriodicMessage,
    contract_messages,
    database_messages,
    response_times,
    transmission_ns,
    utilisation,
)

US = 1_000
MS = 1_000_000


def standard(
    name: str, can_id: int, period_ns: int, length: int = 7, jitter_ns: int = 0
) -> PeriodicMessage:
    """Seven bytes and 11 bits of identifier last exactly 1 ms at 125 kbit/s."""
    return PeriodicMessage(name, can_id, period_ns, length, jitter_ns, extended=False)


def test_the_case_that_refuted_the_older_analysis() -> None:
    """Davis et al. 2007, table 3: 3.5 ms for the second C, where the analysis of 1994 gives 3 ms."""
    periods_us = {"A": 2_500, "B": 3_500, "C": 3_500}
    messages = [standard(name, k, us * US) for k, (name, us) in enumerate(periods_us.items(), 1)]
    a, b, c = response_times(messages, 125_000)
    assert (a.transmission_ns, b.transmission_ns, c.transmission_ns) == (MS, MS, MS)
    assert (a.response_ns, b.response_ns, c.response_ns) == (2 * MS, 3 * MS, 3_500 * US)
    assert (a.blocking_ns, b.blocking_ns, c.blocking_ns) == (MS, MS, 0)
    assert utilisation(messages, 125_000) == Fraction(2, 5) + Fraction(4, 7)


def test_a_case_worked_by_hand() -> None:
    """125 kbit/s, 11 bits: C of 2, 7, 8 bytes are 0.6, 1.0, 1.08 ms; tau_bit 0.008 ms.

    m1: T 2, J 0.2: B 1.08; R = 0.2 + 1.08 + 0.6 = 1.88.
    m2: T 5: B 1.08; w = 1.08 + ceil((w + 0.208) / 2) 0.6 = 1.68; R = 2.68.
    m3: T 10: B 0; w = ceil((w + 0.208) / 2) 0.6 + ceil((w + 0.008) / 5) 1.0 = 1.6; R = 2.68.
    """
    messages = [
        standard("m3", 30, 10 * MS, length=8),
        standard("m1", 10, 2 * MS, length=2, jitter_ns=200 * US),
        standard("m2", 20, 5 * MS),
    ]
    results = response_times(messages, 125_000)
    assert [r.message.name for r in results] == ["m1", "m2", "m3"]
    assert [r.transmission_ns for r in results] == [600 * US, 1_000 * US, 1_080 * US]
    assert [r.blocking_ns for r in results] == [1_080 * US, 1_080 * US, 0]
    assert [r.response_ns for r in results] == [1_880 * US, 2_680 * US, 2_680 * US]
    assert all(r.in_time for r in results)


def test_a_release_within_the_bit_of_arbitration_still_interferes() -> None:
    """The same m3 waits for a second m1 when J_1 + tau_bit reaches past 2 - 1.6 ms."""

    def last(jitter_ns: int) -> int:
        messages = [
            standard("m1", 10, 2 * MS, length=2, jitter_ns=jitter_ns),
            standard("m2", 20, 5 * MS),
            standard("m3", 30, 10 * MS, length=8),
        ]
        return response_times(messages, 125_000)[-1].response_ns

    assert last(392 * US) == 2_680 * US
    assert last(392 * US + 1) == 3_280 * US


def test_a_response_at_the_end_of_the_period_is_in_time() -> None:
    for jitter_ns, in_time in ((500 * US, True), (500 * US + 1, False)):
        (result,) = response_times([standard("m", 1, 1_500 * US, jitter_ns=jitter_ns)], 125_000)
        assert (result.response_ns, result.in_time) == (MS + jitter_ns, in_time)


def test_own_jitter_counts_from_the_period() -> None:
    (alone,) = response_times([standard("m", 1, 10 * MS, jitter_ns=3 * MS)], 125_000)
    assert alone.response_ns == 4 * MS
    (crowded,) = response_times([standard("m", 1, 2 * MS, jitter_ns=5 * MS)], 125_000)
    assert crowded.response_ns == 6 * MS


def test_standard_frames_win_against_extended_ones_of_equal_base() -> None:
    """A standard frame sends RTR and IDE dominant where an extended one is recessive."""
    extended = PeriodicMessage("extended", 0x100 << 18, 10 * MS)
    later = PeriodicMessage("later", 0x0FF << 18 | 0x3FFFF, 10 * MS)
    base = standard("standard", 0x100, 10 * MS)
    names = [r.message.name for r in response_times([extended, base, later], 500_000)]
    assert names == ["later", "standard", "extended"]


@pytest.mark.parametrize("bitrate", [125_000, 250_000, 500_000, 1_000_000])
def test_the_contract_at_each_bit_rate(bitrate: int) -> None:
    """All released at once behind the longest other frame: R is a sum of frames of 160 bits."""
    messages = contract_messages()
    frame_ns = 160 * (10**9 // bitrate)
    load = Fraction(frame_ns, 10 * MS) * Fraction(19, 2)
    assert utilisation(messages, bitrate) == load
    if load > 1:
        with pytest.raises(InputError, match=r"worst-case load 121.6% at 125000 bit/s"):
            response_times(messages, bitrate)
        return
    results = response_times(messages, bitrate)
    assert len(results) == 10
    for place, result in enumerate(results):
        assert result.transmission_ns == frame_ns
        last = place == len(results) - 1
        assert result.response_ns == frame_ns * (place + (1 if last else 2))
        assert result.in_time
    assert [r.message.name for r in results[:2]] == ["ValveCommand", "SafetyBlow"]
    assert results[-1].message.name == "PlantPressures"


def test_a_faster_firmware_raises_the_load() -> None:
    names = ("ValveCommand", "SafetyBlow", "ControllerStatus", "PositionPulse")
    fast = dict.fromkeys(names, 2_500 * US)
    results = {r.message.name: r for r in response_times(contract_messages(fast), 500_000)}
    assert results["PlantPressures"].response_ns > 3_200 * US
    assert results["PlantPressures"].in_time
    with pytest.raises(InputError, match="expected at most 100 %"):
        response_times(contract_messages(fast), 250_000)


def test_full_load_without_slack_is_refused_not_searched_for_ever() -> None:
    full = [standard("a", 1, 2 * MS), standard("b", 2, 2 * MS)]
    results = response_times(full, 125_000)  # b is not blocked: exactly back to back
    assert [r.response_ns for r in results] == [2 * MS, 2 * MS]
    never_idle = [*full[:1], standard("b", 2, 4 * MS), standard("c", 3, 4 * MS)]
    # b: behind c and a until 2 ms, when the next a is there as well.
    assert [r.response_ns for r in response_times(never_idle, 125_000)] == [2 * MS, 4 * MS, 4 * MS]
    with pytest.raises(InputError, match="b: with the more urgent messages it loads the bus so"):
        response_times([standard("a", 1, 2 * MS), standard("b", 2, 2 * MS, jitter_ns=1)], 125_000)


@pytest.mark.parametrize("wrong", [{"period_ns": 0}, {"period_ns": -1}, {"jitter_ns": -1}])
def test_malformed_messages_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match="w: period"):
        response_times([replace(standard("w", 9, MS), **wrong)], 500_000)


def test_shared_identifiers_are_refused() -> None:
    pair = [standard("a", 5, 10 * MS), standard("b", 5, 20 * MS)]
    with pytest.raises(InputError, match="a and b share identifier 0x5"):
        response_times(pair, 500_000)
    other_format = PeriodicMessage("b", 5, 20 * MS)
    assert len(response_times([pair[0], other_format], 500_000)) == 2


def test_a_foreign_database() -> None:
    truck = {kind.__name__: spec_of(kind).cycle_ns for kind in TRUCK}
    everything = database_messages(load_dbc(DBC_PATH))
    assert everything == contract_messages(truck)
    assert [m for m in everything if m.name not in truck] == list(contract_messages())
    text = (
        "BU_: A\nBO_ 5 Slow: 3 A\n\nBO_ 6 Event: 8 A\n\n"
        'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\n'
        'BA_DEF_DEF_ "GenMsgCycleTime" 0;\n'
    )
    attribute = 'BA_ "GenMsgCycleTime" BO_ 5 100;\n'
    (slow,) = database_messages(parse_dbc((text + attribute).encode()))
    assert slow == PeriodicMessage("Slow", 5, 100 * MS, 3, extended=False)
    with pytest.raises(InputError, match="no message has a cycle time"):
        database_messages(parse_dbc(text.encode()))
    long = text.replace("Slow: 3", "Slow: 9") + attribute
    with pytest.raises(InputError, match="Slow: 9 bytes; expected at most 8"):
        database_messages(parse_dbc(long.encode()))


@st.composite
def message_sets(draw: st.DrawFn) -> tuple[list[PeriodicMessage], int]:
    """Up to six messages whose worst-case load is at most 1, and a bit rate."""
    bitrate = draw(st.sampled_from((125_000, 250_000, 500_000)))
    number = draw(st.integers(1, 6))
    ids = draw(
        st.lists(st.integers(0, (1 << 29) - 1), min_size=number, max_size=number, unique=True)
    )
    messages = []
    for place, can_id in enumerate(ids):
        message = PeriodicMessage(f"m{place}", can_id, 10**9, draw(st.integers(0, 8)))
        share = draw(st.floats(1.1, 3.0))
        period_ns = int(transmission_ns(message, bitrate) * number * share)
        jitter_ns = draw(st.integers(0, period_ns))
        messages.append(replace(message, period_ns=period_ns, jitter_ns=jitter_ns))
    return messages, bitrate


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_no_simulated_frame_is_later_than_the_worst_case(data: st.DataObject) -> None:
    """Any phasing, any payload, any jitter up to the bound."""
    messages, bitrate = data.draw(message_sets())
    rng = data.draw(st.randoms(use_true_random=False))
    bound = {r.message.can_id: r for r in response_times(messages, bitrate)}
    bus = BusModel(bitrate)
    end_ns = 12 * max(message.period_ns for message in messages)
    due: dict[tuple[int, int], int] = {}
    for message in messages:
        phase_ns = rng.choice((0, rng.randrange(message.period_ns)))
        latest_ns = 0
        for period_ns in range(phase_ns, end_ns, message.period_ns):
            late_ns = rng.choice((0, message.jitter_ns, rng.randint(0, message.jitter_ns)))
            latest_ns = max(latest_ns + 1, period_ns + late_ns)  # a sender keeps its order
            payload = rng.choice((bytes(8), b"\xff" * 8, rng.randbytes(8)))[: message.length]
            bus.queue(latest_ns, Frame(message.can_id, payload), message.name)
            due[message.can_id, latest_ns] = period_ns
    arrived = bus.advance(10 * end_ns)
    assert len(arrived) == len(due)
    for delivery in arrived:
        can_id = delivery.frame.can_id
        response_ns = delivery.arrival_ns - due[can_id, delivery.released_ns]
        # The analysis counts the intermission after the frame as well.
        assert response_ns + INTERMISSION_BITS * bus.bit_ns <= bound[can_id].response_ns


@pytest.mark.parametrize("bitrate", [250_000, 500_000, 1_000_000])
def test_the_bound_is_reached_but_for_the_stuffing(bitrate: int) -> None:
    """The contract, all released just after the least urgent frame has started."""
    results = response_times(contract_messages(), bitrate)
    bus = BusModel(bitrate)
    blocker = results[-1]
    bus.queue(0, Frame(blocker.message.can_id, bytes(8)), "blocker")
    for result in results[:-1]:
        bus.queue(1, Frame(result.message.can_id, bytes(8)), result.message.name)
    spared_bits = 160 - frame_bits(blocker.message.can_id, bytes(8)) - INTERMISSION_BITS
    for delivery, result in zip(bus.advance(10**9)[1:], results, strict=False):
        assert delivery.frame.can_id == result.message.can_id
        spared_bits += 160 - frame_bits(result.message.can_id, bytes(8)) - INTERMISSION_BITS
        response_ns = delivery.arrival_ns - 1 + INTERMISSION_BITS * bus.bit_ns
        assert response_ns == result.response_ns - spared_bits * bus.bit_ns - 1
        assert response_ns > 0.85 * result.response_ns


# Runs of equal bits, which stuffing is about, are rare in uniform bytes.
payloads = st.lists(
    st.sampled_from((0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xE0, 0x83, 0x7C)) | st.integers(0, 255),
    max_size=8,
).map(bytes)


def plain_bits(can_id: int, data: bytes) -> str:
    """Start of frame to end of data, field by field as in the specification."""
    base, extension = f"{can_id >> 18:011b}", f"{can_id & 0x3FFFF:018b}"
    sof, srr, ide, rtr, reserved = "0", "1", "1", "0", "00"
    header = sof + base + srr + ide + extension + rtr + reserved
    return header + f"{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)


def divided(bits: str) -> str:
    """Remainder of bits * x^15 by the generator, by long division over GF(2)."""
    generator = 0b1100010110011001
    dividend = int(bits, 2) << 15
    while dividend.bit_length() > 15:
        dividend ^= generator << dividend.bit_length() - 16
    return f"{dividend:015b}"


def stuffed(bits: str) -> str:
    out = ""
    for bit in bits:
        out += bit
        if len(out) >= 5 and out[-5:] == out[-1] * 5:
            out += "10"[int(out[-1])]
    return out


@given(st.integers(0, (1 << 29) - 1), payloads)
@settings(max_examples=400, deadline=None)
def test_length_is_that_of_the_frame_written_out(can_id: int, data: bytes) -> None:
    bits = plain_bits(can_id, data)
    on_the_wire = stuffed(bits + divided(bits))
    assert "000000" not in on_the_wire
    assert "111111" not in on_the_wire
    acknowledge, end_of_frame = "101", "1111111"
    length = frame_bits(can_id, data)
    assert length == len(on_the_wire + acknowledge + end_of_frame)
    assert shortest_frame_bits(len(data)) <= length <= longest_frame_bits(len(data))


def test_crc_has_its_published_check_value() -> None:
    """0x059E for the nine digits (catalogue of parametrised CRC algorithms, CRC-15/CAN)."""
    assert crc15(int.from_bytes(b"123456789", "big"), 72) == 0x059E


@pytest.mark.parametrize("length", range(9))
def test_published_bounds(length: int) -> None:
    """Davis et al. 2007, intermission included."""
    assert longest_frame_bits(length, False) + INTERMISSION_BITS == 55 + 10 * length
    assert longest_frame_bits(length, True) + INTERMISSION_BITS == 80 + 10 * length
    assert shortest_frame_bits(length, False) + INTERMISSION_BITS == 47 + 8 * length
    assert shortest_frame_bits(length, True) + INTERMISSION_BITS == 67 + 8 * length


@pytest.mark.parametrize(("can_id", "length"), [(-1, 0), (1 << 29, 0), (0, 9)])
def test_what_is_no_frame_is_refused(can_id: int, length: int) -> None:
    with pytest.raises(ValueError, match="expected 29 bits and at most 8 bytes"):
        frame_bits(can_id, bytes(length))
