"""Friction, process exponents (T3.2) and oil damper (thesis 3.2) by the whole records of a fixed piston's strokes.

The same whole-campaign fit as the diagnosis': tolerances of the unit, gauge offsets and each
stroke's own scatter are fitted with the parameters, under their priors.
Checked by: tests/unit/sil/inference/identify/test_identify.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from can_dbc.errors import InputError
from plant.effects import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.campaign.campaign import Campaign, CampaignStroke, Record, stroke_columns
from sil.files.quantity import counted
from sil.inference.campaign.model import TangentModel
from sil.inference.campaign.observations import observe
from sil.inference.candidate import Candidate
from sil.inference.evidence import misfit
from sil.inference.fit import Fitter, Show, no_progress
from sil.inference.identify.estimate import Identified, ParameterEstimate
from sil.inference.spread import Spread
from sil.report.figure import BAR, MM, Figure, Panel, Series, Stack


@dataclass(frozen=True)
class Method:
    """What is fitted (parameter path -> its index in the packed array), and to which strokes.

    columns: those that a record needs; expressed: tolerances that the parameters themselves express.
    """

    indices: Mapping[str, int]
    columns: tuple[str, ...] = ("position_m", "pressure_1_pa", "pressure_2_pa")
    is_damper: bool = False
    expressed: tuple[str, ...] = ()


METHODS = {
    "friction": Method(
        {
            "friction_fixed.F_sf": Parameters.f_static_s,
            "friction_fixed.F_rf": Parameters.f_run_s,
            "friction_fixed.beta": Parameters.beta_s,
        },
        expressed=("friction",),
    ),
    "alpha": Method(
        {
            f"alpha.{name}": getattr(Parameters, name)
            for name in ("alpha_m1", "alpha_1", "alpha_m2", "alpha_2")
        },
    ),
    "damper": Method(
        {
            "damper.A_S": Parameters.a_small,
            "damper.A_B0": Parameters.a_large,
            "damper.kappa_effective": Parameters.kappa,
        },
        ("position_m", "pressure_oil2_pa"),
        is_damper=True,
    ),
}


def identify_records(
    what: str, campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Fit one of METHODS to a campaign's strokes, tolerances under their priors; raises InputError for too few strokes."""
    method = METHODS[what]
    strokes = usable_strokes(campaign, method)
    estimates, over_noise = _fitted(strokes, parameters, method, progress)
    identified = parameters.override({item.path: item.numbers[0] for item in estimates})
    return Identified(what, estimates, (), _figure(*strokes[0], identified, method), over_noise)


def usable_strokes(campaign: Campaign, method: Method) -> list[tuple[CampaignStroke, Record]]:
    """Return the fixed piston's strokes, unloaded or with the compressible damper; raises InputError for too few."""
    load = "damper" if method.is_damper else "none"
    strokes = []
    for entry in campaign.strokes:
        c = entry.conditions
        unsuited = c.damper_model != "compressible" if method.is_damper else c.charged_before
        if c.kind != "fixed" or c.load != load or unsuited:
            continue
        record = campaign.record(entry)
        if all(name in record for name in method.columns) and (
            method.is_damper or np.ptp(record["position_m"]) > 0.003
        ):
            strokes.append((entry, record))
    least, what = (1, "with compressible damper") if method.is_damper else (2, "without load")
    if len(strokes) < least:
        columns = ", ".join(method.columns)
        raise InputError(
            f"{campaign.folder}: {counted(len(strokes), 'stroke')} of the fixed piston {what} that "
            f"moves, with {columns}; expected at least {least}"
        )
    return strokes


def _fitted(
    strokes: list[tuple[CampaignStroke, Record]],
    parameters: ParameterSet,
    method: Method,
    progress: Show,
) -> tuple[tuple[ParameterEstimate, ...], float]:
    """Return the fitted parameters, and the residual over its expected noise."""
    from scipy.stats import t as student

    observed = [
        replace(observe(entry, record, parameters), internal=None) for entry, record in strokes
    ]
    model = TangentModel(observed, Spread.of(parameters))
    source = f"whole-record fit of {counted(len(strokes), 'stroke')} with their scatter"

    def change(setup: Setup, values: dict[str, float]) -> None:
        for path, index in method.indices.items():
            setup.p[index] *= values[path]

    factors = tuple(EffectParameter(path, "-", 1.0, 0.05, 20.0, 0.1) for path in method.indices)
    effect = Effect("identified", "identified", "force", source, factors, change)
    candidate = Candidate(effect, "", factors, ())
    layout = model.layout((candidate,))
    frozen = [layout.names.index(name) for name in method.expressed]
    start = np.zeros(len(layout.names))
    fit = Fitter(model, progress).fit((candidate,), start=start, freeze=frozen, iterations=20)
    free = [k for k in range(len(layout.names)) if k not in frozen]
    covariance = np.linalg.pinv(fit.normal[np.ix_(free, free)])
    reduced = max(1.0, fit.chi2 / fit.size)
    # the prior of the scatter counts about as much as two strokes
    quantile = float(student.ppf(0.975, len(strokes) + 1))
    estimates = []
    for k, path in enumerate(method.indices):
        row = free.index(layout.effect_slice.start + k)
        base = parameters.value(path)
        centre = base * fit.values[0][path]
        half = quantile * float(np.sqrt(covariance[row, row] * reduced)) * 0.1 * base
        estimates.append(ParameterEstimate(path, centre, centre - half, centre + half, source))
    return tuple(estimates), misfit(model, fit).rms


def _figure(
    entry: CampaignStroke, record: Record, identified: ParameterSet, method: Method
) -> Figure:
    """Return a stroke as it was measured, and as the identified parameters simulate it."""
    time_s = record.time_s - record.time_s[0]
    simulated = stroke_columns(simulate(identified, entry.conditions, time_s, internal=False))
    panels = []
    for name in method.columns:
        scale, unit = (MM, "mm") if name == "position_m" else (BAR, "bar")
        lines = [
            Series("measured", time_s[::10], scale * record[name][::10], "measured", "dots"),
            Series("fitted", time_s[::10], scale * simulated[name][::10], "after"),
        ]
        panels.append(Panel(name.rpartition("_")[0].replace("_", " "), unit, lines, height=200))
    return Figure([Stack("time, s", panels, entry.label)])
