"""Work around a use of freed memory at the exit of processes that import pythonfmu3's units.

The library of a unit (pythonfmu3 0.3 and before) holds a static `std::shared_ptr` to the state of the
interpreter. At exit its destructor releases it, and then the library's unload function assigns to
it once more, which decrements a counter in freed memory: glibc may find its heap corrupted and
abort (exit code 134) after a simulation that was right. The library exports the function that
empties the pointer; called while an instance holds the state, it makes both later releases do
nothing.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

RELEASE = "finalizePythonInterpreter"


def release_static_state(resources: str, class_name: str) -> bool:
    """Empty the static pointer of a unit's library; call it while an instance is being made.

    resources: the folder of the unpacked unit's resources. Returns whether it was emptied: it is
    left as it is while the unit is being exported, and in programs that are not Python, where the
    state must outlive the instance because it ends the interpreter.
    """
    if not sys.orig_argv:
        return False
    for library in (Path(resources).parent / "binaries").glob(f"*/{class_name}.*"):
        try:
            release = getattr(ctypes.CDLL(str(library)), RELEASE)
        except (OSError, AttributeError):  # of another platform, or of a pythonfmu3 without it
            continue
        release()
        return True
    return False
