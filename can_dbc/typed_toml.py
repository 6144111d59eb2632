"""TOML files as typed records: strict, and every error names file, key and what was expected."""

from __future__ import annotations

import functools
import math
import os
import re
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeVar

import msgspec

from can_dbc.errors import InputError, escaped, unknown_name
from can_dbc.user_file import read_user_file

T = TypeVar("T")
Steps = tuple[str | int, ...]


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file; numbers must be finite. Raises InputError naming file and line or key."""
    return parse_toml(read_user_file(path, "a TOML file"), os.fspath(path))


def parse_toml(raw: bytes, source: str) -> dict[str, Any]:
    """Return parsed TOML bytes; `source` names the file in messages. Raises InputError."""
    try:
        text = raw.decode("utf-8-sig")
        # tomllib's time grows with the square of a key's parts: a hundred are too many
        if re.search(r"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){100}", text):
            raise RecursionError
        table = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: byte {error.start}: not UTF-8; expected TOML text") from None
    except RecursionError:
        raise InputError(f"{source}: top level: nested too deeply; expected TOML") from None
    except ValueError as error:  # also an impossible date, an integer of too many digits
        raise InputError(f"{source}: {one_line(str(error))}; expected TOML") from None
    refuse_not_finite(table, source)
    return table


def refuse_not_finite(value: Any, source: str) -> None:
    """Check that all numbers of a parsed table are finite. Raises InputError naming the key."""
    pending: list[tuple[Steps, Any]] = [((), value)]
    while pending:
        steps, item = pending.pop()
        if isinstance(item, dict):
            pending += [((*steps, k), v) for k, v in item.items()]
        elif isinstance(item, list):
            pending += [((*steps, i), v) for i, v in enumerate(item)]
        elif isinstance(item, float) and not math.isfinite(item):
            location = one_line(dotted(steps))
            raise InputError(f"{source}: {location}: {item} is wrong; expected a finite number")


def one_line(text: str, width: int = 200) -> str:
    """Return text with line breaks and control characters made visible, cut to a width."""
    clean = escaped(" ".join(text.split()))
    return clean if len(clean) <= width else clean[: width - 3] + "..."


def dotted(steps: Iterable[str | int]) -> str:
    """Return the steps to a value as text, e.g. request[0].gear."""
    text = ""
    for step in steps:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += f".{step}" if text else step
    return text


def convert(raw: Any, kind: type[T], source: str = "", key: str = "") -> T:
    """Turn parsed TOML into a typed record; unknown keys, wrong types and ranges are refused.

    `key`: the table that `raw` is. Raises InputError 'SOURCE: KEY: what; expected ...', an empty SOURCE left out.
    """
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        problem = _problem(raw, kind, (key,) if key else ()) or str(error)
        raise InputError(f"{source}: {problem}" if source else problem) from None


def _problem(value: Any, kind: Any, steps: Steps) -> str | None:
    """Return 'KEY: what; expected ...' of the first wrong value inside `value`, None if all fit."""
    plain = _plain(kind)
    origin, arguments = typing.get_origin(plain), typing.get_args(plain)
    structs = record_types(plain, value)
    problem: str | None = None
    if isinstance(value, dict) and structs:
        problem = _record_problem(value, structs, steps)
    elif isinstance(value, dict) and origin is dict:
        keys = dict.fromkeys(_choices(arguments[0]) or value, arguments[1])
        problem = _inside(value, keys, steps, True)
    elif isinstance(value, list) and origin in (list, tuple):
        fixed = origin is tuple and Ellipsis not in arguments
        kinds = arguments if fixed else arguments[:1] * len(value)
        if len(kinds) == len(value):
            problem = _inside(dict(enumerate(value)), dict(enumerate(kinds)), steps, True)
    return problem or _value_problem(value, kind, steps)


def _inside(
    value: Mapping[Any, Any], kinds: Mapping[Any, Any], steps: Steps, strict: bool
) -> str | None:
    """Return the first problem of the values inside a table or list; `strict`: no other key."""
    for name, child in value.items():
        if name not in kinds and strict:
            return _wrong((*steps, name), "", name, kinds)
        if name in kinds and (problem := _problem(child, kinds[name], (*steps, name))):
            return problem
    return None


def _record_problem(value: dict[str, Any], structs: list[Any], steps: Steps) -> str | None:
    config = structs[0].__struct_config__
    if len(structs) > 1 and (tag := config.tag_field):  # its tag names none of them
        tags = [str(struct.__struct_config__.tag) for struct in structs]
        if tag in value:
            return _wrong((*steps, tag), f"{_shown(value[tag])} is", str(value[tag]), tags)
        return _missing((*steps, tag), Literal[*tags])
    problem = _inside(value, field_types(structs[0]), steps, config.forbid_unknown_fields)
    if problem:
        return problem
    for field in _fields(structs[0]):
        if field.required and field.encode_name not in value:
            return _missing((*steps, field.encode_name), field.type)
    return None


def _value_problem(value: Any, kind: Any, steps: Steps) -> str | None:
    """Return what is wrong with a value apart from the values inside it."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        what = str(error).partition(" - at `")[0]
        if isinstance(error.__cause__, ValueError):  # a record that checks itself says it all
            joint = "." if isinstance(error.__cause__, InputError) else ": "
            return one_line(f"{dotted(steps)}{joint}{what}" if steps else what, 400)
        if (choices := _choices(kind)) and what.startswith("Invalid"):
            return _wrong(steps, f"{_shown(value)} is", str(value), choices)
        return f"{_location(steps)}: {_shown(value)} is wrong; expected {_expected(what, kind)}"
    return None


def _expected(what: str, kind: Any) -> str:
    """Return what a type asks for, from msgspec's message; of tables and lists also what is in them."""
    if what == "Number out of range":
        return "a smaller number"
    expected = what.removeprefix("Expected ").split(", got ")[0].replace("`", "")
    in_toml_words = {
        "object": "table",
        "array": "list",
        "bool": "true or false",
        "str": "text",
        "int": "whole number",
        "float": "number",
        r" \| null": "",
    }
    for word, in_toml in in_toml_words.items():
        expected = re.sub(rf"\b{word}\b", in_toml, expected)
    expected = expected.replace(" | ", " or ").strip()
    if expected.startswith(("table", "list")):
        expected = f"a {expected}{_content(kind)}"
    return one_line(expected)


