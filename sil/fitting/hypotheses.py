"""Hypotheses: which effects act, as parameters that a fit can move.

A hypothesis is a tuple of effects.  Where the vocabulary leaves open what exactly an effect does
(on which chamber, say), it stands in variants that share its identifier.
Checked by: tests/unit/sil/fitting/test_hypotheses.py
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plant.effects import CATALOGUE, Effect, EffectParameter
from plant.effects.setup import Setup

Starts = tuple[tuple[float, ...], ...]


EFFECT_PRIOR = 10.0
"""Width of the prior of an effect's parameter, in typical sizes: weak."""


@dataclass(frozen=True)
class Candidate:
    """One cause that a fit can try: an effect, or a variant of it.

    parameters: those that are fitted; fixed: the others, that make the variant; starts: values of
    the fitted ones to begin from; roughness: by how much a parameter, where they are a function's
    values on a grid, may leave the line of its neighbours, in typical sizes (0: they are none).
    """

    effect: Effect
    variant: str
    parameters: tuple[EffectParameter, ...]
    starts: Starts
    fixed: Mapping[str, float] = field(default_factory=dict)
    told_class: str = ""
    roughness: float = 0.0

    def __post_init__(self) -> None:
        KNOWN[self.name] = self

    def __reduce__(self):  # type: ignore[no-untyped-def]
        """Between processes a candidate travels by name: the forked ones inherit them all."""
        return known, (self.name,)

    @property
    def id(self) -> str:
        """Identifier in the vocabulary."""
        return self.effect.id

    @property
    def klass(self) -> str:
        """Class in the vocabulary."""
        return self.told_class or self.effect.klass

    @property
    def name(self) -> str:
        """Identifier with the variant."""
        return f"{self.id}:{self.variant}" if self.variant else self.id

    def change(self, setup: Setup, values: Mapping[str, float]) -> None:
        """Change a stroke's setup by these values of the fitted parameters."""
        self.effect.apply(setup, {**self.fixed, **values})

    def physical(self, values: Mapping[str, float]) -> bool:
        """Whether the main parameter lies on the side that the cause's description means."""
        main = self.parameters[0]
        return main.one_sided * (values[main.name] - main.neutral) >= 0.0


def scaled_of(parameter: EffectParameter, value: float) -> float:
    """A parameter's value in typical sizes from neutral; factors and scales count in logarithms.

    A factor on what a tolerance scales too is known through the product alone: in logarithms that
    valley is straight, and a fit walks along it in one step.
    """
    if is_scale(parameter):
        return math.log(value / parameter.neutral) / log_size(parameter)
    return (value - parameter.neutral) / parameter.typical


def value_of(parameter: EffectParameter, scaled: float) -> float:
    """The value at so many typical sizes from neutral, kept within the physical bounds."""
    if is_scale(parameter):
        low, high = scaled_of(parameter, parameter.low), scaled_of(parameter, parameter.high)
        scaled = min(max(scaled, low), high)
        raw = parameter.neutral * math.exp(scaled * log_size(parameter))
    else:
        raw = parameter.neutral + scaled * parameter.typical
    return min(max(raw, parameter.low), parameter.high)


def is_scale(parameter: EffectParameter) -> bool:
    """Whether a parameter is a factor, a width, a volume, a speed: positive wherever it goes."""
    return parameter.neutral > 0.0 and parameter.low > 0.0


def log_size(parameter: EffectParameter) -> float:
    """The typical size of a scale in logarithms."""
    return math.log1p(parameter.typical / parameter.neutral)


def precision(candidates: Sequence[Candidate]) -> NDArray[np.float64]:
    """Inverse covariance of the prior of all candidates' parameters, in typical sizes."""
    count = sum(len(item.parameters) for item in candidates)
    out = np.eye(count) / EFFECT_PRIOR**2
    k = 0
    for item in candidates:
        n = len(item.parameters)
        if item.roughness > 0.0:
            bends = np.diff(np.eye(n), 2, axis=0) / item.roughness
            out[k : k + n, k : k + n] += bends.T @ bends
        k += n
    return out


KNOWN: dict[str, Candidate] = {}
"""Every candidate made in this process, by name."""


def known(name: str) -> Candidate:
    """The candidate of that name."""
    return KNOWN[name]


def compatible(candidate: Candidate, others: Sequence[Candidate]) -> bool:
    """Whether a candidate can stand beside others: no two variants of one cause, one term at most."""
    if any(candidate.id == other.id for other in others):
        return False
    return not (fills_term(candidate) and any(fills_term(other) for other in others))


def fills_term(candidate: Candidate) -> bool:
    """Whether a candidate takes the one place that the equations have for a tabulated term."""
    tabulated = candidate.id == "leak_to_atmosphere" and bool(candidate.variant)
    return candidate.id == "unnamed" or tabulated


