"""Rows that weigh assumptions: by how much each headline holds under other inferred numbers.

A row sets parameters of the model, `factor.NAME` (see `sil.studies.assumptions`) and conditions of
the strokes: `stroke.supply_pressure_pa`, `stroke.mesh_force_n`, `stroke.impulse_factor` on what the
synchronizer asks for, `stroke.scatter_factor` on the scatter from shift to shift; filter and latency of
the runs in closed loop (`sil.studies.assumptions.CONDITIONS`). Each figure is a margin: the headline
holds where it is positive. Designs: `one_at_a_time` gives the range in which each headline holds;
`radial` gives Sobol's total indices by Jansen's estimator, with bootstrapped intervals.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, RunError
from plant.errors import IntegrationError
from plant.parameters import Number, ParameterSet, load
from sil.recording.runs import true_runs
from sil.report.figure import Figure, Panel, Rule, Span, Stack
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load as load_scenario
from sil.studies.assumptions import CONDITIONS, FACTORS, NOT_VARIED
from sil.studies.figures import numbered, title_of
from sil.studies.kinds.budget import THESIS_DELAYS_S
from sil.studies.load_study import load_study
from sil.studies.policies import GEARBOX, NOT_ARRIVED_M_S, PUSH, Family, FamilyModel
from sil.studies.rows import NOT_RUN, PASSED, RowResult
from sil.studies.study import LoadedStudy, Row, texts_of
from sil.studies.table import Table

Floats = NDArray[np.float64]

HEADLINES = {
    "damper_m_s": "the oil damper softens the hardest of the gearbox loads",
    "late_s": "the last part of every stroke is shorter than 48 ms",
    "ahead_m_s": "known ahead: the synchro brake softens 250 N s",
    "cushion_m_s": "in the laboratory the cushion of quick hardware is softer than the open loop",
    "bench_m_s": "there it is harder than the oil damper",
    "truck_m_s": "on the gearbox, 250 N s, it is harder than the oil damper",
    "charged_s": "a charged neutral chamber costs time",
    "often_ahead_m_s": "worst of 10 shifts with scatter, 250 N s: the synchro brake is softer than the open loop",
    "often_damper_m_s": "worst of 10 shifts with scatter, 250 N s: the oil damper is softer than the synchro brake",
}
"""What each figure is the margin of."""
OFTEN = "often_ahead_m_s", "often_damper_m_s"
"""Those that take 30 shifts; a radial design leaves them out."""
OFTEN_STRATEGIES = "open loop", "synchro brake", "oil damper"
SCATTERED, SHIFTS, OFTEN_LOAD = "how_often", 10, "gearbox, 250 N s"
"""The study of which the shifts with scatter are the first, and its load."""

THESIS_S = sum(delay_s for _name, delay_s in THESIS_DELAYS_S)
EXTRA_S = 0.03
RESAMPLES = 1000


def headlines(study: LoadedStudy) -> dict[str, str]:
    """Return the headlines that a study weighs: columns and texts."""
    left_out = OFTEN if study.study.design.kind == "radial" else ()
    return {name: text for name, text in HEADLINES.items() if name not in left_out}


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the margins of the headlines."""
    return (*headlines(study), "failed")


