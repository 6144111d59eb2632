"""What every front end reports: causes with intervals, and the object of diagnosis.json.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from plant.parameters import Parameter
from sil.files.quantity import quantity, unit_of


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

    def contains(self, value: float) -> bool:
        """Return whether a value is within the interval."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{self.value:.4g}{unit} [{self.low:.4g}, {self.high:.4g}]"

    def as_json(self) -> dict[str, Any]:
        """Return the object that diagnosis.json holds."""
        return {"value": self.value, "low": self.low, "high": self.high, "unit": self.unit}


@dataclass(frozen=True)
class ReportedCause:
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


@dataclass(frozen=True)
class Gain:
    """What a diagnosis explains: rms of residuals on strokes that the fit did not use.

    channels: by column (before, after, of which noise), in its unit; before, after: over their
    expected scatter.
    """

    files: tuple[str, ...]
    channels: Mapping[str, tuple[float, float, float]]
    before: float
    after: float

    def __str__(self) -> str:
        """Return the position, or the channel that changes most, before and after, as an engineer reads it."""
        if not self.channels:
            return "no channel is compared"
        over_noise = {name: row[0] / (row[2] or 1.0) for name, row in self.channels.items()}
        name = max(over_noise, key=lambda n: over_noise[n])
        if over_noise.get("position_m", 0.0) > 2.0:  # what a reader knows best
            name = "position_m"
        unit = "N m" if name.endswith("_n_m") else unit_of(name)
        first, second, floor = self.channels[name]
        before, after, noise = (quantity(v, unit, 2) for v in (first, max(second, floor), floor))
        words = name.removesuffix("_n_m").removesuffix("_pa").removesuffix("_m").removesuffix("_n")
        change = before if before == after else f"from {before} to {after}"
        return f"rms of {words.replace('_', ' ')} {change}, of which noise is {noise}"

    def as_json(self) -> dict[str, Any]:
        """Return the object `gain` of diagnosis.json."""
        return {
            "heldout_strokes": list(self.files),
            "channels": {
                name: {"before": before, "after": after, "noise": noise, "unit": "rms"}
                for name, (before, after, noise) in self.channels.items()
            },
            "standardised": {"before": self.before, "after": self.after},
        }


FALSE_ALARM_LEVEL = 0.01


def diagnosis_json(
    campaign: str,
    verdict: str,
    causes: Sequence[ReportedCause],
    findings: Sequence[object],
    false_alarm_basis: str,
    **others: Any,
) -> dict[str, Any]:
    """Return the object of diagnosis.json; `others` complete or replace what all front ends have."""
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


def model_file(comment: str, base: str, sections: Mapping[str, Mapping[str, Parameter]]) -> str:
    """Return the text of a model file: a comment, the set it extends, sections of parameters."""
    lines = [f"# {comment}", "[base]", f"model = {json.dumps(base)}"]
    for section, table in sections.items():
        lines += ["", f"[{section}]", *(_line(name, item) for name, item in table.items())]
    return "\n".join(lines) + "\n"


def _line(name: str, item: Parameter) -> str:
    value = list(map(float, item.value)) if isinstance(item.value, tuple) else float(item.value)
    fields = {"value": value, "low": item.low, "high": item.high}
    numbers = ", ".join(f"{key} = {v!r}" for key, v in fields.items() if v is not None)
    unit, source = json.dumps(item.unit), json.dumps(item.source)
    return f"{name} = {{ {numbers}, unit = {unit}, source = {source} }}"
