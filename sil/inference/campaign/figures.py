"""Figures of a diagnosis: strokes with their residuals, terms, the next stroke.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from sil.inference.campaign.model import channel_parts
from sil.report.figure import BAR, MM, MS, Band, Figure, Panel, Rule, Series, Span, Stack

if TYPE_CHECKING:
    from plant.effects.term import TermForm
    from sil.inference.campaign.diagnosis import Diagnosis
    from sil.inference.campaign.next_experiment import NextExperiment
    from sil.inference.campaign.observations import ObservedChannel, StrokeObservation
    from sil.inference.report import Interval
CHANNEL_UNITS = {"position": ("mm", MM), "pressure": ("bar", BAR), "oil": ("bar", BAR)}


def worst(result: Diagnosis) -> list[int]:
    """Return the strokes that the healthy model fits worst, of different kinds, held-out ones first."""
    strokes = list(result.held_out) or list(result.healthy.blocks)
    squares = {k: float(np.mean(result.healthy.blocks[k].residual ** 2)) for k in strokes}
    chosen: dict[str, int] = {}
    for k in sorted(strokes, key=lambda k: -squares[k]):
        chosen.setdefault(result.model.strokes[k].entry.label, k)
    return list(chosen.values())[:3]


def strokes_figure(result: Diagnosis) -> Figure:
    """Return a few strokes: each channel measured and of both models, and its residuals."""
    return Figure([_stroke(result, k) for k in worst(result)])


def _stroke(result: Diagnosis, k: int) -> Stack:
    stroke = result.model.strokes[k]
    title = f"{stroke.entry.label} ({stroke.entry.file})"
    panels = list(_channels(result, k))
    return Stack("time, ms", panels, title, limits=_view(stroke), width=5.0)


def _view(stroke: StrokeObservation) -> tuple[float, float]:
    """Return what is drawn of a stroke, in ms: a record may begin seconds before its first command."""
    first_s = min((at_s for at_s, _, _ in stroke.conditions.commands), default=0.0)
    begin, end = float(stroke.time_s[0]), float(stroke.time_s[-1])
    low = max(begin, first_s - 0.02)
    return MS * (low if low < end else begin), MS * end


def _channels(result: Diagnosis, k: int) -> Iterator[Panel]:
    stroke = result.model.strokes[k]
    ms = MS * stroke.time_s
    models = [("healthy model", result.healthy, "before", False)]
    if result.final is not result.healthy:
        models.append(("extended model", result.final, "after", True))
    parts = [list(channel_parts(stroke, fit.blocks[k].residual)) for _n, fit, _r, _d in models]
    for n, channel in enumerate(stroke.channels):
        unit, scale = CHANNEL_UNITS[channel.kind]
        x = ms[channel.rows]
        lines = [Series("measured", x, scale * channel.measured, "measured", width=2.2)]
        residuals = []
        for (name, _fit, role, dashed), channels in zip(models, parts, strict=True):
            r = channels[n][1]
            predicted = scale * (channel.measured - r * channel.sd)
            lines.append(Series(name, x, predicted, role, dashed=dashed, width=0.9))
            residuals.append(Series(name, x, r, role, width=0.6))
        yield Panel(title_of(channel), unit, lines, height=120, legend=n == 0)
        band = Span(-inf, inf, "grid", "", -3.0, 3.0)
        yield Panel("residual / sd", "", residuals, spans=[band], height=80, legend=False)


def term_figure(form: TermForm, nodes: Sequence[Interval]) -> Figure:
    """Return the estimated term over its variable, with its interval."""
    x = np.linspace(form.low, form.high, form.count)
    value, low, high = np.array([(node.value, node.low, node.high) for node in nodes]).T
    panel = Panel(
        form.what,
        form.unit,
        [Series("estimate", x, value, "after", "marked")],
        bands=[Band(x, low, high, "after")],
        rules=[Rule(0.0, axis="y")],
        height=220,
    )
    return Figure([Stack(form.on, [panel], width=12.0)])


def next_figure(experiment: NextExperiment) -> Figure:
    """Return what two hypotheses predict of the most telling stroke, and their difference."""
    stroke = experiment.shown
    ms = MS * stroke.time_s
    names = list(experiment.predicted)
    parts = [list(channel_parts(stroke, numbers)) for numbers in experiment.predicted.values()]
    panels = []
    for n, channel in enumerate(stroke.channels):
        unit, scale = CHANNEL_UNITS[channel.kind]
        x = ms[channel.rows]
        roles = zip(names, ("before", "after"), (False, True), parts, strict=True)
        lines = [
            Series(name, x, scale * part[n][1] * channel.sd, role, dashed=dashed, width=1.2)
            for name, role, dashed, part in roles
        ]
        panels.append(Panel(title_of(channel), unit, lines, height=110, legend=n == 0))
        apart = parts[0][n][1] - parts[1][n][1]
        band = Span(-inf, inf, "grid", "", -3.0, 3.0)
        series = [Series("difference", x, apart, "measured", width=0.8)]
        panels.append(Panel("apart", "sd", series, spans=[band], height=70, legend=False))
    title = experiment.strokes[0].entry.label
    return Figure([Stack("time, ms", panels, title, limits=_view(stroke), width=12.0)])


def title_of(channel: ObservedChannel) -> str:
    """Return a channel's name as a panel's title."""
    title = channel.name.removesuffix("_m").removesuffix("_pa").replace("_", " ")
    return f"{title}, absolute" if channel.kind in ("pressure", "oil") else title
