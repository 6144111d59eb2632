"""What every front end reports: causes with intervals, and the object of diagnosis.json.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sil.files.quantity import quantity
from sil.inference.thresholds import UNNAMED


@dataclass(frozen=True)
class Interval:
    """Value with its 95 % interval; note: what limited it."""

    value: float
    low: float
    high: float
    unit: str
    note: str = ""

    @classmethod
    def normal(cls, value: float, deviation: float, unit: str) -> Interval:
        """Return the interval of a normally distributed estimate."""
        return cls(value, value - 1.96 * deviation, value + 1.96 * deviation, unit)

    def __str__(self) -> str:
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{self.value:.4g}{unit} [{self.low:.4g}, {self.high:.4g}]"

    def as_json(self) -> dict[str, Any]:
        """Return the object that diagnosis.json holds."""
        return {"value": self.value, "low": self.low, "high": self.high, "unit": self.unit}


@dataclass(frozen=True)
class Cause:
    """A cause as reported: probability, parameters with intervals, one sentence of evidence."""

    id: str
    cause_class: str
    probability: float
    parameters: dict[str, Interval]
    evidence: str
    variant: str = ""
    what: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the object in `causes` of diagnosis.json."""
        return {
            "id": self.id,
            "class": self.cause_class,
            "probability": round(self.probability, 4),
            "parameters": {name: item.as_json() for name, item in self.parameters.items()},
            "evidence": self.evidence,
        }


def headline(verdict: str, causes: Sequence[Cause], sizes: Sequence[str], reason: str) -> str:
    """Return the one sentence that a reader needs first.

    sizes: what would have been found, as text; reason: why nothing can be concluded.
    """
    if verdict == "cannot_tell":
        return f"These data cannot tell: {reason}."
    if not causes:
        seen = f" {', '.join(sizes)} would have been seen." if sizes else ""
        return f"Nothing found.{seen}"
    first = causes[0]
    if verdict == UNNAMED:
        return f"Something is wrong ({first.cause_class}); no cause of the catalogue fits."
    texts = []
    for cause in causes:
        name, item = next(iter(cause.parameters.items()))
        unit = "" if item.unit == "-" else item.unit
        value, low, high = (quantity(v, unit, 3) for v in (item.value, item.low, item.high))
        what = cause.what or cause.id.replace("_", " ")
        texts.append(f"{cause.cause_class}: {what}, {name} {value} ({low} to {high})")
    text = ("; or " if verdict == "ambiguous" else "; and ").join(texts)
    return f"{text[0].upper()}{text[1:]}."


FALSE_ALARM_LEVEL = 0.01


def diagnosis_json(
    campaign: str,
    verdict: str,
    causes: Sequence[Cause],
    findings: Sequence[object],
    false_alarm_basis: str,
    **others: Any,
) -> dict[str, Any]:
    """Return the object of diagnosis.json; `others` complete or replace what all rigs have."""
    return {
        "format": 1,
        "campaign": campaign,
        "verdict": verdict,
        "causes": [cause.as_json() for cause in causes],
        "rivals": [],
        "next_experiment": None,
        "false_alarm": {"level": FALSE_ALARM_LEVEL, "basis": false_alarm_basis},
        "extended_model": None,
        "findings": [str(item) for item in findings],
        **others,
    }
