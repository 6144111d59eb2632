"""Friction of the fixed piston: breakaway, Coulomb level and slope by a whole-record fit.

Each stroke is simulated, and its own scatter of valve delay and friction is fitted with them.
"""

from __future__ import annotations

import numpy as np

from can_dbc.errors import InputError
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, CampaignStroke, Floats, Record
from sil.inference.fit import Show, no_progress
from sil.inference.identify.campaign_fit import fit_factors
from sil.inference.identify.estimate import Identified
from sil.report.figure import Figure, Panel, Series, Stack


def plain_strokes(campaign: Campaign) -> list[tuple[CampaignStroke, Record]]:
    """Unloaded strokes of the fixed piston that start at rest at its beginning.

    Raises InputError for fewer than two.
    """
    found = []
    needed = ("position_m", "pressure_1_pa", "pressure_2_pa")
    for entry in campaign.strokes:
        c = entry.conditions
        if c.kind == "fixed" and c.load == "none" and not c.charged_before:
            record = campaign.record(entry)
            if all(name in record for name in needed) and np.ptp(record["position_m"]) > 0.003:
                found.append((entry, record))
    if len(found) < 2:
        raise InputError(
            f"{campaign.folder}: {len(found)} unloaded strokes of the fixed piston with both "
            "pressures; expected at least 2"
        )
    return found


def pressures_from_rest(record: Record, atmosphere_pa: float) -> list[Floats]:
    """Return both pressures [n] in Pa, gauge offsets taken off at rest."""
    quiet = slice(0, max(5, len(record) // 100))
    pressures = (record[column] for column in ("pressure_1_pa", "pressure_2_pa"))
    return [pressure - np.mean(pressure[quiet]) + atmosphere_pa for pressure in pressures]


def identify_friction(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Return static and dynamic friction of the fixed piston from a campaign's unloaded strokes.

    Raises InputError for too few strokes.
    """
    entries = [entry for entry, _record in plain_strokes(campaign)]
    factors = {
        "friction_fixed.F_sf": Parameters.f_static_s,
        "friction_fixed.F_rf": Parameters.f_run_s,
        "friction_fixed.beta": Parameters.beta_s,
    }
    fitted, over_noise = fit_factors(
        campaign, entries, parameters, factors, known=("friction",), progress=progress
    )
    _static, level, rate = (item.numbers[0] for item in fitted)
    speeds = np.array([0.0, 1.0])
    given = parameters.value("friction_fixed.F_rf"), parameters.value("friction_fixed.beta")
    series = [
        Series("given", speeds, given[0] + given[1] * speeds, "before"),
        Series("fitted", speeds, level + rate * speeds, "after"),
    ]
    panel = Panel("friction", "N", series, height=320)
    figure = Figure([Stack("speed, m/s", [panel], "Friction against speed")])
    return Identified("friction", fitted, (), figure, over_noise)
