"""Causes that a truck's bus could show, each with one size.

Checked by: tests/unit/sil/inference/truck/test_causes.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plant.effects import CATALOGUE, Effect, EffectParameter
from plant.effects.effect import Variant
from sil.inference.candidate import scaled_of, value_of
from sil.log_replay.recorded_shifts import RecordedShift


@dataclass(frozen=True, eq=False)
class Cause:
    """One effect of the catalogue, with one size: in typical sizes of its first parameter.

    others: values of its further fitted parameters.
    """

    effect: Effect
    variant: Variant
    others: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _BY_NAME[self.name] = self

    def __reduce__(self) -> tuple[Callable[[str], Cause], tuple[str]]:
        """Between processes a cause travels by name: the forked ones inherit them all."""
        return _named, (self.name,)

    @property
    def id(self) -> str:
        """Identifier in the vocabulary."""
        return self.effect.id

    @property
    def name(self) -> str:
        """Its id with the variant, and the values of its other parameters."""
        values = ", ".join(f"{v:g}" for v in self.others)
        return ":".join(part for part in (self.id, self.variant.name, values) if part)

    @property
    def parameter(self) -> EffectParameter:
        """The parameter that is estimated."""
        return self.effect.parameters[0]

    @property
    def is_narrowing(self) -> bool:
        """Whether the effect grows as its parameter falls from infinity: of a supply line."""
        return self.effect.sized_by == "none"

    @property
    def is_by_supply(self) -> bool:
        """Whether the effect moves a valve's delay by the supply pressure."""
        return bool(self.effect.switching) and not self.effect.tolerance

    @property
    def sign(self) -> int:
        """+1 or -1 if only such sizes are physical, 0 if both are."""
        return 1 if self.is_narrowing else self.parameter.sign

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest physical size, in typical ones."""
        low, high = 0.0 if self.sign > 0 else -30.0, 0.0 if self.sign < 0 else 30.0
        if self.is_narrowing:
            return low, high
        own = self.parameter
        return max(low, scaled_of(own, own.low)), min(high, scaled_of(own, own.high))

    def clipped(self, size: float) -> float:
        """Return the nearest physical size, in typical ones."""
        low, high = self.bounds
        return min(max(size, low), high)

    def moves(self, size: float) -> bool:
        """Return whether a size in typical ones is simulated: a supply line too wide to be seen is stiff, and is none."""
        return not self.is_narrowing or size >= 0.3

    def sizes(self, *amounts: float) -> list[float]:
        """Return physical sizes of these amounts, of both signs if both are physical."""
        signs = (float(self.sign),) if self.sign else (1.0, -1.0)
        tried = dict.fromkeys(self.clipped(sign * a) for a in amounts for sign in signs)
        return [size for size in tried if abs(size) > 0.2]

    def value(self, size: float) -> float:
        """Return the parameter's value [its unit] at a size in typical ones."""
        if self.is_narrowing:
            # of size one: four typical values
            return min(self.parameter.high, self.parameter.typical * 4.0 / max(size, 1e-3))
        return value_of(self.parameter, size)

    def values(self, size: float) -> dict[str, float]:
        """Return all parameters of the effect at a size in typical ones."""
        rest = [p for p in self.effect.parameters[1:] if p.fitted]
        others = {p.name: v for p, v in zip(rest, self.others, strict=False)}
        return {**self.variant.fixed, **others, self.parameter.name: self.value(size)}


_BY_NAME: dict[str, Cause] = {}
"""Every cause made in this process, by name."""


def _named(name: str) -> Cause:
    return _BY_NAME[name]


def catalogue() -> list[Cause]:
    """Return the causes that a run can have and a bus could show."""
    causes = []
    for effect in CATALOGUE.values():
        if "damper" in effect.needs or effect.nonparametric:
            continue
        for variant in effect.variants:
            scope = effect.scope_of(variant.fixed)
            is_sensor = scope == "instrument" and effect.equation == "sensor"
            if scope in ("unit", "run") or is_sensor:
                others = dict.fromkeys(start[1:] for start in variant.starts or ((0.0,),))
                causes += [Cause(effect, variant, other) for other in others]
    return causes


def offered(shifts: Sequence[RecordedShift]) -> list[Cause]:
    """Return the catalogue's causes, those by the supply pressure only if that is known to vary."""
    supplies = [s.supply_pa for s in shifts if not np.isnan(s.supply_pa)]
    varies = len(supplies) > 1 and float(np.std(supplies)) > 2e4  # Pa
    return [c for c in catalogue() if varies or not c.is_by_supply]
