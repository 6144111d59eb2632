"""Start a firmware of your own from a draft, or check one: compile it, run a shift, say what it costs.

example:
  opc4 firmware --new own.c
  opc4 firmware --check own.c
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from can_dbc.errors import InputError
from sil.cli.options import JSON, NEW, argument, write_draft

if TYPE_CHECKING:
    from sil.simulation.in_memory import Run

ARGUMENTS = (
    NEW,
    argument("--check", "compile FILE with all warnings, run the shift of lab_n_b", "FILE"),
    argument("--force", "replace FILE"),
    JSON,
)


def run(arguments: argparse.Namespace) -> int:
    """Write a draft, or check a firmware: 1 if its gear is not reached. Raises InputError and RunError."""
    if arguments.new is not None:
        if arguments.new.suffix == ".c":
            from sil.files.atomic import write_atomically
            from sil.firmware.contract import header

            write_atomically(arguments.new.with_name("opc4.h"), header())
        return write_draft("firmware", arguments, f"opc4 firmware --check {arguments.new}")
    if arguments.check is None:
        raise InputError("nothing to do; expected --new FILE or --check FILE")
    return _check(arguments.check, arguments.json)


def _check(firmware: str, as_json: bool) -> int:
    import msgspec

    from sil.simulation.in_memory import run_in_memory
    from sil.simulation.load_scenario import load

    if firmware.endswith(".c"):
        from sil.firmware.compiler import compiled

        compiled(Path(firmware), options=("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion"))
    result = run_in_memory(load("lab_n_b", settings={"firmware": firmware}))
    shift = result.shifts[-1]
    reached = shift.confirmed_s is not None
    if as_json:
        cost = msgspec.to_builtins(result.firmware)
        print(json.dumps({"file": firmware, "gear_confirmed": reached, "cost": cost}))
    else:
        how = "not confirmed"
        if reached and shift.shift_time_s is not None:
            how = f"in {1e3 * shift.shift_time_s:.0f} ms"
        print(f"{firmware}: {shift.from_gear} to {shift.to_gear} {how}")
        print("\n".join(_cost_lines(result)))
    return 0 if reached else 1


def _cost_lines(result: Run) -> list[str]:
    from sil.firmware.compiler import STACK_BYTES

    cost = result.firmware
    if cost is None:
        return ["  a firmware in Python: no cost is counted"]
    return [
        f"  {cost.steps} steps without a finding",
        f"  instructions of a step: {cost.mean_instructions:.0f} on average, "
        f"at most {cost.max_instructions} (at {cost.max_at_s:.3f} s, {len(cost.max_inputs)} frames)",
        f"  stack {cost.stack_bytes} of {STACK_BYTES} bytes, memory {cost.memory_bytes} bytes",
    ]
