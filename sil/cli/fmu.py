"""Export the plant or the firmware of a scenario as an FMI 3.0 co-simulation unit.

The unit runs in the Python of the importing tool, with opc4-sil installed there.

example: opc4 fmu plant actuator.fmu --scenario lab_n_b --set valve.D_fall=0.02
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from can_dbc.errors import InputError
from sil.cli.options import FIRMWARE, MODEL, SETTINGS, argument, say

ARGUMENTS = (
    argument("what", "side to export", choices=("plant", "controller")),
    argument("out", "file to write", "OUT.fmu", type=Path),
    argument(
        "--scenario", "scenario whose values are used [lab_n_b]", "SCENARIO", default="lab_n_b"
    ),
    argument("--force", "replace OUT.fmu"),
    *(FIRMWARE, MODEL, SETTINGS),
)


def run(arguments: argparse.Namespace) -> int:
    """Write the unit. Raises InputError for a file that cannot be written or a missing library."""
    from sil.files.extras import import_extra
    from sil.fmu.export import export
    from sil.simulation import load_scenario

    out: Path = arguments.out
    if out.suffix != ".fmu":
        raise InputError(f"{out}: not the name of a unit; expected OUT.fmu")
    if not out.parent.is_dir():
        raise InputError(f"{out}: no such folder; expected one that exists")
    if not os.access(out.parent, os.W_OK):
        raise InputError(f"{out}: not writable; expected a folder that takes files")
    if out.exists() and not arguments.force:
        raise InputError(f"{out}: exists; expected a new file, or --force")
    import_extra("pythonfmu3", "fmu", "opc4 fmu")
    model, settings = arguments.model, arguments.settings
    loaded = load_scenario.load(arguments.scenario, model=model, settings=settings)
    export(arguments.what, loaded, out)
    say(f"{out}: {arguments.what} of {loaded.scenario.name}, FMI 3.0 co-simulation")
    return 0
