"""A log through the control unit: its inputs at their times, its ticks, both sides' answers.

The log is read some ticks ahead, so that at each tick all of the control unit's recorded frames of that
tick are known, the delayed ones too. Times inside are counted from the control unit's first tick.
"""

from __future__ import annotations

import copy
from collections import Counter, deque
from collections.abc import Callable, Iterable
from itertools import islice, takewhile

from can_dbc.e2e import COUNTERS, PROTECTED
from can_dbc.frame import Frame
from sil.coupling.clock import to_seconds
from sil.coupling.transports.channel import Participant, ParticipantLost
from sil.log_replay.comparison import Comparison
from sil.log_replay.plant_side import PlantSide
from sil.log_replay.recorded_frames import INPUTS, OUTPUTS, OWN_IDS, Arrival, bare, is_intact
from sil.log_replay.signals import NAMES, value_text, values
from sil.log_replay.ticks import Span, TickMap


class Unit:
    """A control unit under replay, which restarts after gaps in the recording.

    make: starts it anew; its times count from the tick of its latest start.
    """

    def __init__(self, make: Callable[[], Participant]) -> None:
        self._make = make
        self._node = make()
        self._start_ns = 0
        self._now_ns = 0

    def restart(self, tick_ns: int) -> None:
        """Start anew with the tick at this time."""
        self.close()
        self._node, self._start_ns, self._now_ns = self._make(), tick_ns, 0

    def copy(self) -> Unit | None:
        """Return a copy in the same state; None for a firmware that is not ours and cannot be copied."""
        from controller.node import ControllerNode

        if not isinstance(self._node, ControllerNode):
            return None
        twin = copy.copy(self)
        twin._node = copy.deepcopy(self._node)
        return twin

    def step(self, tick_ns: int, deliveries: Iterable[tuple[int, Frame]]) -> list[Frame]:
        """Run a tick with the frames that arrived since the one before; return the frames released.

        Raises RunError when the firmware fails.
        """
        start_ns = self._start_ns
        since = [(max(time_ns - start_ns, self._now_ns), frame) for time_ns, frame in deliveries]
        self._now_ns = tick_ns - start_ns
        try:
            released, _ = self._node.advance(tick_ns - start_ns, since)
        except ParticipantLost as lost:
            raise lost.at(to_seconds(tick_ns)) from None
        return [frame for _, frame in released]

    def close(self) -> None:
        """End the control unit."""
        self._node.close()


