"""Compilation of the plant's equations by numba, with a cache that cannot outlive an edit.

numba's own disk cache looks at the file of the compiled function only, so an edited callee in
another file would silently give the old result. Here the cache folder is named after a hash of
every kernel source, of numba's version and of the interpreter's: any edit means another folder.

Checked by: tests/unit/plant/kernel/test_compiled.py
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

from plant.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])

KERNEL_FOLDERS = ("kernel", "parts", "devices", "equations", "integrator", "batch", "systems")
"""Folders of the package that hold compiled functions."""


def kernel_sources(folder: Path | None = None) -> list[Path]:
    """Return all modules of the kernel's folders, in a fixed order."""
    root = folder or Path(__file__).parent.parent
    return [path for name in KERNEL_FOLDERS for path in sorted((root / name).glob("*.py"))]


CHECKED = os.environ.get("OPC4_CHECKED_KERNELS") == "1"
"""True if the kernels run as plain Python on views that check their bounds: slow, for tests and debuggers."""

if numba.config.DISABLE_JIT:
    raise InputError(
        "NUMBA_DISABLE_JIT is set; expected it unset: the plant's equations run compiled only"
    )


def kernel_hash(folder: Path | None = None) -> str:
    """Hash (12 hex digits) of all kernel sources, numba and Python versions."""
    digest = hashlib.sha256()
    digest.update(f"{numba.__version__} {sys.version}".encode())
    for path in kernel_sources(folder):
        digest.update(f"{path.parent.name}/{path.name}".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def cache_folder() -> Path:
    """Folder of the compiled kernels: $OPC4_CACHE, else the user's cache folder."""
    base = os.environ.get("OPC4_CACHE")
    if base is None:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        base = os.path.join(home, "opc4-sil")
    return Path(base) / f"kernel-{kernel_hash()}"


_FOLDER = str(cache_folder())


def is_warm() -> bool:
    """Return whether kernels compiled from exactly these sources are in the cache."""
    return any(Path(_FOLDER).glob("**/integrate.*.nbc"))


class _Announcement(event.Listener):
    """Log, once, that kernels are being compiled: it takes about a minute and looks like a hang."""

    announced = False

    def on_start(self, event: Any) -> None:
        """Log it when a kernel that is not in the cache begins to be compiled."""
        if not self.announced and event.data["dispatcher"].stats.cache_path is not None:
            self.announced = True
            logging.getLogger("plant").warning(
                "compiling the plant's equations, once; this takes about a minute ..."
            )

    def on_end(self, event: Any) -> None:
        """Do nothing."""


event.register("numba:compile", _Announcement())


def kernel(function: F) -> F:
    """Compile `function` with numba (no Python objects, IEEE arithmetic, cached on disk)."""
    if CHECKED:
        return function
    previous = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _FOLDER
    try:
        compiled: F = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    finally:
        numba.config.CACHE_DIR = previous
    return compiled


class _PartLibrary(JITCodeLibrary):
    """LLVM code of a part of the kernels.

    Optimised and turned into machine code only within the kernels that call it: numba alone does both
    again for every function on the way from a kernel to its innermost part.
    """

    def _optimize_functions(self, module: Any) -> None:
        """Leave the code as it is."""

    def _optimize_final_module(self) -> None:
        """Leave the code as it is."""

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: a part has no machine code of its own."""
        return 0

    @property
    def codegen(self) -> _PartLibrary:
        """Return what takes the function's environment, which a part does not need."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Do nothing."""


class _PartCompiler(Compiler):
    """numba's compiler with `_PartLibrary` as its output."""

    def define_pipelines(self) -> Any:
        """Return numba's own passes."""
        state = self.state
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


def _part(function: F, **options: bool) -> F:
    if CHECKED:
        return function
    part: Any = numba.njit(
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        pipeline_class=_PartCompiler,
        **options,
    )(function)
    # Python has no address to call: it gets an ordinary function, compiled when it asks for it
    ordinary = numba.njit(error_model="numpy")(function)
    part.add_overload = lambda found: part.overloads.update({tuple(found.signature.args): found})
    part._compile_for_args = lambda *_args, **_keywords: ordinary
    compiled: F = part
    return compiled


def inlined(function: F) -> F:
    """Compile `function` as part of the kernels that call it; always inlined by LLVM."""
    return _part(function, forceinline=True)


def called(function: F) -> F:
    """Compile `function` as part of the kernels that call it, as a function of its own."""
    return _part(function)


def c_function(function: Callable[..., float], signature: Any) -> Any:
    """Compile `function` to a C function of that signature, cached on disk; its address is `.address`."""
    previous = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _FOLDER
    try:
        return numba.cfunc(signature, cache=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = previous


def plain(function: F) -> F:
    """Return the Python function behind a compiled one."""
    return getattr(function, "py_func", function)
