"""Writes a co-simulation unit (FMI 3.0) of the plant or of the firmware."""

from __future__ import annotations

import json
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import Any

from sil.files.atomic import write_atomically
from sil.firmware.load import in_module
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import expanded


def export(what: str, loaded: Loaded, out: Path) -> None:
    """Write the unit of one side of a scenario to `out`; a firmware in C goes along as a module.

    The same scenario and module give the same instantiation token. Raises ModuleNotFoundError without
    pythonfmu3, InputError for a firmware that is none.
    """
    from pythonfmu3 import FmuBuilder

    settings: dict[str, Any] = {"scenario": expanded(loaded.scenario)}
    module = b""
    if what == "controller" and in_module(loaded.scenario.firmware):
        from sil.firmware.c_firmware import modules

        module = modules(Path(loaded.scenario.firmware))[-1].content
        settings["scenario"]["firmware"] = "firmware.wasm"
    text = json.dumps(settings, sort_keys=True)
    settings["token"] = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{what} {text}{module.hex()}"))
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / f"{what}_fmu.py"
        shutil.copy2(Path(__file__).parent / script.name, script)
        resource = Path(folder) / "settings.json"
        resource.write_text(json.dumps(settings, sort_keys=True))
        resources = [resource]
        if module:
            resources.append(Path(folder) / settings["scenario"]["firmware"])
            resources[-1].write_bytes(module)
        built = FmuBuilder.build_FMU(script, Path(folder) / "built", resources)
        write_atomically(out, Path(built).read_bytes())