@dataclass(frozen=True)
class Conditions:
    """What a row changes of the strokes; None: as each headline has it."""

    supply_pressure_pa: float | None = None
    mesh_force_n: float | None = None
    impulse_factor: float = 1.0
    scatter_factor: float = 1.0

    @property
    def family(self) -> Family:
        """The gearbox loads under these conditions."""
        given = {"supply_pressure_pa": self.supply_pressure_pa, "mesh_force_n": self.mesh_force_n}
        family = GEARBOX.under(
            **{name: value for name, value in given.items() if value is not None}
        )
        cases = (
            replace(case, sync_impulse_n_s=self.impulse_factor * case.sync_impulse_n_s)
            for case in family.cases
        )
        return replace(family, cases=tuple(cases))


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Return the margin of each headline under the row's parameters.

    Raises InputError for settings that no model accepts, RunError if the equations cannot be solved.
    """
    for path, value in row.settings.items():
        if isinstance(value, (bool, str, list)):
            raise InputError(f"{path}: {value!r}; expected a number")
    known = {"factor": FACTORS, "stroke": vars(Conditions())}
    stated, others = row.split(known)
    loop = {path: others.pop(path) for path in CONDITIONS if path in others}
    own, model = (
        {name: float(value) for name, value in each.items()}  # type: ignore[arg-type]
        for each in (stated, others)
    )
    changed: dict[str, Number] = dict(model)
    parameters = load(study.study.model).override(model)
    for name in [name for name in FACTORS if name in own]:
        factor = own.pop(name)
        if not factor > 0.0:
            raise InputError(f"factor.{name}: {factor:g}; expected above 0")
        if factor != 1.0:
            changed |= FACTORS[name](parameters, factor)
            parameters = parameters.override(changed)
    conditions = Conditions(**own)
    settings = texts_of({k: list(v) if isinstance(v, tuple) else v for k, v in changed.items()})
    settings += texts_of(loop)
    try:
        family = conditions.family.under(atmosphere_pa=parameters.value("gas.P_atm"))
        found = _gearbox_margins(parameters, family)
        damper_250_m_s = found.pop("damper_250_m_s")
        found |= _loop_margins(study.study.model, settings, conditions, damper_250_m_s)
        if OFTEN[0] in headlines(study):
            found |= _often_margins(study.study.model, settings, conditions)
    except IntegrationError as error:
        raise RunError(str(error)) from None
    missing = [name for name in headlines(study) if not math.isfinite(found[name])]
    if missing:
        return RowResult(found | {"failed": 1.0}, NOT_RUN, f"no value of {', '.join(missing)}")
    return RowResult(found | {"failed": 0.0}, PASSED)


def _gearbox_margins(parameters: ParameterSet, family: Family) -> dict[str, float]:
    """Return the margins of the headlines on policies of the plant alone, and the damper at 250 N s."""
    plain, damped = (
        FamilyModel(parameters, each, EXTRA_S).plain
        for each in (family, family.under(load="damper"))
    )
    damper_m_s = damped.impact_worst_m_s[0]
    return {
        "damper_m_s": float(plain.impact_worst_m_s.max() - damper_m_s.max()),
        "late_s": THESIS_S - float((plain.arrival_s - plain.revealed_s).max()),
        "damper_250_m_s": float(damper_m_s[-1]),
    }


def _impact(model: str, scenario: str, settings: Sequence[str]) -> tuple[float, float]:
    """Return hardest impact in m/s and time of arrival in s of a scenario's last shift."""
    named = None if model == "nominal" else model
    shift = run_in_memory(load_scenario(scenario, model=named, settings=settings)).shifts[-1]
    if shift.arrived_s is None or shift.impact_worst_m_s is None:
        return NOT_ARRIVED_M_S, 1.0
    return shift.impact_worst_m_s, shift.arrived_s


def _loop_margins(
    model: str, settings: list[str], conditions: Conditions, damper_250_m_s: float
) -> dict[str, float]:
    """Return the margins of the headlines on runs in closed loop."""
    supply, mesh = (
        [] if value is None else [f"plant.{name}={value!r}"]
        for name in ("supply_pressure_pa", "mesh_force_n")
        for value in (getattr(conditions, name),)
    )

    def impact(scenario: str, *more: str) -> tuple[float, float]:
        return _impact(model, scenario, [*settings, *supply, *more])

    truck = (
        "plant.mounted=true",
        "plant.mesh_force_n=1300.0",
        f"driveline.impulse_backward_n_s={250.0 * conditions.impulse_factor!r}",
    )
    held = ("duration_s=0.8", *truck, *mesh)
    unfiltered = "controller.filter.enabled=false"  # also where a row sets the filter's order
    easy_n_s = load_scenario("charged_neutral").scenario.driveline.impulse_backward_n_s or 0.0
    easy = f"driveline.impulse_backward_n_s={easy_n_s * conditions.impulse_factor!r}"
    bench_m_s = impact("strategy_air_cushion", unfiltered, "duration_s=0.4")[0]
    charged_s, vented_s = (
        impact("charged_neutral", "duration_s=0.6", *mesh, easy, *chambers)[1]
        for chambers in ([], ["plant.charged=[]"])
    )
    return {
        "ahead_m_s": impact("lab_n_b", *held)[0]
        - impact("lab_n_b", *held, 'controller.strategy="synchro_brake"')[0],
        "cushion_m_s": impact("lab_n_b", "duration_s=0.4")[0] - bench_m_s,
        "bench_m_s": bench_m_s - impact("oil_damper", "duration_s=0.4")[0],
        "truck_m_s": impact("strategy_air_cushion", unfiltered, *held)[0] - damper_250_m_s,
        "charged_s": charged_s - vented_s,
    }


