"""TOML files as typed records: strict, and every error names file, key and what was expected."""

from __future__ import annotations

import functools
import math
import re
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from can_dbc.errors import InputError, unknown_name
from can_dbc.user_file import read_user_file
from plant.parameters import parsed

T = TypeVar("T")

_WHAT_AND_PATH = re.compile(r"^(?P<what>.*?)(?: - at `(?P<path>.*)`)?$", re.DOTALL)
_NAMED = re.compile(r"`(?P<name>[^`]*)`$")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file into a dictionary; numbers must be finite.

    Raises InputError naming file and line or key.
    """
    return parse_toml(read_user_file(path, "a TOML file"), str(path))


def parse_toml(raw: bytes, source: str) -> dict[str, Any]:
    """Return parsed TOML bytes; `source` names the file in messages. Raises InputError."""
    try:
        table = parsed(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: byte {error.start}: not UTF-8; expected TOML text") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: {one_line(str(error))}; expected TOML") from None
    except RecursionError:
        raise InputError(f"{source}: top level: nested too deeply; expected TOML") from None
    except ValueError as error:  # an impossible date, an integer of too many digits
        raise InputError(f"{source}: {one_line(str(error))}; expected TOML") from None
    refuse_not_finite(table, source)
    return table


def one_line(text: str, width: int = 200) -> str:
    """Return text with line breaks and control characters made visible, cut to a width."""
    clean = " ".join(text.split())
    clean = "".join(c if c.isprintable() else repr(c)[1:-1] for c in clean)
    return clean if len(clean) <= width else clean[: width - 3] + "..."


def convert(raw: Any, kind: type[T], source: str, key: str = "") -> T:
    """Turn parsed TOML into a typed record; unknown keys, wrong types and ranges are refused.

    `key`: the table that `raw` is, in messages. Raises InputError 'SOURCE: KEY: what; expected ...'.
    """
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        found = _WHAT_AND_PATH.match(str(error))
        assert found is not None  # the pattern matches any text
        steps = _named(raw, kind, tuple(_steps(found["path"] or "$")))
        if isinstance(error.__cause__, ValueError):  # a record that checks itself says it all
            inside = dotted((key, *steps) if key else steps)
            joint = "." if isinstance(error.__cause__, InputError) else ": "
            message = f"{inside}{joint}{found['what']}" if inside else found["what"]
            raise InputError(f"{source}: {one_line(message, 400)}") from None
        raise InputError(_message(raw, kind, source, key, found["what"], steps)) from None


def _named(raw: Any, kind: Any, steps: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """Put the first wrong entry's name where the library says '...' for some entry of a table."""
    if "..." not in steps:
        return steps
    before = steps[: steps.index("...")]
    table, at = _descend(raw, kind, before)
    child = _child_type(at, table, "...")
    for key, value in table.items():
        try:
            msgspec.convert(value, child)
        except msgspec.ValidationError:
            return (*before, str(key), *steps[len(before) + 1 :])
    return steps


def _message(
    raw: Any, kind: Any, source: str, prefix: str, what: str, steps: tuple[str | int, ...]
) -> str:
    value, at = _descend(raw, kind, steps)
    location = dotted((prefix, *steps) if prefix else steps) or "top level"
    shown = one_line(repr(value), 60)
    name = _NAMED.search(what)
    if what.startswith("Object contains unknown field") and name:
        key = name["name"]
        inside = f"{location}.{key}" if steps or prefix else key
        known = field_types(at, value)
        return f"{source}: {one_line(inside)}: {unknown_name(key, known)}"
    if what.startswith("Object missing required field") and name:
        key = name["name"]
        inside = f"{location}.{key}" if steps or prefix else key
        choices = _choices(at, value, key)
        expected = f"one of {', '.join(choices)}" if choices else "a value"
        return f"{source}: {inside}: missing; expected {expected}"
    choices = _choices(at, value, None) or (_choices_of_tag(raw, kind, steps) if steps else [])
    if choices and what.startswith("Invalid"):
        return f"{source}: {one_line(location)}: {shown} is {unknown_name(str(value), choices)}"
    if what.startswith("Invalid enum value"):  # a key of a table whose keys are a choice
        names = typing.get_args(_plain(typing.get_args(_plain(at))[0]))
        key = next(key for key in value if key not in names)
        return f"{source}: {one_line(location)}.{one_line(key)}: {unknown_name(key, names)}"
    expected = what.removeprefix("Expected ").split(", got ")[0].replace("`", "")
    if what == "Number out of range":
        expected = "a smaller number"
    for word, in_toml in _IN_TOML.items():
        expected = re.sub(rf"\b{word}\b", in_toml, expected)
    return f"{source}: {one_line(location)}: {shown} is wrong; expected {one_line(expected)}"


_IN_TOML = {
    "object": "table",
    "array": "list",
    "bool": "true or false",
    "str": "text",
    "int": "whole number",
    "float": "number",
    r" \| null": "",
}
"""Words of msgspec's messages, and what TOML calls them."""


