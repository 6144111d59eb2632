"""Reliability of stated probabilities: causes given p, and in how many cases they were true.

Campaigns are those that `hidden_effects` has judged ($OPC4_STUDY); bodies on the force rig are drawn here,
$OPC4_BODIES of each kind (4) from number $OPC4_FIRST (0). The picture goes to $OPC4_PICTURE, a folder.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

Stated = list[tuple[float, bool]]
"""Probability and whether the cause was true."""

BINS = (0.05, 0.3, 0.5, 0.7, 0.9, 1.0)


def of_campaigns(path: Path) -> Stated:
    """Return what was stated of the campaigns in a study's results."""
    from tests.support.hidden_study import read_rows

    return [
        (p, name in row.names)
        for row in read_rows(path)
        for name, _class, p in row.found
        if name != "unnamed"
    ]


def of_bodies(first: int, count: int) -> Stated:
    """Return what is stated of drawn bodies."""
    from tests.bench.bodies import EXPECTED, KINDS, draw
    from tests.support.force_rig import diagnose_force

    stated = []
    with tempfile.TemporaryDirectory() as name:
        for kind in KINDS:
            if kind in ("held", "uneven", "reversed", "corrupted"):
                continue
            for seed in range(first, first + count):
                folder = Path(name) / f"{kind}{seed}"
                draw(folder, kind, seed)
                causes = diagnose_force(folder).as_json()["causes"]
                stated += [
                    (c["probability"], c["id"] == EXPECTED.get(kind))
                    for c in causes
                    if c["id"] != "unnamed"
                ]
    return stated


def measure() -> Iterator[str]:
    """Lines: share of true causes by stated probability; the same as a picture."""
    import numpy as np

    from sil.report.figure import Figure, Panel, Series, Stack
    from sil.report.picture import save
    from tests.support.hidden_study import share

    path = Path(os.environ.get("OPC4_STUDY", "runs/hidden_effects")) / "results.jsonl"
    first, count = (int(os.environ.get(f"OPC4_{n}", d)) for n, d in (("FIRST", 0), ("BODIES", 4)))
    lines = [Series("said = right", np.array([0.0, 1.0]), np.array([0.0, 1.0]), "grid")]
    for name, role, stated in (
        ("campaigns", "measured", of_campaigns(path)),
        ("bodies", "after", of_bodies(first, count)),
    ):
        points = []
        for low, high in pairwise(BINS):
            some = [(p, hit) for p, hit in stated if low < p <= high]
            if some:
                mean, hits = sum(p for p, _hit in some) / len(some), sum(h for _p, h in some)
                points.append((mean, hits / len(some)))
                yield f"{name}: " + share(f"said {mean:.3f}", hits, len(some))
        if points:
            x, y = np.array(points).T
            lines.append(Series(name, x, y, role, "marked"))
    panel = Panel("share that was true", "", lines, height=320, limits=(0.0, 1.05))
    save(
        Figure([Stack("stated probability", [panel], width=6.0)]),
        Path(os.environ.get("OPC4_PICTURE", ".")),
        "reliability",
    )