def starts_of(parameters: tuple[EffectParameter, ...]) -> Starts:
    """Points to start a search from: the main parameter at several sizes, the others at rest."""
    main = parameters[0]
    rest = tuple(item.neutral for item in parameters[1:])
    found = []
    signs = (1.0, -1.0) if main.one_sided == 0 else (float(main.one_sided),)
    for sign in signs:
        for size in (0.15, 0.5, 1.5, 4.0):
            value = main.neutral + sign * size * main.typical
            if main.one_sided == -1 and main.neutral == 1.0:
                value = 1.0 / (1.0 + size * main.typical)
            if main.low < value < main.high:
                found.append((value, *rest))
    return tuple(found)


SPOTS_M = (0.003, 0.0065, 0.010)
"""Where a local drag is looked for first: three places on either side."""

SHARES: Starts = tuple(
    (sign * share, speed) for sign in (1.0, -1.0) for share in (0.02, 0.2) for speed in (0.05, 0.5)
)
"""Where exponents that follow the speed are looked for first."""

SPECIAL: dict[str, tuple[tuple[str, dict[str, float], Starts | None, bool], ...]] = {
    "friction_bump": (
        (
            "",
            {},
            tuple((30.0, s * x, 0.0012) for s in (1.0, -1.0) for x in SPOTS_M),
            False,
        ),
        ("both sides", {"mirrored": 1.0}, tuple((30.0, x, 0.0012) for x in SPOTS_M), True),
    ),
    "hose_droop": (
        ("", {}, ((2e-5, 5e-5), (8e-6, 5e-5), (8e-6, 4e-4), (2e-5, 1e-5), (5e-5, 2e-5)), False),
    ),
    "residual_pressure": (
        ("", {}, None, False),
        ("driving chamber", {"where": 1.0}, None, False),
        ("inner chamber", {"where": 2.0}, None, True),
        ("every chamber", {"where": 3.0}, None, False),
        ("vented", {"where": 4.0}, None, True),
    ),
    "dead_volume_charge": (
        ("", {}, None, False),
        ("outer chambers", {"where": 1.0}, None, True),
    ),
    "dead_volume_passive": (
        ("", {}, None, False),
        ("inner chamber", {"where": 1.0}, None, True),
    ),
    "leak_to_atmosphere": (
        ("", {}, None, False),
        ("driving chamber", {"where": 1.0}, None, False),
        ("every chamber", {"where": 2.0}, None, False),
    ),
    "seal_pressure_friction": (
        ("", {}, None, False),
        ("smaller face", {"face": 1.0}, None, False),
    ),
    "valve_delay_pressure": (
        ("", {}, None, False),
        ("from 6 bar", {"reference_pa": 6e5}, None, False),
        ("from atmosphere", {"reference_pa": 101325.0}, None, False),
    ),
    "alpha_speed": (
        ("", {}, SHARES, False),
        ("all exponents", {"form": 1.0}, SHARES, False),
        ("towards adiabatic", {"form": 2.0}, SHARES, False),
        ("all towards adiabatic", {"form": 3.0}, SHARES, False),
        ("isothermal at rest", {"form": 4.0}, SHARES, False),
        ("all isothermal at rest", {"form": 5.0}, SHARES, False),
    ),
    "clock_skew": (
        ("", {}, ((0.003, 0.0), (-0.003, 0.0), (0.0, 0.005), (0.01, 0.0), (0.003, 0.01)), False),
    ),
}
"""Variants (name, what they fix, where they start, whether only the length stroke has them)."""

RUGGED = ("friction_bump", "hose_droop")
"""Causes with several valleys, which tolerances at their bounds fill: each start is followed by
itself, from tolerances and scatter at rest."""

VARIANT_KEYS = ("where", "mirrored", "form", "face", "reference_pa")


def candidates(has_damper: bool, has_internal: bool, has_length: bool) -> list[Candidate]:
    """All candidates that this campaign's strokes can show at all."""
    found: list[Candidate] = []
    for effect in CATALOGUE.values():
        if effect.id == "unnamed" or (effect.needs_damper and not has_damper):
            continue
        if effect.equation in ("sensor", "clock") and not has_internal:
            continue
        if effect.id == "free_play" and not has_length:
            continue
        free = tuple(p for p in effect.parameters if p.name not in VARIANT_KEYS)
        usual = starts_of(free)
        for variant, fixed, starts, length_only in SPECIAL.get(effect.id, (("", {}, None, False),)):
            if has_length or not length_only:
                found.append(Candidate(effect, variant, free, starts or usual, fixed))
    return found
