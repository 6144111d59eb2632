"""Terms that an effect adds to the equations: plain functions, compiled when they are first used.

A function's address and the values of its parameters are written into a stroke's record, and the equations call it in
its slot: no kernel is compiled again. A stroke with an added term takes the scalar kernel, also in a batch.
"""

from __future__ import annotations

import dis
import functools
import inspect
import re
import threading
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numba
import numpy as np

from plant.effects.setup import Setup
from plant.errors import InputError
from plant.kernel.compiled import c_function
from plant.kernel.layout import ADDED_VALUES, MOST_ADDED, Slot
from plant.kernel.views import TERM
from plant.parts.term import DIRECTION, POSITION, PRESSURE, SPEED, TIME, sum_of_terms

__all__ = ["ARGUMENTS", "AddedTerm", "Slot", "added_term"]

ARGUMENTS: dict[Slot, dict[str, int]] = {
    Slot.FORCE: {"time_s": TIME, "position_m": POSITION, "speed_m_s": SPEED},
    Slot.RESISTANCE: {"position_m": POSITION, "speed_m_s": SPEED, "direction": DIRECTION},
    **{
        slot: {"time_s": TIME, "position_m": POSITION, "valve": DIRECTION, "pressure_pa": PRESSURE}
        for slot in (Slot.FLOW_1, Slot.FLOW_2, Slot.FLOW_3, Slot.LEAK)
    },
    Slot.CHARGE: {"pressure_ratio": PRESSURE},
    Slot.DISCHARGE: {"pressure_ratio": PRESSURE},
    Slot.EXPONENT: {"speed_m_s": SPEED},
}
"""What the term of a slot may depend on, and where the equations pass it (`call_at`)."""


class AddedTerm:
    """A function of what its slot offers (by argument name) and of values that an effect sets."""

    time_limit_s = 20.0  # for its values all over the ranges; one that takes longer never ends

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
        # instructions of `raise` and `assert`, which the equations cannot pass on
        raising = {"RAISE_VARARGS", "LOAD_ASSERTION_ERROR"}
        if raising & {item.opname for item in dis.get_instructions(code)}:
            raise InputError(f"{self.where}: raises an error; expected a number for all arguments")

    @functools.cached_property
    def compiled(self) -> Any:
        """The function as a C function of six numbers and a pointer to its values. Raises InputError if numba refuses it."""
        function = numba.njit(error_model="numpy", forceinline=True)(self.function)
        passed = [
            f"a{ARGUMENTS[self.slot][name]}" if name in self.arguments else
            f"values[{self.values.index(name)}]"
            for name in inspect.signature(self.function).parameters
        ]  # fmt: skip
        space: dict[str, Any] = {"function": function}
        source = (
            f"def entry(a0, a1, a2, a3, a4, a5, values):\n    return function({', '.join(passed)})"
        )
        exec(source, space)
        try:
            return numba.cfunc(TERM, error_model="numpy")(space["entry"])
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
        """Add the term, with values of its other arguments, to a stroke. Raises InputError for other names, or no room."""
        if set(values) != set(self.values):
            expected = ", ".join(self.values) or "none"
            raise InputError(
                f"{self.where}: values {', '.join(values) or 'none'}; expected {expected}"
            )
        write_term(setup, self.slot, self.compiled.address, [values[n] for n in self.values])

    def tried(self, values: list[float]) -> list[tuple[dict[str, float], float]]:
        """Return arguments all over their ranges, and the term there. Raises InputError for a call that does not return."""
        passed = np.array(values)
        call = self.compiled.ctypes
        pointer = passed.ctypes.data_as(call.argtypes[-1])
        results: list[tuple[dict[str, float], float]] = []
        tried: dict[str, tuple[float, ...]] = {
            "time_s": (0.0, 0.1, 1.0),
            "position_m": (-0.03, -0.0131, -0.006, 0.0, 1e-4, 0.006, 0.0131, 0.03),
            "speed_m_s": (-1.0, 0.0, 1e-4, 0.3, 3.0),
            "direction": (-1.0, 1.0),
            "valve": (0.0, 0.5, 1.0),
            "pressure_pa": (5e4, 101325.0, 6e5, 1.2e6),
            "pressure_ratio": (0.05, 0.5, 1.0, 1.0001, 10.0),
        }
        trials = [
            dict(zip(self.arguments, chosen, strict=True))
            for chosen in product(*(tried[name] for name in self.arguments))
        ]

        def call_all() -> None:
            for at in trials:
                six = [0.0] * 6
                for name, value in at.items():
                    six[ARGUMENTS[self.slot][name]] = value
                results.append((at, float(call(*six, pointer))))

        # not even Ctrl-C ends compiled code; a daemon ends with the process
        thread = threading.Thread(target=call_all, daemon=True)
        thread.start()
        thread.join(self.time_limit_s)
        if thread.is_alive():
            call_now = self.called(trials[len(results)], values)
            trials.clear()  # so that a slow term is not called again
            raise InputError(
                f"{call_now} does not return within {self.time_limit_s:g} s; expected a number at once"
            )
        return results

    def called(self, at: dict[str, float], values: list[float]) -> str:
        """Return a call of the term as its user would write it, after FILE:LINE."""
        return f"{self.where}({shown(at | dict(zip(self.values, values, strict=True)))})"


def shown(values: dict[str, float]) -> str:
    """Return values as arguments."""
    return ", ".join(f"{name}={value:g}" for name, value in values.items())


def write_term(setup: Setup, slot: float, address: int, values: Sequence[float]) -> None:
    """Write a term, by its function's address and its values, into a stroke. Raises InputError if there is no room."""
    p = setup.p
    count = int(p.added_count)
    used = int(p.added_used)
    if count == MOST_ADDED or used + len(values) > ADDED_VALUES:
        raise InputError(
            f"{count + 1} added terms of {used + len(values)} values on one stroke; expected at most "
            f"{MOST_ADDED} of {ADDED_VALUES}"
        )
    p.adder = adder_address()
    p.added[count] = slot, address, used
    p.added_values[used : used + len(values)] = values
    p.added_count = count + 1.0
    p.added_used = used + len(values)


@functools.cache
def adder_address() -> int:
    """Return the address of the function that the equations call."""
    return int(c_function(sum_of_terms, TERM).address)


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

    Its arguments are, by name, those of `ARGUMENTS` that it needs, and values that the effect sets.
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
