"""Values from the command line: `--set PATH=VALUE`, applied to a parsed file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from typing import Any

from can_dbc.errors import InputError
from can_dbc.typed_toml import child_type, dotted, field_types


def parse_value(text: str) -> Any:
    """Read the VALUE of --set: a TOML value, or else the text itself."""
    try:
        value = tomllib.loads(f"v = {text}")
    except (ValueError, RecursionError):
        return text
    return value["v"] if set(value) == {"v"} else text


def model_settings(settings: Iterable[str]) -> dict[str, float | list[float]]:
    """Return texts PATH=VALUE as path -> value. Raises InputError unless VALUE is TOML numbers."""
    changes: dict[str, float | list[float]] = {}
    for text in settings:
        path, equals, value = text.partition("=")
        if not equals or not path.strip():
            raise InputError(f"--set {text!r}: expected PATH=VALUE")
        changes[path.strip()] = parse_value(value)
        if isinstance(changes[path.strip()], str):
            raise InputError(f"--set {path}: {value!r}; expected a number")
    return changes


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
    """Set the value at a dotted path in place; return False when the type has no such path.

    A list is entered by index, request[0].gear or request.0.gear.
    """
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
