"""report.html of a replay and its figures: one self-contained page in the look of all others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sil.replay import summary
from sil.replay.figures import excerpts_figure, positions_figure
from sil.replay.replay import ReplayResult
from sil.report.picture import save
from sil.report.plots import Group, plots
from sil.report.shell import Head, Picture, render


def replay_page(outcome: ReplayResult, values: dict[str, Any], command: str, folder: Path) -> str:
    """Return the page, its figures written into the folder; `values` is what diff.json holds.

    `command` is the call that made it. Checked by: tests/unit/sil/replay/test_page.py
    """
    found = outcome.comparison
    states = [
        {"name": history.name, "side": outcome.labels[side], "row": " ".join(row) or "nothing"}
        for history in found.states
        for side in (0, 1)
        for row in (history.sequence(side)[: summary.MOST_STATES_SHOWN],)
    ]
    head = Head(
        command="replay",
        name=outcome.request.log,
        verdict="differs" if outcome.differs else "no difference",
        good=not outcome.differs,
        tiles=_tiles(outcome),
        again=command,
    )
    pictures, groups = _pictures(outcome, folder)
    return render(
        "replay.html",
        head,
        groups,
        diff=values,
        edges=summary.edge_lines(outcome),
        pictures=pictures,
        states=states,
        plant=summary.plant_lines(outcome) if outcome.plant is not None else [],
        frames=summary.account_lines(outcome),
    )


def _tiles(outcome: ReplayResult) -> list[tuple[str, str]]:
    found = outcome.comparison
    results = found.matched_edges()
    edges = sum(len(result.signal.recorded) for result in results)
    alone = sum(len(r.matching.dropped) + len(r.matching.added) for r in results)
    shifts = [abs(s) for result in results for s in result.shift_ns]
    return [
        (f"{found.ticks}", "ticks compared"),
        (f"{found.differing_ticks}", "ticks that differ"),
        (f"{edges}", "edges recorded"),
        (f"{sum(1 for s in shifts if s)}", "edges moved"),
        (f"{alone}", "edges gone or new"),
        (f"{max(shifts, default=0) / 1e6:g} ms", "farthest moved"),
        (f"{outcome.account.total} of {outcome.frames}", "frames accounted for"),
    ]


def _pictures(outcome: ReplayResult, folder: Path) -> tuple[list[Picture], list[Group]]:
    """Return the pictures, each written into the folder, and the plots of the same figures."""
    base_ns, scenes = outcome.grid.origin_ns, outcome.comparison.excerpts.found
    positions = outcome.plant.positions if outcome.plant is not None else []
    a, b = outcome.labels
    alt = "Position, coils and states of both sides over time"
    caption = (
        f"The controller's estimate, the coils energised (pale: {a}, full: {b}) and the states."
    )
    pictures = []
    for number, scene in enumerate(scenes, start=1):
        figure = excerpts_figure([scene], outcome.labels, base_ns, positions)
        pictures.append(Picture(save(figure, folder, f"scene_{number}"), alt, caption))
    groups = plots(excerpts_figure(scenes, outcome.labels, base_ns, positions)) if scenes else []
    if any(np.isfinite(p.recorded_m) for p in positions):
        figure = positions_figure(positions, base_ns)
        alt = "Recorded and replayed position over time"
        caption = "The plant's position as recorded and as replayed."
        pictures.append(Picture(save(figure, folder, "positions"), alt, caption))
        groups += plots(figure)
    return pictures, groups
