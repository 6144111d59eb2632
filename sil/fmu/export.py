"""Writes a co-simulation unit (FMI 3.0) of the plant or of the firmware.

Checked by: tests/unit/sil/fmu/test_export.py
"""

from __future__ import annotations

import json
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import Any

from sil.files.atomic import write_atomically
from sil.simulation.load_scenario import Loaded
from sil.simulation.scenario import expanded


def export(what: str, loaded: Loaded, out: Path) -> None:
    """Write the unit of one side of a scenario to `out`.

    The same scenario gives the same instantiation token; the file's dates differ.
    Raises ModuleNotFoundError without pythonfmu3.
    """
    from pythonfmu3 import FmuBuilder

    settings: dict[str, Any] = {"scenario": expanded(loaded.scenario)}
    text = json.dumps(settings, sort_keys=True)
    settings["token"] = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{what} {text}"))
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / f"{what}_fmu.py"
        shutil.copy2(Path(__file__).parent / script.name, script)
        resource = Path(folder) / "settings.json"
        resource.write_text(json.dumps(settings, sort_keys=True))
        built = FmuBuilder.build_FMU(script, Path(folder) / "built", [resource])
        write_atomically(out, Path(built).read_bytes())
