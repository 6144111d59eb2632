"""Bugs in the firmware in C, for what is to find them: ten known kinds, and mutants that a seed draws."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sil.firmware.contract import header
from sil.firmware.load import SHIPPED_IN_C

MUTANT_SEED = 40


class Bug(NamedTuple):
    """A text of a source file that occurs once there, and what it is replaced by."""

    file: str
    right: str
    wrong: str


BUGS = {
    "timeout_off_by_one": Bug(
        "shift.h",
        "machine.attempt < settings->shift.retries",
        "machine.attempt <= settings->shift.retries",
    ),
    "counter_not_reset_after_an_abort": Bug("shift.h", "    machine.attempt = 0;\n", ""),
    "interlock_lost_in_one_direction": Bug(
        "opc4.c",
        "return !unit.has_been_filled[chamber] ||",
        "return chamber == OPC4_CHAMBER_B || !unit.has_been_filled[chamber] ||",
    ),
    "window_without_its_limit": Bug(
        "position.h",
        "absolute(position_m) <= settings->windows.neutral_tolerance_m",
        "absolute(position_m) < settings->windows.neutral_tolerance_m",
    ),
    "milliseconds_overflow": Bug(
        "opc4.c",
        "const int64_t now_ns = fw_in.now_ns;",
        "const int64_t now_ns = (int64_t)(uint32_t)(fw_in.now_ns / 1000000) * 1000000;",
    ),
    "filter_not_reset": Bug(
        "position.h",
        "if (settings->filter.enabled != 0)\n        filter_settle(raw_m);",
        "if (settings->filter.enabled != 0 && position.index == 0)\n        filter_settle(raw_m);",
    ),
    "stale_sample_used_after_bus_off": Bug(
        "opc4.c",
        "position_update(unit.pulses, unit.pulse_count, !is_valid);",
        "position_update(unit.pulses, unit.pulse_count, false);",
    ),
    "request_lost_while_venting": Bug(
        "shift.h",
        "if (!serve(seen) && seen->now_ns >= machine.until_ns)\n        change(VENT_OVER);",
        "machine.served = seen->requested;\n    if (seen->now_ns >= machine.until_ns)\n        change(VENT_OVER);",
    ),
    "repeated_counter_accepted": Bug(
        "opc4.h", "        return OPC4_E2E_REPEATED;", "        return OPC4_E2E_OK;"
    ),
    "debounce_from_the_wrong_start": Bug(
        "position.h",
        "position.run = gear == position.gear ? position.run + 1 : 1;",
        "position.run = position.run + 1;",
    ),
}


def mutants(count: int = 10, seed: int = MUTANT_SEED) -> dict[str, Bug]:
    """Mutants of the state machine in C: drawn among all places, each another one."""
    text = (SHIPPED_IN_C.parent / "shift.h").read_text()
    places = list(_places(text))
    drawn = random.Random(seed).sample(places, count)
    return {
        f"mutant {k + 1}: {text.count(chr(10), 0, start) + 1}: {text[start:end].strip()} -> {other}": Bug(
            "shift.h", text, text[:start] + other + text[end:]
        )
        for k, (start, end, other) in enumerate(drawn)
    }


def _places(text: str) -> Iterator[tuple[int, int, str]]:
    """Begin, end and replacement of each mutation: relations, constants, assignments, conditions."""
    begin = text.index("static bool is_in(")
    relations = {"<=": "<", ">=": ">", "==": "!=", "!=": "==", "<": "<=", ">": ">="}
    for found in re.finditer(r" (<=|>=|==|!=|<|>) ", text[begin:]):
        start = begin + found.start(1)
        yield start, begin + found.end(1), relations[found[1]]
    for found in re.finditer(r"(?<=[ (-])\d+(?=[,;) ])", text[begin:]):
        for change in (-1, 1):
            yield begin + found.start(), begin + found.end(), str(int(found[0]) + change)
    for found in re.finditer(r"\n +machine\.\w+( = machine\.\w+)* \+?= [^;]+;", text[begin:]):
        yield begin + found.start(), begin + found.end(), ";"
    for found in re.finditer(r"\n +(?:\} else )?if \((.+)\)(?: \{)?\n", text[begin:]):
        yield begin + found.start(1), begin + found.end(1), f"!({found[1]})"


def with_bug(bug: Bug, folder: Path) -> Path:
    """The source of the firmware with this bug; its folder is made, opc4.h beside it."""
    shutil.copytree(SHIPPED_IN_C.parent, folder)
    (folder / "opc4.h").write_text(header())
    source = (folder / bug.file).read_text()
    assert source.count(bug.right) == 1, (bug, source.count(bug.right))
    (folder / bug.file).write_text(source.replace(bug.right, bug.wrong))
    return folder / SHIPPED_IN_C.name
