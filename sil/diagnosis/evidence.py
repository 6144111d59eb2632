"""Causes as they are reported, each with one sentence of evidence.

Checked by: tests/unit/sil/diagnosis/test_verdict.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sil.diagnosis.gain import Gain
from sil.diagnosis.intervals import Interval
from sil.diagnosis.judge import Judged
from sil.diagnosis.terms import form_of
from sil.diagnosis.verdict import Verdict
from sil.fitting.hypotheses import Candidate


@dataclass(frozen=True)
class Cause:
    """A cause as reported: probability, parameters with intervals, one sentence of evidence."""

    id: str
    cause_class: str
    probability: float
    parameters: dict[str, Interval]
    evidence: str
    variant: str = ""


def figure(item: Interval) -> str:
    """Return a parameter with its interval."""
    unit = "" if item.unit == "-" else f" {item.unit}"
    return f"{item.value:.4g}{unit} [{item.low:.4g}, {item.high:.4g}]"


def sentence(
    candidate: Candidate,
    verdict: Verdict,
    judged: Sequence[Judged],
    gain: Gain,
    parameters: Mapping[str, Interval],
) -> str:
    """Return what speaks for the cause, and against the next best."""
    gained = verdict.gains[candidate.id]
    if candidate.is_term:
        form = form_of(candidate)
        sizes = [abs(item.value) for item in parameters.values()]
        what = (
            f"{form.what} depending on {form.on}, up to {max(sizes):.3g} {form.unit}, which no "
            f"named cause describes"
        )
    else:
        main = candidate.parameters[0]
        where = f" ({candidate.variant})" if candidate.variant else ""
        what = f"{candidate.effect.what}{where}: {main.name} {figure(parameters[main.name])}"
    text = (
        f"{what}; it gains {gained:.0f} in log evidence, and on held-out strokes the standardised "
        f"residual falls from {gain.before:.3g} to {gain.after:.3g}"
    )
    other = next_best(candidate, verdict, judged)
    if other is not None:
        text += f"; the next best explanation, {other[0]}, is {other[1]:.0f} behind"
    return text


def next_best(
    candidate: Candidate, verdict: Verdict, judged: Sequence[Judged]
) -> tuple[str, float] | None:
    """Return the best hypothesis without this cause, and how far it is behind."""
    others = [item for item in judged if candidate.id not in item.ids and item.ids]
    if not others:
        return None
    best = min(others, key=lambda item: item.score)
    return best.name, best.score - verdict.leader.score
