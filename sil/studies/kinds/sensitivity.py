"""Rows that weigh assumptions: by how much each headline holds under other inferred numbers.

A row sets parameters of the model, `factor.GROUP` (a common factor on parameters that belong
together), `stroke.supply_pressure_pa` and `stroke.mesh_force_n`. Each figure is a margin: the headline
holds where it is positive. Designs: `one_at_a_time` gives the range in which each headline holds;
`radial` gives Sobol's total indices by Jansen's estimator, with bootstrapped intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, RunError
from plant.errors import IntegrationError
from plant.parameters import ParameterSet, load
from sil.report.figure import Figure, Panel, Rule, Span, Stack
from sil.simulation.in_memory import run_in_memory
from sil.simulation.scenario import load as load_scenario
from sil.studies.figures import numbered, title_of
from sil.studies.policies import GEARBOX, NOT_ARRIVED, Family, FamilyModel, Layout
from sil.studies.rows import NOT_RUN, PASSED, RowResult
from sil.studies.study import LoadedStudy, Row
from sil.studies.table import Table

Floats = NDArray[np.float64]

FACTORS = {
    "friction": [f"friction_length.{name}_{body}" for name in ("F_sf", "F_rf", "beta") for body in "sp"],
    "end_volumes": ["length.V_B0", "length.V_F0"],
}  # fmt: skip
"""Parameters that a common factor changes together."""

HEADLINES = {
    "damper_m_s": "the oil damper softens the hardest of the gearbox loads",
    "late_s": "the last part of every stroke is shorter than 48 ms",
    "blind_m_s": "48 ms late, no programme found is as soft as the oil damper",
    "ahead_m_s": "known ahead: the synchro brake softens 250 N s",
    "cushion_m_s": "in the laboratory the cushion of quick hardware is softer than the open loop",
    "bench_m_s": "there it is harder than the oil damper",
    "truck_m_s": "on the gearbox, 250 N s, it is harder than the oil damper",
    "charged_s": "a charged neutral chamber costs time",
}
"""What each figure is the margin of."""

SECONDS = ("late_s", "charged_s")
THESIS_S = 0.048
EXTRA_S = 0.03
GENERATIONS = 15
RESAMPLES = 1000


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the margins of the headlines."""
    return (*HEADLINES, "failed")


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Return the margin of each headline under the row's parameters.

    Raises InputError for settings that no model accepts, RunError if the equations cannot be solved.
    """
    parameters = load(study.study.model)
    model, conditions = dict[str, float](), dict[str, float]()
    for path, value in row.settings.items():
        if isinstance(value, (bool, str, list)):
            raise InputError(f"{path}: {value!r}; expected a number")
        kind, _, name = path.partition(".")
        if kind == "factor":
            if name not in FACTORS:
                raise InputError(f"{path}: unknown; expected one of {', '.join(FACTORS)}")
            model |= {each: value * parameters.value(each) for each in FACTORS[name]}
        elif kind == "stroke":
            if name not in ("supply_pressure_pa", "mesh_force_n"):
                raise InputError(f"{path}: unknown; expected supply_pressure_pa, mesh_force_n")
            conditions[name] = float(value)
        else:
            model[path] = float(value)
    changed = parameters.override(model)
    cases = tuple(replace(case, **conditions) for case in GEARBOX.cases)  # type: ignore[arg-type]
    settings = [f"{path}={value!r}" for path, value in model.items()]
    try:
        found = gearbox_margins(changed, replace(GEARBOX, cases=cases))
        found |= loop_margins(study.study.model, settings, conditions, found.pop("damper_250_m_s"))
    except IntegrationError as error:
        raise RunError(str(error)) from None
    missing = [name for name in HEADLINES if not math.isfinite(found[name])]
    if missing:
        return RowResult(found | {"failed": 1.0}, NOT_RUN, f"no value of {', '.join(missing)}")
    return RowResult(found | {"failed": 0.0}, PASSED)


def gearbox_margins(parameters: ParameterSet, family: Family) -> dict[str, float]:
    """Return the margins of the headlines on policies of the plant alone, and the damper at 250 N s."""
    damped = replace(family, cases=tuple(replace(case, damper=True) for case in family.cases))
    late = FamilyModel(parameters, family, THESIS_S, EXTRA_S)
    damper_m_s = FamilyModel(parameters, damped, THESIS_S, EXTRA_S).plain.impact_worst_m_s[0, 0]
    plain = late.plain
    return {
        "damper_m_s": float(plain.impact_worst_m_s.max() - damper_m_s.max()),
        "late_s": THESIS_S - float((plain.arrival_s - plain.revealed_s).max()),
        "blind_m_s": softest_blind_m_s(late) - float(damper_m_s.max()),
        "damper_250_m_s": float(damper_m_s[-1]),
    }


def softest_blind_m_s(model: FamilyModel) -> float:
    """Return the softest worst case of programmes of two pulses of N, by a small global search."""
    from scipy.optimize import differential_evolution

    layout, last = Layout("N", 2, 0), 100.0 * float(model.limit_s.max())
    found = differential_evolution(
        lambda x: model.fly(x.T[:, None, :], None, layout).cost_m_s.max(axis=(1, 2)),
        [(0.0, last), (-1.0, 6.0), (0.0, last), (-1.0, 10.0)],
        popsize=10,
        maxiter=GENERATIONS,
        init="sobol",
        updating="deferred",
        vectorized=True,
        polish=False,
        seed=0,
    )
    return float(found.fun)


def loop_margins(
    model: str, settings: list[str], conditions: Mapping[str, float], damper_250_m_s: float
) -> dict[str, float]:
    """Return the margins of the headlines on runs in closed loop."""
    supply = [f"plant.{k}={v!r}" for k, v in conditions.items() if k == "supply_pressure_pa"]
    mesh = [f"plant.{k}={v!r}" for k, v in conditions.items() if k == "mesh_force_n"]

    def impact(scenario: str, *more: str) -> tuple[float, float]:
        loaded = load_scenario(scenario, model=None if model == "nominal" else model,
                               settings=[*settings, *supply, *more])  # fmt: skip
        shift = run_in_memory(loaded).shifts[-1]
        if shift.arrived_s is None or shift.impact_worst_m_s is None:
            return NOT_ARRIVED, 1.0
        return shift.impact_worst_m_s, shift.arrived_s

    truck = [
        "plant.mounted=true",
        "plant.mesh_force_n=1300.0",
        "driveline.impulse_backward_n_s=250.0",
        *mesh,
    ]
    bench_m_s = impact("strategy_air_cushion", "duration_s=0.4")[0]
    bare_m_s = impact("lab_n_b", "duration_s=0.4")[0]
    held = ["duration_s=0.8", *truck]
    easy = ["duration_s=0.6", *(text for text in mesh)]
    charged_s, vented_s = (
        impact("charged_neutral", *easy, *chambers)[1] for chambers in ([], ["plant.charged=[]"])
    )
    return {
        "ahead_m_s": impact("lab_n_b", *held)[0]
        - impact("lab_n_b", *held, 'controller.strategy="synchro_brake"')[0],
        "cushion_m_s": bare_m_s - bench_m_s,
        "bench_m_s": bench_m_s - impact("oil_damper", "duration_s=0.4")[0],
        "truck_m_s": impact("strategy_air_cushion", *held)[0] - damper_250_m_s,
        "charged_s": charged_s - vented_s,
    }


def total_indices(margins: Floats, parameters: int, seed: int = 0) -> Floats:
    """Return total Sobol indices [parameters, 3] of a radial design: estimate, 2.5 and 97.5 % ends.

    margins [rows]: for each centre its value and those with one parameter after another changed.
    Jansen: S_T = E[(f(a) - f(a_i))^2] / (2 Var f). The interval is bootstrapped over the centres.
    """
    blocks = margins.reshape(-1, parameters + 1)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    rng = np.random.default_rng(seed)
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
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    for begin, end in edges.reshape(-1, 2):
        parts.append(f"{x[begin]:g}" if end == begin + 1 else f"{x[begin]:g} to {x[end - 1]:g}")
    return ", ".join(parts)


def own_rows(study: LoadedStudy, table: Table, index: int) -> NDArray[np.int64]:
    """Return the rows [n] of a `one_at_a_time` design in which only one swept value changes."""
    others = [table.numbers[s.path] for k, s in enumerate(study.study.sweep) if k != index]
    same = np.all([column == column[0] for column in others], axis=0)
    return np.flatnonzero(same)


def summary_table(study: LoadedStudy, table: Table) -> list[list[str]]:
    """Return the table of headlines and parameters, its head first.

    A cell is the range of margins and where the headline holds, or a total index with its interval.
    """
    sweeps = study.study.sweep
    lines = [["headline", *(s.label or s.path for s in sweeps)]]
    for name, text in HEADLINES.items():
        scale = 1e3 if name in SECONDS else 1.0
        margins = table.numbers[name]
        cells = []
        if study.study.design.kind == "radial":
            for index, low, high in total_indices(margins, len(sweeps)):
                cells.append(f"{index:.2f} ({low:.2f} to {high:.2f})")
        else:
            for k, sweep in enumerate(sweeps):
                rows = own_rows(study, table, k)
                own = scale * margins[rows]
                cells.append(
                    f"{np.nanmin(own):.3g} to {np.nanmax(own):.3g}; "
                    f"{holds(table.numbers[sweep.path][rows], own)}"
                )
        lines.append([f"{text}{', ms' if scale > 1.0 else ', m/s'}", *cells])
    return lines


def markdown(study: LoadedStudy, table: Table) -> str:
    """Return the table of headlines and parameters as Markdown, a row for each pair."""
    head, *lines = summary_table(study, table)
    what = "total index (95 % interval)"
    if study.study.design.kind != "radial":
        what = "margin from, to | holds at"
    text = [f"| headline | parameter | {what} |", "|---" * (what.count("|") + 3) + "|"]
    for line in lines:
        for name, cell in zip(head[1:], line[1:], strict=True):
            text.append(f"| {line[0]} | {name} | {cell.replace('; ', ' | ')} |")
    return "\n".join(text) + "\n"


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return for each headline its margin over each parameter, or the total index of each."""
    sweeps = study.study.sweep
    labels = [sweep.label or sweep.path for sweep in sweeps]
    radial = study.study.design.kind == "radial"
    stacks = []
    for name, text in HEADLINES.items():
        scale, unit = (1e3, "ms") if name in SECONDS else (1.0, "m/s")
        if radial:
            ends = [(low, high) for _, low, high in total_indices(table.numbers[name], len(sweeps))]
        else:
            own = [
                scale * table.numbers[name][own_rows(study, table, k)] for k in range(len(labels))
            ]
            ends = [(float(np.nanmin(each)), float(np.nanmax(each))) for each in own]
        spans = [
            Span(
                low,
                max(high, low + 1e-3),
                "series0" if low > 0.0 else "alarm",
                "",
                k - 0.3,
                k + 0.3,
            )
            for k, (low, high) in enumerate(ends)
        ]
        panel = Panel(
            text,
            spans=spans,
            rules=[Rule(0.0, "", "ink", "x", "solid")],
            ticks=numbered(labels),
            limits=(len(labels) - 0.5, -0.5),
            height=60 + 14 * len(labels),
        )
        axis = "total Sobol index, 95 % interval" if radial else f"margin of the headline, {unit}"
        stacks.append(Stack(axis, [panel], width=5.2))
    note = "" if radial else "blue: the headline holds over the whole range; red: it turns"
    return {"sensitivity": Figure(stacks, title_of(study), note)}
