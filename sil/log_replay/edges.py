"""Which edge of one switching signal is which of another: matched, dropped, added.

Two edges can be one when they have the same direction and are no farther apart than a window. Of
all assignments in order of time, the one is taken with the least sum of twice the shifts of the
matched edges and the window for each unmatched one: no edge is unmatched that could be matched
without unmatching another, and shifts are as small as they can be.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple


class Edge(NamedTuple):
    """A switching: up (opens, begins) or down (closes, ends)."""

    time_ns: int
    up: bool


class Matching(NamedTuple):
    """Pairs of indices of edges that are one, and the indices of those that are alone."""

    pairs: list[tuple[int, int]]
    dropped: list[int]
    added: list[int]


def match(recorded: Sequence[Edge], replayed: Sequence[Edge], window_ns: int) -> Matching:
    """Match two series of edges, each in order of time; the work grows with edges in a window."""
    if recorded == replayed:
        return Matching([(i, i) for i in range(len(recorded))], [], [])
    times = [edge.time_ns for edge in replayed]
    lows = [0] + [bisect_left(times, edge.time_ns - window_ns) for edge in recorded]
    highs = [bisect_right(times, edge.time_ns + window_ns) for edge in recorded] + [len(times)]
    # Row i: the least cost with i recorded edges and j replayed ones decided. Outside of
    # lows[i]..highs[i] nothing can be matched on the way, so nothing is lost by leaving it out.
    rows: list[dict[int, str]] = []
    before: dict[int, int] = {}
    for i in range(len(recorded) + 1):
        costs: dict[int, int] = {}
        steps: dict[int, str] = {}
        for j in range(lows[i], highs[i] + 1):
            options: list[tuple[int, str]] = []
            if i and j and j - 1 in before:
                a, b = recorded[i - 1], replayed[j - 1]
                shift_ns = abs(a.time_ns - b.time_ns)
                if a.up is b.up and shift_ns <= window_ns:
                    options.append((before[j - 1] + 2 * shift_ns, "both"))
            if i and j in before:
                options.append((before[j] + window_ns, "recorded"))
            if j - 1 in costs:
                options.append((costs[j - 1] + window_ns, "replayed"))
            costs[j], steps[j] = min(options, default=(0, ""))
        before = costs
        rows.append(steps)
    pairs, dropped, added = [], [], []
    i, j = len(recorded), len(replayed)
    while i or j:
        step = rows[i][j]
        i -= step != "replayed"
        j -= step != "recorded"
        if step == "both":
            pairs.append((i, j))
        elif step == "recorded":
            dropped.append(i)
        else:
            added.append(j)
    return Matching(pairs[::-1], dropped[::-1], added[::-1])


@dataclass
class SwitchingSignal:
    """One switching signal on both sides; `up` and `down` name what its edges are."""

    name: str
    up: str
    down: str
    recorded: list[Edge] = field(default_factory=list)
    replayed: list[Edge] = field(default_factory=list)
    state: list[bool] = field(default_factory=lambda: [False, False])

    def take(self, side: int, time_ns: int, on: bool) -> bool:
        """Note the state of a side (0 recorded, 1 replayed); return whether it changed."""
        if self.state[side] is on:
            return False
        self.state[side] = on
        (self.replayed if side else self.recorded).append(Edge(time_ns, on))
        return True

    def verb(self, up: bool) -> str:
        """Return what an edge is."""
        return self.up if up else self.down


class MatchedEdges(NamedTuple):
    """What became of a signal's edges; shift_ns: replayed minus recorded, of each matched one."""

    signal: SwitchingSignal
    matching: Matching
    shift_ns: list[int]

    def lines(self, period_ns: int, base_ns: int = 0) -> list[str]:
        """Say what moved, one line per direction and shift; nothing for what did not move."""
        signal, (pairs, dropped, added) = self.signal, self.matching
        totals = Counter(edge.up for edge in signal.recorded)
        times = {1: "once", 2: "twice"}
        shifts = Counter(
            (signal.recorded[i].up, shift)
            for (i, _), shift in zip(pairs, self.shift_ns, strict=True)
            if shift
        )
        lines = [
            f"{signal.name} {signal.verb(up)} {shift_text(shift, period_ns)}, "
            f"{times.get(count, f'{count} times')} out of {totals[up]}"
            for (up, shift), count in sorted(shifts.items(), key=lambda item: (-item[1], item[0]))
        ]
        for what, side, alone in (
            ("in the recording only", signal.recorded, dropped),
            ("in the replay only", signal.replayed, added),
        ):
            for up in (True, False):
                when = [side[k].time_ns + base_ns for k in alone if side[k].up is up]
                if when:
                    times_s = ", ".join(f"{time_ns / 1e9:.6f}" for time_ns in when[:5])
                    more = f" and {len(when) - 5} more" if len(when) > 5 else ""
                    lines.append(f"{signal.name} {signal.verb(up)} {what}, at {times_s} s{more}")
        return lines

    def as_dict(self, base_ns: int = 0) -> dict[str, Any]:
        """All of it as plain JSON values; times on the log's clock."""
        signal, (pairs, dropped, added) = self.signal, self.matching

        def edge(side: Sequence[Edge], index: int, key: str = "time_s") -> dict[str, Any]:
            time_ns, up = side[index]
            return {"edge": signal.verb(up), key: (time_ns + base_ns) / 1e9}

        return {
            "name": signal.name,
            "recorded": len(signal.recorded),
            "replayed": len(signal.replayed),
            "matched": [
                edge(signal.recorded, i, "recorded_s")
                | edge(signal.replayed, j, "replayed_s")
                | {"shift_ms": shift / 1e6}
                for (i, j), shift in zip(pairs, self.shift_ns, strict=True)
            ],
            "dropped": [edge(signal.recorded, i) for i in dropped],
            "added": [edge(signal.replayed, j) for j in added],
        }


def match_edges(signal: SwitchingSignal, window_ns: int) -> MatchedEdges:
    """Match the edges of a signal."""
    matching = match(signal.recorded, signal.replayed, window_ns)
    shifts = [signal.replayed[j].time_ns - signal.recorded[i].time_ns for i, j in matching.pairs]
    return MatchedEdges(signal, matching, shifts)


def shift_text(shift_ns: int, period_ns: int) -> str:
    """Say a shift in samples, where it is whole ones, and in milliseconds."""
    size_ns = abs(shift_ns)
    text = f"{size_ns / 1e6:g} ms"
    if size_ns % period_ns == 0:
        samples = size_ns // period_ns
        text = f"{samples} sample{'s' if samples > 1 else ''} ({text})"
    return f"{text} {'later' if shift_ns > 0 else 'earlier'}"
