"""Files that the user names."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from can_dbc.errors import InputError
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


def test_json_that_is_nested_too_deeply_is_a_value_error() -> None:
    assert parse_json('{"a": [1]}') == {"a": [1]}
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json("[" * 100_000)


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
