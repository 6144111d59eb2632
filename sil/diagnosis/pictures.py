"""Pictures of a diagnosis: strokes with residual bands, misfit by channel and phase.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sil.diagnosis.phases import PHASES
from sil.diagnosis.residuals import Shown
from sil.fitting.fit import FitResult
from sil.report.theme import LIGHT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from plant.effects.term import TermForm
    from sil.diagnosis.diagnosis import Diagnosis
    from sil.diagnosis.intervals import Interval
    from sil.diagnosis.one_equation import Alone

Floats = NDArray[np.float64]
BEFORE, AFTER, MEASURED = LIGHT.before, LIGHT.after, LIGHT.measured
STROKES_DRAWN = 3


def new_figure(width: float, height: float) -> Figure:
    """A figure that needs no display and no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor=LIGHT.paper)


def parts(result: Diagnosis, fit: FitResult, k: int) -> dict[str, tuple[Floats, Floats]]:
    """Predicted values and standardised residuals of stroke k, by channel."""
    found = {}
    begin = 0
    for channel in result.model.strokes[k].channels:
        end = begin + len(channel.measured)
        r = fit.blocks[k].residual[begin:end]
        found[channel.name] = (channel.measured - r * channel.sd, r)
        begin = end
    return found


def worst(result: Diagnosis) -> list[int]:
    """Strokes that the healthy model fits worst, of different kinds, held-out ones first."""
    places = list(result.held_out) or list(result.healthy.blocks)
    sizes = {k: float(np.mean(result.healthy.blocks[k].residual ** 2)) for k in places}
    chosen: list[int] = []
    kinds: set[str] = set()
    for k in sorted(places, key=lambda k: -sizes[k]):
        kind = result.model.strokes[k].entry.label
        if kind not in kinds and len(chosen) < STROKES_DRAWN:
            chosen.append(k)
            kinds.add(kind)
    return chosen


def strokes_picture(result: Diagnosis) -> Figure:
    """Measured, healthy and extended model of a few strokes; residuals with their band below."""
    chosen = worst(result)
    figure = new_figure(13.0, 9.0)
    grid = figure.subplots(
        4,
        len(chosen),
        sharex="col",
        squeeze=False,
        gridspec_kw={"height_ratios": [1.0, 1.6, 0.8, 1.2]},
    )
    for column, k in zip(grid.T, chosen, strict=True):
        stroke = result.model.strokes[k]
        before, after = parts(result, result.healthy, k), parts(result, result.final, k)
        ms = 1e3 * stroke.time_s
        motion, pressure, small, large = column
        motion.set_title(f"{stroke.entry.label} ({stroke.entry.file})", fontsize=10)
        for channel in stroke.channels:
            axes, scale = (motion, 1e3) if channel.kind == "position" else (pressure, 1e-5)
            if channel.kind == "oil":
                continue
            axes.plot(ms[channel.rows], channel.measured * scale, color=MEASURED, lw=2.2)
            axes.plot(ms[channel.rows], before[channel.name][0] * scale, color=BEFORE, lw=0.9)
            axes.plot(
                ms[channel.rows], after[channel.name][0] * scale, color=AFTER, lw=0.9, ls="--"
            )
        for axes, kinds in ((small, ("position",)), (large, ("pressure", "oil"))):
            axes.axhspan(-3.0, 3.0, color=LIGHT.grid, zorder=0)
            for channel in stroke.channels:
                if channel.kind in kinds:
                    for values, color in ((before, BEFORE), (after, AFTER)):
                        axes.plot(ms[channel.rows], values[channel.name][1], color=color, lw=0.6)
        motion.set_ylabel("mm")
        pressure.set_ylabel("bar")
        small.set_ylabel("position\nresidual / sd")
        large.set_ylabel("pressures\nresidual / sd")
        large.set_xlabel("ms")
        for axes in column:
            axes.grid(color=LIGHT.grid, lw=0.5)
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_facecolor(LIGHT.paper)
    from matplotlib.lines import Line2D

    figure.legend(
        handles=[
            Line2D([], [], color=MEASURED, lw=2.2, label="measured"),
            Line2D([], [], color=BEFORE, label="healthy model, tolerances fitted"),
            Line2D([], [], color=AFTER, ls="--", label="model that stands"),
        ],
        loc="outside upper center",
        ncols=3,
        frameon=False,
    )
    return figure


