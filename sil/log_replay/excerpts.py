"""Short stretches of both sides around edges and differences, for waveforms and pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, NamedTuple


class Row(NamedTuple):
    """One tick: coils B, N, F energised, state and estimate (m), recorded and replayed."""

    time_ns: int
    coils: list[tuple[bool, ...]]
    states: list[str]
    estimates_m: list[float | None]


@dataclass
class Excerpt:
    """Ticks in a row; differs: the commands part in it."""

    rows: list[Row] = field(default_factory=list)
    differs: bool = False


class ExcerptRecorder:
    """Keeps the first scenes with a difference and the first without; memory is bounded.

    A scene is from 80 ms before the first edge or difference to 160 ms after the last, of at most
    1.5 s and 1000 ticks.
    """

    def __init__(self) -> None:
        self.excerpts: list[Excerpt] = []
        self._recent: deque[Row] = deque(maxlen=250)
        self._open: Excerpt | None = None
        self._begun_ns = self._until_ns = 0

    def take(self, row: Row, changed: bool, differs: bool) -> None:
        """Take a tick; `changed`: an edge on either side, `differs`: the commands are not equal."""
        scene = self._open
        if scene is None and (changed or differs):
            scene = self._open = Excerpt(
                [r for r in self._recent if r.time_ns >= row.time_ns - 80_000_000]
            )
            self._begun_ns = row.time_ns
        if scene is not None:
            scene.rows.append(row)
            scene.differs |= differs
            if changed or differs:
                self._until_ns = min(row.time_ns + 160_000_000, self._begun_ns + 1_500_000_000)
            if row.time_ns >= self._until_ns or len(scene.rows) >= 1000:
                self.finish()
        self._recent.append(row)

    def finish(self) -> None:
        """End the scene that is open."""
        scene, self._open = self._open, None
        if scene is None:
            return
        alike = sum(s.differs is scene.differs for s in self.excerpts)
        if alike < (6 if scene.differs else 3):
            self.excerpts.append(scene)


def waveforms(
    scene: Excerpt, labels: tuple[str, str], base_ns: int = 0, width: int = 100
) -> list[str]:
    """Draw a scene in letters: one column per tick, coils and states of both sides."""
    lines = []
    rows = scene.rows
    for start in range(0, len(rows), width):
        part = rows[start : start + width]
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
