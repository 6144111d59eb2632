"""Headlines as data (headlines.toml): what each compares, and how a row of a study measures that."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from can_dbc import typed_toml
from can_dbc.errors import RunError
from plant.errors import IntegrationError
from plant.parameters import ParameterSet
from sil.files.overrides import Settings
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from sil.studies.kinds.runs import RunsStudy
from sil.studies.policies import GEARBOX, PUSH, Arrivals, arrivals_of
from sil.studies.study import Setting, Study

NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Measure(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The greatest value over shifts or strokes: hardest impact, arrival, time from release to stop.

    One of: `value`; `strokes`, the plain push of the plant alone with this load on the gearbox, with
    all impulses or one; `scenario` with changes; `study`, rows with some choices at its first points.
    """

    of: Literal["impact_m_s", "arrival_s", "last_part_s"] = "impact_m_s"
    value: float | None = None
    strokes: Literal["none", "damper"] | None = None
    impulse_n_s: float | None = None
    scenario: str = ""
    set: dict[str, Setting] = {}
    study: str = ""
    choices: dict[str, str] = {}
    points: int = 1


class Headline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sentence that holds where `more` exceeds `less`; its margin is their difference."""

    name: str
    text: str
    more: Measure
    less: Measure


@functools.cache
def shipped_headlines() -> tuple[Headline, ...]:
    """Return the headlines of "Why feedback fails"."""
    path = Path(__file__).parent / "headlines.toml"
    tables = typed_toml.read_toml(path)["headline"]
    return typed_toml.convert(tables, tuple[Headline, ...], str(path))


class RowConditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a row changes; None: as in each headline. Factors: on impulse and a study's scatter."""

    supply_pressure_pa: Annotated[float, msgspec.Meta(ge=1e5)] | None = None
    mesh_force_n: NotNegative | None = None
    impulse_factor: NotNegative = 1.0
    scatter_factor: NotNegative = 1.0


@dataclass(eq=False)
class Case:
    """The model, the settings of scenarios and the conditions under which a row measures."""

    model: str
    parameters: ParameterSet
    settings: Settings
    conditions: RowConditions

    def __post_init__(self) -> None:
        self._values: dict[bytes, float] = {}
        self._arrivals: dict[str, Arrivals] = {}

    def margin(self, headline: Headline) -> float:
        """Return by how much a headline holds, each part measured once. Raises InputError and RunError."""
        return self._value(headline.more) - self._value(headline.less)

    def _value(self, measure: Measure) -> float:
        key = msgspec.json.encode(measure)
        if key not in self._values:
            self._values[key] = self._measured(measure)
        return self._values[key]

    def _measured(self, measure: Measure) -> float:
        if measure.value is not None:
            return measure.value
        if measure.strokes is not None:
            arrivals = self._pushed(measure.strokes)
            values = arrivals.impact_worst_m_s
            if measure.of == "last_part_s":
                values = arrivals.arrival_s - arrivals.revealed_s
            impulses_n_s = [case.sync_impulse_n_s for case in GEARBOX]
            one = measure.impulse_n_s
            return float(values.max() if one is None else values[impulses_n_s.index(one)])
        shifts = self._rows(measure) if measure.study else [(measure.scenario, measure.set)]
        return max(self._last_shift(*shift)[measure.of == "arrival_s"] for shift in shifts)

    def _pushed(self, load: str) -> Arrivals:
        """Return the plain push of the plant alone under the gearbox loads."""
        if load not in self._arrivals:
            changes: dict[str, Any] = {
                name: value
                for name in ("supply_pressure_pa", "mesh_force_n")
                if (value := getattr(self.conditions, name)) is not None
            }
            changes |= {"load": load, "atmosphere_pa": self.parameters.value("gas.P_atm")}
            factor = self.conditions.impulse_factor
            cases = [
                replace(case, sync_impulse_n_s=factor * case.sync_impulse_n_s, **changes)
                for case in GEARBOX
            ]
            try:
                self._arrivals[load] = arrivals_of(self.parameters, cases)
            except IntegrationError as error:
                raise RunError(str(error)) from None
        return self._arrivals[load]

    def _rows(self, measure: Measure) -> Iterator[tuple[str, Settings]]:
        """Yield the scenario and the settings of the rows of a study, scattered by the factor."""
        path = Path(__file__).parents[1] / "shipped" / f"{measure.study}.toml"
        file = typed_toml.convert(typed_toml.read_toml(path), RunsStudy, str(path))
        study, factor = Study(file, str(path)), self.conditions.scatter_factor
        scattered = {s.path: 0.5 * sum(s.ends) for s in file.sweep if s.scale == "normal"}
        for row in itertools.islice(study.rows(), measure.points * study.size // len(study.points)):
            choices = dict(zip(file.groups, row.choices, strict=True))
            if measure.choices.items() <= choices.items():
                changes = {
                    path: centre + factor * (row.settings[path] - centre)
                    for path, centre in scattered.items()
                }
                yield file.scenario, {**row.settings, **changes}

    def _last_shift(self, scenario: str, settings: Settings) -> tuple[float, float]:
        """Return hardest impact in m/s and arrival in s of the last shift; without arrival 2 m/s and 1 s."""
        conditions, changes = self.conditions, dict(settings)
        plain = load_scenario.load(scenario, settings=settings).scenario
        if conditions.supply_pressure_pa is not None:
            supply_pa = plain.plant.supply_pressure_pa or PUSH.supply_pressure_pa
            share = conditions.supply_pressure_pa / PUSH.supply_pressure_pa
            changes["plant.supply_pressure_pa"] = supply_pa * share
        if conditions.mesh_force_n is not None and plain.plant.mounted:
            changes["plant.mesh_force_n"] = conditions.mesh_force_n
        impulse_n_s = plain.driveline.impulse_backward_n_s
        if impulse_n_s is not None:
            changes["driveline.impulse_backward_n_s"] = impulse_n_s * conditions.impulse_factor
        model = None if self.model == "nominal" else self.model
        changes = {**self.settings, **changes}
        loaded = load_scenario.load(scenario, model=model, settings=changes)
        shift = run_in_memory(loaded).shifts[-1]
        if shift.arrived_s is None or shift.impact_worst_m_s is None:
            return 2.0, 1.0
        return shift.impact_worst_m_s, shift.arrived_s
