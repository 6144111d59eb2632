"""Short stretches of both sides around edges and differences, for waveforms and pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Final, NamedTuple

BEFORE_NS: Final = 80_000_000
AFTER_NS: Final = 160_000_000
LONGEST_NS: Final = 1_500_000_000
MOST_ROWS: Final = 1000
MOST_DIFFERING: Final = 6
MOST_EQUAL: Final = 3
WIDTH: Final = 100


class Row(NamedTuple):
    """One tick: coils B, N, F energised, state and estimate (m), recorded and replayed."""

    time_ns: int
    coils: Sequence[tuple[bool, ...]]
    states: Sequence[str]
    estimates_m: Sequence[float | None]


@dataclass
class Excerpt:
    """Ticks in a row; differs: the commands part in it."""

    rows: list[Row] = field(default_factory=list)
    differs: bool = False


class ExcerptRecorder:
    """Keeps the first scenes with a difference and the first without; memory is bounded.

    Checked by: tests/unit/sil/replay/test_excerpts.py
    """

    def __init__(self) -> None:
        self.found: list[Excerpt] = []
        self._recent: deque[Row] = deque(maxlen=MOST_ROWS // 4)
        self._open: Excerpt | None = None
        self._begun_ns = self._until_ns = 0

    def take(self, row: Row, changed: bool, differs: bool) -> None:
        """Take a tick; `changed`: an edge on either side, `differs`: the commands are not equal."""
        scene = self._open
        if scene is None and (changed or differs):
            scene = self._open = Excerpt(
                [r for r in self._recent if r.time_ns >= row.time_ns - BEFORE_NS]
            )
            self._begun_ns = row.time_ns
        if scene is not None:
            scene.rows.append(row)
            scene.differs |= differs
            if changed or differs:
                self._until_ns = min(row.time_ns + AFTER_NS, self._begun_ns + LONGEST_NS)
            if row.time_ns >= self._until_ns or len(scene.rows) >= MOST_ROWS:
                self.finish()
        self._recent.append(row)

    def finish(self) -> None:
        """End the scene that is open."""
        scene, self._open = self._open, None
        if scene is None:
            return
        alike = sum(s.differs is scene.differs for s in self.found)
        if alike < (MOST_DIFFERING if scene.differs else MOST_EQUAL):
            self.found.append(scene)


def waveforms(scene: Excerpt, labels: tuple[str, str], base_ns: int = 0) -> list[str]:
    """Draw a scene in letters: one column per tick, coils and states of both sides.

    Checked by: tests/unit/sil/replay/test_excerpts.py
    """
    lines = []
    rows = scene.rows
    for start in range(0, len(rows), WIDTH):
        part = rows[start : start + WIDTH]
        step_ms = (part[1].time_ns - part[0].time_ns) / 1e6 if len(part) > 1 else 0.0
        lines.append(f"from {(part[0].time_ns + base_ns) / 1e9:.6f} s, {step_ms:g} ms per column")
        margin = max(len(label) for label in labels) + 10
        drawn: list[tuple[str, list[list[Any]], Callable[[list[Any]], str]]] = [
            (f"valve {name}", [[row.coils[side][k] for row in part] for side in (0, 1)], _wave)
            for k, name in enumerate("BNF")
            if any(coils[k] for row in rows for coils in row.coils)
        ]
        drawn.append(("state", [[row.states[side] for row in part] for side in (0, 1)], _named))
        for head, sides, draw in drawn:
            for side, title in enumerate((head, "")):
                lines.append(f"{title:<9} {labels[side]:<{margin - 10}} {draw(sides[side])}")
            marks = "".join("^" if a != b else " " for a, b in zip(*sides, strict=True)).rstrip()
            lines += [" " * (margin + 1) + marks] if marks else []
        lines.append("")
    return lines


def _wave(levels: Sequence[bool]) -> str:
    return "".join("#" if on else "_" for on in levels)


def _named(names: Sequence[str]) -> str:
    """Each name where it begins, as far as there is room, and dots while it lasts."""
    lengths = [(name, len(list(run))) for name, run in groupby(names)]
    return "".join(f"|{name}"[:length].ljust(length, ".") for name, length in lengths)
