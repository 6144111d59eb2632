"""report.html of the claims and its figure: the table, and the shift that they are about.

Checked by: tests/unit/sil/claims/test_claims.py, tests/browser/
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from sil.claims.claim import MET, NOT_MET, Claim
from sil.report.figure import BAR, MM, MS, Figure, Panel, Series, Stack
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load

SCENARIO = "lab_n_b"
WINDOW_MS = (80.0, 320.0)
CAPTION = (
    "Neutral to backward in the laboratory (lab_n_b). Black: true position of the stay. Violet: the "
    "controller's estimate, through its filter; orange: without the filter. Below, the driving and "
    "the opposing chamber."
)


def write_page(found: Sequence[Claim], folder: Path, again: str) -> None:
    """Write report.html, shift.png and shift.svg; `again` is the call that made them."""
    from sil.files.atomic import write_atomically

    counts = Counter(finding.verdict for finding in found)
    head = Head(
        command="claims",
        name="The thesis's claims",
        verdict=f"{counts[MET]} of {len(found)} met",
        good=None if 0 < counts[MET] < len(found) else not counts[NOT_MET],
        tiles=[(str(number), verdict) for verdict, number in counts.most_common()],
        again=again,
    )
    figure = _shift_figure()
    picture = Picture(save(figure, folder, "shift"), "A shift over time", CAPTION)
    page = render("claims.html", head, plots(figure), findings=found, picture=picture)
    write_atomically(folder / "report.html", page)


def _shift_figure() -> Figure:
    filtered, unfiltered = (
        run_in_memory(load(SCENARIO, settings=settings)).record
        for settings in ((), ("controller.filter=false",))
    )
    truth = filtered.truth
    time_ms = MS * truth["time_s"]
    positions = [Series("true", time_ms, MM * truth["position_m"], "truth", width=2.0)]
    for label, role, record in (
        ("controller's estimate", "estimate", filtered),
        ("estimate without the filter", "alarm", unfiltered),
    ):
        when_s, estimate_m = record.estimate
        positions.append(Series(label, MS * when_s, MM * estimate_m, role, "stepped"))
    pressures = [
        Series(f"chamber {name}", time_ms, BAR * truth[f"pressure_{name}_pa"], name)
        for name in "BN"
    ]
    panels = [
        Panel("Position", "mm", positions, height=240),
        Panel("Pressure, absolute", "bar", pressures, height=130),
    ]
    return Figure([Stack("time, ms", panels, limits=WINDOW_MS, width=9.8)])
