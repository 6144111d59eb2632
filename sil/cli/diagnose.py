"""Compare measured with simulated motion: name the cause of a difference, write an extended model.

Exit 1: the verdict is not `consistent`.

example:
  opc4 diagnose measured/ --out diagnosis/
  opc4 diagnose measured/ --next --out first/      then measure first/next/, and
  opc4 diagnose measured/ first/next/ --out second/
  opc4 diagnose truck-monday.asc truck-tuesday.asc --out truck-diagnosis/
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError
from sil.cli.options import EFFECTS, JSON, LAYOUT, argument, out
from sil.files.atomic import write_atomically
from sil.files.output_folder import finite, locked_folder, prepare_folder, without_parent_steps
from sil.files.progress import Progress

ARGUMENTS = (
    argument(
        "campaign",
        "campaign folders of one unit, or CAN logs of one truck; with --new, measured files",
        "CAMPAIGN",
        nargs="+",
    ),
    argument(
        "--new",
        "draft a campaign of the files in this folder: columns, units, picture, open questions",
        "DIR",
        type=Path,
    ),
    argument(
        "--rig",
        "with --new: what was measured: strokes of this actuator, of its fixed piston, of a cylinder of "
        "your own, or force and position of anything",
        choices=("actuator", "fixed", "cylinder", "force"),
    ),
    argument("--next", "also write OUT/next/campaign.toml: the strokes to measure next"),
    argument(
        "--model",
        "parameter set or model file to compare with [nominal]",
        default="nominal",
        metavar="MODEL",
    ),
    EFFECTS,
    *LAYOUT,
    *out("runs/CAMPAIGN-diagnosis-N"),
    argument("--workers", "processes (default 2)", "N", type=int, default=2),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; write verdict, extended model and page; 1 if not consistent. Raises InputError."""
    if arguments.workers < 1:
        raise InputError(f"--workers {arguments.workers}: expected 1 or more")
    if arguments.new is not None:
        return new_campaign(arguments)
    if arguments.rig is not None:
        raise InputError("--rig: without --new; expected it where a campaign is drafted")
    for item in arguments.campaign:
        if not Path(item).exists():
            raise InputError(f"{item}: does not exist; expected a campaign folder or CAN logs")
    paths = [Path(item) for item in arguments.campaign]
    of_truck = all(path.is_file() and path.suffix != ".toml" for path in paths)
    if of_truck:
        _refuse(arguments, ["next"], "not with CAN logs; expected a campaign folder")
    else:
        _refuse(arguments, ["map", "dbc"], "not together with a campaign; expected CAN logs")
    from plant.effects.user_file import load_effects

    # before the modules that list what the catalogue holds
    stamps = [load_effects(file) for file in arguments.effects]
    return run_logs(arguments, stamps) if of_truck else run_campaigns(arguments, stamps)


def _refuse(arguments: argparse.Namespace, options: Sequence[str], why: str) -> None:
    """Raise InputError if one of the options is given."""
    for option in options:
        if getattr(arguments, option) not in (None, False, [], "nominal"):
            raise InputError(f"--{option}: {why}")


def run_campaigns(arguments: argparse.Namespace, stamps: list[str]) -> int:
    """Diagnose a unit by its campaigns; 1 if not consistent. Raises InputError if they do not go together."""
    from plant.parameters import load
    from sil.campaign.campaign import joined, load_campaign
    from sil.inference.campaign.diagnosis import diagnose
    from sil.inference.campaign.page import write_next, write_report
    from sil.inference.force.record import is_force_rig

    folders: list[str] = arguments.campaign
    for item in folders:
        if is_force_rig(item):
            if len(folders) > 1:
                raise InputError(f'{item}: rig = "force" among other campaigns; expected it alone')
            _refuse(arguments, ["model", "next"], 'not together with rig = "force"; expected none')
            return run_force(arguments, item, stamps)
    campaign = joined([load_campaign(item) for item in folders])
    parameters = load(arguments.model)
    if arguments.next and arguments.out is not None:
        for path in sorted((arguments.out / "next").glob("*.csv"))[:1]:
            raise InputError(f"{path.parent}: holds {path.name}; expected another --out")
    folder = prepare_folder(arguments.out, f"{campaign.name}-diagnosis", arguments.force)
    workers, plan = arguments.workers, arguments.next
    with Progress(f"diagnosing {campaign.name}", "%", at_once=True) as progress:
        result = diagnose(campaign, parameters, workers=workers, progress=progress, plan=plan)
    if result.extended is not None:
        write_atomically(folder / "extended_model.toml", result.extended)
    again = f"{shlex.join(folders)} --model {arguments.model}{' --next' if arguments.next else ''}"
    beyond = write_report(result, folder, again, workers)
    values = finite(result.as_json() | beyond | {"effects": stamps})
    if arguments.next:
        values["next_campaign"] = write_next(result, folder)
    return _finish(arguments, folder, values)


