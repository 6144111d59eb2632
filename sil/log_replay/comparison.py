"""Recorded against replayed, tick by tick as they come: signals, edges, states, where they part."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from can_dbc.messages import Chamber, ControllerStatus, Etc1, SafetyBlow, ValveCommand
from sil.log_replay.edges import MatchedEdges, SwitchingSignal, match_edges
from sil.log_replay.excerpts import ExcerptRecorder, Row
from sil.log_replay.signals import Options, SignalComparer, values

RECORDED, REPLAYED = 0, 1
CHAMBERS: Final = (Chamber.B, Chamber.N, Chamber.F)
Side = Mapping[type, bytes]


class Difference(NamedTuple):
    """Where the two sides differ first, and the inputs that led there (texts, oldest first)."""

    time_ns: int
    signals: list[tuple[str, str, str]]
    inputs: list[str]

    def as_dict(self, base_ns: int) -> dict[str, Any]:
        """Return all of it as plain JSON values; the time on the log's clock."""
        named = [{"name": name, "recorded": a, "replayed": b} for name, a, b in self.signals]
        time_s = (self.time_ns + base_ns) / 1e9
        return {"time_s": time_s, "signals": named, "inputs": self.inputs}


@dataclass
class StateHistory:
    """What a discrete signal was on both sides: (time in ns, name) of each change."""

    name: str
    sides: tuple[list[tuple[int, str]], ...] = field(default_factory=lambda: ([], []))

    def as_dict(self, base_ns: int) -> dict[str, Any]:
        """Return all of it as plain JSON values; times on the log's clock."""
        recorded, replayed = (
            [{"time_s": (time_ns + base_ns) / 1e9, "value": name} for time_ns, name in changes]
            for changes in self.sides
        )
        sides = {"recorded": recorded, "replayed": replayed}
        return {"name": self.name, "differs": self.differs} | sides

    def take(self, side: int, time_ns: int, value: str) -> None:
        """Note the value of a side."""
        history = self.sides[side]
        if (not history or history[-1][1] != value) and len(history) < 200_000:
            history.append((time_ns, value))

    def sequence(self, side: int) -> list[str]:
        """Return the names in order."""
        return [name for _, name in self.sides[side]]

    @property
    def differs(self) -> bool:
        """Whether the two sequences are not the same, whatever their times."""
        return self.sequence(RECORDED) != self.sequence(REPLAYED)


