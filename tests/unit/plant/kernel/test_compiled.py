"""A cached kernel never outlives an edited equation: the cache's name follows every source of it."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

import numba
import pytest

from plant.kernel import compiled

PLANT = Path(compiled.__file__).parent.parent
DECORATORS = {"inlined", "called", "kernel"}


def makes_kernels(path: Path) -> bool:
    """Whether a module compiles functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return any(
        isinstance(node, ast.ImportFrom)
        and (node.module or "").endswith("compiled")
        and bool(DECORATORS & {alias.name for alias in node.names})
        for node in ast.walk(tree)
    )


def test_every_module_with_compiled_functions_is_a_source_of_the_cache() -> None:
    found = {path for path in PLANT.rglob("*.py") if makes_kernels(path)}
    assert len(found) >= 15
    assert found <= set(compiled.kernel_sources())


def test_any_edit_means_another_cache(tmp_path: Path) -> None:
    copy = tmp_path / "plant"
    shutil.copytree(PLANT, copy, ignore=shutil.ignore_patterns("__pycache__"))
    hashes = {compiled.kernel_hash(copy)}
    assert hashes == {compiled.kernel_hash()}
    for path in compiled.kernel_sources(copy):
        path.write_text(path.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
        hashes.add(compiled.kernel_hash(copy))
    assert len(hashes) == 1 + len(compiled.kernel_sources())


def test_the_cache_is_named_after_the_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPC4_CACHE", str(tmp_path))
    assert compiled.cache_folder() == tmp_path / f"kernel-{compiled.kernel_hash()}"


def test_python_can_call_a_part_before_and_after_a_kernel_uses_it() -> None:
    @compiled.called
    def twice(value: float) -> float:
        return 2.0 * value

    assert twice(1.5) == 3.0
    outer = numba.njit(lambda value: twice(value) + 1.0)
    assert outer(1.5) == 4.0
    assert twice(2.5) == 5.0