def _content(kind: Any) -> str:
    """Return what is in a table or list of a type: keys of records, else what each value is."""
    plain = _plain(kind)
    arguments = typing.get_args(plain)
    if keys := field_types(plain):
        return f" with the keys {', '.join(keys)}"
    if typing.get_origin(plain) is tuple and Ellipsis not in arguments:
        return f": {', '.join(map(_asked, arguments))}"
    inner = arguments[-1] if typing.get_origin(plain) is dict else child_type(kind, [], 0)
    if keys := field_types(inner):
        return f" of tables with the keys {', '.join(keys)}"
    return f", each value: {asked}" if (asked := _asked(inner)) else ""


def _asked(kind: Any) -> str:
    """Return what a type asks for, empty if that is nothing."""
    if choices := _choices(kind):
        return f"one of {', '.join(choices)}"
    try:
        msgspec.convert(object(), kind)  # what no type accepts
    except msgspec.ValidationError as error:
        return _expected(str(error), kind)
    return ""


def _wrong(steps: Steps, what: str, name: str, choices: Iterable[str]) -> str:
    return f"{_location(steps)}: {what} {unknown_name(name, choices)}".replace(":  ", ": ")


def _missing(steps: Steps, kind: Any) -> str:
    return f"{_location(steps)}: missing; expected {_asked(kind) or 'a value'}"


def _location(steps: Steps) -> str:
    return one_line(dotted(steps)) or "top level"


def _shown(value: Any) -> str:
    return one_line(repr(value), 60)


def _members(kind: Any) -> list[Any]:
    """Return the types of a union without None, or the type itself, without annotations."""
    if typing.get_origin(kind) is typing.Annotated:
        return _members(typing.get_args(kind)[0])
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return [m for a in typing.get_args(kind) if a is not types.NoneType for m in _members(a)]
    return [kind]


def _plain(kind: Any) -> Any:
    members = _members(kind)
    return members[0] if len(members) == 1 else kind


def record_types(kind: Any, value: Any) -> list[Any]:
    """Return the record types that a value of this type may be; its tag picks one."""
    structs = [m for m in _members(kind) if isinstance(m, type) and issubclass(m, msgspec.Struct)]
    for struct in structs:
        config = struct.__struct_config__
        tagged = config.tag_field and isinstance(value, dict)
        if tagged and value.get(config.tag_field) == config.tag:
            return [struct]
    return structs


_fields = functools.cache(msgspec.structs.fields)


def field_types(kind: Any, value: Any = None) -> dict[str, Any]:
    """Return the fields of a record type (or tagged union) by their names in the file."""
    fields: dict[str, Any] = {}
    for struct in record_types(kind, value):
        if struct.__struct_config__.tag_field:
            fields[struct.__struct_config__.tag_field] = str
        for field in _fields(struct):
            fields[field.encode_name] = field.type
    return fields


def child_type(kind: Any, value: Any, step: str | int) -> Any:
    """Return the type of the value at a step into `value` of type `kind`, None if there is none."""
    kind = _plain(kind)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(step, int) and arguments[-1] is not Ellipsis:
        return arguments[step] if step < len(arguments) else None
    if origin in (list, tuple):
        return arguments[0]
    if origin is dict:
        return arguments[1]
    return field_types(kind, value).get(str(step))


def _choices(kind: Any) -> list[str]:
    """Return the allowed values of a choice type, none for another type."""
    literals = [m for m in _members(kind) if typing.get_origin(m) is typing.Literal]
    return [str(value) for literal in literals for value in typing.get_args(literal)]
