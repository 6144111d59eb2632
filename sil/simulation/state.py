"""The values of a graph of objects that may change: taken at an instant, and put back in place.

The objects themselves stay: what refers to what is the same for the whole run. Frozen records, tuples
and functions are values. Checked by: tests/unit/sil/simulation/test_loop.py
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import PurePath
from types import BuiltinFunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np

PACKAGES = ("can_dbc", "controller", "plant", "sil")

VALUES = (
    *(str, bytes, int, float, frozenset, range, type, type(None), Enum, PurePath),
    *(np.generic, MappingProxyType, ModuleType),
)
Values = list[Any]
"""A state: the values of each place, in their order."""


class Place(NamedTuple):
    """An object whose values may change."""

    owner: Any
    take: Callable[[], Any]
    put: Callable[[Any], object]
    names: tuple[str, ...] = ()
    """Of the attributes that are values."""


class State:
    """All places that can be reached from `roots`. Raises TypeError for an object that cannot be saved."""

    def __init__(self, *roots: Any) -> None:
        self.places: list[Place] = []
        self._seen: dict[int, bool] = {}
        for root in roots:
            self._visit(root)
        self._takes = [place.take for place in self.places]
        self._puts = [place.put for place in self.places]

    def values(self) -> Values:
        """Return the values as they are now."""
        return [take() for take in self._takes]

    def restore(self, values: Values) -> None:
        """Put values back, of these places or of others that were made in the same way."""
        for put, value in zip(self._puts, values, strict=True):
            put(value)

    def _visit(self, value: Any) -> bool:
        """Note the places in a value; return whether there are any, so that it is not a value itself."""
        number = id(value)
        if number not in self._seen:
            self._seen[number] = True  # a cycle leads back to a place
            inner = [self._visit(part) for part in _parts(value)]
            if isinstance(value, tuple):
                self._seen[number] = any(inner)
            elif isinstance(value, list | dict | set | deque):
                if not any(inner):
                    self.places.append(_container(value))
            elif isinstance(value, np.ndarray):
                if value.base is None:
                    self.places.append(Place(value, value.copy, partial(np.copyto, value)))
            elif isinstance(value, random.Random):
                self.places.append(Place(value, value.getstate, value.setstate))
            elif isinstance(value, np.random.Generator):
                self.places.append(_generator(value.bit_generator))
            elif _is_value(value):
                self._seen[number] = False
            elif type(value).__module__.partition(".")[0] in PACKAGES:
                self._visit_object(value)
            elif not callable(value):  # functions stay as they are
                raise TypeError(f"{type(value).__name__} has no state that can be saved")
        return self._seen[number]

    def _visit_object(self, value: Any) -> None:
        if hasattr(value, "snapshot"):
            self.places.append(Place(value, value.snapshot, value.restore))
            return
        names = [name for name in _names(value) if not self._visit(getattr(value, name))]
        if names:
            self.places.append(_attributes(value, names))


def _is_value(value: Any) -> bool:
    """Return whether a value never changes."""
    kind = type(value)
    frozen = getattr(getattr(kind, "__dataclass_params__", None), "frozen", False)
    frozen |= getattr(getattr(kind, "__struct_config__", None), "frozen", False)
    return frozen or isinstance(value, VALUES)


def _names(value: Any) -> Iterator[str]:
    yield from getattr(value, "__dict__", ())
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        yield from (name for name in slots if hasattr(value, name))


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
    attributes = getattr(owner, "__dict__", {})
    if all(name in attributes for name in names):
        return Place(
            owner,
            partial(itemgetter(*names), attributes),
            lambda values: attributes.update(zip(names, values, strict=True)),
            tuple(names),
        )

    def put(values: tuple[Any, ...]) -> None:
        for name, value in zip(names, values, strict=True):
            setattr(owner, name, value)

    return Place(owner, partial(attrgetter(*names), owner), put, tuple(names))


def _container(value: Any) -> Place:
    if isinstance(value, list):
        return Place(value, value.copy, partial(value.__setitem__, slice(None)))
    fill = value.extend if isinstance(value, deque) else value.update

    def put(content: Any) -> None:
        value.clear()
        fill(content)

    return Place(value, value.copy, put)


def _generator(bits: np.random.BitGenerator) -> Place:
    def put(state: Any) -> None:
        bits.state = state

    return Place(bits, lambda: bits.state, put)
