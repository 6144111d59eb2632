"""Optional libraries: the command that installs a missing one works where it is printed."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.files import extras


def test_a_present_library_is_imported() -> None:
    assert extras.import_extra("json", "mdf", "log.mf4: MF4").dumps([]) == "[]"


def test_in_a_clone_the_command_installs_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(extras.ROOT)
    monkeypatch.setattr("sys.executable", str(extras.ROOT / ".venv" / "bin" / "python"))
    expected = (
        "log.mf4: MF4 needs no_such_module, which is not installed; expected it after: "
        ".venv/bin/python -m pip install -e '.[mdf]'"
    )
    with pytest.raises(InputError) as caught:
        extras.import_extra("no_such_module", "mdf", "log.mf4: MF4")
    assert str(caught.value) == expected


def test_elsewhere_the_command_installs_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "ROOT", tmp_path)
    assert extras.install_command("fmpy", "fmu").endswith(" -m pip install fmpy")
