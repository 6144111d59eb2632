"""report.html of the claims and its figure: the table, and the shift that they are about.

Checked by: tests/unit/sil/claims/test_claims.py, tests/browser/
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sil.claims.claim import MET, NOT_MET, Finding
from sil.report.figures import save
from sil.report.interactive import Group, Panel, Series, plots
from sil.report.run_plots import held
from sil.report.shell import Head, Picture, render
from sil.report.theme import LIGHT
from sil.simulation.in_memory import run_in_memory
from sil.simulation.scenario import load

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
SCENARIO = "lab_n_b"
WINDOW_S = (0.08, 0.32)
CAPTION = (
    "Neutral to backward in the laboratory (lab_n_b). Black: where the stay is. Violet: where the "
    "controller believes it, through its filter; orange: without the filter. Below, the driving and "
    "the opposing chamber."
)


class Shift:
    """The shift with and without the filter, over the time of its window [s]."""

    def __init__(self) -> None:
        slow, fast = (
            run_in_memory(load(SCENARIO, settings=settings)).record
            for settings in ((), ("controller.filter=false",))
        )
        time_s = slow.truth["time_s"]
        rows = (time_s >= WINDOW_S[0]) & (time_s <= WINDOW_S[1])
        self.time_s: Floats = time_s[rows]
        self.position_m: Floats = slow.truth["position_m"][rows]
        self.filtered_m = held(*slow.believed, self.time_s)
        self.unfiltered_m = held(*fast.believed, self.time_s)
        self.pressures_pa = {name: slow.truth[f"pressure_{name}_pa"][rows] for name in "BN"}


def write_page(found: Sequence[Finding], folder: Path, again: str) -> None:
    """Write report.html, shift.png and shift.svg; `again` is the call that made them."""
    from sil.files.atomic import write_atomically

    shift = Shift()
    counts = Counter(finding.verdict for finding in found)
    head = Head(
        command="claims",
        name="The thesis's claims",
        verdict=f"{counts[MET]} of {len(found)} met",
        good=None if 0 < counts[MET] < len(found) else not counts[NOT_MET],
        tiles=[(str(number), verdict) for verdict, number in counts.most_common()],
        again=again,
    )
    picture = Picture(save(draw(shift), folder, "shift"), "A shift over time", CAPTION)
    page = render("claims.html", head, [_plots(shift)], findings=found, picture=picture)
    write_atomically(folder / "report.html", page)


def _plots(shift: Shift) -> Group:
    positions = [
        Series("true", 1e3 * shift.position_m, "truth"),
        Series("believed", 1e3 * shift.filtered_m, "believed", stepped=True),
        Series("believed without filter", 1e3 * shift.unfiltered_m, "alarm", stepped=True),
    ]
    pressures = [Series(n, 1e-5 * values, n) for n, values in shift.pressures_pa.items()]
    panels = [Panel("Position", "mm", positions, 220), Panel("Pressures", "bar", pressures, 140)]
    return plots("time, s", shift.time_s, panels, twin=True)


def draw(shift: Shift) -> Figure:
    """Draw the shift: true and believed positions above the pressures."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.4), layout="constrained", facecolor=LIGHT.paper)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.0]})
    ms = 1e3 * shift.time_s
    upper.plot(ms, 1e3 * shift.position_m, color=LIGHT.truth, lw=2.0, label="true")
    for values, colour, label in (
        (shift.filtered_m, LIGHT.believed, "believed"),
        (shift.unfiltered_m, LIGHT.alarm, "believed without filter"),
    ):
        upper.step(ms, 1e3 * values, where="post", color=colour, lw=1.4, label=label)
    for name, values in shift.pressures_pa.items():
        lower.plot(ms, 1e-5 * values, color=LIGHT.chamber[name], label=f"chamber {name}")
    upper.set_ylabel("position, mm")
    lower.set_ylabel("bar, absolute")
    lower.set_xlabel("time, ms")
    for axes in (upper, lower):
        _style(axes)
    return figure


def _style(axes: Axes) -> None:
    axes.grid(color=LIGHT.grid, lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
