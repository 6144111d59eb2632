"""The fault table of a safety study: fault by shift, detection, reaction, end state, damage."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from can_dbc.messages import Fault, Gear
from sil.report.figures import save
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

FAULT_TABLE = "fault_table.md"
HEAD = (
    "fault",
    "shift",
    "detected after",
    "reported",
    "valves off after",
    "truly in",
    "reported in",
    "worst impact",
    "B and F filled",
    "half engaged",
)

LEGEND = (
    "Detected after: from the start of the fault to the first report of one, -: none was reported.",
    "Valves off after: from its start until the last coil was switched off, -: none was on.",
    "Truly in: where the stay is at the end; reported in: what a receiver of the status frames "
    "believes then, nothing: they are missing, or refused by their end-to-end protection.",
    "Worst impact: of the stay on a stop, -: it met none.",
    "B and F filled: how long both chambers were above 3 bar.",
    "Half engaged: the stay ended between its gears.",
)
"""What the columns mean."""


def fault_table(study: LoadedStudy, table: Table) -> str:
    """The table as Markdown, one line a row of the study, and above it what was kept."""
    lines = [f"# {study.study.name}", "", study.study.description, "", *kept(study, table), ""]
    lines += ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    lines += ["| " + " | ".join(cells) + " |" for cells in rows(study, table)]
    lines += ["", *(f"- {line}" for line in LEGEND)]
    return "\n".join(lines) + "\n"


def kept(study: LoadedStudy, table: Table) -> list[str]:
    """In sentences: how many rows kept the safe states, and how many faults were seen."""
    orphans = int((table.numbers["orphan_energised_s"] > 0.0).sum())
    half = int(table.numbers["half_engaged"].sum())
    false = np.nan_to_num(table.numbers["false_gear_s"])
    longest, sight = float(false.max(initial=0.0)), study.longest_sight_s
    silent = int(np.isnan(table.numbers["reported_gear"]).sum())
    seen = int((table.numbers["fault_bits"] > 0.0).sum())
    return [
        f"{table.size} runs; a fault was reported in {seen}, no report was believed at the end of "
        f"{silent}.",
        f"A valve energised without a living controller: in {orphans} runs.",
        f"A gear reported that the stay was not in: for {1e3 * longest:.0f} ms at the longest; "
        f"{1e3 * sight:.0f} ms pass before a motion can be seen, more than that in {_where(study, table, false > sight)}.",
        f"The stay ended between its gears: in {half} runs.",
    ]


def _where(study: LoadedStudy, table: Table, flags: np.ndarray) -> str:
    """How many rows, and with which faults."""
    names = [name for name, _items in study.groups][:-1]
    told = [", ".join(table.texts[name][i] for name in names) for i in np.flatnonzero(flags)]
    return f"{len(told)} runs" + (f" ({'; '.join(dict.fromkeys(told))})" if any(told) else "")


def rows(study: LoadedStudy, table: Table) -> Iterator[tuple[str, ...]]:
    """The cells of each row, as texts."""
    number = table.numbers
    names = [name for name, _items in study.groups]
    for i in range(table.size):
        choices = [table.texts[name][i] for name in names]
        yield (
            ", ".join(choices[:-1]) or study.study.name,
            choices[-1] if choices else "",
            _milliseconds(number["detected_after_s"][i]),
            _faults(number["fault_bits"][i]),
            "never"
            if number["energised_at_end"][i]
            else _milliseconds(number["coils_off_after_s"][i]),
            _gear(number["end_gear"][i]),
            "nothing"
            if math.isnan(number["reported_gear"][i])
            else _gear(number["reported_gear"][i]),
            _text(number["worst_impact_m_s"][i], "{:.2f} m/s"),
            _milliseconds(number["both_filled_s"][i]) if number["both_filled_s"][i] else "no",
            "yes" if number["half_engaged"][i] else "no",
        )


def _text(value: float, form: str) -> str:
    return "-" if math.isnan(value) else form.format(value)


def _milliseconds(seconds: float) -> str:
    return _text(1e3 * seconds, "{:.0f} ms")


def _gear(code: float) -> str:
    return "-" if math.isnan(code) else Gear(int(code)).name.lower()


def _faults(bits: float) -> str:
    if math.isnan(bits) or not bits:
        return "-"
    return ", ".join(f.name or "" for f in Fault if f and f in Fault(int(bits)))


OUTCOMES = (
    ("shift done", "#009E73"),
    ("stopped in a gear, fault reported", "#56B4E9"),
    ("stopped in a gear, nothing reported", "#E69F00"),
    ("between the gears, fault reported", "#8C6D31"),
    ("between the gears, nothing reported", "#D55E00"),
    ("in a gear, no report believed at the end", "#CC79A7"),
    ("unsafe: orphaned valve or false gear", "#000000"),
)


def outcome(table: Table, i: int, sight_s: float) -> int:
    """How row `i` ended, as an index of OUTCOMES."""
    number = table.numbers
    if number["orphan_energised_s"][i] > 0.0 or number["false_gear_s"][i] > sight_s:
        return 6
    if not number["failed"][i] and number["reported_gear"][i] == number["end_gear"][i]:
        return 0
    if math.isnan(number["reported_gear"][i]) and not number["half_engaged"][i]:
        return 5
    reported = 0 if number["fault_bits"][i] else 1
    return (3 if number["half_engaged"][i] else 1) + reported


def draw_outcomes(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """Picture of the study: fault by shift, coloured by how it ended."""
    from matplotlib import pyplot
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    names = [name for name, _items in study.groups]
    shifts = list(dict.fromkeys(table.texts[names[-1]]))
    labels = [", ".join(table.texts[name][i] for name in names[:-1]) for i in range(table.size)]
    faults = list(dict.fromkeys(labels))
    grid = np.full((len(faults), len(shifts)), 0)
    sight = study.longest_sight_s
    for i in range(table.size):
        place = faults.index(labels[i]), shifts.index(table.texts[names[-1]][i])
        grid[place] = outcome(table, i, sight)
    half = len(faults) if len(faults) < 12 else -(-len(faults) // 2)
    panels = [part for part in (slice(0, half), slice(half, len(faults))) if faults[part]]
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(6.5 * len(panels), 1.6 + 0.17 * half), squeeze=False
    )
    colours = ListedColormap([colour for _name, colour in OUTCOMES])
    for axis, part in zip(axes[0], panels, strict=True):
        axis.imshow(grid[part], cmap=colours, vmin=0, vmax=len(OUTCOMES) - 1, aspect="auto")
        axis.set_yticks(range(len(faults[part])), faults[part], fontsize=7)
        axis.set_xticks(range(len(shifts)), shifts, fontsize=8)
        axis.xaxis.tick_top()
        axis.tick_params(length=0)
        axis.set_xticks(np.arange(0.5, len(shifts)), minor=True)
        axis.set_yticks(np.arange(0.5, len(faults[part])), minor=True)
        axis.grid(which="minor", color="white", linewidth=1.5)
        axis.tick_params(which="minor", length=0)
    figure.legend(
        handles=[Patch(color=colour, label=name) for name, colour in OUTCOMES],
        loc="lower center",
        ncols=3 if len(panels) > 1 else 2,
        frameon=False,
        fontsize=8,
    )
    wide, tall = 6.5 * len(panels), 1.6 + 0.17 * half
    labels_in = 0.2 + 0.052 * max(map(len, faults))
    axis_in = (0.99 * wide - len(panels) * labels_in) / len(panels)
    figure.subplots_adjust(
        left=labels_in / wide,
        right=0.99,
        top=1.0 - 0.5 / tall,
        bottom=0.8 / tall,
        wspace=labels_in / axis_in,
    )
    save(figure, folder, "faults")
    pyplot.close(figure)
    return folder / "faults.png"
