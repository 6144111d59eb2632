"""The figure of simulated strokes over their records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from sil.campaign.simulate import SimulatedStroke
from sil.recording.run_record import Floats
from sil.report.figure import BAR, MM, MS, Figure, Panel, Rule, Series, Stack


def campaign_figure(
    strokes: Iterable[tuple[SimulatedStroke, Mapping[str, Floats]]], title: str
) -> Figure:
    """Return strokes side by side, each with its record: columns [n] in SI units by name, if there are any."""
    return Figure([_stack(*each) for each in strokes], title, same_scale=True)


def _stack(item: SimulatedStroke, recorded: Mapping[str, Floats]) -> Stack:
    stroke = item.stroke
    columns = {"position_m": (stroke.position_m, "Position", "mm", MM)} | {
        f"pressure_{name}_pa": (stroke.pressure_pa(name), f"Pressure {name}, absolute", "bar", BAR)
        for name in stroke.conditions.chambers
    }
    panels: list[Panel] = []
    rules = [
        Rule(at_s * MS, f"{valve} {'on' if duty else 'off'}")
        for at_s, valve, duty in stroke.conditions.commands
    ]
    for name, (values, title, unit, factor) in columns.items():
        lines = [Series("simulated", stroke.time_s * MS, values * factor, "after", width=1.8)]
        if name in recorded:
            measured = recorded[name] * factor
            lines.insert(0, Series("recorded", stroke.time_s * MS, measured, "measured", width=2.4))
        panels.append(Panel(title, unit, lines, rules=rules, height=150, legend=not panels))
        rules = []
    title = f"{item.entry.label} ({item.entry.file})"
    return Stack("time of the record, ms", panels, title, width=5.0)
