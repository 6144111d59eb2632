"""The keys of a file format as rows: table, key, type, unit, default, range and description.

Everything is read from the record types that check the files. A description is the string below
the field, or follows "key: " in the docstring of the record.
Checked by: tests/docs/test_key_table.py
"""

from __future__ import annotations

import ast
import functools
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
from msgspec import inspect as types

from sil.files.quantity import unit_of


@dataclass(frozen=True)
class Key:
    """One key; `table` as TOML writes it, e.g. "[plant]" or '[[fault]] kind = "loss"'."""

    table: str
    key: str
    type: str
    unit: str
    default: str
    range: str
    description: str


def describe(record: type[msgspec.Struct]) -> list[Key]:
    """Return the keys that a file of this record type may have, those of inner tables too."""
    return list(_rows(types.type_info(record), ""))


def _rows(info: Any, path: str, many: bool = False) -> Iterator[Key]:
    table = (f"[[{path}]]" if many else f"[{path}]") if path else ""
    if info.tag_field is not None:
        table += f' {info.tag_field} = "{info.tag}"'
        text = f'"{info.tag}"'
        yield Key(table, info.tag_field, "text", "", "required", text, _docstring(info.cls))
    texts = descriptions(info.cls)
    inner = []
    for field in info.fields:
        kind = _without_none(field.type)
        structs, listed = _records(kind)
        yield Key(
            table=table,
            key=field.encode_name,
            type=_type_text(kind),
            unit=unit_of(field.encode_name),
            default=_default(field),
            range=_range(kind),
            description=texts.get(field.name, "") or _from_records(field.name, info, structs),
        )
        inside = f"{path}.{field.encode_name}" if path else field.encode_name
        inner += [(struct, inside, listed) for struct in structs]
    for struct, inside, listed in inner:
        yield from _rows(struct, inside, listed)


def _from_records(name: str, owner: Any, structs: list[Any]) -> str:
    """Return what docstrings say of a kind, or of an inner table."""
    if name == "kind":
        return _docstring(owner.cls)
    if len(structs) == 1:
        return _docstring(structs[0].cls).split(". ")[0].rstrip(".") + "."
    return ""


def _docstring(record: type) -> str:
    return " ".join((record.__doc__ or "").split())


def _without_none(kind: Any) -> Any:
    while isinstance(kind, types.Metadata):
        kind = kind.type
    if isinstance(kind, types.UnionType):
        rest = [_without_none(t) for t in kind.types if not isinstance(t, types.NoneType)]
        return rest[0] if len(rest) == 1 else types.UnionType(tuple(rest))
    return kind


def _records(kind: Any) -> tuple[list[Any], bool]:
    """Return the record types of a field, and whether it is a list of them."""
    listed = isinstance(kind, types.ListType)
    item = _without_none(kind.item_type) if isinstance(kind, types.ListType) else kind
    members = item.types if isinstance(item, types.UnionType) else [item]
    return [m for m in members if isinstance(m, types.StructType)], listed


_NAMES: dict[type, str] = {
    types.FloatType: "number",
    types.IntType: "whole number",
    types.BoolType: "true or false",
    types.StrType: "text",
    types.LiteralType: "text",
    types.DictType: "table",
    types.StructType: "table",
}


def _type_text(kind: Any) -> str:
    if isinstance(kind, types.ListType | types.VarTupleType):
        item = _type_text(_without_none(kind.item_type))
        return "list of tables" if item == "table" else f"list of {item}s"
    if isinstance(kind, types.TupleType):
        return f"[{', '.join(_type_text(_without_none(t)) for t in kind.item_types)}]"
    if isinstance(kind, types.UnionType):
        return " or ".join(dict.fromkeys(_type_text(_without_none(t)) for t in kind.types))
    return _NAMES.get(type(kind), "any value")


def _range(kind: Any) -> str:
    """Return what a value has to be, in words; empty when its type says it all."""
    if isinstance(kind, types.LiteralType):
        return ", ".join(json.dumps(value) for value in kind.values)
    if isinstance(kind, types.ListType | types.VarTupleType):
        return _range(_without_none(kind.item_type))
    if isinstance(kind, types.UnionType):
        return ", ".join(filter(None, (_range(_without_none(t)) for t in kind.types)))
    if isinstance(kind, types.StrType) and kind.max_length is not None:
        return f"{kind.min_length or 0} to {kind.max_length} characters"
    if not isinstance(kind, types.FloatType | types.IntType):
        return ""
    if kind.ge is not None and kind.le is not None:
        return f"{_number(kind.ge)} to {_number(kind.le)}"
    bounds = (("above", kind.gt), ("at least", kind.ge), ("below", kind.lt), ("at most", kind.le))
    return ", ".join(f"{word} {_number(bound)}" for word, bound in bounds if bound is not None)


def _number(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


def _default(field: Any) -> str:
    if field.required:
        return "required"
    value = field.default
    if field.default_factory is not msgspec.NODEFAULT:
        value = field.default_factory()
    if value is None:
        return "none"
    if isinstance(value, msgspec.Struct):
        return "as below"
    return json.dumps(msgspec.to_builtins(value))


@functools.cache
def descriptions(record: type) -> dict[str, str]:
    """Return the description of each field of a record type, by the field's name."""
    found: dict[str, str] = {}
    for base in reversed(record.__mro__):
        if not issubclass(base, msgspec.Struct) or base is msgspec.Struct:
            continue
        fields = [field.name for field in msgspec.structs.fields(base)]
        found |= _in_class_docstring(inspect.cleandoc(base.__doc__ or ""), fields)
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for statement, following in zip(tree.body, tree.body[1:], strict=False):
            if not isinstance(statement, ast.AnnAssign) or not isinstance(following, ast.Expr):
                continue
            if isinstance(statement.target, ast.Name) and isinstance(following.value, ast.Constant):
                found[statement.target.id] = " ".join(str(following.value.value).split())
    return found


def _in_class_docstring(text: str, fields: list[str]) -> dict[str, str]:
    """Return what follows "name: " or "name, name: " of each field, up to the next name."""
    if not fields:
        return {}
    name = f"`?(?:{'|'.join(fields)})`?"
    head = re.compile(rf"(?<![\w.])({name}(?:(?:, | and ){name})*): ")
    pieces = head.split(re.split(r"\n *Source: |\n\n(?!.*: )", text)[0])
    found = {}
    for names, words in zip(pieces[1::2], pieces[2::2], strict=True):
        words = " ".join(words.split())
        for key in re.findall(r"\w+", names.replace(" and ", ", ")):
            found[key] = words[:1].upper() + words[1:]
    return found
