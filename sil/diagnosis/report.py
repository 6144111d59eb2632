"""report.html of a diagnosis: one self-contained page.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from plant.effects import look_alikes
from sil.diagnosis.consequence import Change, consequence
from sil.diagnosis.diagnosis import FALSE_ALARM_BASIS, FALSE_ALARM_LEVEL, Diagnosis
from sil.diagnosis.evidence import Cause, figure
from sil.diagnosis.figures import (
    equations_figure,
    phases_figure,
    strokes_figure,
    term_figure,
    worst,
)
from sil.diagnosis.judge import Judged
from sil.diagnosis.one_equation import Alone, alone
from sil.diagnosis.residuals import Shown, show
from sil.diagnosis.structure import FAULTS
from sil.diagnosis.terms import form_of
from sil.diagnosis.verdict import UNNAMED
from sil.files.atomic import write_atomically
from sil.fitting.hypotheses import Candidate
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render

STROKES_CAPTION = (
    "The strokes that the questioned model fits worst among those {where}. Grey: measured. Orange: "
    "the healthy model, its tolerances and scatter fitted. Blue: the extended model. Below each: "
    "residuals over their expected scatter; the band is three standard deviations."
)
PHASES_CAPTION = (
    "Rms of residuals over their expected scatter (1 = explained), by channel and phase of the "
    "stroke: the healthy model, and the extended one."
)
ALONE_CAPTION = (
    "One equation at a time: measured pressures into the stay's force balance, measured position "
    "into each chamber's mass balance. What goes wrong in one of them alone is in that equation. "
    "Orange: the questioned model without tolerances. The fixed rig's chambers begin vented here."
)
TERM_CAPTION = (
    "What none of the named causes describes, as a function without a form: its value at the nodes "
    "and their 95 % interval."
)


def write_report(result: Diagnosis, folder: Path, campaign: str, model: str) -> dict[str, Any]:
    """Write report.html and its figures for a diagnosis of the campaign at `campaign`.

    An extended model that was claimed is in the folder already. Returns the page's numbers beyond
    those of `Diagnosis.as_json`.
    """
    before, after = show(result.model, result.healthy), show(result.model, result.final)
    where = "held out" if result.held_out else "measured"
    strokes = strokes_figure(result)
    pictures = {
        "strokes": Picture(
            save(strokes, folder, "strokes"),
            "Measured and simulated strokes",
            STROKES_CAPTION.format(where=where),
        ),
        "phases": Picture(
            save(phases_figure(before, after), folder, "phases"),
            "Standardised residuals by channel and phase",
            PHASES_CAPTION,
        ),
    }
    found = equations(result)
    if found is not None:
        pictures["alone"] = Picture(
            save(equations_figure(result, found), folder, "equations"),
            "Residuals one equation at a time",
            ALONE_CAPTION,
        )
    for cause, candidate in zip(result.causes, causes_candidates(result), strict=True):
        if candidate is not None:
            pictures["term"] = Picture(
                save(
                    term_figure(form_of(candidate), list(cause.parameters.values())),
                    folder,
                    "term",
                ),
                "What is missing",
                TERM_CAPTION,
            )
    loop = None
    if result.extended is not None:
        loop = consequence(model, folder / "extended_model.toml")
    kind = result.verdict.kind
    head = Head(
        command="diagnose",
        name=result.campaign.name,
        verdict=kind,
        good=kind == "consistent",
        tiles=tiles(result),
        again=f"opc4 diagnose {campaign} --model {model}",
    )
    page = render(
        "diagnosis.html",
        head,
        plots(strokes),
        summary=summary(result),
        causes=[
            {
                "id": cause.id,
                "cause_class": cause.cause_class,
                "variant": cause.variant,
                "probability": cause.probability,
                "figures": figures(cause.parameters),
                "evidence": cause.evidence,
                "look_alikes": look_alikes_of(cause, result),
            }
            for cause in result.causes
        ],
        rivals=result.verdict.rivals,
        experiment=None if result.next_experiment is None else result.next_experiment.as_json(),
        pictures=pictures,
        alone=[] if found is None else alone_rows(found),
        judged=[row_of(item, result) for item in result.judged[:12]],
        gain=gain_rows(result, before, after),
        standard={
            "before": f"{result.gain.before:.3g}",
            "after": f"{result.gain.after:.3g}",
        },
        heldout=result.gain.files,
        loop=loop,
        loop_rows=[] if loop is None else [loop_row(item) for item in loop.changes],
        dependence=dependence_rows(before, after),
        structure=result.structure.sentence(),
        isolability=isolability(result),
        findings=[str(item) for item in result.findings],
        false_alarm=f"False alarms, level aimed at: {FALSE_ALARM_LEVEL:.0%}; {FALSE_ALARM_BASIS}",
        time_text=", ".join(f"{name} {value:.1f} s" for name, value in result.seconds.items()),
        extended=result.extended,
    )
    write_atomically(folder / "report.html", page)
    return {
        "explanations": [explanation(item, result) for item in result.judged],
        "residuals": {"before": plain_residuals(before), "after": plain_residuals(after)},
        "loop": None if loop is None else loop.as_json(),
    }


def explanation(item: Judged, result: Diagnosis) -> dict[str, Any]:
    """One explanation in plain numbers: behind is in log evidence, left_over an rms."""
    pairs = zip(item.training.candidates, item.training.values, strict=True)
    return {
        "name": item.name,
        "behind": item.score - result.judged[0].score,
        "probability": item.probability,
        "left_over": item.misfit.rms,
        "parameters": {candidate.name: dict(own) for candidate, own in pairs},
    }


def plain_residuals(shown: Shown) -> dict[str, Any]:
    """Residuals in plain numbers: standardised rms, and what they depend on."""
    plain = asdict(shown)
    plain["cross"] = [{"channels": list(pair), "value": v} for pair, v in shown.cross.items()]
    return plain


def equations(result: Diagnosis) -> tuple[int, Alone, Alone] | None:
    """Return the stroke fitted worst, one equation at a time, before and after; None without channels.

    Before is the questioned model itself, without tolerances: fitted, those would spread what
    is wrong over all equations.
    """
    final = result.final
    first, last = len(result.model.unit), result.healthy.layout.healthy
    shared = np.zeros_like(result.healthy.shared)
    shared[first:last] = final.shared[first:last]
    plain = replace(result.healthy, shared=shared, stroke=np.zeros_like(result.healthy.stroke))
    for k in worst(result):
        before, after = alone(result.model, plain, k), alone(result.model, final, k)
        if before.rms() and before.rms().keys() == after.rms().keys():
            return k, before, after
    return None


def alone_rows(found: tuple[int, Alone, Alone]) -> list[dict[str, str]]:
    """Return rms by equation, before and after."""
    _k, before, after = found
    return [
        {
            "name": name,
            "before": unit_text("_pa" if name.startswith("mass") else "_m", value),
            "after": unit_text("_pa" if name.startswith("mass") else "_m", after.rms()[name]),
        }
        for name, value in before.rms().items()
    ]


def look_alikes_of(cause: Cause, result: Diagnosis) -> str:
    """Return the cause's look-alikes that were fitted to the end, and how far each is behind."""
    found = []
    for other in look_alikes(cause.id):
        scores = [i.score for i in result.judged if other in i.ids and cause.id not in i.ids]
        if scores:
            found.append(f"{other} {min(scores) - result.verdict.leader.score:,.0f}")
    return ", ".join(found)


