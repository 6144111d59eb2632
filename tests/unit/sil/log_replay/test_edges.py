"""Edge matching: closed forms for shifted, dropped, added and chattering edges; and no better way."""

from __future__ import annotations

from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sil.log_replay.edges import Edge, Matching, SwitchingSignal, match, match_edges, shift_text

MS = 1_000_000
WINDOW = 50 * MS


def pulses(*spans_ms: tuple[float, float]) -> list[Edge]:
    return [
        Edge(round(t * MS), up)
        for span in spans_ms
        for t, up in zip(span, (True, False), strict=True)
    ]


def test_equal_edges_are_matched_one_to_one() -> None:
    edges = pulses((100, 300), (900, 950))
    assert match(edges, list(edges), WINDOW) == Matching([(i, i) for i in range(4)], [], [])
    assert match([], [], WINDOW) == Matching([], [], [])


@pytest.mark.parametrize("shift_ms", [-50, -30, 10, 50])
def test_shifted_edges_keep_their_partners(shift_ms: int) -> None:
    recorded = pulses((100, 300), (900, 1200))
    replayed = [Edge(e.time_ns + shift_ms * MS, e.up) for e in recorded]
    assert match(recorded, replayed, WINDOW) == Matching([(i, i) for i in range(4)], [], [])


def test_an_edge_beyond_the_window_is_another_edge() -> None:
    recorded, replayed = pulses((100, 300)), pulses((100, 351))
    assert match(recorded, replayed, WINDOW) == Matching([(0, 0)], [1], [1])
    assert match(recorded, pulses((100, 350)), WINDOW) == Matching([(0, 0), (1, 1)], [], [])


def test_a_dropped_pulse_leaves_the_others_matched() -> None:
    recorded = pulses((100, 120), (200, 220), (300, 320))
    replayed = pulses((101, 121), (302, 322))
    assert match(recorded, replayed, WINDOW) == Matching(
        [(0, 0), (1, 1), (4, 2), (5, 3)], [2, 3], []
    )


def test_an_added_pulse_leaves_the_others_matched() -> None:
    recorded = pulses((100, 120), (300, 320))
    replayed = pulses((100, 120), (200, 220), (300, 320))
    assert match(recorded, replayed, WINDOW) == Matching(
        [(0, 0), (1, 1), (2, 4), (3, 5)], [], [2, 3]
    )


def test_of_chattering_edges_the_nearest_ones_are_matched() -> None:
    recorded = pulses((100, 200))
    replayed = pulses((92, 94), (96, 98), (101, 200))
    assert match(recorded, replayed, WINDOW) == Matching([(0, 4), (1, 5)], [], [0, 1, 2, 3])


def test_chatter_on_both_sides_is_matched_edge_by_edge() -> None:
    recorded = pulses(*((10 * k, 10 * k + 5) for k in range(50)))
    replayed = [Edge(e.time_ns + 2 * MS, e.up) for e in recorded]
    assert match(recorded, replayed, WINDOW).pairs == [(i, i) for i in range(100)]
    without = replayed[:40] + replayed[42:]  # one pulse of the chatter is missing
    found = match(recorded, without, WINDOW)
    assert found.dropped == [40, 41] and not found.added


def test_edges_of_opposite_direction_are_never_one() -> None:
    assert match([Edge(0, True)], [Edge(0, False)], WINDOW) == Matching([], [0], [0])


SERIES = st.lists(st.tuples(st.integers(0, 120), st.booleans()), max_size=7).map(
    lambda items: [Edge(t, up) for t, up in sorted(items)]
)


@given(SERIES, SERIES, st.sampled_from([0, 5, 20, 60]))
def test_no_other_matching_costs_less(a: list[Edge], b: list[Edge], window: int) -> None:
    found = match(a, b, window)

    @cache
    def least(i: int, j: int) -> int:
        if i == len(a) or j == len(b):
            return (len(a) - i + len(b) - j) * window
        best = min(least(i + 1, j), least(i, j + 1)) + window
        apart = abs(a[i].time_ns - b[j].time_ns)
        if a[i].up is b[j].up and apart <= window:
            best = min(best, least(i + 1, j + 1) + 2 * apart)
        return best

    assert sorted([i for i, _ in found.pairs] + found.dropped) == list(range(len(a)))
    assert sorted([j for _, j in found.pairs] + found.added) == list(range(len(b)))
    assert found.pairs == sorted(found.pairs) and len({j for _, j in found.pairs}) == len(
        found.pairs
    )
    cost = sum(2 * abs(a[i].time_ns - b[j].time_ns) for i, j in found.pairs)
    assert cost + window * (len(found.dropped) + len(found.added)) == least(0, 0)


def test_shifts_are_reported_in_samples_and_ms_with_how_often() -> None:
    signal = SwitchingSignal("valve B", "opens", "closes")
    for k in range(14):
        late = 30 * MS if k in (3, 9) else 0
        signal.take(0, 1000 * MS * k, True)
        signal.take(1, 1000 * MS * k + late, True)
        signal.take(0, 1000 * MS * k + 400 * MS, False)
        signal.take(1, 1000 * MS * k + 400 * MS, False)
    result = match_edges(signal, 200 * MS)
    assert result.lines(10 * MS) == ["valve B opens 3 samples (30 ms) later, twice out of 14"]


def test_a_lane_notes_changes_only_and_tells_what_is_gone_or_new() -> None:
    signal = SwitchingSignal("valve N", "opens", "closes")
    assert not signal.take(0, 0, False)
    assert signal.take(0, 10 * MS, True) and not signal.take(0, 20 * MS, True)
    signal.take(0, 30 * MS, False)
    assert match_edges(signal, WINDOW).lines(10 * MS, base_ns=1000 * MS) == [
        "valve N opens in the recording only, at 1.010000 s",
        "valve N closes in the recording only, at 1.030000 s",
    ]


@pytest.mark.parametrize(
    ("shift_ms", "reported"),
    [(30, "3 samples (30 ms) later"), (-10, "1 sample (10 ms) earlier"), (12.5, "12.5 ms later")],
)
def test_a_shift_that_is_no_whole_sample_is_reported_in_ms(shift_ms: float, reported: str) -> None:
    assert shift_text(round(shift_ms * MS), 10 * MS) == reported
