"""shift.png, shift.svg and report.html of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sil.files.atomic import write_atomically
from sil.report.page import run_page
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.run_figure import run_figure

if TYPE_CHECKING:
    from sil.simulation.runner import Finished


def write_report(finished: Finished, folder: Path) -> None:
    """Write the picture, and the page with it. Needs a record.

    Of a run longer than the record's piece they show that piece, and say so.
    """
    result, record = finished.result, finished.record
    assert record is not None
    end_s, duration_s = float(record.truth["time_s"][-1]), result.scenario["duration_s"]
    shifts = finished.shifts
    title = f"{result.scenario_name}: {result.status}"
    subtitle = result.scenario["description"].strip().split("\n")[0]
    if end_s < duration_s - result.scenario["trace_period_s"]:
        subtitle = f"the first {end_s:.0f} s of {duration_s:g} s. {subtitle}"
        shifts = [s for s in shifts if (s.confirmed_s or s.requested_s + 1.0) < end_s]
    figure = run_figure(record, shifts, title, subtitle)
    picture = save(figure, folder, "shift", dots_per_inch=140)
    write_atomically(folder / "report.html", run_page(result, picture, plots(figure)))
