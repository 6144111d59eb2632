"""Fit a model to healthy strokes of one unit, or to the shifts in a healthy truck's logs: the baseline of its later diagnoses.

Exit 1: the model is not good enough to diagnose with; it is written all the same.

example:
  opc4 calibrate healthy/ --model data_sheet.toml --out mine.toml
  opc4 calibrate monday.asc tuesday.asc --out truck.toml
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.errors import InputError
from sil.cli.options import JSON, LAYOUT, argument
from sil.files.progress import Progress
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.inference.calibrate.calibration import Calibration
    from sil.report.figure import Figure


ARGUMENTS = (
    argument(
        "campaign",
        "campaign folder of healthy strokes, or CAN logs of a healthy truck",
        "CAMPAIGN",
        nargs="+",
    ),
    argument(
        "--model", "data sheet: model file or parameter set [nominal]", "MODEL", default="nominal"
    ),
    argument("--out", "model file to write; its page has the same name", "FILE.toml", type=Path),
    *LAYOUT,
    argument("--force", "replace FILE.toml"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; write model file and page; 1 if it is not good enough. Raises InputError."""
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite
    from sil.inference.calibrate.output import model_text, write_page

    out: Path | None = arguments.out
    if out is None or out.suffix != ".toml":
        raise InputError(f"--out {out or 'missing'}: expected the name of a .toml file to write")
    if out.exists() and not arguments.force:
        raise InputError(f"{out}: exists; expected a new file, or --force")
    for item in map(Path, arguments.campaign):
        if item.suffix == ".toml" and item.is_file():
            raise InputError(f"{item}: is a .toml file; expected a campaign folder, or CAN logs")
    if Path(arguments.campaign[0]).is_file():
        result, figure = _of_logs(arguments)
    else:
        result, figure = _of_campaign(arguments)
    page = out.with_suffix(".html")
    write_atomically(out, model_text(result))
    write_page(result, figure, page, shlex.join(["opc4", *sys.argv[1:]]))
    if arguments.json:
        keys = ("rms_over_noise", "noise", "discrepancy", "correlation_time_s")
        table = {
            "campaign": result.name,
            "good": result.good,
            "headline": result.headline,
            "channels": {
                name: dict(zip(keys, (x.misfit.rms, x.noise, x.discrepancy, x.time_s), strict=True))
                for name, x in result.channels.items()
            },
            "values": {
                path: {"value": v.value, "low": v.low, "high": v.high}
                for path, v in result.scalars.items()
            },
            "undetermined": list(result.undetermined),
            "missing": dict(result.missing or {}),
            "findings": list(result.findings),
            "model": str(out),
            "page": str(page),
        }
        print(json.dumps(finite(table), ensure_ascii=False))
        return 0 if result.good else 1
    print(f"{result.name}: {result.headline}")
    print(f"residual over noise on {result.content.split()[1]} held out:")
    for name, channel in result.channels.items():
        print(f"  {name:22} {channel.misfit.rms:.2f}")
    for path, value in result.scalars.items():
        interval = f"[{value.low:.4g}, {value.high:.4g}]"
        print(f"  {path:26} {value.value:.4g} {interval} {result.parameters[path].unit}")
    if result.undetermined:
        print(f"  not determined, as the data sheet says: {', '.join(result.undetermined)}")
    for line in result.findings:
        print(f"  {line}")
    print(f"  written to {out} and {page}", file=sys.stderr)
    return 0 if result.good else 1


def _of_campaign(arguments: argparse.Namespace) -> tuple[Calibration, Figure]:
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.inference.calibrate.calibration import calibrate
    from sil.inference.calibrate.output import strokes_figure

    folder, *others = arguments.campaign
    if others:
        raise InputError(f"{others[0]}: a second campaign; expected one, or CAN logs only")
    if arguments.map or arguments.dbc:
        raise InputError("--map, --dbc: not together with a campaign; expected CAN logs")
    campaign, parameters = load_campaign(folder), load(arguments.model)
    with Progress(f"calibrating {campaign.name}", "iterations", at_once=True) as progress:
        result = calibrate(campaign, parameters, progress)
    return result, strokes_figure(result)


def _of_logs(arguments: argparse.Namespace) -> tuple[Calibration, Figure]:
    from plant.parameters import load_actuator
    from sil.inference.calibrate.logs import calibrate_truck, shifts_figure
    from sil.inference.truck.diagnosis import shifts_of_truck
    from sil.log_replay.recorded_shifts import BETWEEN_GEARS

    logs: list[str] = arguments.campaign
    name = Path(logs[0]).name + (f" and {len(logs) - 1} more" if logs[1:] else "")
    parameters, skipped = load_actuator(arguments.model), Counter[str]()
    layout = arguments.map, arguments.dbc
    with Progress(f"calibrating {name}", "%", at_once=True) as progress:
        shifts, broken = shifts_of_truck(logs, parameters, layout, skipped)
        if astray := skipped[BETWEEN_GEARS]:
            what = f"{counted(astray, 'shift')} {BETWEEN_GEARS}"
            raise InputError(f"{name}: {what}; expected the logs of a healthy truck")
        result = calibrate_truck(shifts, parameters, name, progress, workers=2)
    skips = [f"{counted(n, 'shift')} {why} left out" for why, n in skipped.items()]
    return replace(result, findings=(*skips, *broken)), shifts_figure(result)
