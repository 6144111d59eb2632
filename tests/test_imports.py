"""The layers hold: sil above plant and controller, these above can_dbc; and inside each of them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def test_import_contracts() -> None:
    from importlinter.cli import lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), cache_dir=None) == 0


def imported(file: Path) -> set[str]:
    """Return the modules a file imports anywhere, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def files(package: str) -> list[Path]:
    found = sorted((ROOT / package).rglob("*.py"))
    assert found, f"no Python files in {package}"
    return found


@pytest.mark.parametrize(
    ("package", "allowed"),
    [
        ("plant", {"plant/node.py", "plant/devices/valve_driver.py"}),
        ("controller", {"controller/node.py"}),
    ],
)
def test_only_the_nodes_speak_can(package: str, allowed: set[str]) -> None:
    speaking = ("can_dbc.codec", "can_dbc.e2e", "can_dbc.frame", "can", "cantools")
    for file in files(package):
        place = file.relative_to(ROOT).as_posix()
        used = {m for m in imported(file) if m in speaking or m.startswith("can.")}
        assert not used or place in allowed, f"{place} imports {sorted(used)}"


def test_the_firmware_reads_no_clock_and_does_no_io() -> None:
    forbidden = {"time", "datetime", "os", "socket", "select", "subprocess", "random", "can"}
    for file in files("controller"):
        used = {m.split(".")[0] for m in imported(file)} & forbidden
        assert not used, f"{file.relative_to(ROOT)} imports {sorted(used)}"


def test_nothing_in_simulated_time_imports_the_wall_clock() -> None:
    for file in files("plant"):
        used = {m.split(".")[0] for m in imported(file)} & {"datetime", "random", "socket"}
        assert not used, f"{file.relative_to(ROOT)} imports {sorted(used)}"


def test_no_test_imports_a_bench() -> None:
    for file in files("tests"):
        place = file.relative_to(ROOT).as_posix()
        used = {m for m in imported(file) if m.startswith("tests.bench")}
        assert not used or place.startswith("tests/bench/"), f"{place} imports {sorted(used)}"