class Comparison:
    """Compares both sides of each tick in bounded memory.

    `inputs`: called where the sides part, returns the inputs that led there. Memory grows
    with the number of edges and state changes, not with the log.
    """

    def __init__(
        self,
        options: Options,
        duty_closed: float,
        inputs: Callable[[], list[str]] = list,
        warming: bool = False,
    ) -> None:
        self._around_ns = round(options.time_s * 1e9)
        self._window_ns = round(options.edges.window_s * 1e9)
        self._judge = SignalComparer(options)
        self.signals = self._judge.counts
        self._duty_closed = duty_closed
        self._inputs = inputs
        self.ticks = 0
        self.differing_ticks = 0
        self.damaged: Counter[type] = Counter()
        self.first: Difference | None = None
        self.first_command: Difference | None = None
        self.switches = [SwitchingSignal(f"valve {c.name}", "opens", "closes") for c in CHAMBERS]
        self.switches += [
            SwitchingSignal("safety blow", "begins", "ends"),
            SwitchingSignal("shift in process", "begins", "ends"),
        ]
        self.states = [StateHistory("state"), StateHistory("confirmed gear")]
        self.reported_ns: tuple[dict[str, int], ...] = ({}, {})
        """When each side first reported each fault, in ns."""
        self.excerpts = ExcerptRecorder()
        self.warm_up_ticks = 0
        self.begin_warm_up()
        self._warming = warming
        self._held: tuple[dict[type, tuple[Any, ...]], ...] = ({}, {})
        self._recent: dict[type, deque[tuple[int, tuple[Any, ...]]]] = {}
        self._waiting: deque[tuple[int, type, tuple[Any, ...]]] = deque()

    def begin_warm_up(self) -> None:
        """From here on compare only once the sides agree: the replay had to begin anew."""
        self._warm_since: int | None = None
        self._warming, self._rested = True, False

    def take(self, time_ns: int, recorded: Side, replayed: Side) -> None:
        """Take what the sides sent at a time (of the log's clock, ns), data by message type.

        Either side may be silent; its latest message then counts. Counters and checksums are
        left out of the data (`bare`).
        """
        ours = self._read(RECORDED, recorded, time_ns)
        self._read(REPLAYED, replayed, time_ns)
        if self._warming and not self._warm(time_ns, ours):
            return
        if ours:
            self.ticks += 1
        differing: list[tuple[str, str, str]] = []
        if self._around_ns:
            self._waiting.extend((time_ns, kind, fields) for kind, fields in ours.items())
            differing = self._compare_waiting(time_ns - self._around_ns)
        else:
            for kind, fields in ours.items():
                if recorded[kind] == replayed.get(kind):
                    self._judge.count(kind)
                else:
                    theirs = self._held[REPLAYED].get(kind)
                    differing += self._judge.compare(time_ns, kind, fields, theirs)
        self._switch(time_ns, self._part(time_ns, differing))

    def finish(self) -> None:
        """Compare what is still waiting: the log ends."""
        if self._around_ns and self._waiting:
            last_ns = self._waiting[-1][0]
            self._part(last_ns, self._compare_waiting(last_ns))
        self.excerpts.finish()

    def _read(self, side: int, sent: Side, time_ns: int) -> dict[type, tuple[Any, ...]]:
        decoded_by_kind: dict[type, tuple[Any, ...]] = {}
        for kind, data in sent.items():
            decoded = values(kind, data)
            if decoded is None:
                self.damaged[kind] += 1
                continue
            decoded_by_kind[kind] = self._held[side][kind] = decoded
            if side == REPLAYED and self._around_ns:
                self._recent.setdefault(kind, deque()).append((time_ns, decoded))
        return decoded_by_kind

    def _warm(self, time_ns: int, ours: Mapping[type, tuple[Any, ...]]) -> bool:
        """Whether the sides agree by now, have had their time, or begin something."""
        if self._warm_since is None:
            self._warm_since = time_ns
        theirs = self._held[REPLAYED]
        status = ControllerStatus in ours
        agree = all(
            kind in theirs and not self._judge.differing(kind, fields, theirs[kind])
            for kind, fields in ours.items()
        )
        busy = [any(self._valve_on(side, chamber) for chamber in CHAMBERS) for side in (0, 1)]
        begun = busy[REPLAYED] or (busy[RECORDED] and self._rested)  # a shift from its beginning
        self._rested |= bool(ours) and not busy[RECORDED]
        if (status and agree) or begun or time_ns - self._warm_since > 5_000_000_000:
            self._warming = False
            return True
        self.warm_up_ticks += bool(ours)
        return False

    def _compare_waiting(self, until_ns: int) -> list[tuple[str, str, str]]:
        """Compare what was recorded up to a time with what the replay had around it."""
        differing: list[tuple[str, str, str]] = []
        while self._waiting and self._waiting[0][0] <= until_ns:
            time_ns, kind, ours = self._waiting.popleft()
            recent = self._recent.get(kind, deque())
            while len(recent) > 1 and recent[1][0] <= time_ns - self._around_ns:
                recent.popleft()
            near = [fields for at_ns, fields in recent if at_ns <= time_ns + self._around_ns]
            best: tuple[Any, ...] | None = None
            if near:  # each signal may have had its value at its own instant
                best = min(near, key=lambda f: len(self._judge.differing(kind, ours, f)))
                columns = zip(ours, best, zip(*near, strict=True), strict=True)
                best = tuple(mine if mine in column else other for mine, other, column in columns)
            differing += self._judge.compare(time_ns, kind, ours, best)
        return differing

    def _part(self, time_ns: int, differing: list[tuple[str, str, str]]) -> bool:
        """Note where the sides part; return whether the plant would hear it."""
        if not differing:
            return False
        self.differing_ticks += 1
        heard = [d for d in differing if d[0].startswith(("ValveCommand.", "SafetyBlow."))]
        if self.first is None:
            self.first = Difference(time_ns, differing, self._inputs())
        if heard and self.first_command is None:
            self.first_command = Difference(time_ns, heard, self._inputs())
        return bool(heard)

    # --- edges and states -------------------------------------------------------------------
    def _valve_on(self, side: int, chamber: Chamber) -> bool:
        """Whether a coil is energised, by its duty or by a blow."""
        valves = self._held[side].get(ValveCommand)
        if valves is not None and valves[chamber] > self._duty_closed:
            return True
        blow = self._held[side].get(SafetyBlow)
        return blow is not None and blow[1] and blow[0] is chamber

    def _switch(self, time_ns: int, commands_part: bool) -> None:
        """Bring lanes, states and scenes up to date."""
        changed = False
        row = Row(time_ns, [], [], [])
        kinds = SafetyBlow, Etc1, ControllerStatus
        for side in (RECORDED, REPLAYED):
            blow, etc1, status = map(self._held[side].get, kinds)
            on = (
                *(self._valve_on(side, chamber) for chamber in CHAMBERS),
                blow is not None and bool(blow[1]),
                etc1 is not None and bool(etc1[2]),
            )
            row.coils.append(on[:3])
            for signal, is_on in zip(self.switches, on, strict=True):
                changed |= signal.take(side, time_ns, is_on)
            if status is not None:
                for history, value in zip(self.states, status, strict=False):
                    history.take(side, time_ns, value.name)
                for fault in status[3]:
                    changed |= self.reported_ns[side].setdefault(fault.name, time_ns) == time_ns
            row.states.append("" if status is None else status[0].name)
            row.estimates_m.append(None if status is None else status[2])
        self.excerpts.take(row, changed, commands_part)

    def matched_edges(self) -> list[MatchedEdges]:
        """Match the edges of all lanes."""
        return [match_edges(signal, self._window_ns) for signal in self.switches]

    @property
    def engaged(self) -> bool:
        """Whether any valve was energised on either side."""
        return any(signal.recorded or signal.replayed for signal in self.switches[:3])

    @property
    def differs(self) -> bool:
        """Whether anything differs that the options do not allow."""
        return any(entry.differing for entry in self.signals.values())
