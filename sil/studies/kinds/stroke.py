"""Rows that are strokes of the plant alone: commands at given times, no controller."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from can_dbc import typed_toml
from can_dbc.errors import InputError, RunError
from plant.effects import overridden
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import IntegrationError
from plant.parameters import load
from plant.systems.stroke import Stroke, simulate
from sil.files.overrides import Settings
from sil.report.figure import BAR, MM, MS, Figure, Panel, Series, Stack
from sil.report.theme import SERIES
from sil.simulation.impacts import PICK_UP, counted, worst_speed_m_s
from sil.studies.figures import pareto_figure, row_labels, swept_figures, title_of
from sil.studies.study import RowResult, Study, StudyFile, StudyRow, Table

Seconds = Annotated[float, msgspec.Meta(ge=0.0, le=60.0)]


class StudyStroke(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The plant alone: one stroke by a list of commands (time s, valve, duty)."""

    kind: Literal["fixed", "N-B", "B-N", "N-F", "F-N"]
    """Rig and stroke."""
    commands: list[tuple[Seconds, str, Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]]]
    """Valve commands: time in s, valve, duty."""
    until_s: Annotated[float, msgspec.Meta(ge=0.001, le=60.0)] = 0.3
    """Simulated time."""
    supply_pressure_pa: Annotated[float, msgspec.Meta(ge=1e5, le=2e6)] = 900000.0
    """Supply pressure, absolute."""
    load: Literal["none", "damper", "spring"] = "none"
    """What is coupled to the stay."""
    damper_model: Literal["compressible", "incompressible"] = "compressible"
    """How the oil of the damper is modelled."""
    charged_before: list[str] | str = []
    """Chambers at supply pressure at the start, a list or their letters."""
    mounted: bool = False
    """Mounted on the gearbox."""
    mesh_force_n: Annotated[float, msgspec.Meta(ge=0.0, le=1e5)] = 0.0
    """Peak of the force against meshing."""
    sync_impulse_n_s: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 0.0
    """Impulse that the synchronizer needs."""
    final_volume_m3: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] | None = None
    """What chamber N of the length stroke keeps in gear; if missing, as the model has it."""

    def __post_init__(self) -> None:
        valves = "12" if self.kind == "fixed" else "BNF"
        for k, (_time_s, valve, _duty) in enumerate(self.commands):
            if valve not in tuple(valves):
                expected = ", ".join(valves)
                raise InputError(f"commands[{k}]: valve {valve!r}; expected {expected}")

    @property
    def chambers(self) -> tuple[str, str]:
        """The driving and the opposing chamber."""
        return ("1", "2") if self.kind == "fixed" else (self.kind[-1], self.kind[0])

    def conditions(self) -> StrokeConditions:
        """Return the stroke as the plant takes it."""
        values = msgspec.structs.asdict(self)
        del values["until_s"], values["final_volume_m3"]
        lists = {name: tuple(values[name]) for name in ("commands", "charged_before")}
        return StrokeConditions(**(values | lists))