def phases_picture(before: Shown, after: Shown) -> Figure:
    """Misfit by channel and phase, before and after, side by side."""
    channels = list(before.by_phase)
    names = [phase for phase in PHASES if any(phase in row for row in before.by_phase.values())]
    figure = new_figure(13.0, 1.2 + 0.42 * len(channels))
    grid = figure.subplots(1, 2, sharey=True, squeeze=False)[0]
    for axes, shown, title in zip(
        grid, (before, after), ("healthy model", "model that stands"), strict=True
    ):
        table = np.full((len(channels), len(names)), np.nan)
        for i, channel in enumerate(channels):
            for j, phase in enumerate(names):
                table[i, j] = shown.by_phase.get(channel, {}).get(phase, np.nan)
        axes.imshow(
            np.log10(np.maximum(table, 0.5)), aspect="auto", cmap="OrRd", vmin=-0.05, vmax=1.5
        )
        for i, j in np.ndindex(table.shape):
            if np.isfinite(table[i, j]):
                dark = table[i, j] > 8.0
                axes.text(
                    j,
                    i,
                    f"{table[i, j]:.3g}" if table[i, j] < 100 else f"{table[i, j]:.0f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if dark else "black",
                )
        axes.set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=9)
        axes.set_yticks(range(len(channels)), channels, fontsize=9)
        axes.set_title(title, fontsize=10)
        axes.tick_params(length=0)
    return figure


def alone_picture(result: Diagnosis, found: tuple[int, Alone, Alone]) -> Figure:
    """One equation at a time: residuals of the force balance and of each chamber, before and after."""
    k, before, after = found
    stroke = result.model.strokes[k]
    rows: list[tuple[str, Floats, Floats, float]] = []
    if before.position_m is not None and after.position_m is not None:
        rows.append(("force balance\nposition, mm", before.position_m, after.position_m, 1e3))
    for name, values in before.pressures_pa.items():
        if name in after.pressures_pa:
            title = f"chamber {name}\npressure, bar"
            rows.append((title, values, after.pressures_pa[name], 1e-5))
    figure = new_figure(13.0, 0.8 + 1.7 * len(rows))
    grid = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    ms = 1e3 * before.time_s
    for axes, (title, first, second, scale) in zip(grid, rows, strict=True):
        axes.axhline(0.0, color=LIGHT.grid, lw=1.0)
        axes.plot(ms, scale * first, color=BEFORE, lw=0.9, label="questioned model")
        axes.plot(ms, scale * second, color=AFTER, lw=0.9, label="model that stands")
        axes.set_ylabel(title)
        axes.grid(color=LIGHT.grid, lw=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_facecolor(LIGHT.paper)
    grid[0].set_title(
        f"{stroke.entry.label} ({stroke.entry.file}): measured - predicted", fontsize=10
    )
    grid[0].legend(frameon=False, ncols=2, loc="upper right")
    grid[-1].set_xlabel("ms")
    return figure


def term_picture(form: TermForm, nodes: list[Interval]) -> Figure:
    """The estimated missing force or flow over its variable, with its interval."""
    figure = new_figure(13.0, 3.2)
    axes = figure.subplots()
    at = np.linspace(form.low, form.high, form.count)
    axes.axhline(0.0, color=LIGHT.grid, lw=1.0)
    axes.fill_between(
        at, [n.low for n in nodes], [n.high for n in nodes], color=AFTER, alpha=0.2, lw=0
    )
    axes.plot(at, [n.value for n in nodes], color=AFTER, marker="o", ms=3.5)
    axes.set_xlabel(form.on)
    axes.set_ylabel(f"{form.what}\n[{form.unit}]", fontsize=9)
    axes.grid(color=LIGHT.grid, lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_facecolor(LIGHT.paper)
    return figure