class ReplayExecutor:
    """Runs a control unit over a log and hands both sides of each tick to the comparison.

    period_ns: of the control unit under replay; the map has that of the recorded one.
    receives: whether the control unit receives the frames of a time (log's clock, ns).
    plant: takes part where the plant is replayed too.
    reference: another control unit whose answers replace the recorded ones.
    Checked by: tests/scenarios/test_replay.py
    """

    def __init__(
        self,
        ticks: TickMap,
        unit: Unit,
        period_ns: int,
        receives: Callable[[int], bool],
        plant: PlantSide | None = None,
        reference: Unit | None = None,
    ) -> None:
        self._map, self._grid = ticks, ticks.grid
        self._unit, self._reference = unit, reference
        self._period_ns = period_ns
        self._same_grid = period_ns == ticks.grid.period_ns
        self._receives = receives
        self._plant = plant
        self._ahead_ns = COUNTERS * self._grid.period_ns + 10_000_000
        self._pending: deque[tuple[int, Frame]] = deque()
        self._answers: dict[int, dict[type, bytes]] = {}
        self._answered_ns: dict[int, int] = {}
        self._last_tick = 0
        self._next_recorded = 0
        self._next_ns = 0
        self._restarts = list(ticks.restarts)
        self._heard: deque[tuple[int, type, Frame]] = deque(maxlen=12)
        self.account: Counter[str] = Counter()
        """How many frames of the log were what; together they are all of its frames."""
        self.steps = 0
        self.unanswered: Counter[str] = Counter()
        self.moved_inputs = 0
        """Inputs counted for another tick than their time says, as the recorded answers show."""
        self.end_ns = ticks.last * self._grid.period_ns
        self.comparison: Comparison | None = None

    def inputs(self) -> list[str]:
        """Return the latest inputs as texts, oldest first."""
        base_ns = self._grid.origin_ns
        return [
            f"{(time_ns + base_ns) / 1e9:.6f} s {_input_text(kind, frame)}"
            for time_ns, kind, frame in self._heard
        ]

    def run(self, arrivals: Iterable[Arrival], comparison: Comparison) -> None:
        """Run the whole log."""
        self.comparison = comparison
        base_ns = self._grid.origin_ns
        front_ns = 0
        for arrival in arrivals:
            front_ns = arrival.time_ns - base_ns
            while self._due_ns() + self._ahead_ns <= front_ns and self._due_ns() <= self.end_ns:
                self._go()
            self._sort(arrival, front_ns)
        while self._due_ns() <= self.end_ns:
            self._go()
        if self._plant is not None:
            self._plant.finish(front_ns)
        comparison.finish()

    def _due_ns(self) -> int:
        if self._same_grid:
            return self._next_ns
        return min(self._next_ns, self._next_recorded * self._grid.period_ns)

    # --- reading ----------------------------------------------------------------------------
    def _sort(self, arrival: Arrival, time_ns: int) -> None:
        """Put a frame where it belongs."""
        kind = arrival.kind
        if kind is None:
            what = "foreign"
        elif kind in OUTPUTS:
            what = self._sort_answer(arrival, kind)
        elif kind not in INPUTS:
            what = "of the plant"
        elif self._receives(arrival.time_ns):
            what = "inputs"
            self._pending.append((time_ns, arrival.frame))
        else:
            what = "inputs while off the bus"
        self.account[what] += 1
        if self._plant is not None:
            self._plant.see(time_ns, arrival)

    def _sort_answer(self, arrival: Arrival, kind: type) -> str:
        """Put an answer to its tick; return what it counts as."""
        if not is_intact(kind, arrival.frame):
            return f"{kind.__name__} with a wrong checksum or length"
        tick = self._map.tick_of(arrival)
        if kind in PROTECTED:
            self._last_tick = tick
        elif not self._grid.exact:  # sent with the answers before it
            tick = self._last_tick
        if kind in self._answers.get(tick, ()):  # its counter does not change
            tick = self._grid.latest_tick(arrival)
        if tick < self._next_recorded:
            return f"{kind.__name__} from before the replay or too late"
        if kind in self._answers.setdefault(tick, {}):
            return f"{kind.__name__} a second time in one tick"
        self._answered_ns.setdefault(tick, arrival.time_ns - self._grid.origin_ns)
        self._answers[tick][kind] = bare(kind, arrival.frame.data)
        return "answers of the control unit"

    # --- running ----------------------------------------------------------------------------
    def _go(self) -> None:
        """Take the next tick of either side."""
        assert self.comparison is not None
        now_ns = self._due_ns()
        recorded: dict[type, bytes] = {}
        tick, rest = divmod(now_ns, self._grid.period_ns)
        if not rest:
            recorded = self._answers.pop(tick, {})
            self._next_recorded = tick + 1
        replayed: dict[type, bytes] = {}
        idle = self._map.idle_at(tick)
        if idle is not None:
            self._skip(idle)
        elif now_ns == self._next_ns:
            self._next_ns += self._period_ns
            recorded, replayed = self._step(now_ns, tick, recorded)
        if self._reference is None and self._same_grid:
            for kind in replayed.keys() - recorded.keys():
                self.unanswered[kind.__name__] += 1
            replayed = {k: data for k, data in replayed.items() if k in recorded}
        if recorded or replayed:
            self.comparison.take(now_ns, recorded, replayed)

    def _skip(self, idle: Span) -> None:
        """Go on behind the ticks that did not run, of which there may be very many."""
        self._next_recorded = idle.end
        end_ns = idle.end * self._grid.period_ns
        self._next_ns = -(-end_ns // self._period_ns) * self._period_ns
        for tick in [tick for tick in self._answers if tick < idle.end]:
            del self._answers[tick]

    def _step(
        self, now_ns: int, tick: int, recorded: dict[type, bytes]
    ) -> tuple[dict[type, bytes], dict[type, bytes]]:
        """Run a tick; return the recorded answers, or those of the reference, and the control unit's."""
        assert self.comparison is not None
        if restarts := sum(1 for _ in takewhile(lambda first: first <= tick, self._restarts)):
            del self._restarts[:restarts]
            self._unit.restart(now_ns)
            if self._reference is not None:
                self._reference.restart(now_ns)
            self.comparison.begin_warm_up()
        released: list[Frame] | None = None
        count = self._arrived(now_ns)
        if recorded and not (self._grid.exact or self._plant or self._reference):
            count, released = self._step_as_recorded(now_ns, tick, count, recorded)
        deliveries = [self._pending.popleft() for _ in range(count)]
        if self._plant is not None:
            deliveries = self._plant.deliveries(now_ns, deliveries)
        self._heard.extend((t, OWN_IDS[frame.can_id], frame) for t, frame in deliveries)
        if released is None:
            released = self._unit.step(now_ns, deliveries)
        self.steps += 1
        answers = by_kind(released)
        if self._plant is not None:
            self._plant.answered(now_ns, released, answers, recorded)
        if self._reference is not None:
            recorded = by_kind(self._reference.step(now_ns, deliveries))
        return recorded, answers

    def _arrived(self, until_ns: int) -> int:
        return sum(1 for _ in takewhile(lambda pending: pending[0] <= until_ns, self._pending))

    def _step_as_recorded(
        self, now_ns: int, tick: int, in_time: int, recorded: dict[type, bytes]
    ) -> tuple[int, list[Frame] | None]:
        """Step with inputs near the tick such that the recorded answers come out, if they can.

        In real time the tick itself is known to the jitter only: an input shortly before it may
        have missed it, and one before the answers may have been in time. Returns how many of the
        pending inputs count, and the frames released; None for these if nothing is open.
        """
        first = self._arrived(now_ns - 1_000_000)
        last = max(self._arrived(self._answered_ns.pop(tick, now_ns)), in_time)
        before = self._unit.copy() if first < last else None
        if before is None:
            return in_time, None
        choices: list[tuple[int, Unit, list[Frame]]] = []
        for count in sorted(range(first, last + 1), key=lambda count: abs(count - in_time)):
            unit = before.copy() or before
            inputs = [(min(t, now_ns), f) for t, f in islice(self._pending, count)]
            choices.append((count, unit, unit.step(now_ns, inputs)))
            if recorded.items() <= by_kind(choices[-1][2]).items():
                self.moved_inputs += abs(count - in_time)
                break
        else:
            del choices[1:]  # the first choice is by time alone
        count, self._unit, released = choices[-1]
        return count, released


def by_kind(released: Iterable[Frame]) -> dict[type, bytes]:
    """Return the data of released frames by message type, without counter and checksum."""
    own = ((OWN_IDS[can_id], data) for can_id, data in released if can_id in OWN_IDS)
    return {kind: bare(kind, data) for kind, data in own}


def _input_text(kind: type, frame: Frame) -> str:
    signal_values = values(kind, frame.data) if is_intact(kind, frame) else None
    if signal_values is None:
        return f"{kind.__name__} damaged: {frame.data.hex().upper()}"
    named = zip((name.split(".")[1] for name in NAMES[kind]), signal_values, strict=True)
    return f"{kind.__name__}: {', '.join(f'{name} {value_text(value)}' for name, value in named)}"
