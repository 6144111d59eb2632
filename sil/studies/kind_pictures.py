"""Pictures of bounds, latency budgets and tunings."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sil.studies.figure_style import COLOURS, saved
from sil.studies.kinds.budget import BARS, THESIS_S, THESIS_WINDOW_S, closed, simulated
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

MARKS = ("o", "s", "^", "D", "v", "P")
FORETOLD = "synchro brake"
"""The strategy that knows the release ahead, from the shaft speeds; in the laboratory nothing is."""

LEAD_S = 0.03
TUNED = Path(__file__).parent / "tuned.csv"
"""Result of the shipped study `tuning`: written by `opc4 whatif tuning`, its results.csv."""

THESIS_DELAY_S = sum(delay_s for _name, delay_s in THESIS_S)
FAMILIES = ("gearbox", "laboratory")


def envelope(delay_s: np.ndarray, bound_m_s: np.ndarray) -> np.ndarray:
    """The bound over the delay: what is reached with late information is so with earlier, too."""
    order = np.argsort(delay_s)
    least = np.minimum.accumulate(bound_m_s[order][::-1])[::-1]
    found = np.empty_like(least)
    found[order] = least
    return found


def worst_over(row: Mapping[str, str], family: str) -> float | None:
    """Worst impact speed of a tuned row over a family's loads; None when one failed."""
    cells = [value for name, value in row.items() if name.startswith(f"impact_m_s {family}")]
    return None if not cells or "" in cells else max(map(float, cells))


