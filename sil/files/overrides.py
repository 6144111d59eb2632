"""Settings: values of a scenario, model or firmware by their path, and the text PATH=VALUE of `--set`."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from can_dbc.errors import InputError
from can_dbc.typed_toml import child_type, dotted, field_types, one_line
from sil.files.quantity import unit_of, without_units

if TYPE_CHECKING:
    from plant.parameters import ParameterSet

Settings = Mapping[str, Any]
"""Values by path, e.g. {"valve.D_fall": 0.02}; a value is what TOML can hold."""
NO_SETTINGS: Settings = MappingProxyType({})


def parse_setting(text: str) -> tuple[str, Any]:
    """Return path and value, of TOML or else text, of PATH=VALUE. Raises InputError if one is missing."""
    path, sign, written = (part.strip() for part in text.partition("="))
    if not sign or not path:
        raise InputError(f"--set {one_line(text)}: no value; expected PATH=VALUE")
    if written in ("True", "False"):
        raise InputError(f"--set {path}: {written}; expected true or false, as TOML has it")
    try:
        value = tomllib.loads(f"v = {written}")
    except (ValueError, RecursionError):
        return path, written
    return path, value["v"] if set(value) == {"v"} else written


def setting_texts(settings: Settings) -> list[str]:
    """Return settings as PATH=VALUE, as a user types them."""
    texts = []
    for path, value in settings.items():
        typed = f"{path}={value}"
        plain = isinstance(value, str) and value and parse_setting(typed) == (path, value)
        texts.append(typed if plain else f"{path}={toml_value(value)}")
    return texts


def toml_value(value: Any) -> str:
    """Return a value, a table, or a list of either, as TOML text."""
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, dict):
        pairs = (f"{json.dumps(k)} = {toml_value(v)}" for k, v in value.items())
        return "{ " + ", ".join(pairs) + " }"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def model_settings(settings: Settings, parameters: ParameterSet) -> dict[str, Any]:
    """Return settings of a model in the units of its parameters. Raises InputError for a text."""

    def unit(path: str) -> str:
        return parameters[path].unit if path in parameters else unit_of(path)

    numbers: dict[str, Any] = without_units(dict(settings), "--set", unit)
    for path, value in numbers.items():
        if isinstance(value, str):
            raise InputError(f"--set {path}: {value!r}; expected a number")
    return numbers


def leaf_paths(kind: Any, value: Any, prefix: tuple[str | int, ...] = ()) -> Iterator[str]:
    """Yield the dotted path of every value that a record of this type may have."""
    fields = field_types(kind, value)
    if not fields:
        yield dotted(prefix)
    for name, child in fields.items():
        inner = value.get(name) if isinstance(value, dict) else None
        if isinstance(inner, list) and inner:
            for index, element in enumerate(inner):
                item = child_type(child, inner, index)
                yield from leaf_paths(item, element, (*prefix, name, index))
        else:
            yield from leaf_paths(child, inner, (*prefix, name))


def set_value(raw: dict[str, Any], kind: Any, path: str, value: Any) -> bool:
    """Set the value at a path, request[0].gear or request.0.gear; return False when the type has none."""
    steps = [
        int(s) if re.fullmatch(r"[0-9]{1,6}", s) else s
        for s in re.split(r"[.\[]", path.replace("]", ""))
        if s
    ]
    at: Any = raw
    for position, step in enumerate(steps):
        kind = child_type(kind, at, step)
        if kind is None:
            return False
        if isinstance(at, list):
            if not isinstance(step, int) or step >= len(at):
                return False
        elif not isinstance(at, dict) or isinstance(step, int):
            return False
        if position == len(steps) - 1:
            at[step] = value
            return True
        if isinstance(at, dict) and at.get(str(step)) is None:
            at[str(step)] = {}
        at = at[step]
    return False
