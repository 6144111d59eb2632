"""Identify flow maps, friction, process exponents or the oil damper from a campaign.

example: opc4 identify friction measured/ --out friction/
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from sil.cli.options import JSON, argument, out

ARGUMENTS = (
    argument(
        "what",
        "flow, friction, alpha, damper",
        "WHAT",
        choices=("flow", "friction", "alpha", "damper"),
    ),
    argument("campaign", "campaign folder", "CAMPAIGN"),
    argument("--model", "parameter set or model file", "MODEL", default="nominal"),
    *out("runs/CAMPAIGN-WHAT-N"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Identify; write the model file and a picture; print the values; 1 if the model does not fit."""
    from plant.parameters import load_actuator
    from sil.campaign.campaign import load_campaign
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite, prepare_folder
    from sil.files.progress import Progress
    from sil.inference.identify.estimate import model_of
    from sil.inference.identify.flow import identify_flow
    from sil.inference.identify.whole_record import identify_records
    from sil.report.picture import save

    parameters = load_actuator(arguments.model)
    campaign = load_campaign(arguments.campaign)
    name = f"{campaign.name}-{arguments.what}"
    folder = prepare_folder(arguments.out, name, arguments.force)
    with Progress(f"identifying {arguments.what}", "steps") as progress:
        if arguments.what == "flow":
            result = identify_flow(campaign, parameters, progress)
        else:
            result = identify_records(arguments.what, campaign, parameters, progress)
    write_atomically(folder / "model.toml", model_of(result, parameters))
    save(result.figure, folder, arguments.what)
    if arguments.json:
        table = {
            "what": result.what,
            "out": str(folder),
            "estimates": [asdict(item) for item in result.estimates],
            "notes": list(result.notes),
            "fits": result.fits,
            "over_noise": result.over_noise,
        }
        print(json.dumps(finite(table)))
        return 0 if result.fits else 1
    for item in result.estimates:
        if isinstance(item.value, tuple):
            shown = "[" + ", ".join(f"{v:.4g}" for v in item.value) + "]"
        else:
            shown = f"{item.value:.5g}"
            if item.low is not None and item.high is not None:
                shown += f"  ({item.low:.5g} to {item.high:.5g})"
        print(f"{item.path:24} {shown} {parameters[item.path].unit}")
    for line in (*result.notes, result.judgement):
        print(line)
    print(f"model file and picture in {folder}")
    return 0 if result.fits else 1
