"""The closed loop in memory: run to an instant, saved, restored, run to the end.

Checked by: tests/unit/sil/simulation/test_loop.py
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file
from plant.node import PlantNode
from sil.coupling.bus import BusFrame
from sil.coupling.clock import to_ns
from sil.coupling.faults import FaultPlan
from sil.coupling.lockstep import Lockstep, RunSummary
from sil.coupling.transports.channel import InProcess
from sil.files.atomic import write_atomically
from sil.files.extras import ROOT
from sil.recording.run_record import PlantEvent
from sil.simulation import build
from sil.simulation.load_scenario import Loaded

FORMAT = "opc4-state-1"
PACKAGES = ("can_dbc", "controller", "plant", "sil")


class _TraceRows(list[np.ndarray]):
    """The blocks of trace rows that the plant writes, each new."""

    write = list.append


class _Events(list[PlantEvent]):
    """The plant's events."""

    def note(self, time_s: float, name: str, values: Mapping[str, Any]) -> None:
        self.append(PlantEvent(time_s, name, dict(values)))


class Loop:
    """Plant, firmware, nodes and bus of a scenario, with all that was recorded up to an instant.

    Raises InputError if the scenario is not valid.
    """

    def __init__(self, loaded: Loaded) -> None:
        scenario = loaded.scenario
        self.loaded = loaded
        self.trace, self.events = _TraceRows(), _Events()
        self.frames: list[BusFrame] = []
        node = PlantNode(
            build.plant_config(scenario),
            loaded.parameters,
            self.trace,
            self.events.note,
            trace_rows_at_once=1 << 14,  # they are read only after the run
        )
        self.participants = [
            node if name == "plant" else build.make_participant(name, loaded, None)
            for name in build.participant_names(scenario)
        ]
        self.plan = FaultPlan(scenario.fault, scenario.seed)
        self.bus = build.make_bus(scenario, self.plan)
        self.lockstep = Lockstep(
            self.bus,
            [InProcess(self.participants, build.received())],
            to_ns(scenario.duration_s),
            record=self.frames.extend,
            outages=self.plan if scenario.fault else None,
            order=build.SENDERS,
        )

    def advance(self, until_s: float) -> None:
        """Run up to an instant before the end. Raises RunError if a participant fails."""
        self.lockstep.advance(to_ns(until_s))

    def finish(self) -> RunSummary:
        """Run to the end and close the participants. Raises RunError if one fails."""
        with self.lockstep as lockstep:
            return lockstep.run()

    def snapshot(self) -> bytes:
        """Return the whole state; firmware in Python files has none that can be saved: TypeError."""
        return pickle.dumps(self, protocol=5)

    @staticmethod
    def restore(state: bytes) -> Loop:
        """Return a loop that continues from a state of this process. Raises UnpicklingError for another."""
        loop = _Restricted(io.BytesIO(state)).load()
        if not isinstance(loop, Loop):
            raise pickle.UnpicklingError("no loop")
        return loop


class _Restricted(pickle.Unpickler):
    """Makes nothing but what a loop consists of: values and records of these packages and of numpy."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("builtins", "getattr"):  # of bound methods
            return _method
        package = module.partition(".")[0]
        others = ("builtins", "copyreg", "msgspec", "pathlib")
        if package in (*PACKAGES, *others, "numpy", "collections", "random", "functools"):
            found = super().find_class(module, name)
            pure = module.startswith(("plant.devices.", "sil.nodes.")) or package not in (
                *PACKAGES,
                *others,
            )
            makes = name in ("_reconstructor", "__newobj__", "rebuild")
            if isinstance(found, type) or pure or makes:
                return found
        if (module, name) in (("_operator", "getitem"), ("_operator", "or_")):  # of flags
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name}")


def _method(owner: Any, name: str) -> Any:
    if name.startswith("__"):
        raise pickle.UnpicklingError(name)
    return getattr(owner, name)


def save(loop: Loop, path: Path) -> None:
    """Write a state: one line of JSON that says what made it, then the state.

    Raises InputError for a firmware whose state cannot be saved.
    """
    try:
        state = loop.snapshot()
    except TypeError:
        raise InputError(
            "firmware in a Python file runs in a process of its own; expected the shipped one, or C"
        ) from None
    head = {"format": FORMAT, "made_by": _made_by(loop.loaded.scenario.firmware)}
    head["sha256"] = hashlib.sha256(state).hexdigest()
    write_atomically(path, json.dumps(head).encode() + b"\n" + state)


def load(path: Path) -> Loop:
    """Return the loop of a file that `save` wrote. Raises InputError for any other."""
    expected = "a state that opc4 run --save-at wrote"
    line, _, state = read_user_file(path, expected, 1 << 30).partition(b"\n")
    try:
        head = json.loads(line)
        if head["format"] != FORMAT or head["sha256"] != hashlib.sha256(state).hexdigest():
            raise ValueError
        if head["made_by"] != _made_by(head["made_by"]["firmware"]):
            what = "made by another version of this program, or of the firmware"
            raise InputError(f"{path}: {what}; expected the same")
        return Loop.restore(state)
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, pickle.UnpicklingError, AttributeError):
        raise InputError(f"{path}: damaged, or not a state; expected {expected}") from None


def _made_by(firmware: str) -> dict[str, str]:
    content = Path(firmware).read_bytes() if Path(firmware).is_file() else b""
    return {
        "firmware": firmware,
        "firmware_sha256": hashlib.sha256(content).hexdigest(),
        "sources_sha256": _sources(),
        "numpy": np.__version__,
    }


@cache
def _sources() -> str:
    """Return the digest of all source files."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()
