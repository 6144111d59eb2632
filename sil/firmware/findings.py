"""Why a firmware in a module cannot go on, in words, with the place in its source."""

from __future__ import annotations

import re
import struct
from typing import Any

PREFIX = "__ubsan_handle_"
"""Of the functions that a sanitised module calls for undefined behaviour."""

_FINDINGS = {
    "add_overflow": "signed integer overflow",
    "sub_overflow": "signed integer overflow",
    "mul_overflow": "signed integer overflow",
    "negate_overflow": "signed integer overflow",
    "divrem_overflow": "division by zero, or its quotient overflows",
    "shift_out_of_bounds": "shift by a negative or too large number, or of too large a value",
    "out_of_bounds": "array index out of bounds",
    "local_out_of_bounds": "access out of bounds",
    "pointer_overflow": "pointer beyond its object, or arithmetic with a null pointer",
    "type_mismatch_v1": "null or misaligned pointer, or one to too small an object",
    "float_cast_overflow": "floating-point number that does not fit its integer type",
    "load_invalid_value": "value that its type does not have",
    "vla_bound_not_positive": "array of no or negative size",
    "nonnull_arg": "null pointer where none is allowed",
    "missing_return": "function that ends without its return",
    "builtin_unreachable": "place that is declared unreachable",
}
_TRAPS = {
    "STACK_OVERFLOW": "stack overflow",
    "MEMORY_OUT_OF_BOUNDS": "access outside the memory",
    "INTEGER_DIVISION_BY_ZERO": "division by zero",
    "INTEGER_OVERFLOW": "quotient that overflows",
    "BAD_CONVERSION_TO_INTEGER": "floating-point number that does not fit its integer type",
    "UNREACHABLE": "unreachable place, or a trap",
    "INDIRECT_CALL_TO_NULL": "call of a null pointer",
    "BAD_SIGNATURE": "call of a function by a pointer of another type",
}


class FirmwareFailure(Exception):
    """A firmware failed; the text says where in its source, and how."""


def finding(name: str, memory: memoryview, arguments: tuple[Any, ...]) -> str:
    """Return what a call of a sanitiser's handler means: 'FILE:LINE:COLUMN: what'."""
    kind = name.removeprefix(PREFIX).removesuffix("_abort")
    what = _FINDINGS.get(kind, kind.replace("_", " "))
    if kind == "type_mismatch_v1" and arguments[1] == 0:
        what = "null pointer"
    if not arguments:
        return what
    address, line, column = struct.unpack_from("<III", memory, arguments[0])
    return f"{text_at(memory, address)}:{line}:{column}: {what}"


def trap_text(trap: Any, max_instructions: int, overflowed: bool) -> str:
    """Return what a trap of wasmtime means, after its place: from the source, else the function.

    `overflowed`: the stack pointer has left the stack.
    """
    code = trap.trap_code.name if trap.trap_code is not None else "UNREACHABLE"
    names = [frame.func_name or "a function without a name" for frame in trap.frames]
    places = re.findall(r"^ +at (?:.*/)?([^/]+:\d+:\d+)$", trap.message, re.MULTILINE)
    inner = [place for place in places if not place.startswith("opc4.h:")]
    where = (inner or places or names[:1] or ["?"])[0]
    what = _TRAPS.get(code, code.lower().replace("_", " "))
    if code == "OUT_OF_FUEL":
        what = f"endless loop: more than {max_instructions} instructions in a step"
    if code == "MEMORY_OUT_OF_BOUNDS" and (overflowed or len(names) - len(set(names)) > 16):
        what = "stack overflow"
    return f"{where}: {what}"


def text_at(memory: memoryview, address: int) -> str:
    """Return the text at an address of a module, at most 200 characters; '' for the null pointer."""
    content = bytes(memory[address : address + 200]) if address else b""
    return content.partition(b"\0")[0].decode(errors="replace")
