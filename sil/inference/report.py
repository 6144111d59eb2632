"""What every front end reports: causes with intervals, the headline, diagnosis.json and model files.

Checked by: tests/unit/sil/inference/test_report.py, test_diagnose.py
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from plant.effects import CATALOGUE
from plant.parameters import Parameter
from sil.files.quantity import quantity, unit_of
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
    """What a diagnosis explains: rms of residuals on strokes that the fit did not use, before and after.

    channels: by column (before, after, of which noise), in its unit; before, after: over their scatter.
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


def sized(value: float, unit: str) -> str:
    """Return a value with its unit as it is said, two digits; one without a unit in per cent."""
    units = {"s/Pa": (1e8, "ms/bar"), "m^2": (1e6, "mm²"), "m^3": (1e6, "cm³"), "": (100.0, "%")}
    factor, unit = units.get(unit, (1.0, unit))
    value *= factor
    plain, _, shown = quantity(value, unit, 12).partition(" ")
    number = float(plain)
    text = f"{number:.0f}" if abs(number) >= 99.5 else f"{number:#.2g}".removesuffix(".")
    return f"{text} {shown}".rstrip()


def size_of(name: str, item: Interval) -> tuple[str, str]:
    """Return a parameter's value and its interval, e.g. "25 % lower" and "22 to 28 %"."""
    values, unit = [item.value, item.low, item.high], "" if item.unit == "-" else item.unit
    word = ""
    if name == "factor" and item.value > 2.0:
        return f"{item.value:#.2g} times the usual", f"{item.low:#.2g} to {item.high:#.2g} times"
    if name == "factor":
        sign = 1.0 if item.value > 1.0 else -1.0
        values, word = [sign * (v - 1.0) for v in values], " higher" if sign > 0.0 else " lower"
    low, high = (sized(v, unit) for v in sorted(values[1:]))
    if low.partition(" ")[2] == high.partition(" ")[2]:
        low = low.partition(" ")[0]
    return f"{sized(values[0], unit)}{word}", f"{low} to {high}"


def sentence_of(cause: ReportedCause) -> str:
    """Return what a cause means, with the size of its main parameter and that one's interval."""
    name, item = next(iter(cause.parameters.items()))
    text = CATALOGUE[cause.id].sentence if cause.id in CATALOGUE else ""
    if not text:
        text = f"{cause.what or cause.id.replace('_', ' ')}, {name.rpartition('_')[0] or name} {{}}"
    size, interval = size_of(name, item)
    return f"{text.format(size)} ({interval})"


def seen_sentence(sizes: Iterable[tuple[str, float, float, str]]) -> str:
    """Return what would have been seen of (id, value, neutral, unit); empty if nothing would."""
    by_id = {name: (value, neutral, unit) for name, value, neutral, unit in sizes}
    order = ("leak", "valve timing", "friction")  # classes that are named first
    effects = sorted(
        CATALOGUE.values(), key=lambda item: (*order, item.cause_class).index(item.cause_class)
    )
    nouns = {item.id: item.noun for item in effects if item.noun}
    nouns["stiffness"] = "a spring"  # no effect of the catalogue
    texts = []
    for name in [name for name in nouns if name in by_id][:3] or list(by_id)[:3]:
        value, neutral, unit = by_id[name]
        size = sized(abs(value), "" if unit == "-" else unit)
        if neutral:
            size = f"{'+' if value > neutral else ''}{sized(value / neutral - 1.0, '')}"
        texts.append(f"{nouns.get(name, name.replace('_', ' '))} above {size}")
    if not texts:
        return ""
    text = f"{', '.join(texts)} would have been seen."
    return f"{text[0].upper()}{text[1:]}"


def headline(verdict: str, causes: Sequence[ReportedCause], seen: str, reason: str) -> str:
    """Return the one sentence that a reader needs first; seen: of what would have been seen; reason: why nothing can be concluded."""
    if verdict == "cannot_tell":
        return f"These data cannot tell: {reason}."
    if verdict == "consistent":
        return f"Nothing found. {seen}".strip()
    if verdict == UNNAMED:
        where = next((c.what or c.cause_class for c in causes if c.id == UNNAMED), "")
        return f"Something is wrong: {where}; no cause of the catalogue fits."
    named = [cause for cause in causes if cause.id != UNNAMED]
    first, *others = map(sentence_of, named)
    joint = "; or " if verdict == "ambiguous" else "; and "
    text = joint.join([first, *(f"{other[0].lower()}{other[1:]}" for other in others)])
    text = f"{text[0].upper()}{text[1:]}"
    if len(named) < len(causes):
        text += ", besides something that no cause of the catalogue fits"
    return f"{text}."
