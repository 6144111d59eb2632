"""report.html of a diagnosis: one self-contained page.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from .diagnosis import FALSE_ALARM_BASIS, FALSE_ALARM_LEVEL, Diagnosis
from .evidence import figure
from .judge import Judged
from .pictures import phases_picture, strokes_picture
from .residuals import Shown, show
from .structure import FAULTS
from .terms import is_term


def write_report(result: Diagnosis, path: Path, campaign: str, model: str) -> None:
    """Write the page of a diagnosis of the campaign at `campaign` under `model`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    import sil.report

    folder = Path(sil.report.__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    before, after = show(result.model, result.healthy), show(result.model, result.final)
    pictures = {
        "strokes": strokes_picture(result),
        "phases": phases_picture(before, after),
    }
    page = environment.get_template("diagnosis.html").render(
        campaign=result.campaign.name,
        verdict=result.verdict.kind,
        summary=summary(result),
        tiles=tiles(result),
        causes=[
            {
                "id": cause.id,
                "klass": cause.klass,
                "variant": cause.variant,
                "probability": cause.probability,
                "figures": figures(cause.parameters),
                "evidence": cause.evidence,
            }
            for cause in result.causes
        ],
        rivals=result.verdict.rivals,
        experiment=None
        if result.next_experiment is None
        else result.next_experiment.as_json(),
        pictures={name: base64.b64encode(image).decode() for name, image in pictures.items()},
        held_text="held out" if result.held_out else "measured",
        judged=[row_of(item, result) for item in result.judged[:12]],
        gain=gain_rows(result, before, after),
        standard={
            "before": f"{result.gain.before:.3g}",
            "after": f"{result.gain.after:.3g}",
        },
        heldout=result.gain.files,
        dependence=dependence_rows(before, after),
        structure=result.structure.sentence(),
        isolability=isolability(result),
        findings=[str(item) for item in result.findings],
        command=f"opc4 diagnose {campaign} --model {model}",
        false_alarm=f"False alarms, level aimed at: {FALSE_ALARM_LEVEL:.0%}; {FALSE_ALARM_BASIS}",
        time_text=", ".join(f"{name} {value:.1f} s" for name, value in result.seconds.items()),
        extended=result.extended,
    )
    path.write_text(page, encoding="utf-8")


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
    """The verdict in words."""
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
        "unnamed": (
            "Something acts that none of the named causes describes; its equation and shape are "
            "in the extended model."
        ),
    }[kind]
    return (
        f"{text} On strokes that the fit has not seen, the residuals fall from {gain.before:.3g} "
        f"to {gain.after:.3g} times their expected scatter."
    )


def tiles(result: Diagnosis) -> list[dict[str, str]]:
    """Figures at the top."""
    rows = [
        ("strokes", str(len(result.model.strokes))),
        ("of them held out", str(len(result.held_out))),
        ("residual over expected, before", f"{result.gain.before:.3g}"),
    ]
    if result.causes:
        rows.append(("after", f"{result.gain.after:.3g}"))
        rows.append((f"probability of {result.causes[0].id}", f"{result.causes[0].probability:.2f}"))
    return [{"name": name, "value": value} for name, value in rows]


def row_of(item: Judged, result: Diagnosis) -> dict[str, Any]:
    """One explanation of the comparison."""
    best = result.judged[0].score
    told = []
    for candidate, own in zip(item.training.candidates, item.training.values, strict=True):
        if is_term(candidate):
            told.append(f"{len(own)} nodes")
        else:
            told += [f"{name} {value:.4g}" for name, value in own.items()]
    return {
        "name": "nothing (healthy)" if item.name == "healthy" else item.name,
        "behind": f"{item.score - best:,.0f}",
        "probability": f"{item.probability:.3f}",
        "left": f"{item.misfit.rms:.3g}",
        "hot": item.misfit.rms > 1.1,
        "parameters": ", ".join(told),
    }


def unit_text(name: str, value: float) -> str:
    """An rms in the unit an engineer reads."""
    if name.endswith("_pa"):
        return f"{value / 1e5:.4f} bar"
    return f"{value * 1e3:.4f} mm"


def gain_rows(result: Diagnosis, before: Shown, after: Shown) -> list[dict[str, str]]:
    """Before and after by channel."""
    rows = []
    for name, (first, second) in result.gain.channels.items():
        told = []
        for shown in (before, after):
            item = shown.relative.get(name)
            told.append("" if item is None else f"{item.mean:.2%} / {item.largest:.1%}")
        rows.append(
            {
                "name": name,
                "before": unit_text(name, first),
                "after": unit_text(name, second),
                "relative_before": told[0],
                "relative_after": told[1],
            }
        )
    return rows


def dependence_rows(before: Shown, after: Shown) -> list[dict[str, str]]:
    """Rms by condition, drift, whiteness and correlation, before and after."""

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
    """The isolability matrix: which fault can be told from which, from structure alone."""
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
