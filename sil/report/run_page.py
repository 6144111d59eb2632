"""shift.png, shift.svg and report.html of a finished run: a page that needs no network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from can_dbc.typed_toml import convert
from sil.files.atomic import write_atomically
from sil.files.output_folder import finite
from sil.files.quantity import quantity, unit_of
from sil.report.picture import save
from sil.report.plots import PlotGroup, plots
from sil.report.run_figure import run_figure
from sil.report.shell import Head, Picture, render
from sil.simulation.metrics import METRICS
from sil.simulation.results import Result
from sil.simulation.safety import fault_spans
from sil.simulation.scenario import Scenario

if TYPE_CHECKING:
    from sil.simulation.runner import Finished


def tiles(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the figures at the top of the page."""
    left_out = ("impact_worst_m_s", "confirmed_early_s", "bus_lag_10_s", "bus_lag_90_s", "frames")
    return [
        (quantity(metrics[name], unit_of(name), 3), title)
        for name, title in METRICS.items()
        if metrics.get(name) is not None and name not in left_out
    ]


def run_page(result: Result, picture: bytes | None, groups: Sequence[PlotGroup] = ()) -> str:
    """Return the page of a run; `picture` is a PNG on light paper, `groups` show the same figure."""
    plain = msgspec.to_builtins(result)
    shown = "Position, valves, pressures, firmware states and CAN frames over simulated time"
    caption = (
        "True position against the controller's estimate; commanded against actual valve states; chamber "
        "pressures; firmware states; every CAN frame from its release to its arrival. One time axis per shift."
    )
    keys = ("versions", "balances", "speed", "bus", "scenario", "model")
    details = {key: plain[key] for key in keys}
    head = Head(
        command="run",
        name=result.scenario_name,
        verdict=result.status,
        good=result.passed,
        tiles=tiles(result.metrics),
        again=f"opc4 run result.json --seed {result.seed} --transport {result.transport}",
    )
    return render(
        "run.html",
        head,
        groups,
        result=plain,
        changes=[] if result.changes is None else [row.cells() for row in result.changes.metrics],
        picture=None if picture is None else Picture(picture, shown, caption),
        details=json.dumps(finite(details), indent=1, ensure_ascii=False),
    )


def write_report(finished: Finished, folder: Path) -> None:
    """Write picture and page; of a run longer than its record's piece they show that, and say so."""
    result, record = finished.result, finished.record
    assert record is not None
    end_s, duration_s = float(record.truth["time_s"][-1]), result.scenario["duration_s"]
    shifts = finished.shifts
    title = f"{result.scenario_name}: {result.status}"
    subtitle = result.scenario["description"].strip().split("\n")[0]
    if end_s < duration_s - result.scenario["trace_period_s"]:
        subtitle = f"the first {end_s:.0f} s of {duration_s:g} s. {subtitle}"
        shifts = [s for s in shifts if (s.confirmed_s or s.requested_s + 1.0) < end_s]
    faults = fault_spans(convert(result.scenario, Scenario, result.scenario_name))
    figure = run_figure(record, shifts, title, subtitle, faults)
    picture = save(figure, folder, "shift", dots_per_inch=140)
    write_atomically(folder / "report.html", run_page(result, picture, plots(figure)))
