"""Files that the user names, TOML as typed records, and the words that error lines share."""

from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from can_dbc.errors import InputError, nearest, os_error_text, unknown_name
from can_dbc.typed_toml import child_type, convert, one_line, parse_toml, read_toml
from can_dbc.user_file import (
    ProcessExit,
    error_text,
    exits_raise,
    parse_json,
    read_user_file,
    read_user_text,
    resolved,
)


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, what in (
        ("/dev/zero", "is a device or pipe"),
        (tmp_path / "pipe", "is a device or pipe"),
        (tmp_path, "is a folder"),
        (tmp_path / "none", "no such file"),
        ("null\0byte", "null byte in the name"),
    ):
        with pytest.raises(InputError, match=rf"{what}; expected a DBC file"):
            read_user_file(path, "a DBC file")


def test_what_the_system_refuses_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Not a directory; expected a TOML file"):
        read_user_file(tmp_path / "file" / "inside", "a TOML file")


def test_size_and_encoding_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa = 1\nb = 2")
    assert read_user_text(path, "TOML") == "a = 1\nb = 2"
    assert len(read_user_file(path, "TOML", 14)) == 14
    with pytest.raises(InputError, match="file: larger than 13 bytes; expected TOML"):
        read_user_file(path, "TOML", 13)
    path.write_bytes(b"a = 1\nb = '\xfc'\n")
    with pytest.raises(InputError, match="line 2: byte 0xFC is not UTF-8; expected TOML"):
        read_user_text(path, "TOML")


def test_json_that_nothing_can_hold_is_a_value_error() -> None:
    assert parse_json('{"a": [1]}') == {"a": [1]}
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json("[" * 100_000)
    with pytest.raises(ValueError, match="surrogates not allowed"):
        parse_json(r'["\ud800"]')


def test_links_are_followed_as_far_as_they_lead(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    (tmp_path / "circle").symlink_to("circle")
    assert resolved(tmp_path / "link") == (tmp_path / "file").resolve()
    assert resolved(tmp_path / "circle").is_absolute()


def test_an_exit_of_a_users_code_is_an_error_but_ends_a_process_that_it_forked() -> None:
    leave = os._exit
    with pytest.raises(ProcessExit, match=r"os\._exit\(3\)"), exits_raise():
        os._exit(3)
    with exits_raise():
        if (child := os.fork()) == 0:
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert os._exit is leave


def error_of(path: Path, source: str) -> str:
    path.write_text(source)
    try:
        exec(compile(source, str(path), "exec"), {})
    except Exception as error:
        return error_text(path, 1, error)
    raise AssertionError("the user's code did not fail")


def test_an_error_of_a_users_python_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    divides = "def inner():\n    return 1 / 0\ninner()\n"
    assert error_of(path, divides) == f"{path}:2: ZeroDivisionError: division by zero"
    broken = error_of(path, "x = 1\ny = (\n")
    assert broken.startswith(f"{path}:2: SyntaxError: ") and broken.endswith(
        "; expected valid Python"
    )
    assert error_text(path, 7, KeyError()) == f"{path}:7: KeyError"


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
    assert convert(read_toml(path), File, str(path)) == File("a", [Loss(0.0)], pair=(1.0, "x"))


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
    assert one_line("a\nb\x01") == "a b\\x01" and one_line("x" * 300, 10) == "xxxxxxx..."


def test_types_of_inner_values() -> None:
    assert child_type(dict[str, int], {}, "any") is int
    assert child_type(list[str] | None, [], 3) is str
    assert [child_type(tuple[int, str], [], i) for i in range(3)] == [int, str, None]
    assert child_type(File, {}, "name") is str and child_type(File, {}, "none") is None


def test_the_path_and_the_reason_without_python_s_words() -> None:
    full = os.strerror(errno.ENOSPC)
    assert (
        os_error_text(OSError(errno.ENOSPC, full, "out/result.json")) == f"out/result.json: {full}"
    )
    assert os_error_text(OSError(errno.ENOSPC, full)) == full
    assert os_error_text(OSError("no reply")) == "no reply"


def test_a_name_with_line_breaks_stays_on_one_line() -> None:
    error = InputError("s.toml: model: a\nb\x1b[31m\udc80: no such parameter")
    assert str(error) == r"s.toml: model: a\nb\x1b[31m\udc80: no such parameter"
    assert str(InputError(f"x: {error}")) == f"x: {error}"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_unknown_names_are_answered_with_the_nearest() -> None:
    assert unknown_name("alpa", ["beta", "alpha"]) == "unknown; expected one of alpha, beta"
    many = ["alpha", *map(str, range(10))]
    assert unknown_name("alpa", many) == "unknown; expected one of alpha, ..."
    assert unknown_name("zzz", ["alpha", "beta"]) == "unknown; expected one of alpha, beta"
    assert unknown_name("zzz", []) == "unknown; expected none"
    many = ["aaa1", "aaa2", "aaa3", "aaa4"]
    assert len(nearest("aaa", many, count=4)) == 4
    assert nearest("aa", ["aabbbb"]) == [] and nearest("aa", ["aabbbb"], cutoff=0.4) == ["aabbbb"]
