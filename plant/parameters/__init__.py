"""Parameter sets: every number with its value, unit and source, in TOML files of sections.

The shipped set `nominal` is the calibrated actuator. An extended model names its base and adds `[effect.<id>]`;
`[cylinder]` states another actuator (`plant.parameters.cylinder`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.errors import nearest
from can_dbc.typed_toml import convert, read_toml
from plant.errors import InputError
from plant.parameters import calibration, cylinder
from plant.parameters.bounds import outside

Number = float | tuple[float, ...]


class Parameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number (or list of numbers) with its unit and where it comes from."""

    value: Number
    unit: str
    source: str
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        for name in ("unit", "source"):
            if not getattr(self, name).strip():
                raise InputError(f"{name}: {getattr(self, name)!r} is wrong; expected a text")


class _Base(msgspec.Struct, forbid_unknown_fields=True):
    model: str


@dataclass(frozen=True)
class ParameterSet:
    """A named, immutable set of parameters, addressed as `section.key`; `effects`: id -> name -> Parameter."""

    name: str
    entries: Mapping[str, Parameter]
    effects: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)

    def __getitem__(self, path: str) -> Parameter:
        """Return the parameter at `section.key`. Raises InputError with the nearest names if there is none."""
        try:
            return self.entries[path]
        except KeyError:
            raise InputError(unknown_path(path, self.entries, self.name)) from None

    def __contains__(self, path: object) -> bool:
        return path in self.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def value(self, path: str) -> float:
        """Return the single number at `section.key`, in its unit. Raises InputError for a list."""
        value = self[path].value
        if isinstance(value, tuple):
            raise InputError(f"{self.name}: {path}: is a list; expected one number")
        return value

    def values(self, path: str) -> tuple[float, ...]:
        """Return the list of numbers at `section.key`."""
        value = self[path].value
        return value if isinstance(value, tuple) else (value,)

    def override(
        self, changes: Mapping[str, float | int | list[float] | tuple[float, ...]]
    ) -> ParameterSet:
        """Return a new set with some values replaced. Raises InputError for unknown paths and wrong kinds."""
        entries = dict(self.entries)
        for path, raw in changes.items():
            old = self[path]
            value = number(raw, f"{self.name}: {path}")
            if isinstance(value, tuple) != isinstance(old.value, tuple):
                kind = "a list of numbers" if isinstance(old.value, tuple) else "one number"
                raise InputError(f"{self.name}: {path}: expected {kind}, got {raw!r}")
            entries[path] = Parameter(value, old.unit, f"override of: {old.source}")
            check_range(path, entries[path], f"{self.name}: {path}")
        return ParameterSet(self.name, complete(entries, self.name), self.effects)


def unknown_path(path: str, entries: Mapping[str, Any], name: str) -> str:
    """Return one line that names an unknown path and those that are nearest."""
    near = nearest(path, entries, cutoff=0.4)
    if not near:
        tail = path.rsplit(".", 1)[-1]
        near = [k for k in entries if k.rsplit(".", 1)[-1].lower() == tail.lower()][:3]
    sections = ", ".join(f"{section}.*" for section in sorted({k.split(".")[0] for k in entries}))
    hint = f"one of {', '.join(near)}, ..." if near else f"one of {sections}"
    return f"{name}: {path}: no such parameter; expected {hint}"


def number(raw: object, where: str) -> Number:
    """Return a finite number or list of numbers; InputError starts with `where`."""
    if isinstance(raw, (list, tuple)):
        return tuple(scalar(item, where) for item in raw)
    return scalar(raw, where)


def scalar(raw: object, where: str) -> float:
    """Return a finite number. Raises InputError that starts with `where` for anything else."""
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        raise InputError(f"{where}: expected a number, got {raw!r}")
    try:
        value = float(raw)
    except OverflowError:
        raise InputError(f"{where}: number too large") from None
    if not math.isfinite(value):
        raise InputError(f"{where}: expected a finite number, got {raw!r}")
    return value