def new_campaign(arguments: argparse.Namespace) -> int:
    """Draft a campaign from measured files; print what they do not say. Raises InputError for bad files."""
    from sil.inference.campaign.new_campaign import draft

    others = ("out", "map", "dbc", "model", "effects", "next")
    _refuse(arguments, others, "not together with --new, which only drafts a campaign")
    target: Path = arguments.new / "campaign.toml"
    if target.exists() and not arguments.force:
        raise InputError(f"{target}: exists; expected a new folder, or --force to draft it anew")
    path = without_parent_steps(arguments.new)
    new_folders = [each for each in (path, *path.parents) if not each.exists()]
    with locked_folder(path, "--new") as folder:
        try:
            files = [Path(file) for file in arguments.campaign]
            columns, asked = draft(folder, files, arguments.rig, arguments.force)
        except BaseException:
            with contextlib.suppress(OSError):  # what another program has put there stays
                for each in new_folders:
                    each.rmdir()
            raise
    if arguments.json:
        values = {"campaign": str(folder), "columns": columns, "questions": asked}
        print(json.dumps(values, ensure_ascii=False))
        return 0
    print(f"{folder / 'campaign.toml'}: a draft; channels.png shows what is in the files")
    print("columns: as named, unit as written, taken for", *columns, sep="\n  ")
    print("open:", *asked, sep="\n  ")
    model = " --model CYLINDER.toml" if arguments.rig == "cylinder" else ""
    print(f'answer every "?" in it, then: opc4 diagnose {folder}{model}')
    return 0


def run_force(arguments: argparse.Namespace, campaign: str, stamps: list[str]) -> int:
    """Diagnose a rig known by driving force and position alone; 1 if not consistent."""
    from sil.inference.force.diagnosis import diagnose_motion
    from sil.inference.force.page import write_page
    from sil.inference.force.record import read_motion

    record = read_motion(campaign)
    folder = prepare_folder(arguments.out, f"{record.name}-diagnosis", arguments.force)
    found = diagnose_motion(record)
    write_page(found, folder, campaign)
    return _finish(arguments, folder, finite(found.as_json() | {"effects": stamps}))


def run_logs(arguments: argparse.Namespace, stamps: list[str]) -> int:
    """Diagnose a truck by the shifts in its logs; 1 if not consistent. Raises InputError for unusable logs."""
    from plant.parameters import load_actuator
    from sil.inference.truck.diagnosis import judge, shifts_of_truck
    from sil.inference.truck.page import as_json, write_files
    from sil.log_replay.recorded_shifts import BETWEEN_GEARS

    name = Path(arguments.campaign[0]).name.split(".")[0]
    logs, skipped = arguments.campaign, Counter[str]()
    parameters = load_actuator(arguments.model)
    layout, workers = (arguments.map, arguments.dbc), arguments.workers
    folder = prepare_folder(arguments.out, f"{name}-diagnosis", arguments.force, inputs=logs)
    with Progress(f"diagnosing {name}", "%", at_once=True) as progress:
        shifts, broken = shifts_of_truck(logs, parameters, layout, skipped)
        astray = skipped.pop(BETWEEN_GEARS, 0)
        result = judge(shifts, parameters, broken, progress, workers, astray)
    values = finite(as_json(result, logs, dict(skipped)) | {"effects": stamps})
    write_files(result, values, folder, arguments.model, shlex.join(["opc4", *sys.argv[1:]]))
    return _finish(arguments, folder, values)


def _finish(arguments: argparse.Namespace, folder: Path, found: dict[str, Any]) -> int:
    """Write diagnosis.json, print, and return the exit code."""
    text = json.dumps(found, indent=1, ensure_ascii=False)
    write_atomically(folder / "diagnosis.json", text + "\n")
    if arguments.json:
        print(json.dumps(found, ensure_ascii=False))
    else:
        print_causes(found)
        for key, item in found.get("body", {}).items():
            limits = f"[{item['low']:.4g}, {item['high']:.4g}]"
            print(f"  {key} {item['value']:.4g} {item['unit']} {limits}")
        for line in found["findings"]:
            print(f"  {line}")
        if arguments.next:
            _print_next(found)
        print(f"  written to {folder}", file=sys.stderr)
    return 0 if found["verdict"] == "consistent" else 1


def print_causes(found: dict[str, Any]) -> None:
    """Print what is wrong, how sure that is, what it explains and what to do next."""
    from sil.inference.thresholds import UNNAMED

    print(f"{found['campaign']}: {found['verdict']}")
    print(f"  {found.get('headline') or found['verdict']}")
    for cause in found["causes"]:
        share = cause["probability"]
        sure = "above 0.99" if share > 0.99 else f"{share:.2f}"
        print(f"  probability of {cause['id']} ({cause['class']}): {sure}")
    if "explains" in found:
        what = "Explains" if " from " in found["explains"] else "Residual"
        print(f"  {what}: {found['explains']}, on strokes that were not used for the fit")
    advice = {
        UNNAMED: "look at the largest residuals in report.html; an effect of your own can describe it",
        "named": "run the control loop with extended_model.toml to see what it changes",
    }
    following = found.get("next_experiment")
    if following is not None:
        print(f"  Next: measure {following['strokes'][0]['label']}; --next writes the strokes")
    elif found["verdict"] == UNNAMED or (found["verdict"] == "named" and found["extended_model"]):
        print(f"  Next: {advice[found['verdict']]}")


def _print_next(found: dict[str, Any]) -> None:
    """Print the strokes to measure next, alike ones once."""
    following = found["next_experiment"]
    if following is None:
        groups = "; ".join(" or ".join(group) for group in found["rivals"])
        what = f"whether {groups} acts" if groups else "more than these do"
        print(f"  next: no stroke of this rig is expected to tell {what}")
        return
    print(f"  next: {following['why']}")
    strokes = following["strokes"]
    for label, count in Counter(stroke["label"] for stroke in strokes).items():
        print(f"    {count} x {label}")
    print(f"    written to {found['next_campaign']}")
