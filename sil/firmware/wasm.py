"""A firmware as a WebAssembly module: checked when it is loaded, its memory is all of its state.

Nothing that it does reaches beyond that memory. Its instructions are counted, so an endless loop ends.
"""

from __future__ import annotations

import os
import struct
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.user_file import read_user_file
from sil.files.extras import import_extra
from sil.firmware import contract
from sil.firmware.compiler import EXPORTS
from sil.firmware.contract import COUNTS, FAILURE, FAILURE_AT, MAX_SENT, SIGNAL, SIGNALS_AT, Step
from sil.firmware.findings import PREFIX, FirmwareFailure, finding, text_at, trap_text

MAX_MODULE_BYTES, MAX_MEMORY_BYTES = 16 << 20, 64 << 20
MAX_INSTRUCTIONS = 50_000_000
"""After so many in one step it counts as an endless loop."""

_WITHOUT_WASI = (
    "expected a module for wasm32-freestanding: cc -target wasm32-freestanding -nostdlib "
    "-Wl,--no-entry " + " ".join(f"-Wl,--export={name}" for name in EXPORTS)
)
_UNTOUCHED = 0xA5


class Answer(NamedTuple):
    """What a step gave: frames to send, traced signals, and the instructions that it took."""

    frames: list[Frame]
    signals: dict[str, float]
    instructions: int


class Module:
    """A module that has what the contract asks for and imports nothing else.

    `source` names it in messages. Raises InputError for another one, and without wasmtime.
    """

    def __init__(self, content: bytes, source: str) -> None:
        self.wasmtime, self.engine = engine()
        self.source = source
        try:
            self.code = self.wasmtime.Module(self.engine, content)
        except self.wasmtime.WasmtimeError as error:
            raise self._wrong(f"not a module: {' '.join(str(error).split())}") from None
        for item in self.code.imports:
            if item.module.startswith("wasi"):
                raise InputError(f"{source}: needs WASI ({item.name}); {_WITHOUT_WASI}")
            if not (item.name or "").startswith(PREFIX):
                raise self._wrong(f"imports {item.module}.{item.name}; expected no imports")
        types = {item.name: item.type for item in self.code.exports}
        for name in ("memory", *EXPORTS):
            if name not in types:
                what = f"does not export {name}; expected memory, {', '.join(EXPORTS)}"
                raise self._wrong(what)
        for name in ("fw_init", "fw_step"):
            kind = types[name]
            if not isinstance(kind, self.wasmtime.FuncType) or kind.params or kind.results:
                raise self._wrong(f"{name} is not a function void {name}(void); expected one")

    def _wrong(self, what: str) -> InputError:
        return InputError(f"{self.source}: {what}")


class Instance:
    """A module at work. Raises InputError for one of another contract, FirmwareFailure when it fails."""

    def __init__(self, module: Module, settings: bytes) -> None:
        wasmtime = module.wasmtime
        self.module = module
        self._store = wasmtime.Store(module.engine)
        self._store.set_limits(memory_size=MAX_MEMORY_BYTES)
        self._store.set_fuel(MAX_INSTRUCTIONS)
        linker = wasmtime.Linker(module.engine)
        for item in module.code.imports:
            linker.define_func(item.module, item.name, item.type, self._handler(item.name))
        try:
            exports = linker.instantiate(self._store, module.code).exports(self._store)
            addresses = [exports[name].value(self._store) for name in EXPORTS[:3]]
        except (wasmtime.WasmtimeError, wasmtime.Trap, AttributeError) as error:
            why = " ".join(str(error).split())
            raise InputError(f"{module.source}: cannot be started: {why}") from None
        memory = exports["memory"]
        self._store.set_limits(memory_size=memory.data_len(self._store))  # it does not move
        self._memory = memoryview(memory.get_buffer_ptr(self._store)).cast("B")
        self._in, self._out, number_at = addresses
        room = len(self._memory) - contract.settings_size() - contract.HEAD.size
        room -= contract.MAX_ARRIVED * contract.FRAME.size
        if not (0 <= self._in <= room and 0 <= self._out <= len(self._memory) - contract.OUT_SIZE):
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
        stack = bytes(self._memory[: self._stack_top])
        return len(stack.lstrip(bytes([_UNTOUCHED])))

    def step(self, step: Step) -> Answer:
        """Run a step. Raises FirmwareFailure when it fails."""
        memory, out = self._memory, self._out
        content = contract.pack_step(step)
        memory[self._in : self._in + len(content)] = content
        instructions = self._call(self._step)
        count, signal_count = COUNTS.unpack_from(memory, out)
        if count > MAX_SENT:
            what = f"sent {count} frames in a step; a bus takes at most {MAX_SENT}"
            raise FirmwareFailure(what)
        begin = out + COUNTS.size
        try:
            frames = contract.unpack_frames(
                bytes(memory[begin : begin + count * contract.FRAME.size])
            )
        except ValueError as error:
            raise FirmwareFailure(str(error)) from None
        signals = {}
        for k in range(min(signal_count, contract.MAX_SIGNALS)):
            value, name_at = SIGNAL.unpack_from(memory, out + SIGNALS_AT + k * SIGNAL.size)
            signals[text_at(memory, name_at)] = value
        return Answer(frames, signals, instructions)

    def snapshot(self) -> bytes:
        """Return the whole state."""
        return bytes(self._memory)

    def restore(self, state: bytes) -> None:
        """Continue from a state of the same module."""
        self._memory[:] = state

    def _call(self, function: Any) -> int:
        """Call a function with empty outputs; return the instructions that it took."""
        store, memory, out = self._store, self._memory, self._out
        memory[out : out + COUNTS.size] = bytes(COUNTS.size)
        at = out + FAILURE_AT
        memory[at : at + FAILURE.size] = bytes(FAILURE.size)
        store.set_fuel(MAX_INSTRUCTIONS)
        try:
            function(store)
        except self.module.wasmtime.Trap as trap:
            overflowed = not 0 <= self._stack() <= self._stack_top
            raise FirmwareFailure(trap_text(trap, MAX_INSTRUCTIONS, overflowed)) from None
        what, file, line = FAILURE.unpack_from(memory, at)
        if what:
            place = f"{text_at(memory, file).rpartition('/')[2]}:{line}: "
            raise FirmwareFailure(place + text_at(memory, what))
        return MAX_INSTRUCTIONS - int(store.get_fuel())

    def _stack(self) -> int:
        pointer = self._stack_pointer
        return 0 if pointer is None else int(pointer.value(self._store))

    def _handler(self, name: str) -> Any:
        def handle(*arguments: Any) -> None:
            raise FirmwareFailure(finding(name, self._memory, arguments))

        return handle


def read_module(path: Path) -> bytes:
    """Return the content of a module file. Raises InputError for one that is not, or too large."""
    content = read_user_file(path, "a WebAssembly module", MAX_MODULE_BYTES)
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
