"""What an identification returns: values with intervals, checks in words, curves to draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plant.parameters import ParameterSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """One identified parameter: value(s), 95 % interval where it is one number, how it was found."""

    path: str
    value: float | tuple[float, ...]
    low: float | None
    high: float | None
    source: str


@dataclass(frozen=True)
class Curve:
    """One line or cloud of a picture."""

    label: str
    x: Floats
    y: Floats
    kind: str = "line"


@dataclass(frozen=True)
class Panel:
    """One picture: axis labels and curves."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]


@dataclass(frozen=True)
class Identified:
    """The outcome of one identification."""

    what: str
    estimates: tuple[Estimate, ...]
    notes: tuple[str, ...]
    panels: tuple[Panel, ...]
    beside: tuple[Estimate, ...] = field(default=())


def interval(samples: Sequence[float]) -> tuple[float, float, float]:
    """Mean and 95 % interval of the mean (Student) of independent values."""
    from scipy.stats import t as student

    values = np.asarray(samples, dtype=np.float64)
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, float("-inf"), float("inf")
    half = float(student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5)
    return mean, mean - half, mean + half


def model_file(found: Identified, parameters: ParameterSet) -> str:
    """The identified values as a model file that extends the set they were found with."""
    import json

    sections: dict[str, list[str]] = {}
    for item in found.estimates:
        section, key = item.path.split(".", 1)
        unit = parameters[item.path].unit
        if isinstance(item.value, tuple):
            value = "[" + ", ".join(f"{v:.10g}" for v in item.value) + "]"
        else:
            value = f"{item.value:.10g}"
        fields = [f"value = {value}"]
        if (
            item.low is not None
            and item.high is not None
            and np.isfinite([item.low, item.high]).all()
        ):
            fields += [f"low = {item.low:.10g}", f"high = {item.high:.10g}"]
        fields += [f"unit = {json.dumps(unit)}", f"source = {json.dumps(item.source)}"]
        sections.setdefault(section, []).append(f"{key} = {{ {', '.join(fields)} }}")
    lines = ["[base]", f"model = {json.dumps(parameters.name)}"]
    for section, entries in sections.items():
        lines += ["", f"[{section}]", *entries]
    return "\n".join(lines) + "\n"
