"""shift.png, shift.svg and report.html of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sil.report.figures import save
from sil.report.page import run_page
from sil.report.picture import draw
from sil.report.run_plots import run_plots
from sil.report.theme import LIGHT
from sil.results import write_whole

if TYPE_CHECKING:
    from sil.cosim import Finished


def write_report(finished: Finished, folder: Path) -> None:
    """Write the picture, and the page with it. Needs a record."""
    result, record = finished.result, finished.record
    assert record is not None
    title = f"{result.scenario_name}: {result.status}"
    subtitle = result.scenario["description"].strip().split("\n")[0]
    figure = draw(record, finished.shifts, title, subtitle, LIGHT)
    picture = save(figure, folder, "shift", dots_per_inch=140)
    plots = run_plots(record, finished.shifts)
    write_whole(folder / "report.html", run_page(result, picture, plots))
