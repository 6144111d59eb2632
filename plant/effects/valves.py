"""Valve timing: delays longer, dependent on pressure, or a plunger that takes its time."""

from __future__ import annotations

from plant.effects.effect import EffectParameter, Variant, choice, effect
from plant.effects.setup import Setup
from plant.effects.tolerances import shift_delay


@effect(
    "valve_open_delay",
    "valve timing",
    "valve",
    "opens later",
    EffectParameter("delay_s", "s", 0.0, -0.008, 0.1, 0.003, 1),
    tolerance="rise",
    switching="rise",
    look_alikes=("valve_delay_pressure", "valve_creep"),
    sentence="Valves open {} late",
    noun="a delay",
)
def open_later(setup: Setup, values: dict[str, float]) -> None:
    """Open later by a time."""
    shift_delay(setup, "rise", values["delay_s"])


@effect(
    "valve_delay_pressure",
    "valve timing",
    "valve",
    "opening delay depends on the supply pressure",
    EffectParameter("slope_s_pa", "s/Pa", 0.0, -1e-7, 1e-7, 1e-8),
    choice("reference_pa", "Pa", 9e5, 0.0, 2e6, 1e5),
    variants=(
        Variant(),
        Variant("from 6 bar", {"reference_pa": 6e5}),
        Variant("from atmosphere", {"reference_pa": 101325.0}),
    ),
    switching="rise",
    sentence="The valves' opening delay changes with supply pressure by {}",
)
def open_by_pressure(setup: Setup, values: dict[str, float]) -> None:
    """Open later by slope (P_s - reference): the plunger opens against the supply."""
    shift_delay(setup, "rise", values["slope_s_pa"] * (setup.p.p_supply - values["reference_pa"]))


@effect(
    "valve_slow_close",
    "valve timing",
    "valve",
    "closes later",
    EffectParameter("delay_s", "s", 0.0, -0.035, 0.2, 0.01, 1),
    tolerance="fall",
    switching="fall",
    look_alikes=("valve_creep",),
    sentence="Valves close {} late",
)
def close_later(setup: Setup, values: dict[str, float]) -> None:
    """Close later by a time."""
    shift_delay(setup, "fall", values["delay_s"])


@effect(
    "valve_creep",
    "valve timing",
    "valve",
    "the plunger crosses slowly instead of at once",
    EffectParameter("travel_s", "s", 0.0, 0.0, 0.1, 0.005, 1),
    scope="stroke",
    sentence="The valves' plungers take {} to cross",
)
def creep(setup: Setup, values: dict[str, float]) -> None:
    """Let the plunger cross in a straight ramp of this duration, both ways."""
    setup.creep_s = values["travel_s"]
