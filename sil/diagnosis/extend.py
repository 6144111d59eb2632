"""The extended model: the questioned model plus the effects found, with intervals and provenance.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

import json

from plant.parameters import Parameter, ParameterSet
from sil.campaign.campaign import Campaign
from sil.diagnosis.evidence import Cause
from sil.diagnosis.intervals import Interval
from sil.diagnosis.terms import form_of
from sil.fitting.fit import FitResult
from sil.fitting.hypotheses import Candidate


def extended_model(
    parameters: ParameterSet, final: FitResult, causes: list[Cause], campaign: Campaign
) -> str:
    """Text of extended_model.toml: [base] and one [effect.<id>] a claimed cause."""
    source = f"diagnosed from campaign {campaign.name}, {len(campaign.strokes)} strokes"
    lines = [
        f"# the model {parameters.name} extended by what campaign {campaign.name} shows",
        "[base]",
        f"model = {json.dumps(parameters.name)}",
    ]
    for identifier, table in parameters.effects.items():
        if identifier not in {item.id for item in final.candidates}:
            lines += ["", f"[effect.{identifier}]"]
            lines += [entry(name, item) for name, item in table.items()]
    reported = {(cause.id, cause.variant): cause for cause in causes}
    for candidate in final.candidates:
        cause = reported[(candidate.id, candidate.variant)]
        lines += ["", f"[effect.{candidate.id}]"]
        if candidate.is_term:
            lines += term_lines(candidate, cause.parameters, source)
            continue
        for name, item in cause.parameters.items():
            lines.append(
                f"{name} = {{ value = {item.value!r}, low = {item.low!r}, high = {item.high!r}, "
                f"unit = {json.dumps(item.unit)}, "
                f"source = {json.dumps(source + ', 95 % interval')} }}"
            )
        for name, value in candidate.fixed.items():
            unit = next(p.unit for p in candidate.effect.parameters if p.name == name)
            lines.append(
                f"{name} = {{ value = {float(value)!r}, unit = {json.dumps(unit)}, "
                f"source = {json.dumps('variant ' + candidate.variant)} }}"
            )
    return "\n".join(lines) + "\n"


def entry(name: str, item: Parameter) -> str:
    """One parameter as a line."""
    value = list(item.value) if isinstance(item.value, tuple) else item.value
    bounds = "".join(
        f", {key} = {bound!r}"
        for key, bound in (("low", item.low), ("high", item.high))
        if bound is not None
    )
    return (
        f"{name} = {{ value = {value!r}{bounds}, unit = {json.dumps(item.unit)}, "
        f"source = {json.dumps(item.source)} }}"
    )


def term_lines(candidate: Candidate, parameters: dict[str, Interval], source: str) -> list[str]:
    """Return a non-parametric term as an extended model holds it."""
    form = form_of(candidate)
    origin = json.dumps(
        f"{source}: {form.what} of {form.on} [{form.unit}], class {form.cause_class}"
    )
    rows = {
        "equation": float(form.slot),
        "variable": float(form.over),
        "low": form.low,
        "step": form.step,
        "nodes": [item.value for item in parameters.values()],
    }
    return [
        f'{name} = {{ value = {value!r}, unit = "-", source = {origin} }}'
        for name, value in rows.items()
    ]
