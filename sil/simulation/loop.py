"""The closed loop in memory: run to an instant, saved, restored, run to the end."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from collections.abc import Mapping
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from can_dbc.errors import InputError
from can_dbc.user_file import parse_json, read_user_file
from plant.node import PlantNode
from plant.trace import trace_columns
from sil.coupling.bus import BusFrame
from sil.coupling.clock import to_ns
from sil.coupling.faults import FaultPlan
from sil.coupling.lockstep import Lockstep, RunSummary
from sil.coupling.transports.channel import InProcess
from sil.files.atomic import write_atomically
from sil.recording.run_record import PlantEvent, RunRecord
from sil.simulation import build
from sil.simulation.inputs import PACKAGES, program_hash
from sil.simulation.load_scenario import Loaded, from_table
from sil.simulation.scenario import expanded
from sil.simulation.state import State, Values

FORMAT = "opc4-state-2"


class _TraceRows(list[np.ndarray]):
    """The blocks of trace rows that the plant writes, each new."""

    write = list.append


class _Events(list[PlantEvent]):
    """The plant's events."""

    def note(self, time_s: float, name: str, values: Mapping[str, Any]) -> None:
        self.append(PlantEvent(time_s, name, dict(values)))


class Loop:
    """Plant, firmware, nodes and bus of a scenario, with all that was recorded. Raises InputError."""

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
        channel = InProcess(self.participants, build.received())
        end_ns, outages = to_ns(scenario.duration_s), self.plan if scenario.fault else None
        record, order = self.frames.extend, build.SENDERS
        self.lockstep = Lockstep(
            self.bus, [channel], end_ns, record=record, outages=outages, order=order
        )

    def advance(self, until_s: float) -> None:
        """Run up to an instant before the end. Raises RunError if a participant fails."""
        self.lockstep.advance(to_ns(until_s))

    def finish(self) -> RunSummary:
        """Run to the end and close the participants. Raises RunError if one fails."""
        with self.lockstep as lockstep:
            return lockstep.run()

    def record(self) -> RunRecord:
        """Return what was recorded so far."""
        rows, columns = np.concatenate(self.trace), trace_columns(self.loaded.scenario.plant.drive)
        return RunRecord(
            truth={name: np.ascontiguousarray(rows[:, i]) for i, name in enumerate(columns)},
            events=self.events,
            frames=self.frames,
            **build.constants(self.loaded),
        )

    @cached_property
    def _state(self) -> State:
        parts = (self.participants, self.plan, self.bus, self.lockstep)
        return State(*parts, self.trace, self.events, self.frames)

    def snapshot(self) -> Values:
        """Return the whole state; firmware in Python files has none that can be saved: TypeError."""
        return self._state.values()

    def restore(self, state: Values) -> None:
        """Continue from a state of this loop, or of another one of the same scenario."""
        self._state.restore(state)


class _Restricted(pickle.Unpickler):
    """Makes nothing but values: records of these packages, numpy's arrays, and containers."""

    def find_class(self, module: str, name: str) -> Any:
        package = module.partition(".")[0]
        found = super().find_class(module, name) if package in (*PACKAGES, "numpy") else None
        if isinstance(found, type):
            is_record = hasattr(found, "__dataclass_fields__") or issubclass(found, tuple | Enum)
            if is_record or issubclass(found, msgspec.Struct | np.ndarray | np.generic | np.dtype):
                return found
        if (name if package == "numpy" else f"{module}.{name}") in _MAKERS:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name}")


_MAKERS = (
    *("collections.deque", "collections.Counter", "collections.defaultdict"),
    *("builtins.int", "pathlib.PosixPath"),
    *("_reconstruct", "scalar", "_frombuffer"),  # of numpy
    *("_operator.or_", "_operator.getitem", "msgspec._utils.rebuild"),  # of flags and records
)


def save(loop: Loop, path: Path) -> None:
    """Write a state after a line that says what made it. Raises InputError for a firmware without."""
    try:
        state = pickle.dumps(loop.snapshot(), protocol=5)
    except TypeError:
        raise InputError(
            "firmware in a Python file runs in a process of its own; expected the shipped one, or C"
        ) from None
    head = {
        "format": FORMAT,
        "made_by": _made_by(loop.loaded),
        "sha256": hashlib.sha256(state).hexdigest(),
        "source": loop.loaded.source,
        "scenario": expanded(loop.loaded.scenario),
    }
    write_atomically(path, json.dumps(head).encode() + b"\n" + state)


def load(path: Path) -> Loop:
    """Return the loop of a file that `save` wrote. Raises InputError for any other."""
    expected = "a state that opc4 run --save-at wrote"
    line, _, state = read_user_file(path, expected, 1 << 30).partition(b"\n")
    try:
        head = parse_json(line)
        if head["format"] != FORMAT or head["sha256"] != hashlib.sha256(state).hexdigest():
            raise ValueError
        loaded = from_table(head["scenario"], head["source"])
        if head["made_by"] != _made_by(loaded):
            what = "made by another version of this program, of the model, or of the firmware"
            raise InputError(f"{path}: {what}; expected the same")
        loop = Loop(loaded)
        loop.restore(_Restricted(io.BytesIO(state)).load())
        return loop
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, pickle.UnpicklingError, AttributeError):
        raise InputError(f"{path}: damaged, or not a state; expected {expected}") from None


def _made_by(loaded: Loaded) -> dict[str, str]:
    firmware = Path(loaded.scenario.firmware)
    content = firmware.read_bytes() if firmware.is_file() else b""
    model = {path: loaded.parameters[path].value for path in loaded.parameters}
    return {
        "firmware_sha256": hashlib.sha256(content).hexdigest(),
        "model_sha256": hashlib.sha256(json.dumps(model).encode()).hexdigest(),
        "sources_sha256": program_hash(),
        "numpy": np.__version__,
    }
