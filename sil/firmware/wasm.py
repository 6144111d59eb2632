"""A firmware as a WebAssembly module: checked when it is loaded, its memory is all of its state.

Nothing that it does reaches beyond that memory. Its instructions are counted, so an endless loop ends.
"""

from __future__ import annotations

import os
import re
import struct
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.user_file import read_user_file
from sil.files.extras import import_extra
from sil.firmware import contract
from sil.firmware.compiler import EXPORTS
from sil.firmware.contract import COUNTS, FAILURE, FAILURE_AT, MAX_SENT, SIGNAL, SIGNALS_AT

PREFIX = "__ubsan_handle_"  # of the functions that a sanitised module calls for undefined behaviour


class FirmwareFailure(Exception):
    """A firmware failed; the text says where in its source, and how."""


def finding(name: str, memory: memoryview, arguments: tuple[Any, ...]) -> str:
    """Return what a call of a sanitiser's handler means: 'FILE:LINE:COLUMN: what'."""
    kind = name.removeprefix(PREFIX).removesuffix("_abort")
    findings = {
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
    what = findings.get(kind, kind.replace("_", " "))
    if kind == "type_mismatch_v1" and arguments[1] == 0:
        what = "null pointer"
    if not arguments:
        return what
    address, line, column = struct.unpack_from("<III", memory, arguments[0])
    return f"{text_at(memory, address)}:{line}:{column}: {what}"


def trap_text(trap: Any, max_instructions: int, overflowed: bool) -> str:
    """Return place and meaning of a trap of wasmtime; `overflowed`: the stack pointer has left the stack."""
    code = trap.trap_code.name if trap.trap_code is not None else "UNREACHABLE"
    names = [frame.func_name or "a function without a name" for frame in trap.frames]
    places = re.findall(r"^ +at (?:.*/)?([^/]+:\d+:\d+)$", trap.message, re.MULTILINE)
    inner = [place for place in places if not place.startswith("opc4.h:")]
    where = (inner or places or names[:1] or ["?"])[0]
    traps = {
        "STACK_OVERFLOW": "stack overflow",
        "MEMORY_OUT_OF_BOUNDS": "access outside the memory",
        "INTEGER_DIVISION_BY_ZERO": "division by zero",
        "INTEGER_OVERFLOW": "quotient that overflows",
        "BAD_CONVERSION_TO_INTEGER": "floating-point number that does not fit its integer type",
        "UNREACHABLE": "unreachable place, or a trap",
        "INDIRECT_CALL_TO_NULL": "call of a null pointer",
        "BAD_SIGNATURE": "call of a function by a pointer of another type",
    }
    what = traps.get(code, code.lower().replace("_", " "))
    if code == "OUT_OF_FUEL":
        what = f"endless loop: more than {max_instructions} instructions in a step"
    if code == "MEMORY_OUT_OF_BOUNDS" and (overflowed or len(names) - len(set(names)) > 16):
        what = "stack overflow"
    return f"{where}: {what}"


def text_at(memory: memoryview, address: int) -> str:
    """Return the text at an address of a module, at most 200 characters; '' for the null pointer."""
    content = bytes(memory[address : address + 200]) if address else b""
    return content.partition(b"\0")[0].decode(errors="replace")


_UNTOUCHED = 0xA5


class Module:
    """A module that has what the contract asks for and imports nothing else.

    `source` names it in messages. Raises InputError for another one, and without wasmtime.
    """

    def __init__(self, content: bytes, source: str) -> None:
        self.wasmtime, self.engine = engine()
        self.source, self.content = source, content
        try:
            self.code = self.wasmtime.Module(self.engine, content)
        except self.wasmtime.WasmtimeError as error:
            raise self._wrong(f"not a module: {' '.join(str(error).split())}") from None
        self.linker = self.wasmtime.Linker(self.engine)
        for item in self.code.imports:
            if item.module.startswith("wasi"):
                exports = " ".join(f"-Wl,--export={name}" for name in EXPORTS)
                raise InputError(
                    f"{source}: needs WASI ({item.name}); expected a module for wasm32-freestanding: "
                    f"cc -target wasm32-freestanding -nostdlib -Wl,--no-entry {exports}"
                )
            if not (item.name or "").startswith(PREFIX):
                raise self._wrong(f"imports {item.module}.{item.name}; expected no imports")
            handler = partial(_report, item.name)
            self.linker.define_func(item.module, item.name, item.type, handler, access_caller=True)
        types = {item.name: item.type for item in self.code.exports}
        for name in ("memory", *EXPORTS):
            if name not in types:
                expected = f"memory, {', '.join(EXPORTS)}"
                raise self._wrong(f"does not export {name}; expected {expected}")
        for name in ("fw_init", "fw_step"):
            kind = types[name]
            if not isinstance(kind, self.wasmtime.FuncType) or kind.params or kind.results:
                raise self._wrong(f"{name} is not a function void {name}(void); expected one")

    def _wrong(self, what: str) -> InputError:
        return InputError(f"{self.source}: {what}")


class Instance:
    """A module at work. Raises InputError for one of another contract, FirmwareFailure when it fails."""

    most_instructions = 50_000_000  # after so many in one step it counts as an endless loop

    def __init__(self, module: Module, settings: bytes) -> None:
        self._module, wasmtime = module, module.wasmtime
        self._store = store = wasmtime.Store(module.engine)
        store.set_limits(memory_size=64 << 20)
        store.set_fuel(self.most_instructions)
        try:
            exports = module.linker.instantiate(store, module.code).exports(store)
            self._in, self._out, number_at = (exports[name].value(store) for name in EXPORTS[:3])
        except (wasmtime.WasmtimeError, wasmtime.Trap, AttributeError) as error:
            why = " ".join(str(error).split())
            raise InputError(f"{module.source}: cannot be started: {why}") from None
        memory = exports["memory"]
        store.set_limits(memory_size=memory.data_len(store))  # it does not move
        self._memory = memoryview(memory.get_buffer_ptr(store)).cast("B")
        room = len(self._memory) - contract.settings_size() - contract.HEAD.size
        room -= contract.MAX_ARRIVED * contract.FRAME.size
        out_size = contract.FAILURE_AT + contract.FAILURE.size
        if not (0 <= self._in <= room and 0 <= self._out <= len(self._memory) - out_size):
            raise InputError(f"{module.source}: fw_in or fw_out reaches beyond the memory")
        number = struct.unpack_from("<I", self._memory, number_at)[0]
        if number != contract.contract_number():
            raise InputError(
                f"{module.source}: made for contract {number}; expected {contract.contract_number()}: "
                "compile it with the opc4.h of this version, which opc4 firmware --new writes"
            )
        self._stack_pointer = exports.get("__stack_pointer")
        self._stack_top = self._stack()
        self._memory[: self._stack_top] = bytes([_UNTOUCHED]) * self._stack_top
        self._step = exports["fw_step"]
        self._memory[self._in : self._in + len(settings)] = settings
        self._in += len(settings)
        self._call(exports["fw_init"])

    @property
    def memory_bytes(self) -> int:
        """Size of the memory."""
        return len(self._memory)

    @property
    def stack_bytes(self) -> int:
        """Deepest use of the stack so far; what the compiler keeps in locals is not on it."""
        touched = np.frombuffer(self._memory, np.uint8, self._stack_top) != _UNTOUCHED
        return self._stack_top - int(touched.argmax()) if touched.any() else 0

    def step(self, content: bytes) -> int:
        """Run a step with the bytes of `contract.pack_step`; return its instructions. Raises FirmwareFailure."""
        self._memory[self._in : self._in + len(content)] = content
        return self._call(self._step)

    def frames(self) -> list[Frame]:
        """Return the frames that the step sent. Raises FirmwareFailure for too many, or one that is none."""
        count, _ = COUNTS.unpack_from(self._memory, self._out)
        if count > MAX_SENT:
            raise FirmwareFailure(f"sent {count} frames in a step; a bus takes at most {MAX_SENT}")
        begin = self._out + COUNTS.size
        try:
            return contract.unpack_frames(self._memory[begin : begin + count * contract.FRAME.size])
        except ValueError as error:
            raise FirmwareFailure(str(error)) from None

    def signals(self) -> dict[str, float]:
        """Return what the step traced."""
        _, count = COUNTS.unpack_from(self._memory, self._out)
        signals = {}
        for k in range(min(count, contract.MAX_SIGNALS)):
            at = self._out + SIGNALS_AT + k * SIGNAL.size
            value, name_at = SIGNAL.unpack_from(self._memory, at)
            signals[text_at(self._memory, name_at)] = value
        return signals

    def snapshot(self) -> tuple[bytes, int]:
        """Return the whole state."""
        return bytes(self._memory), self._stack()

    def restore(self, state: tuple[bytes, int]) -> None:
        """Continue from a state of the same module, also after a failure."""
        self._memory[:], pointer = state
        if pointer != self._stack():
            self._stack_pointer.set_value(self._store, pointer)

    def _call(self, function: Any) -> int:
        """Call a function with empty outputs; return the instructions that it took."""
        store, memory, out = self._store, self._memory, self._out
        memory[out : out + COUNTS.size] = bytes(COUNTS.size)
        store.set_fuel(self.most_instructions)
        try:
            function(store)
        except self._module.wasmtime.Trap as trap:
            overflowed = not 0 <= self._stack() <= self._stack_top
            raise FirmwareFailure(trap_text(trap, self.most_instructions, overflowed)) from None
        what, file, line = FAILURE.unpack_from(memory, out + FAILURE_AT)
        if what:
            place = f"{text_at(memory, file).rpartition('/')[2]}:{line}: "
            raise FirmwareFailure(place + text_at(memory, what))
        return self.most_instructions - int(store.get_fuel())

    def _stack(self) -> int:
        pointer = self._stack_pointer
        return 0 if pointer is None else int(pointer.value(self._store))


def _report(name: str, caller: Any, *arguments: Any) -> None:
    """Stand for a handler of undefined behaviour."""
    memory = caller["memory"]
    content = memoryview(memory.get_buffer_ptr(caller)).cast("B")
    raise FirmwareFailure(finding(name, content, arguments))


def read_module(path: Path) -> bytes:
    """Return the content of a module file. Raises InputError for one that is not, or too large."""
    content = read_user_file(path, "a WebAssembly module", 16 << 20)
    if not content.startswith(b"\0asm"):
        raise InputError(f"{path}: not WebAssembly; expected a module, or FILE.c")
    return content


@cache
def engine() -> tuple[Any, Any]:
    """Return wasmtime, and the engine that compiles all modules of this process."""
    os.environ.setdefault("WASMTIME_BACKTRACE_DETAILS", "1")  # traps name the line of the source
    wasmtime = import_extra("wasmtime", "wasm", "firmware in C or WebAssembly")
    config = wasmtime.Config()
    config.consume_fuel = True
    config.parallel_compilation = False  # its threads do not survive a fork
    return wasmtime, wasmtime.Engine(config)
