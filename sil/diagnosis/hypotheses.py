"""Hypotheses: which effects act, as parameters that a fit can move.

A hypothesis is a tuple of effects.  Where the vocabulary leaves open what exactly an effect does
(on which chamber, say), it stands in variants that share its identifier.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from plant import layout as L
from plant.effects import CATALOGUE, Effect, EffectParameter
from plant.setup import Setup

Change = Callable[[Setup, dict[str, float]], None]


@dataclass(frozen=True)
class Candidate:
    """One cause that a fit can try: an effect, or a variant of it."""

    id: str
    klass: str
    equation: str
    variant: str
    parameters: tuple[EffectParameter, ...]
    change: Change
    starts: tuple[tuple[float, ...], ...]

    @property
    def name(self) -> str:
        """Identifier with the variant, for logs."""
        return f"{self.id}:{self.variant}" if self.variant else self.id


def starts_of(parameters: tuple[EffectParameter, ...]) -> tuple[tuple[float, ...], ...]:
    """Points to start a search from: the main parameter at several sizes, the others at rest."""
    main = parameters[0]
    rest = tuple(item.neutral for item in parameters[1:])
    found = []
    signs = (1.0, -1.0) if main.one_sided == 0 else (float(main.one_sided),)
    for sign in signs:
        for size in (0.5, 1.5, 4.0):
            value = main.neutral + sign * size * main.typical
            if main.one_sided == -1 and main.neutral == 1.0:
                value = 1.0 / (1.0 + size * main.typical)
            if main.low < value < main.high:
                found.append((value, *rest))
    return tuple(found)


def from_effect(effect: Effect) -> Candidate:
    """The effect as the catalogue has it."""
    return Candidate(
        effect.id,
        effect.klass,
        effect.equation,
        "",
        effect.parameters,
        effect.change,
        starts_of(effect.parameters),
    )


def spots(effect: Effect) -> tuple[tuple[float, ...], ...]:
    """Starts for a bump: a few places along the stroke on either side."""
    return tuple(
        (force, place, 0.0012)
        for force in (80.0,)
        for place in (0.003, 0.0065, 0.010, -0.003, -0.0065, -0.010)
    )


def mirrored_bump(setup: Setup, values: dict[str, float]) -> None:
    """A bump at the same distance from neutral on both sides: on the side of this stroke."""
    CATALOGUE["friction_bump"].change(setup, values)
    if setup.conditions.kind in ("N-F", "F-N"):
        setup.p[L.BUMP_X] = -setup.p[L.BUMP_X]


def residual_in(chambers: dict[str, str]) -> Change:
    """Overpressure at the start in one chamber a kind of stroke."""

    def change(setup: Setup, values: dict[str, float]) -> None:
        chamber = chambers.get(setup.conditions.kind)
        if chamber is not None:
            before = setup.residual_pa.get(chamber, 0.0)
            setup.residual_pa[chamber] = before + values["pressure_pa"]

    return change


def volume_named(indices: tuple[int, ...]) -> Change:
    """Extra volume on fixed chambers, whatever their role in a stroke."""

    def change(setup: Setup, values: dict[str, float]) -> None:
        for index in indices:
            setup.p[index] += values["volume_m3"]

    return change


def candidates(has_damper: bool, has_internal: bool, has_length: bool) -> list[Candidate]:
    """All candidates that this campaign's strokes can show at all."""
    found: list[Candidate] = []
    for effect in CATALOGUE.values():
        if effect.id == "unnamed":
            continue
        if effect.needs_damper and not has_damper:
            continue
        if effect.equation in ("sensor", "clock") and not has_internal:
            continue
        if effect.id == "free_play" and not has_length:
            continue
        base = from_effect(effect)
        if effect.id == "friction_bump":
            found.append(
                Candidate(
                    base.id,
                    base.klass,
                    base.equation,
                    "",
                    base.parameters,
                    base.change,
                    spots(effect),
                )
            )
            if has_length:
                found.append(
                    Candidate(
                        base.id,
                        base.klass,
                        base.equation,
                        "both sides",
                        base.parameters,
                        mirrored_bump,
                        spots(effect)[:3],
                    )
                )
        elif effect.id == "hose_droop":
            found.append(
                Candidate(
                    base.id,
                    base.klass,
                    base.equation,
                    "",
                    base.parameters,
                    base.change,
                    ((2e-5, 5e-5), (8e-6, 5e-5), (8e-6, 4e-4), (2e-5, 1e-5)),
                )
            )
        elif effect.id == "residual_pressure":
            found.append(base)
            found.append(
                Candidate(
                    base.id,
                    base.klass,
                    base.equation,
                    "driving chamber",
                    base.parameters,
                    residual_in(
                        {"fixed": "1", "N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}
                    ),
                    base.starts,
                )
            )
            if has_length:
                found.append(
                    Candidate(
                        base.id,
                        base.klass,
                        base.equation,
                        "neutral chamber",
                        base.parameters,
                        residual_in(dict.fromkeys(("N-B", "N-F", "B-N", "F-N"), "N")),
                        base.starts,
                    )
                )
        elif effect.id == "dead_volume_charge":
            found.append(base)
            if has_length:
                found.append(
                    Candidate(
                        base.id,
                        base.klass,
                        base.equation,
                        "outer chambers",
                        base.parameters,
                        volume_named((L.VOL_B, L.VOL_F)),
                        base.starts,
                    )
                )
        elif effect.id == "dead_volume_passive":
            found.append(base)
            if has_length:
                found.append(
                    Candidate(
                        base.id,
                        base.klass,
                        base.equation,
                        "inner chamber",
                        base.parameters,
                        volume_named((L.VOL_N,)),
                        base.starts,
                    )
                )
        else:
            found.append(base)
    return found
