"""Fit a model to healthy strokes of one unit: the baseline of its later diagnoses.

Exit 1: the model is not good enough to diagnose with; it is written all the same.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

from can_dbc.errors import InputError
from sil.cli.options import JSON, argument

EXAMPLE = "example: opc4 calibrate healthy/ --model data_sheet.toml --out mine.toml"

ARGUMENTS = (
    argument("campaign", "campaign folder of healthy strokes", "CAMPAIGN"),
    argument(
        "--model", "data sheet: model file or parameter set [nominal]", "MODEL", default="nominal"
    ),
    argument("--out", "model file to write; its page has the same name", "FILE.toml", type=Path),
    argument("--force", "replace FILE.toml"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; write the model file and its page; 1 if it is not good enough to diagnose with.

    Raises InputError for a campaign, a data sheet or an --out that is not valid.
    """
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite
    from sil.files.progress import Progress
    from sil.inference.calibrate.calibration import calibrate
    from sil.inference.calibrate.output import model_text, scalars, write_page

    out: Path | None = arguments.out
    if out is None or out.suffix != ".toml":
        raise InputError(f"--out {out or 'missing'}: expected the name of a .toml file to write")
    if out.exists() and not arguments.force:
        raise InputError(f"{out}: exists; expected a new file, or --force")
    if Path(arguments.campaign).is_file():
        what = "is a file; expected a campaign folder (logs of a truck are not calibrated)"
        raise InputError(f"{arguments.campaign}: {what}")
    campaign, parameters = load_campaign(arguments.campaign), load(arguments.model)
    with Progress(f"calibrating {campaign.name}", "iterations", at_once=True) as progress:
        result = calibrate(campaign, parameters, progress)
    page = out.with_suffix(".html")
    write_atomically(out, model_text(result))
    write_page(result, page, shlex.join(["opc4", *sys.argv[1:]]))
    if arguments.json:
        table = {
            "campaign": campaign.name,
            "good": result.good,
            "headline": result.headline,
            "channels": {
                name: {
                    "rms_over_noise": item.misfit.rms,
                    "noise": item.noise,
                    "discrepancy": item.discrepancy,
                    "correlation_time_s": item.time_s,
                }
                for name, item in result.channels.items()
            },
            "values": {
                path: {"value": v.value, "low": v.low, "high": v.high}
                for path, v in scalars(result).items()
            },
            "undetermined": list(result.undetermined),
            "missing": dict(result.missing),
            "findings": [str(item) for item in result.findings],
            "model": str(out),
            "page": str(page),
        }
        print(json.dumps(finite(table), ensure_ascii=False))
        return 0 if result.good else 1
    print(f"{campaign.name}: {result.headline}")
    print("residual over noise on strokes held out:")
    for name, channel in result.channels.items():
        print(f"  {name:22} {channel.misfit.rms:.2f}")
    for path, value in scalars(result).items():
        interval = f"[{value.low:.4g}, {value.high:.4g}]"
        print(f"  {path:26} {value.value:.4g} {interval} {parameters[path].unit}")
    if result.undetermined:
        print(f"  not determined, as the data sheet says: {', '.join(result.undetermined)}")
    for line in result.findings:
        print(f"  {line}")
    print(f"  written to {out} and {page}", file=sys.stderr)
    return 0 if result.good else 1