class StrokeStudy(StudyFile, frozen=True, kw_only=True, tag_field="kind", tag="stroke"):
    """A row is one stroke of the plant alone. The default kind of a file with [stroke]."""

    rows_together: ClassVar[int] = 16
    stroke: StudyStroke
    """Stroke of the plant alone that is simulated."""

    def columns(self) -> tuple[str, ...]:
        """Return the figures of a stroke."""
        return (
            *("arrival_s", "impact_speed_m_s", "impact_energy_j", "impact_worst_m_s"),
            *("air_used_kg", "first_motion_s", "standstills"),
            *("charging_drop_pa", "passive_peak_pa", "failed"),
        )

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Simulate a stroke. Raises InputError, or RunError if the equations cannot be solved."""
        table, stroke = self._stroke(row.settings)
        impact = stroke.impact
        driving, opposing = table.chambers
        charging_pa = stroke.pressure_pa(driving)
        charging_pa = charging_pa[stroke.time_s < (impact.time_s if impact else stroke.time_s[-1])]
        drop_pa = np.max(np.maximum.accumulate(charging_pa) - charging_pa, initial=0.0)
        moved = np.flatnonzero(np.abs(stroke.position_m - stroke.position_m[0]) > 5e-5)
        turns = sum(e.name == "turn" for e in stroke.events)
        figures = {
            "arrival_s": impact.time_s if impact else math.nan,
            "impact_speed_m_s": impact.speed_m_s if impact else math.nan,
            "impact_energy_j": impact.energy_j if impact else math.nan,
            "impact_worst_m_s": _worst_m_s(stroke) if impact else math.nan,
            "air_used_kg": stroke.balance.air_in_kg,
            "first_motion_s": float(stroke.time_s[moved[0]]) if len(moved) else math.nan,
            "standstills": float(turns),
            "charging_drop_pa": float(drop_pa),
            "passive_peak_pa": float(np.max(stroke.pressure_pa(opposing))),
            "failed": 0.0 if impact else 1.0,
        }
        if impact:
            return RowResult(figures)
        return RowResult(figures, "failed", f"the stay met no stop within {table.until_s:g} s")

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return metrics over sweeps and choices, few strokes over time, a front beside the base."""
        figures = swept_figures(study, table)
        if "pareto" in figures:
            figures["pareto"] = pareto_figure(study, table, self._references(study, table))
        return figures | ({"curves": self._curves(study, table)} if study.size <= 12 else {})

    def _stroke(self, settings: Settings) -> tuple[StudyStroke, Stroke]:
        """Simulate a stroke; settings stroke.* change its table, all others the model."""
        changes = {path[7:]: x for path, x in settings.items() if path.startswith("stroke.")}
        model = {path: x for path, x in settings.items() if not path.startswith("stroke.")}
        values = msgspec.to_builtins(self.stroke) | changes
        table = typed_toml.convert(values, StudyStroke, key="stroke")
        parameters = overridden(load(self.model), model)
        if table.final_volume_m3 is not None:
            swept_m = parameters.value("length.x_free_total") + parameters.value("length.stroke")
            neutral_m3 = table.final_volume_m3 + parameters.value("length.A_p") * swept_m
            parameters = parameters.override({"length.V_N0": neutral_m3})
        time_s = np.arange(round(table.until_s / 1e-4) + 1, dtype=np.float64) * 1e-4
        try:
            return table, simulate(parameters, table.conditions(), time_s, internal=False)
        except IntegrationError as error:
            raise RunError(str(error)) from None

    def _references(self, study: Study, table: Table) -> dict[str, dict[str, Mapping[str, float]]]:
        """Return each group's figures with nothing swept, without load and with the damper."""
        groups: dict[str, dict[str, Mapping[str, float]]] = {}
        swept = {_whole(sweep.path) for sweep in self.sweep}
        first = {int(rows[0]): label for label, rows in study.row_groups(table).items()}
        for row in itertools.islice(study.rows(), max(first) + 1):
            if row.number not in first:
                continue
            kept = {path: x for path, x in row.settings.items() if _whole(path) not in swept}
            references = groups.setdefault(first[row.number], {})
            for name, load_of_stay in (("nothing changed", "none"), ("oil damper", "damper")):
                with contextlib.suppress(InputError):
                    settings = kept | {"stroke.load": load_of_stay}
                    result = study.run(replace(row, settings=settings))
                    if result.outcome == "passed":
                        references[name] = result.figures
        return groups

    def _curves(self, study: Study, table: Table) -> Figure:
        """Return position and pressures of every row over time."""
        curves: list[list[Series]] = [[], [], []]
        end_s = 0.0
        for row, label in zip(study.rows(), row_labels(study, table), strict=True):
            role, dashed = f"series{row.number % SERIES}", row.number >= SERIES
            stroke = self._stroke(row.settings)[1]
            pressures = (BAR * stroke.pressure_pa(chamber) for chamber in self.stroke.chambers)
            for lines, y in zip(curves, (MM * stroke.position_m, *pressures), strict=True):
                lines.append(Series(label, MS * stroke.time_s, y, role, dashed=dashed))
            end_s = max(end_s, stroke.impact.time_s if stroke.impact else 0.0)
        until_s = self.stroke.until_s
        last_s = min(until_s, 1.6 * end_s + 0.02) if end_s else until_s
        titles = (
            ("Position of the stay", "mm", 220),
            *((f"Pressure {chamber}, absolute", "bar", 170) for chamber in self.stroke.chambers),
        )
        panels = [
            Panel(title, unit, lines, height=height)
            for (title, unit, height), lines in zip(titles, curves, strict=True)
        ]
        stack = Stack("time, ms", panels, "Over time", limits=(0.0, MS * last_s), width=8.6)
        return Figure([stack], title_of(study))


def _worst_m_s(stroke: Stroke) -> float:
    """Return the hardest impact of a stroke as a speed of the stay, see `sil.simulation.impacts`."""
    gears = {"N": "neutral", "B": "backward", "F": "forward"}
    kind = stroke.conditions.kind
    way = (gears[kind[0]], gears[kind[-1]]) if kind != "fixed" else ("", "")
    events = stroke.events
    energy_j = np.array([e.energy_j for e in events])
    counts = counted(
        np.array([e.name.replace(" ", "_") for e in events]),
        np.array([e.time_s for e in events]),
        energy_j,
        np.array([e.name == "block" for e in events], dtype=np.bool_),
        PICK_UP.get(way, ()),
    )
    speed = max(e.speed_m_s for e in events if e.name == "stop")
    mass_kg = float(stroke.packed.m_s + stroke.packed.m_p)
    return float(worst_speed_m_s(energy_j[counts].max(initial=0.0), np.array(speed), mass_kg))


def _whole(path: str) -> str:
    """Return the effect of a path effect.ID.PARAMETER, any other path as it is."""
    return path.rpartition(".")[0] if path.startswith("effect.") else path
