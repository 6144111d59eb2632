"""Hypotheses: which effects act, as parameters that a fit can move.

A hypothesis is a tuple of effects, or of their variants, which share an identifier. A term is a bounded
smooth function in exactly one equation, whose parameters are its values at the nodes of a grid.
Checked by: tests/unit/sil/inference/test_candidate.py
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from plant.effects import CATALOGUE, Effect, EffectParameter
from plant.effects.added_term import compile_terms
from plant.effects.effect import Need, Starts
from plant.effects.setup import Setup
from plant.effects.term import FORMS, TermForm, term
from plant.errors import InputError, IntegrationError


@dataclass(frozen=True)
class Candidate:
    """One cause that a fit can try: an effect, or a variant of it.

    parameters: fitted, from `starts`; fixed: the others, that make the variant; roughness: by how many
    typical sizes a node may leave the line of its neighbours (0: no nodes); fills_table: it takes the
    one tabulated term of the equations; prior: see `Variant`.
    """

    effect: Effect
    variant: str
    parameters: tuple[EffectParameter, ...]
    starts: Starts
    fixed: Mapping[str, float] = field(default_factory=dict)
    roughness: float = 0.0
    fills_table: bool = False
    prior: float = 1.0

    def __post_init__(self) -> None:
        _BY_NAME[self.name] = self

    def __reduce__(self) -> tuple[Callable[[str], Candidate], tuple[str]]:
        """Between processes a candidate travels by name: the forked ones inherit them all."""
        return _named, (self.name,)

    @property
    def id(self) -> str:
        """Identifier in the vocabulary."""
        return self.effect.id

    @property
    def cause_class(self) -> str:
        """Class in the vocabulary."""
        return self.effect.cause_class

    @property
    def is_term(self) -> bool:
        """Whether it is a non-parametric term."""
        return self.effect.nonparametric

    @property
    def name(self) -> str:
        """Identifier with the variant."""
        return f"{self.id}:{self.variant}" if self.variant else self.id

    def change(self, setup: Setup, values: Mapping[str, float]) -> None:
        """Change a stroke's setup by these values of the fitted parameters.

        Raises IntegrationError for values at which the plant does not exist: a fit goes on without them.
        """
        try:
            self.effect.apply(setup, {**self.fixed, **values})
        except InputError as error:
            raise IntegrationError(str(error)) from error

    def physical(self, values: Mapping[str, float]) -> bool:
        """Return whether the main parameter is on the side that the cause's description means."""
        main = self.parameters[0]
        return main.sign * (values[main.name] - main.neutral) >= 0.0


def scaled_of(parameter: EffectParameter, value: float) -> float:
    """Return a parameter's value in typical sizes from neutral; factors and scales count in logarithms.

    So the valley of a factor and a tolerance that scales the same is straight, and walked in one step.
    """
    if is_scale(parameter):
        return math.log(value / parameter.neutral) / log_size(parameter)
    return (value - parameter.neutral) / parameter.typical


def value_of(parameter: EffectParameter, scaled: float) -> float:
    """Return the value at so many typical sizes from neutral, limited to the physical bounds."""
    if is_scale(parameter):
        low, high = scaled_of(parameter, parameter.low), scaled_of(parameter, parameter.high)
        scaled = min(max(scaled, low), high)
        raw = parameter.neutral * math.exp(scaled * log_size(parameter))
    else:
        raw = parameter.neutral + scaled * parameter.typical
    return min(max(raw, parameter.low), parameter.high)


def is_scale(parameter: EffectParameter) -> bool:
    """Return whether a parameter is a factor, a width, a volume, a speed: positive wherever it goes."""
    return parameter.neutral > 0.0 and parameter.low > 0.0


def log_size(parameter: EffectParameter) -> float:
    """Return the typical size of a scale in logarithms."""
    return math.log1p(parameter.typical / parameter.neutral)


