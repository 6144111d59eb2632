"""Measured against simulated: what is wrong, why, an extended model, and what it gains."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from sil.cli.options import EFFECTS, JSON, argument, out

EXAMPLE = "example: opc4 diagnose measured/ --out diagnosis/"


ARGUMENTS = (
    argument("campaign", "campaign folder", "CAMPAIGN"),
    argument(
        "--model", "parameter set or model file questioned", default="nominal", metavar="MODEL"
    ),
    EFFECTS,
    *out("runs/CAMPAIGN-diagnosis-N"),
    argument("--workers", "processes (default 2)", "N", type=int, default=2),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; write diagnosis.json, extended_model.toml, report.html; 1 if not consistent."""
    from plant.effects.user_file import load_effects
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.diagnosis.diagnosis import diagnose
    from sil.diagnosis.force_rig import is_force_rig
    from sil.diagnosis.report import write_report
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite
    from sil.files.progress import Progress

    stamps = [load_effects(file) for file in arguments.effects]
    if is_force_rig(arguments.campaign):
        return run_force(arguments)
    campaign = load_campaign(arguments.campaign)
    parameters = load(arguments.model)
    folder = free_folder(arguments, campaign.name)

    with Progress(f"diagnosing {campaign.name}", "%") as progress:
        result = diagnose(
            campaign, parameters, workers=max(1, arguments.workers), progress=progress
        )
    if result.extended is not None:
        write_atomically(folder / "extended_model.toml", result.extended)
    beyond = write_report(result, folder, arguments.campaign, arguments.model)
    plain = finite(result.as_json() | beyond | {"effects": stamps})
    text = json.dumps(plain, indent=1, ensure_ascii=False)
    write_atomically(folder / "diagnosis.json", text + "\n")
    if arguments.json:
        print(json.dumps(plain, ensure_ascii=False))
    else:
        print(f"{campaign.name}: {result.verdict.kind}")
        for cause in result.causes:
            print(f"  {cause.probability:.2f} {cause.id} ({cause.cause_class}): {cause.evidence}")
        print(f"  written to {folder}", file=sys.stderr)
    return 0 if result.verdict.kind == "consistent" else 1


def free_folder(arguments: argparse.Namespace, name: str) -> Path:
    """Return the folder to write; InputError if it holds another diagnosis and --force is missing."""
    from sil.files.output_folder import prepare_folder

    return prepare_folder(arguments.out, f"{name}-diagnosis", arguments.force)


def run_force(arguments: argparse.Namespace) -> int:
    """Diagnose a rig known by driving force and position alone; 1 if not consistent."""
    from sil.diagnosis.force_page import write_page
    from sil.diagnosis.force_rig import diagnose_force
    from sil.files.atomic import write_atomically
    from sil.files.output_folder import finite

    found = diagnose_force(arguments.campaign)
    folder = free_folder(arguments, found.name)
    plain = finite(found.as_json())
    text = json.dumps(plain, indent=1, ensure_ascii=False)
    write_atomically(folder / "diagnosis.json", text + "\n")
    write_page(found, folder, arguments.campaign)
    if arguments.json:
        print(json.dumps(plain, ensure_ascii=False))
    else:
        print(f"{found.name}: {plain['verdict']}")
        for cause in plain["causes"]:
            print(
                f"  {cause['probability']:.2f} {cause['id']} ({cause['class']}): {cause['evidence']}"
            )
        for key, item in plain["body"].items():
            print(
                f"  {key} {item['value']:.4g} {item['unit']} [{item['low']:.4g}, {item['high']:.4g}]"
            )
        for line in plain["findings"]:
            print(f"  {line}")
        print(f"  written to {folder}", file=sys.stderr)
    return 0 if plain["verdict"] == "consistent" else 1
