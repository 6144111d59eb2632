"""TOML as typed records: one line for everything that is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from can_dbc.errors import InputError
from can_dbc.typed_toml import child_type, convert, one_line, parse_toml, read_toml


class Loss(Struct, tag_field="kind", tag="loss", forbid_unknown_fields=True):
    at_s: Annotated[float, Meta(ge=0.0)]


class Delay(Struct, tag_field="kind", tag="delay", forbid_unknown_fields=True):
    gear: Literal["neutral", "backward"]


class Checked(Struct, forbid_unknown_fields=True):
    low: int = 0

    def __post_init__(self) -> None:
        if self.low == 1:
            raise InputError("low: 1 is wrong; expected another")
        if self.low == 2:
            raise ValueError("two; expected another")


class Open(Struct):
    size: int = 0


class File(Struct, forbid_unknown_fields=True):
    name: str = ""
    fault: list[Loss | Delay] = []
    checked: Checked | None = None
    pair: tuple[float, str] = (0.0, "")
    limits: dict[Literal["a", "b"], float] = {}
    any_name: dict[str, int] = {}
    rate: Literal[125000, 250000] = 125000
    other: Open | None = None
    size: float = 0.0
    gears: list[Literal["neutral", "backward"]] = []
    points: Annotated[list[tuple[float, float]], Meta(min_length=1)] | None = None
    free: dict[str, Any] = {}


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"nam": 1}, "nam: unknown; expected one of name"),
        ({"name": 1}, "name: 1 is wrong; expected text"),
        ({"fault": [{"kind": "los"}]}, "fault[0].kind: 'los' is unknown; expected one of loss"),
        ({"fault": [{}]}, "fault[0].kind: missing; expected one of loss, delay"),
        ({"fault": [{"kind": "loss"}]}, "fault[0].at_s: missing; expected number"),
        (
            {"fault": [{"kind": "loss", "at_s": -1.0}]},
            "fault[0].at_s: -1.0 is wrong; expected number >= 0.0",
        ),
        (
            {"fault": [{"kind": "delay"}]},
            "fault[0].gear: missing; expected one of neutral, backward",
        ),
        (
            {"fault": [{"kind": "delay", "gear": "bakward"}]},
            "fault[0].gear: 'bakward' is unknown; expected one of backward",
        ),
        ({"checked": {"low": 1}}, "checked.low: 1 is wrong; expected another"),
        (
            {"fault": 3},
            "fault: 3 is wrong; expected a list of tables with the keys kind, at_s, gear",
        ),
        ({"checked": {"low": 2}}, "checked: two; expected another"),
        ({"checked": 3}, "checked: 3 is wrong; expected a table with the keys low"),
        ({"pair": [1.0, 2]}, "pair[1]: 2 is wrong; expected text"),
        ({"pair": [1.0]}, "pair: [1.0] is wrong; expected a list of length 2: number, text"),
        ({"pair": 1}, "pair: 1 is wrong; expected a list: number, text"),
        ({"any_name": 1}, "any_name: 1 is wrong; expected a table, each value: whole number"),
        ({"gears": 1}, "gears: 1 is wrong; expected a list, each value: one of neutral, backward"),
        (
            {"points": []},
            "points: [] is wrong; expected a list of length >= 1, each value: a list: num",
        ),
        ({"points": [3]}, "points[0]: 3 is wrong; expected a list: number, number"),
        ({"free": 1}, "free: 1 is wrong; expected a table"),
        ({"limits": {"c": 1.0}}, "limits.c: unknown; expected one of a, b"),
        ({"any_name": {"x": 1, "y": "z"}}, "any_name.y: 'z' is wrong; expected whole number"),
        ({"rate": 300000}, "rate: 300000 is unknown; expected one of"),
        ({"size": 10**400}, f"size: 1{'0' * 56}... is wrong; expected a smaller number"),
        ({"other": {"unknown": 1, "size": "x"}}, "other.size: 'x' is wrong; expected whole number"),
        ([], "top level: [] is wrong; expected a table with the keys name, fault, checked, pair"),
    ],
)
def test_one_line_for_what_is_wrong(raw: Any, message: str) -> None:
    for source, key in (("", ""), ("f.toml", ""), ("", "table")):
        with pytest.raises(InputError) as caught:
            convert(raw, File, source, key)
        text = message.replace("top level", key) if key else message
        inside = f"{key}." if key and not text.startswith(key) else ""
        assert (f"{source}: " if source else "") + inside + text in str(caught.value)


def test_a_file_becomes_a_record(tmp_path: Path) -> None:
    path = tmp_path / "file.toml"
    path.write_text("\ufeffname = 'a'\npair = [1, 'x']\n[[fault]]\nkind = 'loss'\nat_s = 0\n")
    converted = convert(read_toml(path), File, str(path))
    assert converted == File("a", [Loss(0.0)], pair=(1.0, "x"))


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"a = '\xfc'", "f: byte 5: not UTF-8; expected TOML text"),
        (b"a = [", "f: Invalid value (at end of document); expected TOML"),
        (b"a = 2020-13-01", "expected TOML"),
        (b"a." * 200 + b"b = 1", "f: top level: nested too deeply; expected TOML"),
        (b"a = [{b = [1, nan]}]", "f: a[0].b[1]: nan is wrong; expected a finite number"),
    ],
)
def test_broken_toml(raw: bytes, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_toml(raw, "f")
    assert message in str(caught.value)


def test_long_texts_are_cut_to_a_line() -> None:
    assert one_line("a\nb\x01") == "a b\\x01"
    assert one_line("x" * 300, 10) == "xxxxxxx..."


def test_types_of_inner_values() -> None:
    assert child_type(dict[str, int], {}, "any") is int
    assert child_type(list[str] | None, [], 3) is str
    assert [child_type(tuple[int, str], [], i) for i in range(3)] == [int, str, None]
    assert child_type(File, {}, "name") is str
    assert child_type(File, {}, "none") is None