def causes_candidates(result: Diagnosis) -> list[Candidate | None]:
    """Return the non-parametric term behind each reported cause, None where it is a named one."""
    terms = {c.name: c for c in result.final.candidates if c.is_term}
    return [terms.get(f"{cause.id}:{cause.variant}") for cause in result.causes]


def figures(parameters: dict[str, Any]) -> list[str]:
    """Parameters as lines; a term's nodes as one."""
    if "node_00" in parameters:
        values = ", ".join(f"{item.value:.3g}" for item in parameters.values())
        return [f"nodes: {values}"]
    return [
        f"{name} {figure(item)}" + (f" ({item.note})" if item.note else "")
        for name, item in parameters.items()
    ]


def summary(result: Diagnosis) -> str:
    """Return the verdict in words."""
    gain = result.gain
    kind = result.verdict.kind
    if kind == "consistent":
        return (
            "Noise, unit tolerances and the known scatter between strokes explain these "
            f"measurements: residuals are {gain.before:.3g} times their expected scatter."
        )
    names = " and ".join(cause.id for cause in result.causes if cause.id in result.verdict.claimed)
    text = {
        "named": f"The measurements are explained by {names}.",
        "ambiguous": f"{names} explains the measurements, but look-alikes do nearly as well.",
        UNNAMED: (
            "Something acts that none of the named causes describes; its equation and shape are "
            "in the extended model."
        ),
    }[kind]
    return (
        f"{text} On strokes that the fit did not use, the residuals fall from {gain.before:.3g} "
        f"to {gain.after:.3g} times their expected scatter."
    )


