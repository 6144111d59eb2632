"""A quicker start for commands that last a second: numba without scipy, and no collecting."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quick_start() -> Iterator[None]:
    """Import numba, then whatever the block imports, with the garbage collector at rest.

    numba looks for scipy's BLAS when it is imported, which costs a fifth of a second; no kernel of
    ours multiplies matrices.  What is imported stays to the end, so the collector need not look at it.
    """
    gc.disable()
    try:
        if "scipy.linalg" not in sys.modules:
            sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
            try:
                import numba.np.arraymath  # noqa: F401
            finally:
                del sys.modules["scipy.linalg"]
        yield
    finally:
        gc.freeze()
        gc.enable()
