"""Compilation of the plant's equations by numba, with a cache that cannot outlive an edit.

numba's disk cache misses an edited callee in another file: the folder is named after a hash of all kernel sources and
versions.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import platformdirs

from plant.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])

CHECKED = os.environ.get("OPC4_CHECKED_KERNELS") == "1"
"""True if the kernels run as plain Python on arrays that check their bounds: slow, for tests and debuggers."""

if numba.config.DISABLE_JIT:
    raise InputError(
        "NUMBA_DISABLE_JIT is set; expected it unset: the plant's equations run compiled only"
    )


def kernel_sources(package: Path | None = None) -> list[Path]:
    """Return all modules of the folders that hold compiled functions, in a fixed order."""
    root = package or Path(__file__).parent.parent
    folders = ["kernel", "parts", "devices", "equations", "integrator"]
    folders += ["batch", "systems", "effects"]
    return [path for name in folders for path in sorted((root / name).glob("*.py"))]


def kernel_hash(package: Path | None = None) -> str:
    """Hash (12 hex digits) of all kernel sources, numba and Python versions."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for path in kernel_sources(package):
        digest.update(f"{path.parent.name}/{path.name}".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@functools.cache
def cache_folder() -> Path:
    """Folder of the compiled kernels: in $NUMBA_CACHE_DIR, the user's cache folder, or else a temporary one."""
    base = os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir("opc4-sil")
    folder = Path(base) / f"kernel-{kernel_hash()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        base = tempfile.mkdtemp(prefix="opc4-sil-")
        atexit.register(shutil.rmtree, base, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = base
        logging.getLogger("plant").warning(
            "%s: %s; the compiled equations go to %s, until this command ends",
            folder, error.strerror, base,
        )  # fmt: skip
        folder = Path(base) / folder.name
    return folder


def is_warm() -> bool:
    """Return whether kernels compiled from exactly these sources are in the cache."""
    return any(cache_folder().glob("**/integrate.*.nbc"))


@functools.cache
def announce() -> None:
    """Log, once, that kernels are being compiled: it takes a while and looks like a hang."""
    logging.getLogger("plant").warning(
        "compiling the plant's equations, once; this takes about a minute ..."
    )


def _cached(decorator: Callable[[F], Any], function: F) -> Any:
    previous = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder())
    try:
        return decorator(function)
    finally:
        numba.config.CACHE_DIR = previous


def kernel(function: F) -> F:
    """Compile `function` with numba (no Python objects, IEEE arithmetic, cached on disk)."""
    if CHECKED:
        return function
    compiled: F = _cached(numba.njit(cache=True, error_model="numpy", nogil=True), function)
    return compiled


def called(function: F) -> F:
    """Compile `function` as a part of the kernels that call it."""
    if CHECKED:
        return function
    part: F = numba.njit(error_model="numpy", no_cfunc_wrapper=True)(function)
    return part


def inlined(function: F) -> F:
    """Compile `function` as a part of the kernels that call it; always inlined by LLVM."""
    if CHECKED:
        return function
    part: F = numba.njit(error_model="numpy", forceinline=True, no_cfunc_wrapper=True)(function)
    return part


def c_function(function: Callable[..., float], signature: Any) -> Any:
    """Compile `function` to a C function of that signature, cached on disk; its address is `.address`."""
    return _cached(numba.cfunc(signature, cache=True, error_model="numpy"), function)


def plain(function: F) -> F:
    """Return the Python function behind a compiled one."""
    return getattr(function, "py_func", function)
