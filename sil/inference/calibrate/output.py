"""What `opc4 calibrate` writes: the model file, which stands alone, and a page with every stroke.

Checked by: tests/unit/sil/inference/calibrate/test_calibrate.py
"""

from __future__ import annotations

from math import inf
from pathlib import Path

from plant.parameters import Parameter, load
from sil.files.atomic import write_atomically
from sil.inference.calibrate.calibration import Calibration, StrokeCalibration, residuals
from sil.inference.campaign.figures import CHANNEL_UNITS, title_of
from sil.inference.report import model_file
from sil.report.figure import MS, Figure, Panel, Series, Span, Stack
from sil.report.plots import plots
from sil.report.shell import Head, render


def model_text(result: Calibration) -> str:
    """Return the text of the calibrated model file, all that differs from the set `nominal`: it needs no other file."""
    nominal, given = load(), result.parameters
    source = f"calibrated on {result.name}, {result.content}"
    entries = {
        path: item
        for path, item in given.entries.items()
        if item.source != "computed from [cylinder]" and item != nominal.entries.get(path)
    }
    for path, value in result.values.items():
        item = given.entries.get(path)
        text = f"{source}; {'unknown' if item is None else item.source}"
        unit = item.unit if item is not None else ""
        entries[path] = Parameter(value.value, unit, text, value.low, value.high)
    entries |= result.posterior
    sections: dict[str, dict[str, Parameter]] = {}
    for path, item in entries.items():
        section, key = path.split(".", 1)
        sections.setdefault(section, {})[key] = item
    for identifier, table in given.effects.items():
        sections[f"effect.{identifier}"] = dict(table)
    return model_file(f"{source}. {result.headline}", "nominal", sections)


def strokes_figure(result: StrokeCalibration) -> Figure:
    """Return every stroke: channels measured and simulated, and residuals over their noise."""
    return Figure([_stroke(result, k) for k in result.fit.blocks])


def _stroke(result: StrokeCalibration, k: int) -> Stack:
    stroke = result.model.strokes[k]
    parts = residuals(result.model, {k: result.fit.blocks[k]})
    panels: list[Panel] = []
    for channel in stroke.channels:
        unit, scale = CHANNEL_UNITS[channel.kind]
        ((r, noise, time_s),) = parts[channel.name]
        lines = [
            Series("measured", MS * time_s, scale * channel.measured, "measured", width=2.2),
            Series("calibrated", MS * time_s, scale * (channel.measured - r), "after", width=0.9),
        ]
        panels.append(Panel(title_of(channel), unit, lines, height=120, legend=not panels))
        band = Span(-inf, inf, "grid", "", -3.0, 3.0)
        left = [Series("residual", MS * time_s, r / noise, "after", width=0.6)]
        panels.append(Panel("residual / noise", "", left, spans=[band], height=80, legend=False))
    return Stack("time, ms", panels, f"{stroke.entry.label} ({stroke.entry.file})", width=8.0)


def write_page(result: Calibration, figure: Figure, path: Path, again: str) -> None:
    """Write the page of a calibration; figure: of what was measured."""
    count, data = result.content.split()
    tiles = [(count, data), (f"{result.worst[1]:.3g}", "rms over noise, held out")]
    verdict = "good enough" if result.good else "structure missing"
    head = Head("calibrate", result.name, verdict, result.good, tiles, again)
    rows = [(path, result.parameters[path], item) for path, item in result.scalars.items()]
    page = render("calibration.html", head, plots(figure), result=result, rows=rows)
    write_atomically(path, page)