def shipped() -> list[str]:
    """Return the names of the parameter sets that come with the package."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))


def load(model: str | Path = "nominal", based_on: tuple[str, ...] = ()) -> ParameterSet:
    """Load a shipped set by name, or a model file by path.

    A file is a full set, or starts with `[base] model = "nominal"` and changes keys of it, with the same units, or
    adds `effects`. based_on: the files whose [base] led here. Raises InputError for an unknown name and for whatever
    is wrong in the file.
    """
    text = str(model)
    path = Path(text)
    if not text.endswith(".toml"):
        path = Path(__file__).parent / f"{text}.toml"
        if text not in shipped():
            raise InputError(
                f"model {text!r}: no such parameter set; expected {', '.join(shipped())}, "
                "or the path of a .toml file"
            )
    if (real := os.path.realpath(path)) in based_on:
        raise InputError(
            f"{path}: base.model: leads back to this file; expected a full set at its end"
        )
    name = path.stem if path.parent == Path(__file__).parent else str(path)
    return parse(read_toml(path), name, (*based_on, real))


def load_actuator(model: str) -> ParameterSet:
    """Load the parameters of an actuator that shifts gears. Raises InputError as `load`, and for a [cylinder]."""
    parameters = load(model)
    if "cylinder.bore" in parameters:
        what = "states a [cylinder], which shifts no gears; expected a model of the actuator"
        raise InputError(f"{parameters.name}: {what}")
    return parameters


def parse(raw: Mapping[str, Any], name: str, based_on: tuple[str, ...] = ()) -> ParameterSet:
    """Return a parsed model file as a ParameterSet (see `load`). Raises InputError as `load` does."""
    sections = dict(raw)
    base = None
    if "base" in sections:
        model = convert(sections.pop("base"), _Base, name, "base").model
        near = Path(name).parent / model  # a model file may lie next to the one that it is based on
        base = load(near if model.endswith(".toml") and near.is_file() else model, based_on)
    tables = dict[str, dict[str, Parameter]]
    effects = convert(sections.pop("effect", {}), tables, name, "effect")
    given = {
        f"{section}.{key}": item
        for section, table in convert(sections, tables, name).items()
        for key, item in table.items()
    }
    possible = dict(base.entries if base else given if name == "nominal" else load().entries)
    optional = cylinder.UNITS | calibration.UNITS
    possible |= {path: Parameter(0.0, unit, "optional") for path, unit in optional.items()}
    for path, item in given.items():
        if path not in possible:
            raise InputError(unknown_path(path, possible, name))
        if item.unit != possible[path].unit:
            raise InputError(
                f"{name}: {path}: unit {item.unit!r}; expected {possible[path].unit!r}"
            )
        check_range(path, item, f"{name}: {path}.value")
    if base is not None:
        entries = complete({**base.entries, **given}, name)
        return ParameterSet(name, entries, {**base.effects, **effects})
    given = {"length.F_bond": possible["length.F_bond"]} | given  # a full set may leave it out
    for path in possible:
        if path not in given and path not in optional:
            raise InputError(f'{name}: no {path}; expected a full set, or [base] model = "nominal"')
    return ParameterSet(name, complete(given, name), effects)


def complete(entries: Mapping[str, Parameter], name: str) -> dict[str, Parameter]:
    """Return the entries with what follows from [cylinder], if there is one. Raises InputError if that is impossible."""
    completed = dict(entries)
    stated = {
        path: float(item.value)
        for path, item in entries.items()
        if path in cylinder.UNITS and not isinstance(item.value, tuple)
    }
    for path, value in cylinder.derived(stated, name).items() if stated else ():
        if path in cylinder.USUAL:
            usual = Parameter(value, cylinder.UNITS[path], "usual value")
            completed.setdefault(path, usual)
        else:
            unit = completed[path].unit
            completed[path] = Parameter(value, unit, "computed from [cylinder]")
    return completed


def check_range(path: str, item: Parameter, where: str) -> None:
    """Raise InputError for values that the parameter at `section.key` cannot have."""
    values = item.value if isinstance(item.value, tuple) else (item.value,)
    wrong = outside(path, item.unit, values)
    if wrong:
        raise InputError(f"{where}: {wrong}")