def _choices_of_tag(raw: Any, kind: Any, steps: tuple[str | int, ...]) -> list[str]:
    parent_value, parent = _descend(raw, kind, steps[:-1])
    return _choices(parent, parent_value, str(steps[-1]))


def _steps(path: str) -> Iterator[str | int]:
    for name, index in re.findall(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]", path):
        if name:
            yield name
        else:
            yield int(index) if index.isdigit() else index


def dotted(steps: Iterable[str | int]) -> str:
    """Return the steps to a value as text, e.g. request[0].gear."""
    text = ""
    for step in steps:
        if isinstance(step, int) or step == "...":
            text += f"[{step}]"
        else:
            text += f".{step}" if text else step
    return text


def _descend(value: Any, kind: Any, steps: tuple[str | int, ...]) -> tuple[Any, Any]:
    """Follow the steps through value and type together; either may end as None."""
    for step in steps:
        kind = _child_type(kind, value, step)
        if isinstance(value, dict):
            value = value.get(step) if step != "..." else next(iter(value.values()), None)
        elif isinstance(value, list) and isinstance(step, int) and step < len(value):
            value = value[step]
        else:
            value = None
    return value, kind


def _plain(kind: Any) -> Any:
    """Strip Annotated and Optional."""
    if typing.get_origin(kind) is typing.Annotated:
        return _plain(typing.get_args(kind)[0])
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        rest = [a for a in typing.get_args(kind) if a is not types.NoneType]
        if len(rest) == 1:
            return _plain(rest[0])
    return kind


def _members(kind: Any) -> list[Any]:
    kind = _plain(kind)
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return [_plain(a) for a in typing.get_args(kind)]
    return [kind]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _structs(kind: Any, value: Any) -> list[Any]:
    """Return the record types that a value of this type may be; a known tag picks one."""
    structs = [m for m in _members(kind) if _is_struct(m)]
    for struct in structs:
        config = struct.__struct_config__
        if (
            config.tag_field
            and isinstance(value, dict)
            and value.get(config.tag_field) == config.tag
        ):
            return [struct]
    return structs


_fields = functools.cache(msgspec.structs.fields)


def field_types(kind: Any, value: Any = None) -> dict[str, Any]:
    """Return the fields of a record type (or tagged union) by their names in the file."""
    found: dict[str, Any] = {}
    for struct in _structs(kind, value):
        if struct.__struct_config__.tag_field:
            found[struct.__struct_config__.tag_field] = str
        for field in _fields(struct):
            found[field.encode_name] = field.type
    return found


def _child_type(kind: Any, value: Any, step: str | int) -> Any:
    kind = _plain(kind)
    origin = typing.get_origin(kind)
    if origin in (list, tuple):
        return typing.get_args(kind)[0]
    if origin is dict:
        return typing.get_args(kind)[1]
    return field_types(kind, value).get(str(step))


def _choices(kind: Any, value: Any, key: str | None) -> list[str]:
    """Return the allowed values of a choice type, or of the field (or tag) `key` of a record."""
    if key is None:
        found: list[str] = []
        for member in _members(kind):
            if typing.get_origin(member) is typing.Literal:
                found += [str(a) for a in typing.get_args(member)]
        return found
    structs = [m for m in _members(kind) if _is_struct(m)]
    tags = [str(s.__struct_config__.tag) for s in structs if s.__struct_config__.tag_field == key]
    return tags or _choices(field_types(kind, value).get(key), None, None)


def refuse_not_finite(value: Any, source: str) -> None:
    """Check that all numbers of a parsed table are finite. Raises InputError naming the key."""
    pending: list[tuple[tuple[str | int, ...], Any]] = [((), value)]
    while pending:
        steps, item = pending.pop()
        if isinstance(item, dict):
            pending += [((*steps, k), v) for k, v in item.items()]
        elif isinstance(item, list):
            pending += [((*steps, i), v) for i, v in enumerate(item)]
        elif isinstance(item, float) and not math.isfinite(item):
            location = one_line(dotted(steps))
            raise InputError(f"{source}: {location}: {item} is wrong; expected a finite number")


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
    if not field_types(kind, value):
        yield dotted(prefix)
        return
    for name, child in field_types(kind, value).items():
        inner = value.get(name) if isinstance(value, dict) else None
        origin = typing.get_origin(_plain(child))
        if origin in (list, tuple) and isinstance(inner, list) and inner:
            item = typing.get_args(_plain(child))[0]
            for index, element in enumerate(inner):
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
    if not steps:
        return False
    at: Any = raw
    for position, step in enumerate(steps):
        last = position == len(steps) - 1
        child = _child_type(kind, at, step)
        if child is None:
            return False
        if isinstance(at, list):
            if not isinstance(step, int) or step >= len(at):
                return False
        elif not isinstance(at, dict) or isinstance(step, int):
            return False
        if last:
            at[step] = value
            return True
        if isinstance(at, dict) and at.get(str(step)) is None:
            at[str(step)] = {}
        at = at[step]
        kind = child
    return False
