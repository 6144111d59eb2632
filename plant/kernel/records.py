"""Records: flat arrays whose elements have names, which views (`plant.kernel.views`) and Python share.

`p.leak_atm` is the element (of an array with one row per stroke: the column), `Parameters.leak_atm` its index.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

Value: TypeAlias = Any
"""A number, or one number per stroke."""


class Block(NamedTuple):
    """Shape of a field of several elements: `length` in all, in rows of `row` (0: none); paths: see `given`."""

    length: int
    row: int = 0
    paths: tuple[str, ...] = ()


def block(length: int, row: int = 0) -> Value:
    """Declare a field of `length` elements, or of `length` rows of `row` elements."""
    return Block(length * max(row, 1), row)


def given(*paths: str) -> Value:
    """Declare a field that a parameter set gives, `section.key`: of both actuators, or of either."""
    return Block(0, 0, paths)


@dataclass(frozen=True)
class Field:
    """Position of a field: its first element, how many there are (0: one number), and their rows."""

    start: int
    length: int
    row: int
    paths: tuple[str, ...]

    @property
    def index(self) -> int | slice:
        """Index of the field in an array."""
        return slice(self.start, self.start + self.length) if self.length else self.start


class Access:
    """Descriptor of one field: the index on the class, the elements on an instance."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.index = field.index

    def __get__(self, record: Record | None, owner: type) -> Value:
        if record is None:
            return self.index
        array = record.array
        elements = (array if array.ndim == 1 else array.T)[self.index]
        return elements.reshape(-1, self.field.row) if self.field.row else elements

    def __set__(self, record: Record, value: Value) -> None:
        array = record.array
        (array if array.ndim == 1 else array.T)[self.index] = value


RECORDS: dict[str, type[Record]] = {}
"""All records by name."""


class Record:
    """Named access to an array of shape [size] or [strokes, size]; `record[Parameters.leak_atm]` works as well."""

    __slots__ = ("array",)
    fields: ClassVar[dict[str, Field]]
    size: ClassVar[int]

    def __init_subclass__(cls) -> None:
        start = 0
        cls.fields = {}
        for name in cls.__annotations__:
            shape = cls.__dict__.get(name, Block(0))
            cls.fields[name] = Field(start, *shape)
            setattr(cls, name, Access(cls.fields[name]))
            start += max(shape.length, 1)
        cls.size = start
        RECORDS[cls.__name__] = cls

    def __init__(self, array: NDArray[Any]) -> None:
        self.array = array

    @classmethod
    def zeros(cls, dtype: type = float) -> Self:
        """Return a record of zeros."""
        return cls(np.zeros(cls.size, dtype=dtype))

    def copy(self) -> Self:
        """Return a record with its own array."""
        return type(self)(self.array.copy())

    def __setattr__(self, name: str, value: Value) -> None:
        if name != "array" and name not in self.fields:
            raise AttributeError(f"{type(self).__name__} has no field {name!r}")
        object.__setattr__(self, name, value)

    def __getitem__(self, index: int | slice) -> Value:
        return self.array.T[index]

    def __setitem__(self, index: int | slice, value: Value) -> None:
        self.array.T[index] = value


def interleaved(record: type[Record], width: int) -> type[Record]:
    """Return the record of `width` interleaved copies: each of its fields holds that of all copies."""
    fields: dict[str, Any] = {
        name: Block(max(field.length, 1) * width, field.row * width)
        for name, field in record.fields.items()
    }
    space = fields | {"__annotations__": fields}
    return cast(type[Record], type(f"{record.__name__}{width}", (Record,), space))
