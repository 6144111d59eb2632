"""The values of a graph of objects that may change: taken at an instant, and put back in place.

The objects stay: what refers to what is the same for the whole run. Frozen records and tuples are values.
Checked by: tests/unit/sil/simulation/test_loop.py
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from functools import partial
from operator import attrgetter
from pathlib import PurePath
from types import BuiltinFunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from sil.simulation.inputs import PACKAGES

_VALUES = (
    *(str, bytes, int, float, frozenset, range, type, type(None), Enum, PurePath),
    *(np.generic, MappingProxyType, ModuleType),
)

Values = list[Any]  # a state: the values of each place, in their order


class Place(NamedTuple):
    """An object whose values may change; `names`: of the attributes that are values."""

    owner: Any
    take: Callable[[], Any]
    put: Callable[[Any], object]
    names: tuple[str, ...] = ()


class State:
    """All places that can be reached from `roots`. Raises TypeError for an object that cannot be saved."""

    def __init__(self, *roots: Any) -> None:
        self.places: list[Place] = []
        self._seen: dict[int, bool] = {}
        self._visit(roots)

    def values(self) -> Values:
        """Return the values as they are now."""
        return [place.take() for place in self.places]

    def restore(self, values: Values) -> None:
        """Put values back, of these places or of others that were made in the same way."""
        for place, value in zip(self.places, values, strict=True):
            place.put(value)

    def _visit(self, value: Any) -> bool:
        """Note the places in a value; return whether it has any, so that it is not a value itself."""
        number, kind = id(value), type(value)
        if number in self._seen:
            return self._seen[number]
        self._seen[number] = True  # a cycle leads back to a place
        inside = [self._visit(part) for part in _parts(value)]
        if isinstance(value, tuple):
            self._seen[number] = any(inside)
        elif isinstance(value, list | dict | set | deque):
            if not any(inside):
                self._note(value, value.copy, partial(_refill, value))
        elif isinstance(value, np.ndarray):
            if value.base is None:
                self._note(value, value.copy, partial(np.copyto, value))
        elif isinstance(value, random.Random):
            self._note(value, value.getstate, value.setstate)
        elif isinstance(value, np.random.Generator):
            bits = value.bit_generator
            self._note(bits, lambda: bits.state, partial(setattr, bits, "state"))
        elif isinstance(value, _VALUES) or _is_frozen(kind):
            self._seen[number] = False
        elif hasattr(value, "snapshot"):
            self._note(value, value.snapshot, value.restore)
        elif kind.__module__.partition(".")[0] in PACKAGES:
            names = [name for name in _names(value) if not self._visit(getattr(value, name))]
            self.places += [_attributes(value, names)] if names else []
        elif not callable(value):  # functions stay as they are
            raise TypeError(f"{kind.__name__} has no state that can be saved")
        return self._seen[number]

    def _note(self, owner: Any, take: Callable[[], Any], put: Callable[[Any], object]) -> None:
        self.places.append(Place(owner, take, put))


def _is_frozen(kind: type) -> bool:
    records = (getattr(kind, name, None) for name in ("__dataclass_params__", "__struct_config__"))
    return any(getattr(record, "frozen", False) for record in records)


def _names(value: Any) -> Iterator[str]:
    yield from getattr(value, "__dict__", ())
    for kind in type(value).__mro__:
        yield from (name for name in kind.__dict__.get("__slots__", ()) if hasattr(value, name))


def _parts(value: Any) -> Iterator[Any]:
    """Yield what a container or a function holds; what lists collect is never changed afterwards."""
    if isinstance(value, dict):
        yield from value.values()
    elif isinstance(value, tuple):
        yield from value
    elif isinstance(value, list | set | deque):
        yield from (part for part in value if not isinstance(part, tuple | np.ndarray))
    elif isinstance(value, MethodType | BuiltinFunctionType):
        yield value.__self__
    elif isinstance(value, partial):
        yield from (value.func, *value.args, *value.keywords.values())


def _attributes(owner: Any, names: list[str]) -> Place:
    names = names if len(names) > 1 else 2 * names  # of one name, a getter gives no tuple

    def put(values: tuple[Any, ...]) -> None:
        for name, value in zip(names, values, strict=True):
            setattr(owner, name, value)

    return Place(owner, partial(attrgetter(*names), owner), put, tuple(names))


def _refill(container: Any, content: Any) -> None:
    container.clear()
    getattr(container, "update" if isinstance(container, dict | set) else "extend")(content)
