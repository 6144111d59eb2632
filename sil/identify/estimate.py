"""What an identification returns: values with intervals, checks in words, a figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plant.parameters import ParameterSet
from sil.fitting.floor import EXPLAINED
from sil.report.figure import Figure

Floats = NDArray[np.float64]
Show = Callable[[float, float], None]
"""Shows that so much of so much is done."""


def no_progress(done: float, size: float) -> None:
    """Show nothing."""


@dataclass(frozen=True)
class Estimate:
    """One identified parameter: value(s), 95 % interval where it is one number, how it was found."""

    path: str
    value: float | tuple[float, ...]
    low: float | None
    high: float | None
    source: str


@dataclass(frozen=True)
class Identified:
    """The outcome of one identification.

    over_noise: rms of the residual over the expected noise, 1 = explained; beside: estimates by the
    thesis's method. Where the model does not fit, no interval is stated: it would hold only if the
    model were right.
    """

    what: str
    estimates: tuple[Estimate, ...]
    notes: tuple[str, ...]
    figure: Figure
    over_noise: float
    beside: tuple[Estimate, ...] = ()

    def __post_init__(self) -> None:
        if not self.fits:
            for name in ("estimates", "beside"):
                withheld = tuple(replace(e, low=None, high=None) for e in getattr(self, name))
                object.__setattr__(self, name, withheld)

    @property
    def fits(self) -> bool:
        """Whether the expected noise explains the residual."""
        return self.over_noise <= EXPLAINED

    @property
    def judgement(self) -> str:
        """One sentence on the residual."""
        size = f"residual {self.over_noise:.3g} times the expected noise"
        if self.fits:
            return f"the model fits: {size}"
        return (
            f"the model does not fit: {size} (at most {EXPLAINED:g} if noise explains it); the values "
            "are its best fit, their intervals are withheld"
        )


def interval(samples: Sequence[float]) -> tuple[float, float, float]:
    """Return mean and 95 % interval of the mean (Student) of independent values."""
    from scipy.stats import t as student

    values = np.asarray(samples, dtype=np.float64)
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, float("-inf"), float("inf")
    half = float(student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5)
    return mean, mean - half, mean + half


def model_file(found: Identified, parameters: ParameterSet) -> str:
    """Return the identified values as a model file that extends the set they were found with."""
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
    lines = [f"# {found.judgement}", "[base]", f"model = {json.dumps(parameters.name)}"]
    for section, entries in sections.items():
        lines += ["", f"[{section}]", *entries]
    return "\n".join(lines) + "\n"