def precision(candidates: Sequence[Candidate]) -> NDArray[np.float64]:
    """Return the inverse covariance [parameters, parameters] of the prior, in typical sizes."""
    count = sum(len(item.parameters) for item in candidates)
    out = np.eye(count) / 10.0**2  # ten typical sizes wide: weak
    k = 0
    for item in candidates:
        n = len(item.parameters)
        if item.roughness > 0.0:
            bends = np.diff(np.eye(n), 2, axis=0) / item.roughness
            out[k : k + n, k : k + n] += bends.T @ bends
        k += n
    return out


_BY_NAME: dict[str, Candidate] = {}
"""Every candidate made in this process, by name."""


def _named(name: str) -> Candidate:
    return _BY_NAME[name]


def compatible(candidate: Candidate, others: Sequence[Candidate]) -> bool:
    """Return whether a candidate can act beside others: no variant of one of them, one tabulated term at most."""
    if any(candidate.id == other.id for other in others):
        return False
    return not (candidate.fills_table and any(other.fills_table for other in others))


def starts_of(parameters: tuple[EffectParameter, ...]) -> Starts:
    """Points to start a search from: the main parameter at several sizes, the others at rest."""
    main = parameters[0]
    rest = tuple(item.neutral for item in parameters[1:])
    values = []
    for sign in (1.0, -1.0) if main.sign == 0 else (float(main.sign),):
        for size in (0.15, 0.5, 1.5, 4.0):
            if main.sign == -1 and main.neutral == 1.0:
                values.append(1.0 / (1.0 + size * main.typical))
            else:
                values.append(main.neutral + sign * size * main.typical)
    return tuple((value, *rest) for value in values if main.low < value < main.high)


def candidates(has: Collection[Need]) -> list[Candidate]:
    """Return all candidates that strokes which have this can show at all."""
    usable: list[Candidate] = []
    compile_terms()
    for effect in CATALOGUE.values():
        fitted = [p for p in effect.parameters if p.fitted]
        for variant in () if effect.nonparametric else effect.variants:
            if not set(has) >= {*effect.needs, *variant.needs}:
                continue
            free = tuple(p for p in fitted if p.name not in variant.fixed)
            item = Candidate(
                effect, variant.name, free, variant.starts or starts_of(free), variant.fixed
            )
            usable.append(replace(item, fills_table=variant.fills_table, prior=variant.prior))
    return usable


def _term_starts(form: TermForm) -> Starts:
    """Return points to begin a search from: zero; level, rising and falling curves; of categories each alone."""
    rising = np.linspace(0.0, 1.0, form.count)
    shapes = [np.ones(form.count), rising, rising[::-1]]
    if is_categorical(form):
        shapes += list(np.eye(form.count))
    rows = itertools.product((0.5, 2.0, 6.0), shapes, (1.0, -1.0))
    curves = [sign * size * form.typical * shape for size, shape, sign in rows]
    return tuple(tuple(curve.tolist()) for curve in (np.zeros(form.count), *curves))


def is_categorical(form: TermForm) -> bool:
    """Return whether a form's nodes are things, such as valves, not values of a quantity."""
    return form.count <= 4


def term_candidate(form: TermForm) -> Candidate:
    """Return a term as a candidate."""
    names = tuple(f"node_{k:02d}" for k in range(form.count))

    def change(setup: Setup, values: dict[str, float]) -> None:
        nodes = tuple(values[name] for name in names)
        grid = {"equation": form.slot, "variable": form.over, "low": form.low, "step": form.step}
        term.change(setup, {**grid, "nodes": nodes})  # type: ignore[dict-item]

    limit = form.most * form.typical
    parameters = tuple(
        EffectParameter(name, form.unit, 0.0, -limit, limit, form.typical) for name in names
    )
    effect = Effect(
        term.id, form.cause_class, term.equation, form.what, parameters, change, nonparametric=True
    )
    # typical sizes by which a node may leave the line of its neighbours, which no stroke may reach
    roughness = 0.0 if is_categorical(form) else 0.5
    return Candidate(
        effect, form.name, parameters, _term_starts(form), roughness=roughness, fills_table=True
    )


def form_of(candidate: Candidate) -> TermForm:
    """Return the form of a term."""
    return next(form for form in FORMS if form.name == candidate.variant)
