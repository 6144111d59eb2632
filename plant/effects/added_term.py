"""Terms that an effect adds to the equations: plain functions, compiled when they are first used.

The function's address and the values of its parameters are written into a stroke's record; the
equations call it in its slot. So no kernel is compiled again, and strokes without a term run as
they do without this module.  A stroke with an added term takes the scalar kernel, also in a batch.
Checked by: tests/unit/plant/effects/test_added_term.py
"""

from __future__ import annotations

import dis
import functools
import inspect
import re
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numba
import numpy as np
from numba import types

from plant.effects.setup import Setup
from plant.errors import InputError
from plant.kernel.layout import ADDED_VALUES, MOST_ADDED, Slot

__all__ = ["ARGUMENTS", "AddedTerm", "Slot", "added_term"]

FLOW = {"time_s": 0, "position_m": 1, "valve": 3, "pressure_pa": 4}
ARGUMENTS: dict[Slot, dict[str, int]] = {
    Slot.FORCE: {"time_s": 0, "position_m": 1, "speed_m_s": 2},
    Slot.RESISTANCE: {"position_m": 1, "speed_m_s": 2, "direction": 3},
    Slot.FLOW_1: FLOW,
    Slot.FLOW_2: FLOW,
    Slot.FLOW_3: FLOW,
    Slot.LEAK: FLOW,
    Slot.CHARGE: {"pressure_ratio": 4},
    Slot.DISCHARGE: {"pressure_ratio": 4},
    Slot.EXPONENT: {"speed_m_s": 2},
}
"""What the term of a slot may depend on, and where the equations pass it (`call_at`)."""

TRIED: dict[str, tuple[float, ...]] = {
    "time_s": (0.0, 0.1, 1.0),
    "position_m": (-0.03, -0.0131, -0.006, 0.0, 1e-4, 0.006, 0.0131, 0.03),
    "speed_m_s": (-1.0, 0.0, 1e-4, 0.3, 3.0),
    "direction": (-1.0, 1.0),
    "valve": (0.0, 0.5, 1.0),
    "pressure_pa": (5e4, 101325.0, 6e5, 1.2e6),
    "pressure_ratio": (0.05, 0.5, 1.0, 1.0001, 10.0),
}
"""Values of each argument at which a term must be a finite number."""

RAISES = {"RAISE_VARARGS", "LOAD_ASSERTION_ERROR"}
"""Instructions of `raise` and `assert`, which the equations cannot pass on."""

SIGNATURE = types.float64(*[types.float64] * 5, types.CPointer(types.float64))


