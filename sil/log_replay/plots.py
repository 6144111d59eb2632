"""Interactive plots of a replay: both sides over the time of the log.

Checked by: tests/unit/sil/log_replay/test_page.py, tests/browser/
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sil.log_replay.excerpts import Row, Scene
from sil.log_replay.plant_side import Position
from sil.log_replay.replay import Outcome
from sil.report.interactive import Group, Panel, Series, Window, plots

Floats = NDArray[np.float64]
CHAMBERS = "BNF"
ROLES = ("believed", "alarm")
ROW = 2.6
"""Height of a chamber's lane, which holds both sides."""


def replay_plots(outcome: Outcome) -> list[Group]:
    """The scenes on one axis with a button for each; the plant's position over the whole log."""
    found = []
    positions = outcome.plant.positions if outcome.plant is not None else []
    if outcome.comparison.scenes.found:
        found.append(_scenes(outcome, positions))
    both = [p for p in positions if p.recorded_m == p.recorded_m]
    if both:
        found.append(_positions(both, outcome.grid.origin_ns))
    return found


def _scenes(outcome: Outcome, positions: Sequence[Position]) -> Group:
    base_ns = outcome.grid.origin_ns
    scenes = outcome.comparison.scenes.found
    rows = one_after_another(scenes)
    time_s = np.array(
        # the middle of a gap stands for it
        [
            (row.time_ns + base_ns) / 1e9
            if row is not None
            else (rows[k - 1].time_ns + rows[k + 1].time_ns + 2 * base_ns) / 2e9  # type: ignore[union-attr]
            for k, row in enumerate(rows)
        ]
    )

    def over(value: Callable[[Row], float | None]) -> Floats:
        told = [None if row is None else value(row) for row in rows]
        return np.array([np.nan if v is None else v for v in told], dtype=np.float64)

    names = list(dict.fromkeys(n for row in rows if row is not None for n in row.states))
    position = [
        Series(
            f"believed, {outcome.labels[side]}",
            1e3 * over(lambda row, side=side: row.estimates_m[side]),  # type: ignore[misc]
            ROLES[side],
            stepped=True,
            dashed=side == 1,
        )
        for side in (0, 1)
    ]
    position += [
        Series(label, 1e3 * _at(time_s, positions, base_ns, which), "truth", dashed=which == 1)
        for which, label in enumerate(("true, recorded", "true, plant replayed"))
        if positions
    ]
    coils = [
        Series(
            f"{chamber} {outcome.labels[side]}",
            over(
                lambda row, k=k, side=side: (  # type: ignore[misc]
                    _lane(k, side) + row.coils[side][k]
                )
            ),
            chamber,
            stepped=True,
            dashed=side == 1,
        )
        for k, chamber in enumerate(CHAMBERS)
        for side in (0, 1)
    ]
    marks = [
        (_lane(k, side) + 0.5, f"{chamber}{' ’'[side]}".strip())
        for k, chamber in enumerate(CHAMBERS)
        for side in (0, 1)
    ]
    states = [
        Series(
            outcome.labels[side],
            over(lambda row, side=side: names.index(row.states[side])),  # type: ignore[misc]
            ROLES[side],
            stepped=True,
            dashed=side == 1,
        )
        for side in (0, 1)
    ]
    windows = [
        Window(
            f"{(scene.rows[0].time_ns + base_ns) / 1e9:.3f} s{', differs' if scene.differs else ''}",
            (scene.rows[0].time_ns + base_ns) / 1e9,
            (scene.rows[-1].time_ns + base_ns) / 1e9,
        )
        for scene in scenes
        if len(scene.rows) > 1
    ]
    state_marks = [(float(k), name.lower()) for k, name in enumerate(names)]
    panels = [
        Panel("Position", "mm", position, 220),
        Panel(f"Coils energised (’: {outcome.labels[1]})", "on", coils, 190, marks),
        Panel("State", "", states, 60 + 18 * len(names), state_marks),
    ]
    return plots("time of the log, s", time_s, panels, windows, twin=True)


def _lane(chamber: int, side: int) -> float:
    """The zero of a coil: B on top, the replayed side below the recorded one."""
    return ROW * (len(CHAMBERS) - 1 - chamber) + 1.2 * (1 - side)


def one_after_another(scenes: Sequence[Scene]) -> list[Row | None]:
    """All rows in ascending time, each once, with None between scenes that lie apart."""
    found: list[Row | None] = []
    last_ns: int | None = None
    for scene in sorted(scenes, key=lambda scene: scene.rows[0].time_ns):
        fresh = [row for row in scene.rows if last_ns is None or row.time_ns > last_ns]
        if fresh and found:
            found.append(None)
        found += fresh
        if fresh:
            last_ns = fresh[-1].time_ns
    return found


def _at(time_s: Floats, positions: Sequence[Position], base_ns: int, which: int) -> Floats:
    """Recorded (0) or replayed (1) position [m] at these times, nan where it is not known."""
    values = [(p.time_ns, (p.recorded_m, p.replayed_m)[which]) for p in positions]
    known = [((t + base_ns) / 1e9, v) for t, v in values if v == v]
    if not known:
        return np.full(len(time_s), np.nan)
    times, told = (np.array(part) for part in zip(*known, strict=True))
    return np.interp(time_s, times, told, left=np.nan, right=np.nan)


def _positions(both: Sequence[Position], base_ns: int) -> Group:
    time_s = np.array([(p.time_ns + base_ns) / 1e9 for p in both])
    recorded = np.array([p.recorded_m for p in both])
    replayed = np.array([p.replayed_m for p in both])
    panels = [
        Panel(
            "Position of the plant",
            "mm",
            [
                Series("recorded", 1e3 * recorded, "truth"),
                Series("plant replayed", 1e3 * replayed, "alarm", dashed=True),
            ],
        ),
        Panel(
            "Apart",
            "mm",
            [Series("replayed - recorded", 1e3 * (replayed - recorded), "alarm")],
            120,
        ),
    ]
    return plots("time of the log, s", time_s, panels, twin=True)
