"""The views of `plant.kernel.views` as slices of numpy arrays, which check their bounds (OPC4_CHECKED_KERNELS=1)."""

from __future__ import annotations

import ctypes

import numpy as np

from plant.kernel.records import Record


def view(array, offset):
    """Return the view of an array from element `offset` on. Raises TypeError if it is not C-contiguous."""
    if not array.flags.c_contiguous:
        raise TypeError("a view needs a C-contiguous array")
    return array.reshape(-1)[offset:]


def lane(v, index, width):
    """Return lane `index` of `width` interleaved copies."""
    return v[index::width]


def discarding(v):
    """Return a copy: what is written to it is lost."""
    return v.copy()


def named(record: type[Record], zeros: tuple[str, ...] = ()):
    """Return the function that makes a view a view of a record; `zeros` are 0 in the memory as well."""
    return lambda v: record(v.array if isinstance(v, Record) else v)


def call_at(address, slot, t, x, v, direction, pressure, p) -> float:
    """Call the compiled function at an address with six numbers and a pointer to a view."""
    kind = ctypes.CFUNCTYPE(ctypes.c_double, *[ctypes.c_double] * 6, ctypes.c_void_p)
    values = np.ascontiguousarray(p.array)
    return float(kind(int(address))(slot, t, x, v, direction, pressure, values.ctypes.data))


def unlikely(condition: bool) -> bool:
    """Return the condition."""
    return condition
