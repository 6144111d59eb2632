"""What an effect is: all that is known about one candidate extension of the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from can_dbc.errors import unknown_name
from plant.effects.force_term import ForceTerm
from plant.effects.setup import Setup
from plant.errors import InputError
from plant.parameters import Number, Parameter

Values = Mapping[str, Number]
Change = Callable[[Setup, dict[str, float]], None]
Starts = tuple[tuple[float, ...], ...]

Scope = Literal["unit", "run", "stroke", "instrument"]
"""What an effect belongs to: the actuator, the supply of a whole run, one stroke, an instrument."""

Need = Literal["damper", "internal position", "length stroke", "process exponents", "truck"]
"""What the strokes of a campaign must have for an effect to show in them."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    neutral: where the effect is absent; low, high: physical bounds; typical: size worth reporting (scale of a search);
    sign: +1 or -1 if only values above or below neutral are physical; optional: may be left out (neutral then);
    listed: a list of numbers; fitted: false if only a variant sets it.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    typical: float
    sign: int = 0
    optional: bool = False
    listed: bool = False
    fitted: bool = True


@dataclass(frozen=True)
class Variant:
    """One reading of an effect that the vocabulary of causes leaves open, e.g. on which chamber.

    fixed: parameters that make it; starts: fitted parameters to begin a search from (none: multiples of the typical
    size); needs: beyond the effect's; fills_table: it takes the one tabulated term of the equations; prior: against 1
    of a cause without variants.
    """

    name: str = ""
    fixed: Mapping[str, float] = field(default_factory=dict)
    starts: Starts = ()
    needs: tuple[Need, ...] = ()
    fills_table: bool = False
    prior: float = 1.0


@dataclass(frozen=True)
class Effect:
    """A candidate extension of the model.

    cause_class: class in the vocabulary of causes; equation: the one it enters ("force", "chamber",
    "valve", "sensor", "clock", "gauge", "initial", "geometry", "damper"); change(setup, values)
    applies it; scope: what it belongs to, or a function of its values; on_run: its values as a run
    applies them.

    sentence: what it means, with {} for its size; noun: what would have been seen, of the effects named first;
    tolerance: the tolerance of healthy units that acts the same way; switching: the instant of a
    valve ("rise" or "fall") that it moves; sized_by: the fitted parameters that say how large it is;
    form_error: standard deviation of the first parameter, as a share, because the form is a guess (a gap has no
    data sheet); rugged: a fit has several minima, so each start is followed separately; look_alikes: effects that
    are hard to distinguish from it (stated on either side); force: the same as a term of the force balance
    of a body of which only force and position are known.
    """

    id: str
    cause_class: str
    equation: str
    what: str
    parameters: tuple[EffectParameter, ...]
    change: Change
    scope: Scope | Callable[[Values], Scope] = "unit"
    on_run: Callable[[Values], Values] = dict
    needs: tuple[Need, ...] = ()
    variants: tuple[Variant, ...] = (Variant(),)
    sentence: str = ""
    noun: str = ""
    tolerance: str = ""
    switching: str = ""
    sized_by: Literal["first", "any", "none"] = "first"
    form_error: float = 0.0
    rugged: bool = False
    nonparametric: bool = False
    look_alikes: tuple[str, ...] = ()
    force: ForceTerm | None = None

    def scope_of(self, values: Values) -> Scope:
        """Return what the effect belongs to at these values."""
        return self.scope(values) if callable(self.scope) else self.scope

    def apply(self, setup: Setup, values: Values) -> None:
        """Change a stroke's setup unless all that a fit may move are neutral; parameters left out are neutral."""
        full = {item.name: values.get(item.name, item.neutral) for item in self.parameters}
        moved = (full[item.name] != item.neutral for item in self.parameters if item.fitted)
        if self.nonparametric or any(moved):
            self.change(setup, full)  # type: ignore[arg-type]

    def check(self, table: Mapping[str, Parameter], where: str) -> None:
        """Check a table of parameters.

        Raises InputError, `where` in front, for an unknown or missing one, another unit and a value out of bounds.
        """
        expected = {item.name: item for item in self.parameters}
        for name, given in table.items():
            if name not in expected:
                raise InputError(f"{where} {name}: {unknown_name(name, expected)}")
            item = expected[name]
            if given.unit != item.unit:
                raise InputError(f"{where} {name}: unit {given.unit!r}; expected {item.unit!r}")
            values = given.value if isinstance(given.value, tuple) else (given.value,)
            if isinstance(given.value, tuple) != item.listed:
                kind = "a list of numbers" if item.listed else "one number"
                raise InputError(f"{where} {name}: expected {kind}")
            for value in values:
                if not item.low <= value <= item.high:
                    raise InputError(
                        f"{where} {name}: {value:g}; expected {item.low:g} to {item.high:g}"
                    )
        for name, item in expected.items():
            if name not in table and not item.optional:
                raise InputError(f"{where}: no {name}; expected {', '.join(expected)}")


def effect(
    identifier: str,
    cause_class: str,
    equation: str,
    what: str,
    *parameters: EffectParameter,
    **facts: Any,
) -> Callable[[Change], Effect]:
    """Make the function below into the effect that it applies; facts: further fields of Effect."""
    return lambda change: Effect(
        identifier, cause_class, equation, what, parameters, change, **facts
    )


def choice(
    name: str, unit: str, usual: float, low: float, high: float, step: float = 1.0
) -> EffectParameter:
    """Return a parameter that a variant sets and no fit moves; left out it has its usual value."""
    return EffectParameter(name, unit, usual, low, high, step, optional=True, fitted=False)
