"""C source to WebAssembly, by zig or by clang: a plain build, and one that finds undefined behaviour."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file
from sil.files.extras import install_command
from sil.firmware.contract import header

STACK_BYTES = 65536
EXPORTS = ("fw_in", "fw_out", "fw_contract", "fw_init", "fw_step")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion")

_COMMON = (
    *("-target", "wasm32-freestanding", "-std=c99", "-g", "-c"),
    *("-ffp-contract=off", "-fno-math-errno", "-mbulk-memory"),
)
_PLAIN = ("-O2", "-fno-sanitize=all")
_SANITISED = (
    *("-O1", "-ftrivial-auto-var-init=pattern", "-fno-sanitize-trap=all"),
    "-fsanitize=undefined,float-cast-overflow,local-bounds",
)
_LINK = (
    *("--no-entry", "--stack-first", "-z", f"stack-size={STACK_BYTES}"),
    *(f"--export={name}" for name in (*EXPORTS, "__stack_pointer")),
)
_PATIENCE_S = 120.0


def compiled(path: Path, *, sanitised: bool = False, options: tuple[str, ...] = ()) -> bytes:
    """Return the module that a C file compiles to; `sanitised`: undefined behaviour calls the host.

    What the compiler writes goes to standard error. Raises InputError if it refuses the file, and
    with the command that installs a compiler without one.
    """
    read_user_file(path, "C source")
    with tempfile.TemporaryDirectory(prefix="opc4-") as folder:
        Path(folder, "opc4.h").write_text(header())
        flags = (*_COMMON, *(_SANITISED if sanitised else _PLAIN), *options, "-I", folder)
        _call(path, (*tool("cc"), *flags, path.name, "-o", f"{folder}/own.o"))
        undefined = ("--allow-undefined",) if sanitised else ()
        link = (*_LINK, *undefined, f"{folder}/own.o", "-o", f"{folder}/own.wasm")
        _call(path, (*tool("wasm-ld"), *link))
        return Path(folder, "own.wasm").read_bytes()


def _call(path: Path, command: tuple[str, ...]) -> None:
    caches = Path(platformdirs.user_cache_dir("opc4-sil")) / "zig"
    folders = {f"ZIG_{kind}_CACHE_DIR": str(caches) for kind in ("GLOBAL", "LOCAL")}
    try:
        done = subprocess.run(
            command,
            cwd=path.parent,  # messages name the file as it is called, without folders
            env={**os.environ, **folders},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=_PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        what = f"the compiler has not finished within {_PATIENCE_S:g} s"
        raise InputError(f"{path}: {what}; expected C source") from None
    sys.stderr.write(done.stderr.decode(errors="replace"))
    if done.returncode != 0:
        raise InputError(f"{path}: does not compile, see above; expected C99 that includes opc4.h")


@cache
def tool(name: str) -> tuple[str, ...]:
    """Return the command of the compiler (cc) or of the linker (wasm-ld). Raises InputError without one."""
    if importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-m", "ziglang", name)
    tools = {"cc": shutil.which("clang"), "wasm-ld": shutil.which("wasm-ld")}
    if not all(tools.values()):
        raise InputError(
            "firmware in C needs a compiler; expected clang and wasm-ld on the PATH, or ziglang after: "
            f"{install_command('ziglang', 'c')}"
        )
    return (str(tools[name]),)
