"""A cached kernel never outlives an edited equation: the cache's name follows every source of it."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

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
    modules = {path for path in PLANT.rglob("*.py") if makes_kernels(path)}
    assert len(modules) >= 15
    assert modules <= set(compiled.kernel_sources())


def test_any_edit_means_another_cache(tmp_path: Path) -> None:
    copy = tmp_path / "plant"
    shutil.copytree(PLANT, copy, ignore=shutil.ignore_patterns("__pycache__"))
    hashes = {compiled.kernel_hash(copy)}
    assert hashes == {compiled.kernel_hash()}
    for path in compiled.kernel_sources(copy):
        path.write_text(path.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
        hashes.add(compiled.kernel_hash(copy))
    assert len(hashes) == 1 + len(compiled.kernel_sources())


def test_the_cache_is_in_the_folder_of_numba_if_the_user_names_one(tmp_path: Path) -> None:
    done = folder_of(NUMBA_CACHE_DIR=str(tmp_path))
    assert done.stdout.split() == [str(tmp_path / f"kernel-{compiled.kernel_hash()}")]
    assert done.stderr == ""


def test_without_a_writable_folder_one_line_names_the_temporary_one(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    done = folder_of(NUMBA_CACHE_DIR=str(blocked))
    folder = Path(done.stdout.strip())
    assert folder.name == f"kernel-{compiled.kernel_hash()}" and not folder.exists()
    assert done.stderr.count("\n") == 1 and str(folder.parent) in done.stderr


def folder_of(**environment: str) -> subprocess.CompletedProcess[str]:
    """Ask a fresh interpreter for its cache folder."""
    return subprocess.run(
        [sys.executable, "-c", "from plant.kernel.compiled import cache_folder as f; print(f())"],
        env={**os.environ, **environment}, capture_output=True, text=True, check=True,
    )  # fmt: skip


def test_each_kernel_has_one_signature() -> None:
    """Processes that compile the same kernel at once then write the same file."""
    files = [str(path).rsplit(".", 2)[0] for path in compiled.cache_folder().rglob("*.nbc")]
    assert len(files) == len(set(files))
