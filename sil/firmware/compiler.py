"""C source to WebAssembly, by zig or by clang: a plain build, and one that finds undefined behaviour."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from hashlib import sha256
from pathlib import Path

import platformdirs

from can_dbc.errors import InputError
from can_dbc.user_file import read_user_file, resolved
from sil.files.atomic import write_atomically
from sil.files.extras import install_command
from sil.firmware.contract import header

STACK_BYTES = 65536
EXPORTS = ("fw_in", "fw_out", "fw_contract", "fw_init", "fw_step")

_CACHE = Path(platformdirs.user_cache_dir("opc4-sil"))


def compiled(path: Path, *, sanitised: bool = False, options: tuple[str, ...] = ()) -> bytes:
    """Return the module that a C file compiles to; `sanitised`: undefined behaviour calls the host.

    Unless it or what it includes has changed, or the compiler had something to say, it is not compiled
    again. Raises InputError if the compiler refuses the file, and with the command that installs one.
    """
    read_user_file(path, "C source")
    flags = "-target wasm32-freestanding -std=c99 -g -c -ffp-contract=off -fno-math-errno -mbulk-memory "
    flags += (
        "-O1 -ftrivial-auto-var-init=pattern -fno-sanitize-trap=all "
        "-fsanitize=undefined,float-cast-overflow,local-bounds"
        if sanitised
        else "-O2 -fno-sanitize=all"
    )
    command = (*tool("cc"), *flags.split(), *options, path.name)
    key = "\n".join((str(resolved(path)), header(), _version(), *command))
    stored = _CACHE / "c" / sha256(key.encode()).hexdigest()
    with contextlib.suppress(OSError, ValueError):
        head, _, module = stored.read_bytes().partition(b"\n")
        if all(_stamp(file) == stamp for file, stamp in json.loads(head).items()):
            return module
    with tempfile.TemporaryDirectory(prefix="opc4-") as folder:
        Path(folder, "opc4.h").write_text(header())
        output = ("-I", folder, "-MMD", "-MF", f"{folder}/own.d", "-o", f"{folder}/own.o")
        said = _call(path, (*command, *output))
        undefined = ("--allow-undefined",) if sanitised else ()
        link = (
            *("--no-entry", "--stack-first", "-z", f"stack-size={STACK_BYTES}", *undefined),
            *(f"--export={name}" for name in (*EXPORTS, "__stack_pointer")),
            *(f"{folder}/own.o", "-o", f"{folder}/own.wasm"),
        )
        said += _call(path, (*tool("wasm-ld"), *link))
        module = Path(folder, "own.wasm").read_bytes()
        names = Path(folder, "own.d").read_text().partition(":")[2].replace("\\\n", " ").split()
        files = [resolved(path).parent / name for name in names if not name.startswith(folder)]
        with contextlib.suppress(OSError):  # a name with a blank, or no room: compiled again
            stamps = {str(file): _stamp(file) for file in files}
            if not said:
                stored.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(stored, json.dumps(stamps).encode() + b"\n" + module)
        return module


def _stamp(file: str | Path) -> list[int]:
    state = os.stat(file)
    return [state.st_mtime_ns, state.st_size]


def _call(path: Path, command: tuple[str, ...]) -> str:
    """Run a tool; return what it wrote, which goes to standard error. Raises InputError if it fails."""
    folders = {f"ZIG_{kind}_CACHE_DIR": str(_CACHE / "zig") for kind in ("GLOBAL", "LOCAL")}
    try:
        done = subprocess.run(
            command,
            cwd=path.parent,  # messages name the file as it is called, without folders
            env={**os.environ, **folders},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=120.0,
            check=False,
        )
    except subprocess.TimeoutExpired:
        what = "the compiler has not finished within 120 s"
        raise InputError(f"{path}: {what}; expected C source") from None
    said = done.stderr.decode(errors="replace")
    lines = said.splitlines(keepends=True)
    sys.stderr.writelines(lines[:60])
    if (more := len(lines) - 60) > 0:
        sys.stderr.write(f"and {more} more lines of the compiler\n")
    if done.returncode != 0:
        raise InputError(f"{path}: does not compile, see above; expected C99 that includes opc4.h")
    return said


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


@cache
def _version() -> str:
    """Return what differs between versions of the compiler."""
    if importlib.util.find_spec("ziglang") is not None:
        return importlib.metadata.version("ziglang")
    return str(Path(*tool("cc")).stat().st_mtime_ns)
