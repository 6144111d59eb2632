"""Simulate the plant alone under each stroke's conditions and commands of a campaign."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

EXAMPLE = "example: opc4 simulate measured/ --out simulated/ --set friction_length.F_rf_p=60"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("campaign", metavar="CAMPAIGN", help="campaign folder")
    parser.add_argument("--model", default="nominal", help="parameter set or model file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="change a model value"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write")
    parser.add_argument("--force", action="store_true", help="replace a campaign in DIR")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write the campaign folder, print one line a stroke."""
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.campaign.simulate import campaign_folder, simulate_campaign, write_campaign
    from sil.files.output_folder import finite, prepare_folder
    from sil.files.overrides import model_settings
    from sil.files.progress import Progress

    campaign = load_campaign(arguments.campaign)
    parameters = load(arguments.model)
    parameters = parameters.override(model_settings(arguments.set))
    folder = prepare_folder(arguments.out, f"{campaign.name}-simulated", arguments.force)
    campaign_folder(folder, arguments.force)
    rows = []

    def note(item) -> None:  # type: ignore[no-untyped-def]
        rows.append(
            {
                "file": item.entry.file,
                "label": item.entry.label,
                "arrival_s": item.arrival_s,
                "impact_speed_m_s": item.impact_speed_m_s,
                "rms": item.rms,
                "energy_residual_j": item.stroke.balance.energy_residual_j,
                "balances_closed": item.stroke.balance.closed,
            }
        )
        progress(len(rows), len(campaign.strokes))
        if not arguments.json:
            deviations = "  ".join(shown(name, value) for name, value in item.rms.items())
            print(
                f"{item.entry.file}  {item.entry.label:<24} "
                f"arrival {1e3 * item.arrival_s:8.3f} ms  "
                f"impact {item.impact_speed_m_s:7.4f} m/s  {deviations}"
            )

    with Progress(f"simulating {campaign.name}", "strokes") as progress:
        write_campaign(campaign, simulate_campaign(campaign, parameters), folder, note)
    if arguments.json:
        print(json.dumps(finite({"campaign": campaign.name, "out": str(folder), "strokes": rows})))
    else:
        print(f"{len(rows)} strokes in {folder}", file=sys.stderr)
    return 0


def shown(name: str, value: float) -> str:
    """One deviation in the unit an engineer reads."""
    short = name.removesuffix("_pa").removesuffix("_m").replace("pressure_", "P_")
    if name.endswith("_pa"):
        return f"{short} {value / 1e5:.4f} bar"
    return f"{short} {value * 1e3:.4f} mm"
