"""Which ticks the recorded unit ran, and which tick each of its frames belongs to.

The end-to-end counters show it. When nothing of the control unit was on the bus for a while, counters that
went on by the ticks that passed mean that it ran and was off the bus, so that it received nothing;
counters that did not change mean that it did not run. A hole in which nobody was on the bus is none
of the control unit's: the recorder was off, and the replay starts anew behind it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from can_dbc.e2e import COUNTERS, PROTECTED
from sil.log_replay.recorded_frames import OUTPUTS, Arrival, counter_of, is_intact
from sil.log_replay.tick_grid import Grid


class Span(NamedTuple):
    """Ticks from `first` to before `end`."""

    first: int
    end: int


class TickMap:
    """What the recorded unit's ticks were like; made by `map_ticks`.

    idle: ticks that did not run. off_bus: ticks that ran while the control unit was off the bus.
    restarts: first ticks after gaps in the recording. last: the last tick with a frame.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.idle: list[Span] = []
        self.off_bus: list[Span] = []
        self.restarts: list[int] = []
        self.last = -1
        self._from = [0]
        self._shift = [0]

    def count_from(self, tick: int, counter: int) -> None:
        """From this tick on the counter is `counter`, one more with each tick."""
        self._from.append(tick)
        self._shift.append((tick - counter) % COUNTERS)

    def idle_at(self, tick: int) -> Span | None:
        """Return the ticks that did not run of which this is one."""
        return _holding(self.idle, tick)

    def receives(self, time_ns: int) -> bool:
        """Whether the control unit could receive a frame that arrived at a time of the log's clock."""
        tick = (time_ns - self.grid.origin_ns) // self.grid.period_ns
        return _holding(self.off_bus, tick) is None

    def tick_of(self, arrival: Arrival) -> int:
        """Return the tick that released a frame of the control unit.

        It is the latest possible one, of a protected frame the latest with its counter: a frame
        may have been delayed by up to 15 ticks.
        """
        latest = self.grid.latest_tick(arrival)
        if arrival.kind not in PROTECTED:
            return latest
        counter = latest - self._shift[bisect_right(self._from, latest) - 1]
        tick = latest - (counter - counter_of(arrival.frame)) % COUNTERS
        possible = tick >= 0 or not self.grid.exact  # one delayed from before the log's first tick
        return tick if possible and self.idle_at(tick) is None else latest


def _holding(spans: list[Span], tick: int) -> Span | None:
    index = bisect_right(spans, tick, key=lambda span: span.first) - 1
    return spans[index] if index >= 0 and tick < spans[index].end else None


def map_ticks(arrivals: Iterable[Arrival], grid: Grid) -> TickMap:
    """Read a whole log and say which ticks ran; memory grows with the gaps only."""
    tick_map = TickMap(grid)
    active: int | None = None
    latest: dict[type, tuple[int, int]] = {}
    for answer, tick in _with_ticks(_protected_answers(arrivals), grid):
        kind, counter = answer.kind, answer.counter
        if active is None:
            tick_map.count_from(max(tick, 0), (counter - min(tick, 0)) % COUNTERS)
            if grid.fresh and tick > 0:  # its first frames were lost
                tick_map.count_from(0, (counter - tick) % COUNTERS)
        elif answer.after_hole:
            tick_map.idle.append(Span(active + 1, tick))
            tick_map.restarts.append(tick)
            tick_map.count_from(tick, counter)
            latest.clear()
        elif tick > active + 1 and kind in latest:
            _judge_silence(tick_map, active, tick, counter, latest[kind])
        active = tick if active is None else max(active, tick)
        latest[kind] = (tick, counter)
    tick_map.last = -1 if active is None else active
    return tick_map


class _Answer(NamedTuple):
    """A protected frame of the control unit; after_hole: the recorder was off before it."""

    arrival: Arrival
    kind: type
    counter: int
    after_hole: bool


def _protected_answers(arrivals: Iterable[Arrival]) -> Iterator[_Answer]:
    last_ns, hole = 0, False
    for number, arrival in enumerate(arrivals):
        hole |= number > 0 and arrival.time_ns - last_ns > 2_000_000_000  # nobody on the bus
        last_ns, kind = arrival.time_ns, arrival.kind
        if kind in OUTPUTS and kind in PROTECTED and is_intact(kind, arrival.frame):
            yield _Answer(arrival, kind, counter_of(arrival.frame), hole)
            hole = False


def _with_ticks(answers: Iterable[_Answer], grid: Grid) -> Iterator[tuple[_Answer, int]]:
    """Yield the answers with their ticks.

    In a log recorded in real time a busy machine delays frames, by several ticks at times. The
    counters then go on without a gap, and the delay is made up for; ticks that did not run are not.
    So the smallest delay among the next answers is that of the ticks themselves.
    """
    if grid.exact:
        yield from ((answer, grid.latest_tick(answer.arrival)) for answer in answers)
        return
    waiting: deque[tuple[_Answer, int, int]] = deque()
    counted = before = 0
    for answer in answers:
        tick = grid.latest_tick(answer.arrival)
        silent = answer.after_hole or tick - before >= COUNTERS
        if silent:
            yield from _undelayed(waiting, 0)
        step = (answer.counter - counted + COUNTERS // 2) % COUNTERS - COUNTERS // 2
        step += COUNTERS * round((tick - before - step) / COUNTERS)
        counted, before = counted + step, tick
        waiting.append((answer, counted, tick - counted))
        yield from _undelayed(waiting, 48)
    yield from _undelayed(waiting, 0)


def _undelayed(
    waiting: deque[tuple[_Answer, int, int]], most: int
) -> Iterator[tuple[_Answer, int]]:
    while len(waiting) > most:
        least = min(delay for _, _, delay in waiting)
        answer, counted, _ = waiting.popleft()
        yield answer, counted + least


def _judge_silence(
    tick_map: TickMap, active: int, tick: int, counter: int, before: tuple[int, int]
) -> None:
    """Decide what the control unit did between `active` and `tick`, of which nothing is in the log."""
    passed = tick - before[0]
    steps = (counter - before[1]) % COUNTERS
    if steps == passed % COUNTERS:
        if tick - active > 2:
            tick_map.off_bus.append(Span(active + 1, tick))
        return
    missed = min(passed - steps, tick - active - 1)
    if missed > 0:  # else a frame was delayed
        runs_again = active + 1 + missed
        tick_map.idle.append(Span(active + 1, runs_again))
        tick_map.count_from(runs_again, (counter - (tick - runs_again)) % COUNTERS)
