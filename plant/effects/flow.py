"""Leaks, supply, restrictions, volumes and what was left in a chamber."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plant.effects.effect import EffectParameter, Scope, Values, Variant, choice, effect
from plant.effects.setup import Setup
from plant.effects.term import add_table
from plant.kernel.compiled import plain
from plant.kernel.layout import TERM_NODES, Over, Slot
from plant.parts.flow import orifice

Floats = NDArray[np.float64]

CDA = EffectParameter("cda_m2", "m^2", 0.0, 0.0, 2e-5, 2e-7, 1)
WHERE = choice("where", "-", 0.0, 0.0, 4.0)
VOLUME = EffectParameter("volume_m3", "m^3", 0.0, -5e-5, 5e-4, 5e-6, 1)
CLOG = EffectParameter("factor", "-", 1.0, 0.02, 3.0, 0.2, -1)


@effect(
    "piston_leak",
    "leak",
    "chamber",
    "flow past the moving piston",
    CDA,
    form_error=0.05,
    look_alikes=("leak_to_atmosphere", "exhaust_clog"),
    sentence="Air leaks past the piston through {}",
    noun="a leak",
)
def piston_leak(setup: Setup, values: dict[str, float]) -> None:
    """Orifice C_d A across each piston, from chamber to chamber."""
    setup.p.leak_piston = values["cda_m2"]


def leak_on_run(values: Values) -> Values:
    """Return the values for a run, in which the chamber that drives is the one on supply."""
    return {**values, "where": 0.0} if values.get("where") == 1.0 else values


@effect(
    "leak_to_atmosphere",
    "leak",
    "chamber",
    "a charged chamber leaks outside",
    CDA,
    WHERE,
    form_error=0.05,
    variants=(
        Variant(),
        Variant("driving chamber", {"where": 1.0}, fills_table=True),
        Variant("every chamber", {"where": 2.0}, fills_table=True),
    ),
    on_run=leak_on_run,
    look_alikes=("inlet_clog", "hose_droop"),
    sentence="A charged chamber leaks outside through {}",
)
def leak_out(setup: Setup, values: dict[str, float]) -> None:
    """Orifice C_d A from a chamber to the atmosphere.

    where 0: from every chamber on supply; 1: from the one that drives the stroke, its valve open
    or not; 2: from every chamber, always.
    """
    if values["where"] == 0.0:
        setup.p.leak_atm = values["cda_m2"]
    elif values["cda_m2"] > 0.0:
        p = setup.p
        pressures = np.linspace(p.p_atm, 1.2e6, TERM_NODES)
        gas = (values["cda_m2"], p.t_gas, p.gamma, p.r_air)
        flow = plain(orifice)
        lost = np.array([flow(pressure, p.p_atm, *gas) for pressure in pressures.tolist()])
        index = setup.conditions.chambers.index(setup.charged_chamber)
        if values["where"] == 1.0:
            follow_pressure(setup, Slot.FLOW_1 + index, pressures, -lost)
        else:
            follow_pressure(setup, Slot.LEAK, pressures, lost)


def follow_pressure(setup: Setup, slot: float, pressures: Floats, flows: Floats) -> None:
    """Enter flows [n] in K kg/s of a chamber, tabulated by its own pressures [n] in Pa."""
    grid = {"low": float(pressures[0]), "step": float(pressures[1] - pressures[0])}
    add_table(setup, {"equation": slot, "variable": Over.SPEED, **grid}, flows)


@effect(
    "supply_low",
    "supply",
    "chamber",
    "true supply pressure below the stated one by a share",
    EffectParameter("deficit", "-", 0.0, -0.5, 0.8, 0.05, 1),
    scope="run",
    tolerance="supply",
    look_alikes=("inlet_clog", "hose_droop"),
    sentence="The supply pressure is {} below the stated one",
)
def supply_low(setup: Setup, values: dict[str, float]) -> None:
    """Lower the true supply pressure below the stated one by a share."""
    setup.p.p_supply *= 1.0 - values["deficit"]


@effect(
    "hose_droop",
    "supply",
    "chamber",
    "restriction and finite volume upstream of the valve",
    EffectParameter("cda_m2", "m^2", 0.0, 0.0, 1e-3, 5e-6, 1),
    EffectParameter("volume_m3", "m^3", 5e-5, 1e-6, 1e-2, 5e-5),
    scope="run",
    variants=(
        Variant(starts=((2e-5, 5e-5), (8e-6, 5e-5), (8e-6, 4e-4), (2e-5, 1e-5), (5e-5, 2e-5))),
    ),
    sized_by="none",  # the wider the line, the smaller the effect
    rugged=True,
    look_alikes=("inlet_clog",),
)
def droop(setup: Setup, values: dict[str, float]) -> None:
    """Supply line of a volume behind an orifice: the pressure at the valve sags while it feeds.

    A line that fills within a millisecond is followed as one that takes about that long.
    """
    if values["cda_m2"] <= 0.0:
        return
    setup.has_line = True
    setup.p.line_cda = values["cda_m2"]
    setup.p.line_volume = max(values["volume_m3"], 0.2 * values["cda_m2"])


@effect(
    "exhaust_clog",
    "flow restriction",
    "chamber",
    "exhaust flows times a factor",
    CLOG,
    tolerance="flow_out",
    look_alikes=("dead_volume_passive", "residual_pressure"),
    sentence="Exhaust flows are {}",
)
def exhaust_clog(setup: Setup, values: dict[str, float]) -> None:
    """Exhaust flows times a factor."""
    setup.p.k_out *= values["factor"]


@effect(
    "inlet_clog",
    "flow restriction",
    "chamber",
    "charge flows times a factor",
    CLOG,
    tolerance="flow_in",
    look_alikes=("dead_volume_charge",),
    sentence="Charge flows are {}",
)
def inlet_clog(setup: Setup, values: dict[str, float]) -> None:
    """Charge flows times a factor."""
    setup.p.k_in *= values["factor"]


def scope_of_volume(values: Values) -> Scope:
    """Return "unit" if the chambers are given by name, else "stroke": each drives some strokes."""
    return "unit" if values.get("where", 0.0) == 1.0 else "stroke"


@effect(
    "dead_volume_charge",
    "volume",
    "chamber",
    "extra volume on the charged chamber",
    VOLUME,
    WHERE,
    scope=scope_of_volume,
    variants=(Variant(), Variant("outer chambers", {"where": 1.0}, needs=("length stroke",))),
    look_alikes=("alpha_speed",),
    sentence="The charged chamber has {} more volume",
)
def dead_charge(setup: Setup, values: dict[str, float]) -> None:
    """Extra dead volume on the chamber that drives the stroke (where 0) or on B, F, 1 (where 1)."""
    if values["where"] == 1.0:
        setup.p.vol_b += values["volume_m3"]
        setup.p.vol_f += values["volume_m3"]
    else:
        setup.p[setup.volume_index(setup.charged_chamber)] += values["volume_m3"]


@effect(
    "dead_volume_passive",
    "volume",
    "chamber",
    "extra volume on the discharging chamber",
    VOLUME,
    WHERE,
    scope=scope_of_volume,
    variants=(Variant(), Variant("inner chamber", {"where": 1.0}, needs=("length stroke",))),
    look_alikes=("alpha_speed",),
    sentence="The discharging chamber has {} more volume",
)
def dead_passive(setup: Setup, values: dict[str, float]) -> None:
    """Extra dead volume on the chamber that the stroke compresses (where 0) or N, 2 (where 1)."""
    if values["where"] == 1.0:
        setup.p.vol_n += values["volume_m3"]
    else:
        for chamber in setup.passive_chambers:
            setup.p[setup.volume_index(chamber)] += values["volume_m3"]


@effect(
    "residual_pressure",
    "initial state",
    "initial",
    "the passive chamber was not vented at the start",
    EffectParameter("pressure_pa", "Pa", 0.0, -9e4, 1e6, 3e4, 1),
    WHERE,
    scope="stroke",
    variants=(
        Variant(),
        Variant("driving chamber", {"where": 1.0}),
        Variant("inner chamber", {"where": 2.0}, needs=("length stroke",)),
        Variant("every chamber", {"where": 3.0}),
        Variant("vented", {"where": 4.0}, needs=("length stroke",)),
    ),
    sentence="A chamber begins {} above atmosphere",
)
def residual(setup: Setup, values: dict[str, float]) -> None:
    """Overpressure at time 0.

    where 0: in the chamber that the stroke compresses, whatever its pressure; 1: in the one that
    drives the stroke; 2: in chamber N or 2; 3: in every chamber; 4: as 0, only if it was vented.
    """
    where = values["where"]
    charged = setup.conditions.charged_before
    chambers: tuple[str, ...] = setup.passive_chambers
    if where == 1.0:
        chambers = (setup.charged_chamber,)
    elif where == 2.0:
        chambers = ("N",) if "N" in setup.conditions.chambers else ("2",)
    elif where == 3.0:
        chambers = setup.conditions.chambers
    for chamber in chambers:
        if where in (0.0, 2.0) or chamber not in charged:
            other_pa = setup.residual_pa.get(chamber, 0.0)
            setup.residual_pa[chamber] = other_pa + values["pressure_pa"]