class AddedTerm:
    """A function of what its slot offers (by argument name) and of values that an effect sets."""

    def __init__(self, slot: Slot, function: Callable[..., float]) -> None:
        self.slot = slot
        self.function = function
        self.name = function.__name__
        code = function.__code__
        self.where = f"{code.co_filename}:{code.co_firstlineno}: {self.name}"
        given = inspect.signature(function).parameters.values()
        self.arguments = tuple(item.name for item in given if item.name in ARGUMENTS[slot])
        self.values = tuple(item.name for item in given if item.name not in ARGUMENTS[slot])
        if any(item.kind is not item.POSITIONAL_OR_KEYWORD for item in given):
            raise InputError(f"{self.where}: *, / or ** in its arguments; expected plain names")
        if {item.opname for item in dis.get_instructions(code)} & RAISES:
            raise InputError(f"{self.where}: raises an error; expected a number for all arguments")
        if len(self.values) > ADDED_VALUES:
            raise InputError(
                f"{self.where}: {len(self.values)} arguments besides {', '.join(ARGUMENTS[slot])}; "
                f"expected at most {ADDED_VALUES}"
            )

    @functools.cached_property
    def compiled(self) -> Any:
        """The function compiled to a C function of five numbers and a pointer to its values.

        Raises InputError with file, line and reason if numba cannot compile it.
        """
        function = numba.njit(error_model="numpy", forceinline=True)(self.function)
        passed = [
            f"a{ARGUMENTS[self.slot][name]}" if name in self.arguments else
            f"values[{self.values.index(name)}]"
            for name in inspect.signature(self.function).parameters
        ]  # fmt: skip
        space: dict[str, Any] = {"function": function}
        source = f"def entry(a0, a1, a2, a3, a4, values):\n    return function({', '.join(passed)})"
        exec(source, space)
        try:
            return numba.cfunc(SIGNATURE, error_model="numpy")(space["entry"])
        except Exception as error:  # numba's own errors, and what its inspection of the code meets
            raise InputError(f"{self._line_of(error)}: {reason_of(error)}") from None

    def _line_of(self, error: Exception) -> str:
        """Return FILE:LINE: NAME of what numba could not compile."""
        file, first = self.function.__code__.co_filename, self.function.__code__.co_firstlineno
        lines = [
            int(part.split(":")[0].split(" ")[0])
            for part in str(error).split(f'File "{file}", line ')[1:]
        ]
        return f"{file}:{lines[-1] if lines else first}: {self.name}"

    def add_to(self, setup: Setup, **values: float) -> None:
        """Add the term, with these values of its other arguments, to a stroke.

        Raises InputError if they are not its arguments, or the stroke has no room for one more.
        """
        if set(values) != set(self.values):
            expected = ", ".join(self.values) or "none"
            raise InputError(
                f"{self.where}: values {', '.join(values) or 'none'}; expected {expected}"
            )
        p = setup.p
        count = int(p.added_count)
        if count == MOST_ADDED:
            raise InputError(
                f"{self.where}: the {count + 1}th added term; expected at most {MOST_ADDED}"
            )
        row = p.added[count]
        row[0] = self.slot
        row[1] = self.compiled.address
        row[2:] = 0.0
        row[2 : 2 + len(self.values)] = [values[name] for name in self.values]
        p.added_count = count + 1.0

    def tried(self, values: list[float]) -> Iterator[tuple[dict[str, float], float]]:
        """Yield arguments all over their ranges, and the term there, for these values."""
        own = np.array(values)
        call = self.compiled.ctypes
        pointer = own.ctypes.data_as(call.argtypes[-1])
        for chosen in product(*(TRIED[name] for name in self.arguments)):
            at = dict(zip(self.arguments, chosen, strict=True))
            five = [0.0] * 5
            for name, value in at.items():
                five[ARGUMENTS[self.slot][name]] = value
            yield at, float(call(*five, pointer))


def reason_of(error: Exception) -> str:
    """Return what numba says of a function that it cannot compile, as one line."""
    noise = ("Failed in", "File ", "During", "[1] During", "-")
    lines = [line.strip() for line in str(error).splitlines()]
    said = next((line for line in lines if line and not line.startswith(noise)), "no reason given")
    said = re.sub(r" for '\$.*", "", said).rstrip(".")
    return f"numba cannot compile it: {said}; expected numbers and functions of math and numpy"


ALL_TERMS: list[AddedTerm] = []
"""Every term of this process, in the order of its definition."""


def added_term(slot: Slot) -> Callable[[Callable[..., float]], AddedTerm]:
    """Make the function below a term of a slot of the equations.

    Its arguments are, by name, what `ARGUMENTS` lists for the slot, as far as it needs them, and
    values that the effect sets.

    Raises InputError for a slot that has one value a stroke: an effect changes that in its setup.
    """
    if slot not in ARGUMENTS:
        expected = ", ".join(item.name for item in ARGUMENTS)
        raise InputError(f"slot {slot!r}: no term can be added there; expected {expected}")

    def make(function: Callable[..., float]) -> AddedTerm:
        term = AddedTerm(slot, function)
        ALL_TERMS.append(term)
        return term

    return make


def compile_terms() -> None:
    """Compile all terms now, so that the processes that are forked from this one have them."""
    for term in ALL_TERMS:
        _ = term.compiled
