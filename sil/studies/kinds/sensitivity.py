"""Rows that weigh assumptions: by how much each headline holds under other inferred numbers.

A row sets parameters of the model, `factor.GROUP` (a common factor on parameters that belong
together), `stroke.supply_pressure_pa` and `stroke.mesh_force_n`. Each figure is a margin: the headline
holds where it is positive. Designs: `one_at_a_time` gives the range in which each headline holds;
`radial` gives Sobol's total indices by Jansen's estimator, with bootstrapped intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

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
from sil.studies.study import LoadedStudy, Row, texts_of
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
    for path, value in row.settings.items():
        if isinstance(value, (bool, str, list)):
            raise InputError(f"{path}: {value!r}; expected a number")
    known = {"factor": FACTORS, "stroke": ("supply_pressure_pa", "mesh_force_n")}
    own, model = (
        {name: float(value) for name, value in each.items()}  # type: ignore[arg-type]
        for each in row.split(known)
    )
    parameters = load(study.study.model)
    for group in [group for group in FACTORS if group in own]:
        factor = own.pop(group)
        model |= {path: factor * parameters.value(path) for path in FACTORS[group]}
    try:
        found = _gearbox_margins(parameters.override(model), GEARBOX.under(**own))
        damper_250_m_s = found.pop("damper_250_m_s")
        found |= _loop_margins(study.study.model, texts_of(model), own, damper_250_m_s)
    except IntegrationError as error:
        raise RunError(str(error)) from None
    missing = [name for name in HEADLINES if not math.isfinite(found[name])]
    if missing:
        return RowResult(found | {"failed": 1.0}, NOT_RUN, f"no value of {', '.join(missing)}")
    return RowResult(found | {"failed": 0.0}, PASSED)


def _gearbox_margins(parameters: ParameterSet, family: Family) -> dict[str, float]:
    """Return the margins of the headlines on policies of the plant alone, and the damper at 250 N s."""
    late, damped = (
        FamilyModel(parameters, each, THESIS_S, EXTRA_S)
        for each in (family, family.under(load="damper"))
    )
    plain, damper_m_s = late.plain, damped.plain.impact_worst_m_s[0, 0]
    return {
        "damper_m_s": float(plain.impact_worst_m_s.max() - damper_m_s.max()),
        "late_s": THESIS_S - float((plain.arrival_s - plain.revealed_s).max()),
        "blind_m_s": _softest_blind_m_s(late) - float(damper_m_s.max()),
        "damper_250_m_s": float(damper_m_s[-1]),
    }


def _softest_blind_m_s(model: FamilyModel) -> float:
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


def _loop_margins(
    model: str, settings: list[str], conditions: Mapping[str, float], damper_250_m_s: float
) -> dict[str, float]:
    """Return the margins of the headlines on runs in closed loop."""
    supply, mesh = (
        [f"plant.{name}={conditions[name]!r}"] if name in conditions else []
        for name in ("supply_pressure_pa", "mesh_force_n")
    )

    def impact(scenario: str, *more: str) -> tuple[float, float]:
        loaded = load_scenario(
            scenario,
            model=None if model == "nominal" else model,
            settings=[*settings, *supply, *more],
        )
        shift = run_in_memory(loaded).shifts[-1]
        if shift.arrived_s is None or shift.impact_worst_m_s is None:
            return NOT_ARRIVED, 1.0
        return shift.impact_worst_m_s, shift.arrived_s

    truck = (
        "plant.mounted=true",
        "plant.mesh_force_n=1300.0",
        "driveline.impulse_backward_n_s=250.0",
    )
    held = ("duration_s=0.8", *truck, *mesh)
    bench_m_s = impact("strategy_air_cushion", "duration_s=0.4")[0]
    charged_s, vented_s = (
        impact("charged_neutral", "duration_s=0.6", *mesh, *chambers)[1]
        for chambers in ([], ["plant.charged=[]"])
    )
    return {
        "ahead_m_s": impact("lab_n_b", *held)[0]
        - impact("lab_n_b", *held, 'controller.strategy="synchro_brake"')[0],
        "cushion_m_s": impact("lab_n_b", "duration_s=0.4")[0] - bench_m_s,
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
    for k, values in enumerate(swept):
        alone = (np.delete(swept, k, axis=0) == np.delete(swept[:, :1], k, axis=0)).all(axis=0)
        own = _unit(name)[1] * margins[alone]
        low, high = np.nanmin(own), np.nanmax(own)
        yield low, high, f"{low:.3g} to {high:.3g} | {holds(values[alone], own)}"


def files(study: LoadedStudy, table: Table) -> Iterator[tuple[str, str]]:
    """Yield the table of headlines and parameters as Markdown, a row for each pair."""
    radial = study.study.design.kind == "radial"
    what = "total index (95 % interval)" if radial else "margin from, to | holds at"
    lines = [f"| headline | parameter | {what} |", "|---" * (what.count("|") + 3) + "|"]
    for name, text in HEADLINES.items():
        cells = (cell for _low, _high, cell in _weighed(study, table, name))
        for sweep, cell in zip(study.study.sweep, cells, strict=True):
            lines.append(f"| {text}, {_unit(name)[0]} | {sweep.label or sweep.path} | {cell} |")
    yield "sensitivity.md", "\n".join(lines) + "\n"


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return for each headline its margin over each parameter, or the total index of each."""
    labels = [sweep.label or sweep.path for sweep in study.study.sweep]
    radial = study.study.design.kind == "radial"
    stacks = []
    for name, text in HEADLINES.items():
        spans = [
            Span(low, max(high, low + 1e-3), role, "", k - 0.3, k + 0.3)
            for k, (low, high, _cell) in enumerate(_weighed(study, table, name))
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
