"""What the scripts inside the exported units share: settings, variables, a safe exit."""

from __future__ import annotations

import ctypes
import json
import sys
from pathlib import Path
from typing import Any

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability

from sil.simulation.load_scenario import Loaded, from_table


def prepare(slave: Fmi3Slave) -> Loaded:
    """Return the scenario that a unit was exported from, and declare its token and time. Raises InputError."""
    resources = Path(str(slave.resources))
    release_static_state(str(resources), type(slave).__name__)
    settings = json.loads((resources / "settings.json").read_text())
    slave.guid = settings["token"]
    slave.time = 0.0
    kind = {"causality": Fmi3Causality.independent, "variability": Fmi3Variability.continuous}
    slave.register_variable(Float64("time", **kind))
    return from_table(settings["scenario"], "settings.json", folder=resources)


def declare(
    slave: Fmi3Slave,
    kind: type,
    start: dict[str, Any],
    *,
    output: bool,
    continuous: bool = False,
    descriptions: dict[str, str] | None = None,
    units: dict[str, str] | None = None,
) -> None:
    """Register inputs or outputs of one kind (Float64, Int32), with their values at the start."""
    variability = Fmi3Variability.continuous if continuous else Fmi3Variability.discrete
    options: dict[str, Any] = {"causality": Fmi3Causality.input}
    if output:
        options = {"causality": Fmi3Causality.output, "initial": Fmi3Initial.calculated}
    for name, value in start.items():
        setattr(slave, name, value)
        details = dict(options)
        if descriptions:
            details["description"] = descriptions[name]
        if units:
            details["unit"] = units[name]
        slave.register_variable(kind(name, variability=variability, **details))


def release_static_state(resources: str, class_name: str) -> bool:
    """Empty the static pointer of a unit's library, found from its resources; return whether that was done.

    pythonfmu3 (0.3 and before) releases a static `std::shared_ptr` to the interpreter's state twice at
    exit, after which glibc may abort (exit code 134). The library exports the function that empties it
    before. In programs that are not Python it stays, because it ends the interpreter there.
    """
    if not sys.orig_argv:
        return False
    for library in (Path(resources).parent / "binaries").glob(f"*/{class_name}.*"):
        try:
            release = ctypes.CDLL(str(library)).finalizePythonInterpreter
        except (OSError, AttributeError):  # of another platform, or of a pythonfmu3 without it
            continue
        release()
        return True
    return False