def _often_margins(model: str, settings: list[str], conditions: Conditions) -> dict[str, float]:
    """Return the margins of the headlines on shifts with scatter: the first of `how_often`."""
    study = load_study(SCATTERED)
    assert study.study.scenario is not None
    supply_pa, factor = conditions.supply_pressure_pa, conditions.scatter_factor
    worst_m_s: dict[str, float] = {}
    for row in itertools.islice(study.rows(), SHIFTS * study.size // len(study.points)):
        choice = dict(zip(study.groups, row.choices, strict=True))
        if choice["load"] != OFTEN_LOAD or choice["strategy"] not in OFTEN_STRATEGIES:
            continue
        changed = dict(row.settings)
        for sweep in study.study.sweep:
            if sweep.scale == "normal":
                centre = 0.5 * (sweep.low + sweep.high)  # type: ignore[operator]
                changed[sweep.path] = centre + factor * (row.settings[sweep.path] - centre)  # type: ignore[operator]
        if supply_pa is not None:
            changed["plant.supply_pressure_pa"] *= supply_pa / PUSH.supply_pressure_pa  # type: ignore[operator]
        if conditions.mesh_force_n is not None:
            changed["plant.mesh_force_n"] = conditions.mesh_force_n
        changed["driveline.impulse_backward_n_s"] *= conditions.impulse_factor  # type: ignore[operator]
        found_m_s = _impact(model, study.study.scenario, [*settings, *texts_of(changed)])[0]
        name = choice["strategy"]
        worst_m_s[name] = max(found_m_s, worst_m_s.get(name, 0.0))
    open_loop, brake, damper = (worst_m_s[name] for name in OFTEN_STRATEGIES)
    return {"often_ahead_m_s": open_loop - brake, "often_damper_m_s": brake - damper}


def total_indices(margins: Floats, parameters: int) -> Floats:
    """Return total Sobol indices [parameters, 3] of a radial design: estimate, 2.5 and 97.5 % ends.

    margins [rows]: for each centre its value and those with one parameter after another changed.
    Jansen: S_T = E[(f(a) - f(a_i))^2] / (2 Var f). The interval is bootstrapped over the centres.
    """
    blocks = margins.reshape(-1, parameters + 1)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    rng = np.random.default_rng(0)
    picks = rng.integers(len(blocks), size=(RESAMPLES, len(blocks)))
    drawn = np.concatenate([blocks[None], blocks[picks]])
    change = ((drawn[..., 1:] - drawn[..., :1]) ** 2).mean(axis=1)
    variance = drawn.reshape(len(drawn), -1).var(axis=1)
    found = change / (2.0 * np.maximum(variance, 1e-30))[:, None]
    ends = np.quantile(found[1:], [0.025, 0.975], axis=0)
    return np.stack([found[0], *ends], axis=1)


def holds(values: Floats, margins: Floats) -> str:
    """Return between which swept values a headline holds: "always", "never" or ranges.

    values [n]: swept, in the unit of their path; margins [n]: of the headline, in its unit.
    """
    order = np.argsort(values)
    x, good = values[order], margins[order] > 0.0
    if good.all() or not good.any():
        return "always" if good.all() else "never"
    parts = []
    for begin, end in true_runs(good):
        parts.append(f"{x[begin]:g}" if end == begin + 1 else f"{x[begin]:g} to {x[end - 1]:g}")
    return ", ".join(parts)


DIGITS = {"ms": 0, "m/s": 2}
"""Digits of a margin, by its unit."""


def _unit(name: str) -> tuple[str, float]:
    return ("ms", 1e3) if name.endswith("_s") and not name.endswith("_m_s") else ("m/s", 1.0)


def _weighed(study: LoadedStudy, table: Table, name: str) -> Iterator[tuple[float, float, str]]:
    """Yield low and high end of each swept value's influence on a headline, and the same in words.

    Of a radial design it is the interval of the total index, of the other the range of margins.
    """
    sweeps, margins = study.study.sweep, table.numbers[name]
    if study.study.design.kind == "radial":
        for index, low, high in total_indices(margins, len(sweeps)):
            yield low, high, f"{index:.2f} ({low:.2f} to {high:.2f})"
        return
    swept = np.array([table.numbers[sweep.path] for sweep in sweeps])
    unit, scale = _unit(name)
    for k, values in enumerate(swept):
        alone = (np.delete(swept, k, axis=0) == np.delete(swept[:, :1], k, axis=0)).all(axis=0)
        own = scale * margins[alone]
        ran = own[np.isfinite(own)]
        ends = (ran.min(), ran.max()) if len(ran) else (math.nan, math.nan)
        yield *ends, in_words(values[alone], own, DIGITS[unit])


def in_words(values: Floats, margins: Floats, digits: int) -> str:
    """Return the range of a headline's margins over swept values [n], bold with `holds` if it turns.

    A range that is below half of the last digit is no effect. NaN: the row did not run.
    """
    ran = np.isfinite(margins)
    if not ran.any():
        return "not run"
    values, margins = values[ran], margins[ran]
    low, high = margins.min(), margins.max()
    if low > 0.0 and high - low < 0.5 * 10.0**-digits:
        return "none"
    text = f"{low:.{digits}f} to {high:.{digits}f}"
    where = holds(values, margins)
    return text if where == "always" else f"**{text}; holds: {where}**"


def files(study: LoadedStudy, table: Table) -> Iterator[tuple[str, str]]:
    """Yield the tables of parameters and headlines as Markdown, and the parameters that are not in them."""
    names, radial = headlines(study), study.study.design.kind == "radial"
    lines = []
    for k, (name, text) in enumerate(names.items(), 1):
        unit, scale = _unit(name)
        nominal = "" if radial else f"{scale * table.numbers[name][0]:.{DIGITS[unit]}f} "
        lines.append(f"{k}. {text}: {nominal}{unit}")
    columns = [[cell for _low, _high, cell in _weighed(study, table, name)] for name in names]
    rows = []
    for k, sweep in enumerate(study.study.sweep):
        over = f": {min(sweep.values):g} to {max(sweep.values):g}" if sweep.values else ""
        rows.append([f"{sweep.label or sweep.path}{over}", *(column[k] for column in columns)])
    turns = ["**" in "".join(row) for row in rows]
    parts = [("turns a headline", True), ("turns none", False)]
    for what, wanted in [("total index (95 % interval)", False)] if radial else parts:
        head = [what, *map(str, range(1, len(names) + 1))]
        lines += ["", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
        lines += [f"| {' | '.join(row)} |" for row, turn in zip(rows, turns, strict=True) if turn == wanted]  # fmt: skip
    lines += ["", "Not varied:", ""]
    lines += [f"- {', '.join(paths)}: {reason}" for reason, paths in NOT_VARIED.items()]
    yield "sensitivity.md", "\n".join(lines) + "\n"


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return for each headline its margin over each parameter, or the total index of each."""
    labels = [sweep.label or sweep.path for sweep in study.study.sweep]
    radial = study.study.design.kind == "radial"
    stacks = []
    for name, text in headlines(study).items():
        spans = [
            Span(low, max(high, low + 1e-3), role, "", k - 0.3, k + 0.3)
            for k, (low, high, _cell) in enumerate(_weighed(study, table, name))
            if math.isfinite(high)
            for role in ("series0" if low > 0.0 else "alarm",)
        ]
        panel = Panel(
            text,
            spans=spans,
            rules=[Rule(0.0, "", "ink", "x", "solid")],
            ticks=numbered(labels),
            limits=(len(labels) - 0.5, -0.5),
            height=60 + 14 * len(labels),
        )
        axis = "total Sobol index, 95 % interval"
        stacks.append(
            Stack(
                axis if radial else f"margin of the headline, {_unit(name)[0]}", [panel], width=5.2
            )
        )
    note = "" if radial else "blue: the headline holds over the whole range; red: it turns"
    return {"sensitivity": Figure(stacks, title_of(study), note)}
