"""Parameter sets: every number with its value, unit and source.

A set is a TOML file of sections with entries `key = { value, unit, source }`.  The shipped set
`nominal` is the calibrated actuator.  An extended model names its base and adds `[effect.<id>]`.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from can_dbc.errors import nearest
from can_dbc.user_file import read_user_text
from plant.errors import InputError
from plant.parameters.bounds import outside

Number = float | tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number (or list of numbers) with its unit and where it comes from."""

    value: Number
    unit: str
    source: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class ParameterSet:
    """A named, immutable set of parameters, addressed as `section.key`.

    `effects` holds the extensions of an extended model, `effect id -> name -> Parameter`.
    """

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
        """Return a new set with some values rewhered. Raises InputError for unknown paths and wrong kinds."""
        entries = dict(self.entries)
        for path, raw in changes.items():
            old = self[path]
            value = number(raw, f"{self.name}: {path}")
            if isinstance(value, tuple) != isinstance(old.value, tuple):
                kind = "a list of numbers" if isinstance(old.value, tuple) else "one number"
                raise InputError(f"{self.name}: {path}: expected {kind}, got {raw!r}")
            entries[path] = Parameter(value, old.unit, f"override of: {old.source}")
            check_range(path, entries[path], f"{self.name}: {path}")
        return ParameterSet(self.name, entries, self.effects)


def unknown_path(path: str, known: Mapping[str, Any], name: str) -> str:
    """Return one line that names an unknown path and the nearest known ones."""
    near = nearest(path, known, cutoff=0.4)
    if not near:
        tail = path.rsplit(".", 1)[-1]
        near = [k for k in known if k.rsplit(".", 1)[-1].lower() == tail.lower()][:3]
    hint = ", ".join(near) if near else ", ".join(sorted({k.split(".")[0] for k in known}))
    return f"{name}: {path}: no such parameter; nearest: {hint}"


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


_DEEP_KEY = re.compile(r"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){100}")
"""A key of more than a hundred parts; nothing else has that many words between dots."""


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file; unreadable or malformed files raise InputError naming file and where."""
    text = read_user_text(path, "a TOML file")
    try:
        return parsed(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None
    except ValueError as error:  # an impossible date, an integer of too many digits
        raise InputError(f"{path}: not valid TOML: {error}") from None


def parsed(text: str) -> dict[str, Any]:
    """Parse TOML as tomllib does, whose time grows with the square of a dotted key's parts.

    Raises RecursionError for keys of very many parts, and what tomllib raises.
    """
    if _DEEP_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)


def parameter(raw: object, where: str) -> Parameter:
    """Return a `{ value, unit, source }` table as a Parameter. Raises InputError for anything else."""
    if not isinstance(raw, dict):
        raise InputError(f"{where}: expected {{ value, unit, source }}, got {raw!r}")
    unknown = set(raw) - {"value", "unit", "source", "low", "high"}
    if unknown:
        raise InputError(
            f"{where}: unknown key {sorted(unknown)[0]!r}; expected value, unit, source"
        )
    for key in ("value", "unit", "source"):
        if key not in raw:
            raise InputError(f"{where}: no {key}; expected value, unit, source")
    for key in ("unit", "source"):
        if not isinstance(raw[key], str) or not raw[key].strip():
            raise InputError(f"{where}: {key}: expected a non-empty text, got {raw[key]!r}")
    bounds = [scalar(raw[key], f"{where}.{key}") if key in raw else None for key in ("low", "high")]
    return Parameter(
        number(raw["value"], f"{where}.value"), raw["unit"], raw["source"], bounds[0], bounds[1]
    )


def shipped() -> list[str]:
    """Return the names of the parameter sets that come with the package."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.toml"))


def load(model: str | Path = "nominal") -> ParameterSet:
    """Load a shipped set by name, or a model file by path.

    A file may be a full set, or start with `[base] model = "nominal"` and change or add to it;
    every key it sets must exist in the base, with the same unit.  `[effect.<id>]` tables become
    `effects`. Raises InputError for an unknown name and for whatever is wrong in the file.
    """
    text = str(model)
    path = Path(text)
    if not text.endswith(".toml"):
        path = Path(__file__).parent / f"{text}.toml"
        if text not in shipped():
            near = nearest(text, shipped(), cutoff=0.3) or shipped()
            raise InputError(
                f"model {text!r}: no such parameter set; shipped: {', '.join(near)}, "
                "or give the path of a .toml file"
            )
    return parse(read_toml(path), path.stem if path.parent == Path(__file__).parent else str(path))


def parse(raw: Mapping[str, Any], name: str) -> ParameterSet:
    """Return a parsed model file as a ParameterSet (see `load`). Raises InputError as `load` does."""
    entries: dict[str, Parameter] = {}
    effects: dict[str, dict[str, Parameter]] = {}
    base: ParameterSet | None = None
    if "base" in raw:
        table = raw["base"]
        if not isinstance(table, dict) or set(table) != {"model"}:
            raise InputError(f'{name}: [base]: expected model = "<name>"')
        if not isinstance(table["model"], str):
            raise InputError(f"{name}: base.model: expected a name, got {table['model']!r}")
        base = load(table["model"])
        entries.update(base.entries)
        effects.update({k: dict(v) for k, v in base.effects.items()})
    for section, table in raw.items():
        if section == "base":
            continue
        if not isinstance(table, dict):
            raise InputError(f"{name}: {section}: expected a section, got {table!r}")
        if section == "effect":
            for effect, body in table.items():
                where = f"{name}: [effect.{effect}]"
                if not isinstance(body, dict):
                    raise InputError(f"{where}: expected a table of parameters")
                effects[effect] = {
                    key: parameter(value, f"{where} {key}") for key, value in body.items()
                }
            continue
        for key, value in table.items():
            where = f"{name}: [{section}] {key}"
            item = parameter(value, where)
            full = f"{section}.{key}"
            if base is not None:
                if full not in entries:
                    raise InputError(unknown_path(full, entries, name))
                if entries[full].unit != item.unit:
                    raise InputError(
                        f"{where}: unit {item.unit!r}; expected {entries[full].unit!r}"
                    )
            check_range(full, item, f"{where}.value")
            entries[full] = item
    if base is None:
        check_complete(entries, name)
    return ParameterSet(name, entries, effects)


def check_range(path: str, item: Parameter, where: str) -> None:
    """Raise InputError for values that the parameter at `section.key` cannot have."""
    values = item.value if isinstance(item.value, tuple) else (item.value,)
    wrong = outside(path, item.unit, values)
    if wrong:
        raise InputError(f"{where}: {wrong}")


def check_complete(entries: Mapping[str, Parameter], name: str) -> None:
    """Raise InputError if a full set lacks or adds keys, or changes units, against the nominal one."""
    reference = Path(__file__).parent / "nominal.toml"
    wanted = {
        f"{section}.{key}": value["unit"]
        for section, table in read_toml(reference).items()
        for key, value in table.items()
    }
    for path, unit in wanted.items():
        if path not in entries:
            raise InputError(f'{name}: no {path}; expected a full set, or [base] model = "nominal"')
        if entries[path].unit != unit:
            raise InputError(f"{name}: {path}: unit {entries[path].unit!r}; expected {unit!r}")
    for path in entries:
        if path not in wanted:
            raise InputError(unknown_path(path, wanted, name))
