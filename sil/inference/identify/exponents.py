"""Process exponents by the whole-record fit of strokes with position and pressures (T3.2)."""

from __future__ import annotations

from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.campaign.campaign import Campaign
from sil.inference.fit import Show, no_progress
from sil.inference.identify.campaign_fit import fit_factors
from sil.inference.identify.estimate import Identified
from sil.inference.identify.friction import plain_strokes, pressures_from_rest
from sil.report.figure import BAR, Figure, Panel, Series, Stack

NAMES = ("alpha_m1", "alpha_1", "alpha_m2", "alpha_2")


def identify_alpha(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """alpha_m and alpha of charging and discharging from a campaign's fixed-piston strokes.

    Flow, volumes, friction and each stroke's delays and supply are fitted with them, under their priors.
    """
    strokes = plain_strokes(campaign)
    factors = {f"alpha.{name}": getattr(Parameters, name) for name in NAMES}
    entries = [entry for entry, _record in strokes]
    fitted, over_noise = fit_factors(campaign, entries, parameters, factors, progress=progress)
    identified = parameters.override({item.path: item.numbers[0] for item in fitted})
    entry, record = strokes[0]
    time_s = record.time_s - record.time_s[0]
    shown = simulate(identified, entry.conditions, time_s, internal=False)
    lines = []
    measured = pressures_from_rest(record, campaign.atmosphere_pa)
    for name, role, pressure in zip("12", ("series0", "series1"), measured, strict=True):
        lines.append(Series(f"P{name} measured", time_s[::10], BAR * pressure[::10], role, "dots"))
        predicted = BAR * shown.pressure_pa(name)[::10]
        lines.append(Series(f"P{name} fitted", time_s[::10], predicted, role))
    figure = Figure([Stack("time, s", [Panel("Pressures", "bar", lines, height=320)])])
    return Identified("alpha", fitted, (), figure, over_noise)
