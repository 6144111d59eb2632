"""The plant under replay: the recorded commands into it, and its answers to a unit that parts."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

from can_dbc.codec import can_id_of
from can_dbc.e2e import PROTECTED
from can_dbc.frame import Frame
from can_dbc.messages import PlantMotion, SafetyBlow, Tsc1, ValveCommand
from sil.coupling.bus import BusModel
from sil.coupling.frame_bits import frame_bits
from sil.log_replay.comparison import Difference
from sil.log_replay.recorded_frames import (
    FROM_PLANT,
    ID_OF,
    INPUTS,
    OUTPUTS,
    OWN_IDS,
    Arrival,
    is_intact,
)
from sil.log_replay.signals import Options, SignalComparer, values
from sil.log_replay.tick_grid import Grid

if TYPE_CHECKING:
    from plant.node import PlantNode

COMMANDS: Final = (ValveCommand, SafetyBlow)
ENGINE_REQUEST: Final = can_id_of(Tsc1)
"""What else the plant takes, from a vehicle around it."""


class Position(NamedTuple):
    """Recorded and replayed stay position at a time of the replay, m."""

    time_ns: int
    recorded_m: float
    replayed_m: float


class PlantSide:
    """Runs the plant together with the control unit; times in ns from the control unit's first tick.

    As long as the control unit commands what was recorded, the plant gets the recorded commands at their
    recorded times and the control unit the recorded inputs. With `closes`, the loop closes at the first
    command that differs: from then on a bus model carries the frames of unit, plant and everybody
    else in the log between them, and the plant answers.
    Checked by: tests/scenarios/test_replay.py
    """

    def __init__(
        self,
        node: PlantNode,
        options: Options,
        grid: Grid,
        *,
        closes: bool,
        receives: Callable[[int], bool],
    ) -> None:
        self._node, self._closes, self._receives = node, closes, receives
        self._grid, self._bus = grid, BusModel(grid.bitrate)
        self._next_ns = node.start()
        self._commands: deque[tuple[int, Frame]] = deque()
        self._others: deque[tuple[int, Frame, str]] = deque()
        self._released: dict[type, deque[tuple[int, bytes]]] = {
            kind: deque(maxlen=256) for kind in FROM_PLANT
        }
        self._recorded: deque[tuple[int, type, bytes]] = deque()
        self._for_plant: list[tuple[int, Frame]] = []
        self._for_unit: list[tuple[int, Frame]] = []
        self._judge = SignalComparer(options)
        self.closed_ns: int | None = None
        self.compared = 0
        self.differing = 0
        self.unmatched = 0
        self.first: Difference | None = None
        self.positions: list[Position] = []

    @property
    def largest(self) -> dict[str, float]:
        """The largest difference of each signal that differs by a number, by name."""
        entries = sorted(self._judge.counts.items())
        return {name: entry.largest for name, entry in entries if entry.largest is not None}

    # --- reading ----------------------------------------------------------------------------
    def see(self, time_ns: int, arrival: Arrival) -> None:
        """Take a frame of the log, some ticks ahead of the replay."""
        kind, frame = arrival.kind, arrival.frame
        if time_ns < 0:  # of before the control unit's first tick, where the plant is at rest
            return
        if kind in OUTPUTS:
            if kind in COMMANDS and self.closed_ns is None and self._receives(arrival.time_ns):
                self._commands.append((time_ns, frame))
            return
        if kind in FROM_PLANT:
            assert kind is not None
            if is_intact(kind, frame):
                self._recorded.append((time_ns, kind, frame.data))
            return
        if frame.can_id == ENGINE_REQUEST and self.closed_ns is None:
            self._commands.append((time_ns, frame))
        if len(frame.data) <= 8:
            begun_ns = time_ns - frame_bits(frame.can_id, frame.data) * self._bus.bit_ns
            self._others.append((begun_ns, frame, "log"))

    # --- the control unit's ticks -------------------------------------------------------------------
    def deliveries(self, now_ns: int, recorded: list[tuple[int, Frame]]) -> list[tuple[int, Frame]]:
        """Bring plant and bus to a tick; return what the control unit receives: the log's frames, or ours."""
        self._advance(now_ns)
        ours, self._for_unit = self._for_unit, []
        return recorded if self.closed_ns is None else ours

    def answered(
        self,
        now_ns: int,
        released: Sequence[Frame],
        replayed: dict[type, bytes],
        recorded: dict[type, bytes],
    ) -> None:
        """Take what the control unit released at a tick, and what was recorded of that tick."""
        if not self._closes:
            return
        for frame in released:
            self._bus.queue(now_ns + self._grid.computation_ns, frame, "unit")
        if self.closed_ns is None and any(
            kind in recorded and replayed.get(kind) != recorded[kind] for kind in COMMANDS
        ):
            self.closed_ns = now_ns
            # Commands of earlier ticks still come from the log, later ones from the control unit.
            self._commands = deque(c for c in self._commands if c[0] <= now_ns)

    def finish(self, end_ns: int) -> None:
        """Go on to the end of the log, and compare what is left."""
        self._advance(end_ns)
        self._compare(None)
        self._node.close()

    # --- plant and bus ----------------------------------------------------------------------
    def _advance(self, until_ns: int) -> None:
        """Let the plant publish everything up to and at `until_ns`."""
        while self._next_ns <= until_ns:
            self._publish(self._next_ns)
        if self._closes:
            self._carry(until_ns)
        self._compare(until_ns)

    def _publish(self, now_ns: int) -> None:
        if self._closes:
            self._carry(now_ns)
        count = sum(1 for _ in takewhile(lambda command: command[0] <= now_ns, self._commands))
        deliveries = [self._commands.popleft() for _ in range(count)] + self._for_plant
        self._for_plant = []
        released, self._next_ns = self._node.advance(now_ns, deliveries)
        for release_ns, frame in released:
            kind = OWN_IDS[frame.can_id]
            if self.closed_ns is None:
                self._released[kind].append((release_ns, frame.data))
            if kind is PlantMotion and len(self.positions) < 200_000:
                message_values = values(kind, frame.data)
                assert message_values is not None  # our own encoding
                self.positions.append(Position(release_ns, float("nan"), message_values[0]))
            if self._closes:
                self._bus.queue(release_ns, frame, "plant")

    def _carry(self, until_ns: int) -> None:
        """Let the bus carry frames up to `until_ns`; before the loop closes nobody listens."""
        bus = self._bus
        while self._others and self._others[0][0] <= until_ns:
            begun_ns, frame, sender = self._others.popleft()
            bus.queue(max(begun_ns, bus.now_ns), frame, sender)
        for _released_ns, arrival_ns, sender, frame in bus.advance(until_ns):
            kind = OWN_IDS.get(frame.can_id)
            if kind in INPUTS:
                self._for_unit.append((arrival_ns, frame))
            elif (kind in COMMANDS and sender == "unit") or frame.can_id == ENGINE_REQUEST:
                self._for_plant.append((arrival_ns, frame))
        if self.closed_ns is None:  # what arrives now was recorded, too
            self._for_unit.clear()
            self._for_plant.clear()

    # --- comparing --------------------------------------------------------------------------
    def _compare(self, until_ns: int | None) -> None:
        """Compare the recorded frames of the plant with those of its replay, up to a time."""
        while self._recorded and (until_ns is None or self._recorded[0][0] <= until_ns):
            time_ns, kind, data = self._recorded.popleft()
            if kind is PlantMotion:
                self._note_position(time_ns, data)
            if self.closed_ns is not None:
                continue
            ours = self._partner(time_ns, kind, data)
            self.compared += ours is not None
            recorded, replayed = values(kind, data), values(kind, ours) if ours else None
            if recorded is None or replayed is None:
                self.unmatched += 1
                continue
            if parts := self._judge.compare(time_ns, kind, recorded, replayed):
                self.differing += 1
                self.first = self.first or Difference(time_ns, parts, [])

    def _partner(self, time_ns: int, kind: type, data: bytes) -> bytes | None:
        """Return the data of the replayed plant that a recorded frame is to be compared with.

        It was released before the frame was sent, not too long ago, and is no other's partner:
        the one with the same data, else with the same counter, else the latest.
        """
        bits = frame_bits(ID_OF[kind], data)
        sent_ns = time_ns - bits * self._bus.bit_ns + self._grid.slack_ns
        released = self._released[kind]
        while released and released[0][0] < time_ns - 60_000_000:
            released.popleft()

        def likeness(index: int) -> tuple[bool, bool, int]:
            ours = released[index][1]
            return ours == data, kind in PROTECTED and (ours[1] ^ data[1]) & 0x0F == 0, index

        possible = sum(1 for _ in takewhile(lambda release: release[0] <= sent_ns, released))
        if not possible:
            return None
        best = max(range(possible), key=likeness)
        partner = released[best][1]
        del released[best]
        return partner

    def _note_position(self, time_ns: int, data: bytes) -> None:
        message_values = values(PlantMotion, data)
        index = bisect_right(self.positions, time_ns, key=lambda p: p.time_ns) - 1
        if message_values is not None and index >= 0:
            self.positions[index] = self.positions[index]._replace(recorded_m=message_values[0])

    def as_dict(self, base_ns: int) -> dict[str, object]:
        """All of it as plain JSON values; times on the log's clock."""
        return {
            "compared": self.compared,
            "differing": self.differing,
            "unmatched": self.unmatched,
            "first": self.first and self.first.as_dict(base_ns),
            "largest": self.largest,
            "closed_at_s": None if self.closed_ns is None else (self.closed_ns + base_ns) / 1e9,
        }
