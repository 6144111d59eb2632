"""Oil damper: outlets and effective bulk modulus from damper strokes (thesis 3.2).

The thesis set them by hand so that the position follows; here whole records are fitted, healthy
scatter included.
"""

from __future__ import annotations

from can_dbc.errors import InputError
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.campaign.campaign import Campaign
from sil.inference.fit import Show, no_progress
from sil.inference.identify.campaign_fit import fit_factors
from sil.inference.identify.estimate import Identified
from sil.report.figure import BAR, Figure, Panel, Series, Stack


def identify_damper(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Outlets and bulk modulus from a campaign's strokes with the compressible damper.

    Raises InputError if there is no such stroke.
    """
    strokes = []
    for entry in campaign.strokes:
        c = entry.conditions
        if c.kind != "fixed" or c.load != "damper" or c.damper_model != "compressible":
            continue
        record = campaign.record(entry)
        if "position_m" in record and "pressure_oil2_pa" in record:
            strokes.append((entry, record))
    if not strokes:
        raise InputError(
            f"{campaign.folder}: no stroke of the fixed piston with damper, position_m and "
            "pressure_oil2_pa; expected at least one"
        )
    factors = {
        "damper.A_S": Parameters.a_small,
        "damper.A_B0": Parameters.a_large,
        "damper.kappa_effective": Parameters.kappa,
    }
    entries = [entry for entry, _record in strokes]
    fitted, over_noise = fit_factors(campaign, entries, parameters, factors, progress=progress)
    found = parameters.override({item.path: item.numbers[0] for item in fitted})
    entry, record = strokes[0]
    time_s = record.time_s - record.time_s[0]
    shown = simulate(found, entry.conditions, time_s, internal=False)
    lines = [
        Series("measured", time_s, BAR * record["pressure_oil2_pa"], "measured", "dots"),
        Series("fitted", time_s, BAR * shown.pressure_pa("oil2"), "after"),
    ]
    figure = Figure([Stack("time, s", [Panel("Oil pressure", "bar", lines, height=320)])])
    return Identified("damper", fitted, (), figure, over_noise)
