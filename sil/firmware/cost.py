"""What the steps of a firmware in C or WebAssembly cost, as a record and as metrics of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from sil.files.atomic import write_atomically

COST = "firmware.json"
"""File in the folder of a run by which the control unit's process hands the record on."""


class Cost(msgspec.Struct, frozen=True):
    """Cost of all steps, of the plain build; instructions are those of WebAssembly."""

    steps: int
    mean_instructions: float
    max_instructions: int
    max_at_s: float
    """Time of the step that took most."""
    max_inputs: list[str]
    """Frames that this step was given, as identifier#data."""
    stack_bytes: int
    """Deepest use of the stack; what the compiler keeps in locals is not on it."""
    memory_bytes: int


METRICS = {
    "firmware_instructions": "instructions of the worst step",
    "firmware_stack_bytes": "stack of the firmware",
}


def write_cost(cost: Cost, folder: Path) -> None:
    """Write the record into the folder of a run."""
    write_atomically(folder / COST, json.dumps(msgspec.to_builtins(cost)))


def read_cost(folder: Path) -> Cost | None:
    """Take the record from the folder of a run; None if there is none."""
    path = folder / COST
    if not path.exists():
        return None
    cost = msgspec.json.decode(path.read_bytes(), type=Cost)
    path.unlink()
    return cost


def cost_metrics(cost: Cost | None) -> dict[str, Any]:
    """Return the metrics of a run: instructions of the worst step, and stack; none without a record."""
    if cost is None:
        return {}
    return dict(zip(METRICS, (cost.max_instructions, cost.stack_bytes), strict=True))
