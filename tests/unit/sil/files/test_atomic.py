"""Atomic writes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from sil.files.atomic import open_atomically, write_atomically


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    write_atomically(target, "old")
    with pytest.raises(KeyboardInterrupt), open_atomically(target) as file:
        file.write(b"new")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    write_atomically(target, "new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["result.json"]


def test_a_name_that_is_not_utf8_is_written_as_json_escapes_it(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.json", '"\udcff.py"')
    assert json.loads((tmp_path / "a.json").read_text()) == "\udcff.py"


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    """A process that writes the same file meanwhile replaces it as a whole."""
    target = tmp_path / "out.fmu"
    with open_atomically(target) as file:
        file.write(b"first " * 1000)
        pid = os.fork()
        if pid == 0:
            write_atomically(target, "second")
            os._exit(0)
        os.waitpid(pid, 0)
        assert target.read_text() == "second"
    assert target.read_bytes() == b"first " * 1000 and os.listdir(tmp_path) == ["out.fmu"]


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error:
        write_atomically(tmp_path / "none" / "file", "")
    assert error.value.filename == str(tmp_path / "none" / "file")
