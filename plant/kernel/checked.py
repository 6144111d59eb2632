"""Views in plain Python that check their bounds: for tests and debuggers (OPC4_CHECKED_KERNELS=1).

The same interface as the compiled views of `plant.kernel.views`.
"""

from __future__ import annotations

import ctypes

import numpy as np

from plant.kernel.records import RECORDS, Record


class CheckedView:
    """A view that knows the memory it may touch: the elements of one array or of one field.

    array: the flat memory; start: first element; end: end of what may be touched; width, length,
    record, zeros and discards: see `plant.kernel.views.View`.
    """

    __slots__ = ("_array", "_discards", "_end", "_length", "_record", "_start", "_width", "_zeros")

    def __init__(
        self, array, start, end, width=1, length=0, record="", zeros=(), discards=False
    ) -> None:
        for name, value in zip(
            ("_array", "_start", "_end", "_width", "_length", "_record", "_zeros", "_discards"),
            (array, start, end, width, length, record, zeros, discards),
            strict=True,
        ):
            object.__setattr__(self, name, value)

    def _at(self, index: int) -> int:
        position = self._start + index * self._width
        if index < 0 or not position < self._end:
            raise IndexError(f"element {index} of a view of {self._record or 'an array'}")
        return position

    def _from(self, index: int, end: int | None = None, length: int = 0) -> CheckedView:
        start = self._start + index * self._width
        if index < 0:
            raise IndexError(f"view from element {index} of {self._record or 'an array'}")
        return CheckedView(
            self._array, start, self._end if end is None else end, self._width, length
        )

    def __getitem__(self, i):
        if isinstance(i, slice):
            return self._from(i.start)
        if isinstance(i, tuple):
            return self._array[self._at(i[0] * self._length + i[1])]
        if self._length:
            return self._from(i * self._length)
        return self._array[self._at(int(i))]

    def __setitem__(self, i, value) -> None:
        if not self._discards:
            k = i[0] * self._length + i[1] if isinstance(i, tuple) else i
            self._array[self._at(int(k))] = value

    def __getattr__(self, name):
        try:
            field = RECORDS[self._record].fields[name]
        except KeyError:
            raise AttributeError(name) from None
        if field.length:
            last = self._at(field.start + field.length - 1)
            return self._from(field.start, last + 1, field.row)
        value = self[field.start]
        return value * 0 if name in self._zeros else value

    def __setattr__(self, name: str, value) -> None:
        self[RECORDS[self._record].fields[name].start] = value


def view(array, offset):
    """Return the view of an array from element `offset` on.

    Raises TypeError if it is not C-contiguous.
    """
    flat = array.reshape(-1)
    if not np.shares_memory(flat, array) and array.size:
        raise TypeError("a view needs a C-contiguous array")
    return CheckedView(flat, offset, flat.size)


def lane(v, index, width):
    """Return lane `index` of `width` interleaved copies."""
    return CheckedView(v._array, v._start + index, v._end, width)


def discarding(v):
    """Return the same view, to which nothing is written."""
    return CheckedView(v._array, v._start, v._end, v._width, v._length, discards=True)


def call_at(address, slot, t, x, v, direction, pressure, p) -> float:
    """Call the compiled function at an address with six numbers and a pointer to a view."""
    double = ctypes.c_double
    kind = ctypes.CFUNCTYPE(double, *[double] * 6, ctypes.c_void_p)
    pointer = p._array[p._start :].ctypes.data
    return float(kind(int(address))(slot, t, x, v, direction, pressure, pointer))


def unlikely(condition: bool) -> bool:
    """Return the condition."""
    return condition


def named(record: type[Record], zeros: tuple[str, ...] = ()):
    """Return the function that makes a view, or an array, a view of a record."""

    def of(v):
        if not isinstance(v, CheckedView):
            v = view(v, 0)
        return CheckedView(v._array, v._start, v._end, v._width, 0, record.__name__, zeros)

    return of