def tuned_points(family: str, path: Path = TUNED) -> dict[str, list[tuple[float, float]]]:
    """(information delay s, worst impact speed m/s) of each strategy of the shipped tuning."""
    if not path.exists():
        return {}
    found: dict[str, list[tuple[float, float]]] = {}
    with open(path, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            worst = worst_over(row, family)
            if worst is not None and row["strategy"] not in ("open loop", "oil damper"):
                points = found.setdefault(row["strategy"], [])
                delay_s = float(row["information_delay_s"])
                points.append((delay_from(row, family, delay_s), worst))
    return found


def delay_from(row: Mapping[str, str], family: str, delay_s: float) -> float:
    """Delay of what a tuned row acts on; negative, at most `LEAD_S`, where it knows it ahead."""
    if row["strategy"] != FORETOLD or family != "gearbox":
        return delay_s
    return -min(LEAD_S, float(row["best.least_lead_s"] or LEAD_S))


def draw_bounds(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """Bounds and strategies over the information delay, the damper and the plain push as levels."""
    from matplotlib import pyplot

    delay = table.numbers["bound.delay_s"]
    loads = np.array(table.texts.get("load", [study.study.name] * table.size))
    variants = np.array(table.texts.get("variant", [""] * table.size))
    families = list(dict.fromkeys(loads))
    figure, axes = pyplot.subplots(
        1, len(families), figsize=(6.4 * len(families), 5.6), sharey=True, squeeze=False
    )
    for axis, family in zip(axes[0], families, strict=True):
        inside = loads == family
        first = np.flatnonzero(inside)[0]
        axis.axhline(table.numbers["open_loop_m_s"][first], color="#555555", lw=1.2, ls=":")
        axis.axhline(table.numbers["damper_m_s"][first], color="#009E73", lw=2.0)
        for name, column in (("open loop", "open_loop_m_s"), ("oil damper", "damper_m_s")):
            axis.annotate(
                name,
                (64.0, table.numbers[column][first]),
                xytext=(-4, 4),
                textcoords="offset points",
                ha="right",
                fontsize=9,
            )
        for k, variant in enumerate(dict.fromkeys(variants)):
            rows = np.flatnonzero(inside & (variants == variant))
            rows = rows[np.argsort(delay[rows])]
            x = 1e3 * delay[rows]
            b = envelope(delay[rows], table.numbers["bound_m_s"][rows])
            a = float(np.min(table.numbers["clairvoyant_m_s"][rows]))
            name = f"valves: {variant}" if variant else "bound"
            axis.plot(x, b, "-", color=COLOURS[k], lw=2.2, label=f"(b) {name}")
            axis.plot(x, np.full(len(x), a), "--", color=COLOURS[k], lw=1.0, label=f"(a) {name}")
        for k, (strategy, points) in enumerate(tuned_points(family).items()):
            axis.plot(
                [1e3 * x for x, _ in points],
                [y for _, y in points],
                MARKS[k % len(MARKS)],
                ms=6,
                mfc="none",
                color="#D55E00" if strategy == FORETOLD else "#333333",
                label=strategy,
                clip_on=False,
                zorder=4,
            )
        axis.axvline(1e3 * THESIS_DELAY_S, color="#D55E00", lw=0.8)
        axis.annotate(
            "thesis: 48 ms",
            (1e3 * THESIS_DELAY_S, 0.02),
            rotation=90,
            xytext=(-10, 4),
            textcoords="offset points",
            fontsize=8,
            color="#D55E00",
        )
        axis.axvspan(axis.get_xlim()[0], 0.0, color="#eeeeee", zorder=0)
        axis.set_xlim(1e3 * float(np.min(delay)), 64.0)
        axis.set_title(f"{family}: worst of its loads", loc="left")
        axis.set_xlabel("information delay, ms (grey: known ahead)")
        axis.set_ylim(0.0, 1.5)
        axis.grid(alpha=0.25)
    axes[0][0].set_ylabel("impact speed at the stop, m/s")
    axes[0][-1].legend(frameon=False, fontsize=8, loc="upper right", ncols=2)
    figure.suptitle(headline(table, loads), x=0.01, ha="left", fontweight="bold")
    return saved(figure, folder / "bounds.png")


def headline(table: Table, loads: np.ndarray) -> str:
    """What the bounds say: which families no controller can stop as softly as the damper."""
    seen = table.numbers["bound.delay_s"] >= 0.0
    harder = table.numbers["bound_m_s"] > table.numbers["damper_m_s"]
    found = [
        family
        for family in dict.fromkeys(loads)
        if (seen & (loads == family)).any() and harder[seen & (loads == family)].all()
    ]
    if not found:
        return "The softest worst-case stop found for a controller"
    return (
        f"On the {' and the '.join(found)} no policy found that waits for the motion stops as softly "
        "as the oil damper"
    )


def draw_budget(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """The thesis's sum, and each row's delays as one stack against the time that there is."""
    from matplotlib import pyplot

    keys = [name for name, _items in study.groups]
    rows = [k for k in range(table.size) if not table.numbers["failed"][k]]
    labels = [", ".join(table.texts[key][k] for key in keys) or study.study.name for k in rows]
    figure, axis = pyplot.subplots(figsize=(12.0, 1.8 + 0.5 * (len(rows) + 1)))
    shades = pyplot.get_cmap("tab10").colors
    left = 0.0
    for name, delay_s in THESIS_S:
        axis.barh(0, 1e3 * delay_s, left=left, height=0.6, color="#bbbbbb", edgecolor="white")
        axis.text(
            left + 5e2 * delay_s,
            0,
            f"{name}\n{1e3 * delay_s:.0f}",
            ha="center",
            va="center",
            fontsize=7,
        )
        left += 1e3 * delay_s
    axis.plot([1e3 * THESIS_WINDOW_S] * 2, [-0.45, 0.45], color="#D55E00", lw=2.5)
    axis.text(left + 1, 0, f"slack {1e3 * THESIS_WINDOW_S - left:.0f}", va="center", fontsize=8)
    for at, k in enumerate(rows, start=1):
        left = told = 0.0
        for n, bar in enumerate(BARS):
            width = 1e3 * float(table.numbers[simulated(bar)][k])
            exact = 1e3 * float(table.numbers[closed(bar)][k])
            label = bar if at == 1 else None
            axis.barh(at, width, left=left, height=0.55, color=shades[n], label=label)
            axis.plot([told, told + exact], [at + 0.36] * 2, color=shades[n], lw=2)
            left, told = left + width, told + exact
        part = 1e3 * float(table.numbers["last_part_s"][k])
        window = 1e3 * float(table.numbers["window_s"][k])
        axis.plot([part] * 2, [at - 0.42, at + 0.42], color="#D55E00", lw=2.5)
        if window > part + 0.5:
            axis.plot([window] * 2, [at - 0.3, at + 0.3], color="#D55E00", lw=1.0, ls=":")
        axis.text(max(left, told) + 1, at, f"slack {part - left:.0f}", va="center", fontsize=8)
    axis.plot([], [], color="#D55E00", lw=2.5, label="stop (after the release, if there is one)")
    axis.plot([], [], color="#D55E00", lw=1.0, ls=":", label="stop, counted from the first motion")
    axis.set_yticks(range(len(rows) + 1), ["thesis 4.2.1", *labels])
    axis.invert_yaxis()
    axis.set_xlim(0.0, 115.0)
    axis.set_xlabel("ms after the motion that is to be answered (thin lines: closed form)")
    axis.legend(frameon=False, fontsize=8, loc="center right")
    axis.set_title(
        "From motion to counter-force: every delay, and the time there is",
        loc="left",
        weight="bold",
    )
    return saved(figure, folder / "budget.png")


def draw_tuning(study: LoadedStudy, table: Table, folder: Path) -> list[Path]:
    """Worst impact of each tuned row, by family; over a grid of two values also as maps."""
    from matplotlib import pyplot

    keys = [name for name, _items in study.groups]
    swept = [s.path for s in study.study.sweep]
    labels = []
    for k in range(table.size):
        parts = [table.texts[key][k] for key in keys]
        parts += [f"{s.label or s.path} {_value(table, s.path, k)}" for s in study.study.sweep]
        labels.append(", ".join(parts))
    made = []
    if study.study.design.kind == "grid" and len(swept) == 2:
        made.append(_maps(study, table, folder))
    if table.size <= 64:
        worst = {family: _worst(table, family) for family in families_of(table)}
        figure, axis = pyplot.subplots(figsize=(11.0, 1.6 + 0.24 * table.size))
        for n, (family, values) in enumerate(worst.items()):
            axis.plot(values, range(table.size), MARKS[n], color=COLOURS[n], label=family)
        axis.set_yticks(range(table.size), labels, fontsize=8)
        axis.invert_yaxis()
        axis.set_xlim(left=0.0)
        axis.grid(alpha=0.3)
        axis.set_xlabel("worst impact speed over the loads, m/s")
        axis.legend(frameon=False)
        made.append(saved(figure, folder / "tuning.png"))
    return made


def families_of(table: Table) -> list[str]:
    """What stands before the comma in the names of a tuning's loads, each once."""
    names = [n.removeprefix("impact_m_s ") for n in table.numbers if n.startswith("impact_m_s ")]
    return list(dict.fromkeys(name.split(",")[0] for name in names))


def _value(table: Table, path: str, k: int) -> str:
    if path in table.texts:
        return table.texts[path][k]
    value = float(table.numbers[path][k])
    return f"{1e3 * value:g} ms" if path.endswith(("_s", "D_rise", "D_fall")) else f"{value:g}"


def _over(table: Table, family: str, what: str = "impact_m_s") -> np.ndarray:
    """Impact under each of a family's loads [loads, rows], nan where one failed."""
    columns = [v for name, v in table.numbers.items() if name.startswith(f"{what} {family}")]
    return np.array(columns) if columns else np.full((1, table.size), np.nan)


def _worst(table: Table, family: str) -> np.ndarray:
    """Worst impact over a family's loads, nan where one of them failed."""
    worst: np.ndarray = np.max(_over(table, family), axis=0)
    return worst


def frame_of(table: Table, family: str, row: int) -> str | None:
    """Line of a map's frame: solid as soft as the damper at worst, dashed in the mean, or none."""
    ours, damper = (_over(table, family, what)[:, row] for what in ("impact_m_s", "damper_m_s"))
    if np.max(ours) <= np.max(damper):
        return "-"
    return "--" if np.mean(ours) <= np.mean(damper) else None


def _maps(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """Worst impact over the two swept values, a row a family, a column a variant."""
    from matplotlib import pyplot

    first, second = study.study.sweep
    variants = list(dict.fromkeys(table.texts.get("variant", [""] * table.size)))
    which = np.array(table.texts.get("variant", [""] * table.size))
    x, y = np.unique(table.numbers[first.path]), np.unique(table.numbers[second.path])
    families = families_of(table)
    figure, axes = pyplot.subplots(
        len(families),
        len(variants),
        figsize=(4.3 * len(variants) + 1.2, 3.7 * len(families)),
        squeeze=False,
        sharey=True,
    )
    mesh: Any = None
    for line, family in zip(axes, families, strict=True):
        values = _worst(table, family)
        for axis, variant in zip(line, variants, strict=True):
            grid = np.full((len(y), len(x)), np.nan)
            for k in np.flatnonzero(which == variant):
                i = int(np.searchsorted(y, table.numbers[second.path][k]))
                j = int(np.searchsorted(x, table.numbers[first.path][k]))
                grid[i, j] = values[k]
            mesh = axis.pcolormesh(
                range(len(x) + 1), range(len(y) + 1), grid, cmap="viridis_r", vmin=0.0, vmax=1.4
            )
            for k in np.flatnonzero(which == variant):
                style = frame_of(table, family, int(k))
                if style is not None:
                    corner = (
                        int(np.searchsorted(x, table.numbers[first.path][k])) + 0.03,
                        int(np.searchsorted(y, table.numbers[second.path][k])) + 0.03,
                    )
                    axis.add_patch(
                        pyplot.Rectangle(
                            corner, 0.94, 0.94, fill=False, ec="#D55E00", lw=3, ls=style
                        )
                    )
            for (i, j), value in np.ndenumerate(grid):
                text = "failed" if np.isnan(value) else f"{value:.2f}"
                dark = not np.isnan(value) and value > 0.8
                axis.text(j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=9,
                          color="white" if dark else "black")  # fmt: skip
            axis.set_xticks(np.arange(len(x)) + 0.5, [f"{1e3 * v:g}" for v in x])
            axis.set_yticks(np.arange(len(y)) + 0.5, [f"{1e3 * v:g}" for v in y])
            axis.set_title(f"{family}, {variant}", fontsize=10)
            axis.set_xlabel(f"{first.label or first.path}, ms")
        line[0].set_ylabel(f"{second.label or second.path}, ms")
    figure.suptitle(
        "Framed: as soft as the oil damper in the worst of the loads (dashed: in their mean only)",
        x=0.01,
        ha="left",
    )
    figure.tight_layout()
    figure.colorbar(mesh, ax=list(axes.flat), label="worst impact speed over the loads, m/s")
    return saved(figure, folder / "map.png", trimmed=True)
