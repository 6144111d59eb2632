"""report.html of a replay and its figures: one self-contained page in the look of all others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sil.log_replay import summary
from sil.log_replay.pictures import draw_positions, draw_scene
from sil.log_replay.plots import replay_plots
from sil.log_replay.replay import Outcome
from sil.report.figures import save
from sil.report.shell import Head, Picture, render


def replay_page(outcome: Outcome, values: dict[str, Any], command: str, folder: Path) -> str:
    """Return the page, its figures written beside it; `values` is what diff.json holds.

    `command` is the call that made it. Checked by: tests/unit/sil/log_replay/test_page.py
    """
    found = outcome.comparison
    states = [
        {"name": history.name, "side": outcome.labels[side], "row": " ".join(row) or "nothing"}
        for history in found.states
        for side in (0, 1)
        for row in (history.sequence(side)[: summary.MOST_STATES_TOLD],)
    ]
    head = Head(
        command="replay",
        name=outcome.order.log,
        verdict="differs" if outcome.differs else "no difference",
        good=not outcome.differs,
        tiles=_tiles(outcome),
        again=command,
    )
    return render(
        "replay.html",
        head,
        replay_plots(outcome),
        told=values,
        edges=summary.edge_lines(outcome),
        pictures=_pictures(outcome, folder),
        states=states,
        plant=summary.plant_lines(outcome) if outcome.plant is not None else [],
        frames=summary.account_lines(outcome),
    )


def _tiles(outcome: Outcome) -> list[tuple[str, str]]:
    found = outcome.comparison
    results = found.lane_results()
    edges = sum(len(result.lane.recorded) for result in results)
    moved = sum(sum(1 for s in result.shift_ns if s) for result in results)
    alone = sum(len(r.matching.dropped) + len(r.matching.added) for r in results)
    shifts = [abs(s) for result in results for s in result.shift_ns]
    tiles = [
        ("ticks compared", f"{found.ticks}"),
        ("ticks that differ", f"{found.differing_ticks}"),
        ("edges recorded", f"{edges}"),
        ("edges moved", f"{moved}"),
        ("edges gone or new", f"{alone}"),
        ("farthest moved", f"{max(shifts, default=0) / 1e6:g} ms"),
        ("frames accounted for", f"{outcome.account.total} of {outcome.frames}"),
    ]
    return [(value, name) for name, value in tiles]


def _pictures(outcome: Outcome, folder: Path) -> list[Picture]:
    base_ns = outcome.grid.origin_ns
    positions = outcome.plant.positions if outcome.plant is not None else []
    a, b = outcome.labels
    found = [
        Picture(
            save(draw_scene(scene, outcome.labels, base_ns, positions), folder, f"scene_{number}"),
            "Position, coils and states of both sides over time",
            f"What the unit believed, the coils it energised (pale: {a}, full: {b}) and its states.",
        )
        for number, scene in enumerate(outcome.comparison.scenes.found, start=1)
    ]
    if any(p.recorded_m == p.recorded_m for p in positions):
        found.append(
            Picture(
                save(draw_positions(positions, base_ns), folder, "positions"),
                "Recorded and replayed position over time",
                "The plant's position as recorded and as replayed.",
            )
        )
    return found
