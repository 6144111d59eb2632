"""The fault table of a safety study: fault and shift, detection, reaction, end state, damage."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from can_dbc.messages import Fault, Gear
from sil.files.quantity import counted
from sil.report.figure import Figure, Panel, Span, Stack
from sil.simulation.circumstances import sight_s
from sil.studies.figures import numbered, title_of
from sil.studies.study import Study, Table
from sil.studies.table import markdown

FAULT_TABLE_HEAD = (
    *("fault", "shift", "detected after", "reported", "valves off after", "truly in"),
    *("reported in", "worst impact", "B and F filled", "half engaged"),
)
LEGEND = (
    "Detected after: from the start of the fault to the first report of one, -: none was reported.",
    "Valves off after: from its start until the last coil was switched off, -: none was on.",
    "Truly in: position of the stay at the end; reported in: the last gear that a receiver of the "
    "status frames accepts, nothing: they are missing, or fail their end-to-end protection.",
    "Worst impact: of the stay on a stop, -: it met none.",
    "B and F filled: how long both chambers were above 3 bar.",
    "Half engaged: the stay ended between its gears.",
)
"""What the columns mean."""


def fault_table(study: Study, table: Table) -> str:
    """Return the table as Markdown, one line for each row, after the counts of safe states."""
    lines = [f"# {study.file.name}", "", study.file.description, "", *safe_states(study, table), ""]
    lines += [*markdown(FAULT_TABLE_HEAD, rows(study, table)), "", *(f"- {x}" for x in LEGEND)]
    return "\n".join(lines) + "\n"


def longest_sight_s(study: Study) -> float:
    """Return the longest time before a motion of the base scenario reaches the status frames."""
    return sight_s(study.loaded({}).scenario)


def safe_states(study: Study, table: Table) -> list[str]:
    """Return sentences: how many rows kept the safe states, and how many faults were reported."""
    orphans = int((table.numbers["orphan_energised_s"] > 0.0).sum())
    half = int(table.numbers["half_engaged"].sum())
    false = np.nan_to_num(table.numbers["false_gear_s"])
    longest, sight = float(false.max(initial=0.0)), longest_sight_s(study)
    silent = int(np.isnan(table.numbers["reported_gear"]).sum())
    reported = int((table.numbers["fault_bits"] > 0.0).sum())
    return [
        f"{counted(table.size, 'run')}; a fault was reported in {reported}, no report was accepted at the end of "
        f"{silent}.",
        f"A valve energised without a living controller: in {counted(orphans, 'run')}.",
        f"A gear reported that the stay was not in: for {1e3 * longest:.0f} ms at the longest; "
        f"a motion can take {1e3 * sight:.0f} ms to be observed, longer than that in {_where(study, table, false > sight)}.",
        f"The stay ended between its gears: in {counted(half, 'run')}.",
    ]


def _where(study: Study, table: Table, flags: NDArray[np.bool_]) -> str:
    """Return the number of flagged [rows], and their faults."""
    names = list(study.file.groups)[:-1]
    faults = [", ".join(table.texts[name][i] for name in names) for i in np.flatnonzero(flags)]
    listed = f" ({'; '.join(dict.fromkeys(faults))})" if any(faults) else ""
    return f"{counted(len(faults), 'run')}{listed}"


def rows(study: Study, table: Table) -> Iterator[tuple[str, ...]]:
    """Yield the cells of each row, as texts."""
    for i in range(table.size):
        *fault, shift = [table.texts[name][i] for name in study.file.groups] or [""]
        number = {name: values[i] for name, values in table.numbers.items()}
        off_after = _milliseconds(number["coils_off_after_s"])
        yield (
            ", ".join(fault) or study.file.name,
            shift,
            _milliseconds(number["detected_after_s"]),
            _faults(number["fault_bits"]),
            "never" if number["energised_at_end"] else off_after,
            _gear(number["end_gear"]),
            _gear(number["reported_gear"], "nothing"),
            _text(number["worst_impact_m_s"], "{:.2f} m/s"),
            _milliseconds(number["both_filled_s"]) if number["both_filled_s"] else "no",
            "yes" if number["half_engaged"] else "no",
        )


def _text(value: float, form: str) -> str:
    return "-" if math.isnan(value) else form.format(value)


def _milliseconds(seconds: float) -> str:
    return _text(1e3 * seconds, "{:.0f} ms")


def _gear(code: float, unknown: str = "-") -> str:
    return unknown if math.isnan(code) else Gear(int(code)).name.lower()


def _faults(bits: float) -> str:
    if math.isnan(bits) or not bits:
        return "-"
    return ", ".join(f.name or "" for f in Fault if f and f in Fault(int(bits)))


def _outcome(table: Table, i: int, sight_s: float) -> int:
    """Return how row `i` ended, by its place in the key of `outcomes_figure`; sight_s: of `longest_sight_s`."""
    number = table.numbers
    if number["orphan_energised_s"][i] > 0.0 or number["false_gear_s"][i] > sight_s:
        return 6
    if not number["failed"][i] and number["reported_gear"][i] == number["end_gear"][i]:
        return 0
    if math.isnan(number["reported_gear"][i]) and not number["half_engaged"][i]:
        return 5
    reported = 0 if number["fault_bits"][i] else 1
    return (3 if number["half_engaged"][i] else 1) + reported


def outcomes_figure(study: Study, table: Table) -> Figure:
    """Return a grid of faults and shifts, coloured by how each run ended; long ones in two halves."""
    *of_fault, of_shift = study.file.groups
    shifts = list(dict.fromkeys(table.texts[of_shift]))
    labels = [", ".join(table.texts[name][i] for name in of_fault) for i in range(table.size)]
    faults = list(dict.fromkeys(labels))
    half = len(faults) if len(faults) < 12 else -(-len(faults) // 2)
    sight = longest_sight_s(study)
    stacks: list[Stack] = []
    outcomes = (
        ("shift done", "#009E73"),
        ("stopped in a gear, fault reported", "#56B4E9"),
        ("stopped in a gear, nothing reported", "#E69F00"),
        ("between the gears, fault reported", "#8C6D31"),
        ("between the gears, nothing reported", "#D55E00"),
        ("in a gear, no report accepted at the end", "#CC79A7"),
        ("unsafe: orphaned valve or false gear", "#000000"),
    )
    for begin in range(0, len(faults), half):
        part = faults[begin : begin + half]
        spans = []
        for i, label in enumerate(labels):
            if label in part:
                x, y = shifts.index(table.texts[of_shift][i]), part.index(label)
                colour = outcomes[_outcome(table, i, sight)][1]
                spans.append(Span(x - 0.46, x + 0.46, colour, "", y - 0.42, y + 0.42))
        ticks, limits, height = numbered(part), (half - 0.5, -0.5), max(120, 40 + 14 * half)
        keys = () if stacks else outcomes
        panel = Panel("Faults", spans=spans, ticks=ticks, limits=limits, keys=keys, height=height)
        stacks.append(Stack("shift", [panel], ticks=numbered(shifts), width=6.5))
    return Figure(stacks, title_of(study))
