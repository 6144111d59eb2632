"""What an effect is: its place in the model, its parameters, and the change it makes."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from plant.effects.setup import Setup
from plant.errors import InputError
from plant.parameters import Number, Parameter

Values = Mapping[str, Number]


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    neutral: the value at which the effect is absent; low, high: physical bounds; typical: the size
    of an effect worth reporting (scale of a search); one_sided: 0 if both signs are physical, +1 or
    -1 if only values above or below neutral are; optional: may be left out (neutral then).
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    typical: float
    one_sided: int = 0
    optional: bool = False
    listed: bool = False


@dataclass(frozen=True)
class Effect:
    """A candidate extension of the model.

    equation: the one it enters ("force", "chamber", "valve", "sensor", "clock", "gauge",
    "initial", "geometry", "damper"); change(setup, values) applies it.
    """

    id: str
    klass: str
    equation: str
    what: str
    parameters: tuple[EffectParameter, ...]
    change: Callable[[Setup, dict[str, float]], None]
    needs_damper: bool = False

    def apply(self, setup: Setup, values: Values) -> None:
        """Change a stroke's setup; parameters left out are neutral."""
        full = {item.name: values.get(item.name, item.neutral) for item in self.parameters}
        self.change(setup, full)  # type: ignore[arg-type]

    def check(self, table: Mapping[str, Parameter], place: str) -> None:
        """Refuse unknown or missing parameters, other units and values outside the bounds."""
        known = {item.name: item for item in self.parameters}
        for name, given in table.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3, cutoff=0.3) or list(known)
                raise InputError(f"{place} {name}: no such parameter; nearest: {', '.join(near)}")
            item = known[name]
            if given.unit != item.unit:
                raise InputError(f"{place} {name}: unit {given.unit!r}; expected {item.unit!r}")
            values = given.value if isinstance(given.value, tuple) else (given.value,)
            if isinstance(given.value, tuple) != item.listed:
                kind = "a list of numbers" if item.listed else "one number"
                raise InputError(f"{place} {name}: expected {kind}")
            for value in values:
                if not item.low <= value <= item.high:
                    raise InputError(
                        f"{place} {name}: {value:g}; expected {item.low:g} to {item.high:g}"
                    )
        for name, item in known.items():
            if name not in table and not item.optional:
                raise InputError(f"{place}: no {name}; expected {', '.join(known)}")
