"""What an identification returns: values with intervals, checks in words, a figure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plant.parameters import Parameter, ParameterSet
from sil.inference.report import model_file
from sil.inference.thresholds import LIMITS
from sil.report.figure import Figure


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter: value(s), 95 % interval where it is one number, how it was found."""

    path: str
    value: float | tuple[float, ...]
    low: float | None
    high: float | None
    source: str

    @property
    def numbers(self) -> tuple[float, ...]:
        """The value, or the values."""
        return self.value if isinstance(self.value, tuple) else (self.value,)


@dataclass(frozen=True)
class Identified:
    """The outcome of one identification; over_noise: rms of the residual over its noise, 1 = explained.

    Where the model does not fit, no interval is stated: it would hold only if the model were right.
    """

    what: str
    estimates: tuple[ParameterEstimate, ...]
    notes: tuple[str, ...]
    figure: Figure
    over_noise: float

    def __post_init__(self) -> None:
        if not self.fits:
            withheld = tuple(replace(e, low=None, high=None) for e in self.estimates)
            object.__setattr__(self, "estimates", withheld)

    @property
    def fits(self) -> bool:
        """Whether the expected noise explains the residual."""
        return self.over_noise <= LIMITS.max_residual_ratio

    @property
    def judgement(self) -> str:
        """One sentence on the residual."""
        size = f"residual {self.over_noise:.3g} times the expected noise"
        if self.fits:
            return f"the model fits: {size}"
        return (
            f"the model does not fit: {size} (at most {LIMITS.max_residual_ratio:g} if noise explains it); the values "
            "are its best fit, their intervals are withheld"
        )


def model_of(result: Identified, parameters: ParameterSet) -> str:
    """Return the identified values as a model file that extends the set they were found with."""
    sections: dict[str, dict[str, Parameter]] = {}
    for item in result.estimates:
        section, key = item.path.split(".", 1)
        numbers = tuple(map(_rounded, item.numbers))
        value = numbers if isinstance(item.value, tuple) else numbers[0]
        low = high = None
        if item.low is not None and item.high is not None and np.isfinite(item.high - item.low):
            low, high = _rounded(item.low), _rounded(item.high)
        unit = parameters[item.path].unit
        sections.setdefault(section, {})[key] = Parameter(value, unit, item.source, low, high)
    return model_file(result.judgement, parameters.name, sections)


def _rounded(value: float) -> float:
    return float(f"{value:.10g}")
