"""Both sides compared tick by tick: first difference, edges, states, warming up, tolerance in time."""

from __future__ import annotations

from can_dbc.codec import encode
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
from sil.log_replay.signals import Options

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
    found = compared([(idle, idle), (on, on), (blow, idle), (idle, idle)])
    valve, *_ = found.matched_edges()
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
