"""Both sides compared tick by tick: signals, tolerances, first difference, edges, excerpts."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.codec import encode
from can_dbc.errors import InputError
from can_dbc.messages import (
    Chamber,
    ControllerStatus,
    Fault,
    Gear,
    SafetyBlow,
    ShiftState,
    ValveCommand,
)
from sil.log_replay.comparison import Comparison
from sil.log_replay.edges import Edge, SwitchingSignal, match, match_edges, shift_text
from sil.log_replay.excerpts import Excerpt, ExcerptRecorder, Row, waveforms
from sil.log_replay.signals import Options, SignalComparer, load_options, same, value_text, values


def status(estimate_m: float, state: ShiftState = ShiftState.IDLE) -> tuple[object, ...]:
    message = ControllerStatus(state, Gear.NEUTRAL, estimate_m, Fault.NONE)
    found = values(ControllerStatus, encode(message).data)
    assert found is not None
    return found


def test_numbers_are_the_same_within_their_tolerance_only() -> None:
    assert same(1.0, 1.0, 0.0) and not same(1.0, 1.0 + 1e-12, 0.0)
    assert same(0.3, 0.1 + 0.2, 1e-9) and same(1.0, 1.5, 0.5) and not same(1.0, 1.51, 0.5)
    assert not same(None, 1.0, 10.0) and same(None, None, 0.0)


def test_ignored_and_tolerated_signals_do_not_differ() -> None:
    ours, theirs = status(0.001), status(0.002, ShiftState.PUSH)
    names = [
        name for _, name in SignalComparer(Options()).differing(ControllerStatus, ours, theirs)
    ]
    assert names == ["ControllerStatus.state", "ControllerStatus.estimate_m"]
    some = SignalComparer(Options(ignore=["*.estimate_m"]))
    assert [n for _, n in some.differing(ControllerStatus, ours, theirs)] == [
        "ControllerStatus.state"
    ]
    lenient = Options(ignore=["*.state"], tolerance={"ControllerStatus.estimate_m": 0.001})
    assert SignalComparer(lenient).differing(ControllerStatus, ours, theirs) == []


def test_values_outside_the_contract_are_none() -> None:
    assert values(ControllerStatus, bytes(8)) is None  # unused bits are ones


def test_options_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "o.toml"
    file.write_text(
        'ignore = ["Etc1.*"]\ntime_s = 0.01\n[tolerance]\n"ControllerStatus.estimate_m" = 1e-5\n'
        "[edges]\nwindow_s = 0.1\n"
    )
    options = load_options(file)
    assert options.time_s == 0.01 and options.edges.window_s == 0.1


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('ignore = ["Etc9.*"]', "ignore: Etc9"),
        ('ignored = ["Etc1.*"]', "ignored: unknown"),
        (
            '[tolerance]\n"ControllerStatus.estimat_m" = 1.0',
            "expected one of ControllerStatus.estimate_m",
        ),
        ('[tolerance]\n"ControllerStatus.estimate_m" = -1.0', "tolerance"),
        ('[tolerance]\n"ControllerStatus.estimate_m" = nan', "finite"),
        ("time_s = 'x'", "time_s"),
        ("[edges", "expected TOML"),
    ],
)
def test_options_that_are_none_are_refused_by_name(
    tmp_path: Path, text: str, complaint: str
) -> None:
    file = tmp_path / "o.toml"
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        load_options(file)
    assert complaint in str(refused.value) and str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_values_as_a_reader_wants_them() -> None:
    assert value_text(Fault.NONE) == "NONE"
    assert value_text(Fault.POSITION_LOST | Fault.SPEEDS_LOST) == "POSITION_LOST|SPEEDS_LOST"
    assert (value_text(None), value_text(True), value_text(0.98), value_text(Gear.FORWARD)) == (
        "not available",
        "yes",
        "0.98",
        "FORWARD",
    )


TICK = 10_000_000


def tick(
    duty_b: float = 0.0,
    state: ShiftState = ShiftState.IDLE,
    estimate_m: float = 0.0,
    blow: Chamber = Chamber.NONE,
) -> dict[type, bytes]:
    active = blow is not Chamber.NONE
    messages = (
        ValveCommand(duty_b, 0.0, 0.0, Gear.NEUTRAL),
        SafetyBlow(blow, active, 0.1 if active else 0.0),
        ControllerStatus(state, Gear.NEUTRAL, estimate_m, Fault.NONE),
    )
    return {type(message): encode(message).data for message in messages}


def compared(
    pairs: list[tuple[dict[type, bytes], dict[type, bytes]]],
    options: Options | None = None,
    warming: bool = False,
) -> Comparison:
    found = Comparison(options or Options(), 0.33, lambda: ["what led there"], warming)
    for k, (recorded, replayed) in enumerate(pairs):
        found.take(k * TICK, recorded, replayed)
    found.finish()
    return found


def test_equal_sides_do_not_differ_and_are_engaged_when_a_valve_was() -> None:
    idle, on = tick(), tick(0.98, ShiftState.PUSH)
    found = compared([(idle, idle), (on, on), (idle, idle)])
    assert not found.differs and found.engaged and found.ticks == 3
    assert found.signals["ValveCommand.duty_b"].compared == 3
    assert not compared([(idle, idle)] * 3).engaged


def test_the_first_difference_has_time_signals_and_inputs() -> None:
    idle, on = tick(), tick(0.98, ShiftState.PUSH)
    found = compared([(idle, idle), (idle, tick(estimate_m=0.001)), (on, idle), (on, on)])
    assert found.first is not None and found.first_command is not None
    assert found.first.time_ns == TICK and found.first.inputs == ["what led there"]
    assert found.first.signals == [("ControllerStatus.estimate_m", "0", "0.001")]
    assert found.first_command.time_ns == 2 * TICK
    assert found.first_command.signals[0] == ("ValveCommand.duty_b", "0.98", "0")
    assert found.differing_ticks == 2
    assert found.signals["ControllerStatus.estimate_m"].largest == 0.001


def test_a_valve_is_open_by_its_duty_or_by_a_blow() -> None:
    on, blow, idle = tick(0.98), tick(blow=Chamber.B), tick()
    valve, *_ = compared([(idle, idle), (on, on), (blow, idle), (idle, idle)]).matched_edges()
    assert valve.lines(TICK) == ["valve B closes 1 sample (10 ms) earlier, once out of 1"]
    assert not compared([(tick(0.33), tick(0.33))]).engaged  # the duty that leaves it closed


def test_states_of_another_order_differ() -> None:
    idle, push, fault = tick(), tick(state=ShiftState.PUSH), tick(state=ShiftState.FAULT)
    found = compared([(idle, idle), (push, fault), (idle, idle)])
    assert found.states[0].differs
    assert found.states[0].sequence(1) == ["IDLE", "FAULT", "IDLE"]
    late = compared([(idle, idle), (push, idle), (push, push), (idle, idle)])
    assert not late.states[0].differs  # the same sequence, another time


def test_warming_up_leaves_out_what_came_before_the_sides_agreed() -> None:
    push, init, idle = tick(0.98, ShiftState.PUSH), tick(state=ShiftState.INIT), tick()
    found = compared([(push, init), (push, idle), (idle, idle), (push, push)], warming=True)
    assert found.warm_up_ticks == 2 and not found.differs and found.ticks == 2


def test_a_shift_that_begins_while_warming_up_is_compared() -> None:
    push, init, idle = tick(0.98, ShiftState.PUSH), tick(state=ShiftState.INIT), tick()
    found = compared([(idle, init), (idle, init), (push, init), (push, init)], warming=True)
    assert found.differs and found.warm_up_ticks == 2
    assert found.matched_edges()[0].matching.dropped == [0]


def test_a_tolerance_in_time_allows_for_that_much_and_no_more() -> None:
    idle, on = tick(), tick(0.98, ShiftState.PUSH)
    pairs = [(idle, idle)] * 5 + [(on, idle)] * 2 + [(on, on)] * 5 + [(idle, idle)] * 5
    assert compared(pairs).differs
    assert compared(pairs, Options(time_s=0.01)).differs
    lenient = compared(pairs, Options(time_s=0.02))
    assert not lenient.differs and lenient.signals["ValveCommand.duty_b"].compared == len(pairs)


def test_a_silent_side_stands_with_what_it_sent_last() -> None:
    idle, on = tick(), tick(0.98, ShiftState.PUSH)
    found = compared([(idle, idle), ({}, on), (on, {}), (on, on)])
    assert not found.differs and found.ticks == 3


MS = 1_000_000
WINDOW = 50 * MS


def pulses(*spans_ms: tuple[float, float]) -> list[Edge]:
    return [
        Edge(round(t * MS), up)
        for span in spans_ms
        for t, up in zip(span, (True, False), strict=True)
    ]


def test_chatter_on_both_sides_is_matched_edge_by_edge() -> None:
    recorded = pulses(*((10 * k, 10 * k + 5) for k in range(50)))
    replayed = [Edge(e.time_ns + 2 * MS, e.up) for e in recorded]
    assert match(recorded, replayed, WINDOW).pairs == [(i, i) for i in range(100)]
    without = replayed[:40] + replayed[42:]  # one pulse of the chatter is missing
    found = match(recorded, without, WINDOW)
    assert found.dropped == [40, 41] and not found.added


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


COLUMN = 10_000_000


def row(k: int, a: bool, b: bool, states: tuple[str, str] = ("IDLE", "IDLE")) -> Row:
    return Row(k * COLUMN, ((a, False, False), (b, False, False)), states, (0.0, 0.0))


def test_a_scene_has_what_came_before_and_after() -> None:
    scenes = ExcerptRecorder()
    for k in range(200):
        scenes.take(row(k, k >= 100, k >= 100), changed=k == 100, differs=False)
    (scene,) = scenes.excerpts
    assert (scene.rows[0].time_ns, scene.rows[-1].time_ns) == (92 * COLUMN, 116 * COLUMN)
    assert not scene.differs


def test_only_so_many_and_so_long_scenes_are_kept() -> None:
    scenes = ExcerptRecorder()
    for k in range(4_000):  # a difference and an edge in turn, every half second
        scenes.take(row(k, False, k % 100 < 5), changed=k % 100 == 50, differs=k % 100 < 5)
    assert sum(s.differs for s in scenes.excerpts) == 6
    assert sum(not s.differs for s in scenes.excerpts) == 3
    always = ExcerptRecorder()
    for k in range(50_000):
        always.take(row(k, False, True), changed=False, differs=True)
    assert len(always.excerpts) == 6
    assert all(len(s.rows) <= 1000 for s in always.excerpts)
    assert always.excerpts[0].rows[-1].time_ns <= 1_500_000_000 + COLUMN


def test_waveforms_show_both_sides_and_mark_what_differs() -> None:
    on = [False, True, True, True, False, False]
    off = [False, True, False, False, False, False]
    states = (
        [("IDLE", "IDLE")] + [("PUSH", "PUSH")] + [("PUSH", "HOLD")] * 2 + [("IDLE", "IDLE")] * 2
    )
    rows = [row(k, *x) for k, x in enumerate(zip(on, off, states, strict=True))]
    assert waveforms(Excerpt(rows, True), ("recorded", "replayed"), 5 * COLUMN) == [
        "from 0.050000 s, 10 ms per column",
        "valve B   recorded _###__",
        "          replayed _#____",
        "                     ^^",
        "state     recorded ||PU|I",
        "          replayed |||H|I",
        "                     ^^",
        "",
    ]