def tiles(result: Diagnosis) -> list[tuple[str, str]]:
    """Figures at the top."""
    rows = [
        ("strokes", str(len(result.model.strokes))),
        ("of them held out", str(len(result.held_out))),
        ("residual over expected, before", f"{result.gain.before:.3g}"),
    ]
    if result.causes:
        rows.append(("after", f"{result.gain.after:.3g}"))
        rows.append(
            (f"probability of {result.causes[0].id}", f"{result.causes[0].probability:.2f}")
        )
    return [(value, name) for name, value in rows]


def row_of(item: Judged, result: Diagnosis) -> dict[str, Any]:
    """One explanation of the comparison."""
    best = result.judged[0].score
    texts = []
    for candidate, own in zip(item.training.candidates, item.training.values, strict=True):
        if candidate.is_term:
            texts.append(f"{len(own)} nodes")
        else:
            texts += [f"{name} {value:.4g}" for name, value in own.items()]
    return {
        "name": "nothing (healthy)" if item.name == "healthy" else item.name,
        "behind": f"{item.score - best:,.0f}",
        "probability": f"{item.probability:.3f}",
        "left": f"{item.misfit.rms:.3g}",
        "hot": item.misfit.rms > 1.1,
        "parameters": ", ".join(texts),
    }


def unit_text(name: str, value: float) -> str:
    """Return an rms in the unit an engineer reads."""
    if name.endswith("_pa"):
        return f"{value / 1e5:.4f} bar"
    return f"{value * 1e3:.4f} mm"


def gain_rows(result: Diagnosis, before: Shown, after: Shown) -> list[dict[str, str]]:
    """Before and after by channel."""
    rows = []
    for name, (first, second) in result.gain.channels.items():
        errors = []
        for shown in (before, after):
            item = shown.relative.get(name)
            errors.append("" if item is None else f"{item.mean:.2%} / {item.largest:.1%}")
        rows.append(
            {
                "name": name,
                "before": unit_text(name, first),
                "after": unit_text(name, second),
                "relative_before": errors[0],
                "relative_after": errors[1],
            }
        )
    return rows


def loop_row(item: Change) -> dict[str, str]:
    """Return a shift's figures as an engineer reads them."""

    def quantity(value: float | None, scale: float, unit: str) -> str:
        return "not reached" if value is None else f"{scale * value:.3g} {unit}"

    return {
        "scenario": item.scenario,
        "shift": item.shift,
        **{f"time_{k}": quantity(v, 1e3, "ms") for k, v in enumerate(item.shift_time_s)},
        **{f"impact_{k}": quantity(v, 1.0, "m/s") for k, v in enumerate(item.impact_speed_m_s)},
    }


def dependence_rows(before: Shown, after: Shown) -> list[dict[str, str]]:
    """Return rms by condition, drift, whiteness and correlation, before and after."""

    def table(values: dict[str, float]) -> str:
        return ", ".join(f"{name} {value:.2f}" for name, value in values.items())

    rows = [
        {"name": name, "before": table(before.dependence[name]), "after": table(table_after)}
        for name, table_after in after.dependence.items()
    ]
    rows.append(
        {
            "name": "drift over the campaign, a stroke",
            "before": f"{before.drift:+.4f}",
            "after": f"{after.drift:+.4f}",
        }
    )
    rows.append(
        {
            "name": "correlation of neighbouring samples (0 = white)",
            "before": table(before.whiteness),
            "after": table(after.whiteness),
        }
    )

    def largest(shown: Shown) -> str:
        if not shown.cross:
            return ""
        pair = max(shown.cross, key=lambda item: abs(shown.cross[item]))
        return f"{pair[0]} with {pair[1]} {shown.cross[pair]:+.2f}"

    rows.append(
        {
            "name": "largest correlation between channels",
            "before": largest(before),
            "after": largest(after),
        }
    )
    return rows


def isolability(result: Diagnosis) -> dict[str, Any] | None:
    """Return the isolability matrix: which fault can be distinguished from which, from structure alone."""
    structure = result.structure
    if not structure.detectable:
        return None
    names = [FAULTS[fault] for fault in structure.faults]
    rows = []
    for fault in structure.faults:
        cells = [
            "-" if fault == other else ("yes" if (fault, other) in structure.isolable else "no")
            for other in structure.faults
        ]
        rows.append({"name": FAULTS[fault], "cells": cells})
    return {"names": names, "rows": rows}
