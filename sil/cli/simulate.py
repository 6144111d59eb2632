"""Simulate the plant alone under each stroke's conditions and commands of a campaign.

example: opc4 simulate measured/ --out simulated/ --set friction_length.F_rf_p=60
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError
from sil.cli.options import EFFECTS, JSON, SETTINGS, argument, out, say
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.campaign.simulate import SimulatedStroke

ARGUMENTS = (
    argument("campaign", "campaign folder", "CAMPAIGN"),
    argument("--model", "parameter set or model file", "MODEL", default="nominal"),
    *(EFFECTS, SETTINGS, *out("runs/CAMPAIGN-simulated-N"), JSON),
)


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write the campaign folder, print one line a stroke. Raises InputError for bad input."""
    from can_dbc.user_file import resolved
    from plant.effects import overridden
    from plant.effects.user_file import load_effects
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign, misspelt_columns
    from sil.campaign.simulate import (
        campaign_folder,
        read_records,
        simulate_campaign,
        write_campaign,
    )
    from sil.files.output_folder import finite, prepare_folder
    from sil.files.overrides import model_settings
    from sil.files.progress import Progress

    campaign = load_campaign(arguments.campaign)
    stamps = [load_effects(file) for file in arguments.effects]
    parameters = load(arguments.model)
    parameters = overridden(parameters, model_settings(arguments.settings, parameters))
    if arguments.out is not None and resolved(arguments.out) == resolved(campaign.folder):
        what = "is the campaign that is simulated; expected another folder"
        raise InputError(f"{arguments.out}: --out: {what}")
    records = read_records(campaign)
    pairs = zip(campaign.strokes, records, strict=True)
    named = [(entry, record.columns) for entry, record in pairs if record is not None]
    for file, column, what in misspelt_columns(named):
        say(f"opc4 simulate: {campaign.folder / file}: {column}: {what}")
    folder = prepare_folder(arguments.out, f"{campaign.name}-simulated", arguments.force)
    campaign_folder(folder, arguments.force)
    rows: list[dict[str, Any]] = []

    def note(item: SimulatedStroke) -> None:
        balance = item.stroke.balance
        row: dict[str, Any] = {"file": item.entry.file, "label": item.entry.label}
        row |= {name: getattr(item, name) for name in ("arrival_s", "impact_speed_m_s", "rms")}
        row |= {"energy_residual_j": balance.energy_residual_j, "balances_closed": balance.closed}
        rows.append(row)
        progress(len(rows), len(campaign.strokes))
        if not arguments.json:
            deviations = "  ".join(shown(name, value) for name, value in item.rms.items())
            stop = f"stop at {1e3 * item.arrival_s:8.3f} ms of the record"
            stop += f"  impact {item.impact_speed_m_s:7.4f} m/s"
            stop = f"{'no stop':46}" if math.isnan(item.arrival_s) else stop
            line = f"{item.entry.file}  {item.entry.label:<24} {stop}"
            print(f"{line}  {deviations}" if deviations else line)

    with Progress(f"simulating {campaign.name}", "strokes") as progress:
        write_campaign(campaign, simulate_campaign(campaign, parameters, records), folder, note)
    if arguments.json:
        report = {"campaign": campaign.name, "out": str(folder), "effects": stamps, "strokes": rows}
        print(json.dumps(finite(report)))
    else:
        print(f"{counted(len(rows), 'stroke')} in {folder}", file=sys.stderr)
    return 0


def shown(name: str, value: float) -> str:
    """One deviation in the unit an engineer reads."""
    short = name.removesuffix("_pa").removesuffix("_m").replace("pressure_", "P_")
    is_pressure = name.endswith("_pa")
    return f"{short} {value / 1e5:.4f} bar" if is_pressure else f"{short} {value * 1e3:.4f} mm"
