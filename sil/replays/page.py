"""report.html of a replay: one self-contained page in the look of a run's."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from sil.replays import told
from sil.replays.pictures import draw_positions, draw_scene
from sil.replays.replay import Outcome


def replay_page(outcome: Outcome, values: dict[str, Any], command: str) -> str:
    """Return the page; `values` is what diff.json holds, `command` the call that made it.

    Checked by: tests/unit/sil/replays/test_page.py
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    import sil.report

    folders = [Path(__file__).parent, Path(next(iter(sil.report.__path__)))]
    environment = Environment(
        loader=FileSystemLoader(folders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    found = outcome.comparison
    states = [
        {"name": history.name, "side": outcome.labels[side], "row": " ".join(row) or "nothing"}
        for history in found.states
        for side in (0, 1)
        for row in (history.sequence(side)[: told.MOST_STATES_TOLD],)
    ]
    account = told.account_lines(outcome)
    return environment.get_template("page.html").render(
        name=outcome.order.log,
        told=values,
        tiles=_tiles(outcome),
        edges=told.edge_lines(outcome),
        pictures=_pictures(outcome),
        states=states,
        plant=told.plant_lines(outcome) if outcome.plant is not None else [],
        frames=account,
        command=command,
    )


def _tiles(outcome: Outcome) -> list[dict[str, str]]:
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
    return [{"name": name, "value": value} for name, value in tiles]


def _pictures(outcome: Outcome) -> list[dict[str, str]]:
    base_ns = outcome.grid.origin_ns
    plant = outcome.plant
    positions = plant.positions if plant is not None else []
    found = []
    for scene in outcome.comparison.scenes.found:
        a, b = outcome.labels
        found.append(
            _picture(
                draw_scene(scene, outcome.labels, base_ns, positions),
                "Position, coils and states of both sides over time",
                f"What the unit believed, the coils it energised (pale: {a}, full: {b}) and its states.",
            )
        )
    if any(p.recorded_m == p.recorded_m for p in positions):
        found.append(
            _picture(
                draw_positions(positions, base_ns),
                "Recorded and replayed position over time",
                "The plant's position as recorded and as replayed.",
            )
        )
    return found


def _picture(png: bytes, alt: str, caption: str) -> dict[str, str]:
    return {"png": base64.b64encode(png).decode(), "alt": alt, "caption": caption}
