"""Views read and write the elements that they say; a cached kernel never outlives an edited equation."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import TypingError

from plant.kernel import checked, compiled
from plant.kernel.records import Record, Value, block, interleaved
from plant.kernel.views import discarding, lane, named, view

WIDTH = 4


class Sample(Record):
    first: Value
    pair: Value = block(2)
    matrix: Value = block(2, 3)
    last: Value


sample = named(Sample)
sample_without_last = named(Sample, ("last",))


@numba.njit
def double_from(array, offset):
    v = view(array, offset)
    for i in range(3):
        v[i] = 2.0 * v[i]
    tail = v[2:]
    tail[1] = -1.0


@numba.njit
def sums_of_lanes(array, out):
    v = view(array, 0)
    for k in range(WIDTH):
        column = lane(v[WIDTH:], k, WIDTH)
        out[k] = column[0] + 10.0 * column[1]


def test_elements_and_tails():
    array = np.arange(8.0)
    double_from(array, 2)
    assert array.tolist() == [0.0, 1.0, 4.0, 6.0, 8.0, -1.0, 6.0, 7.0]


def test_lanes_are_columns():
    array = np.arange(3.0 * WIDTH).reshape(3, WIDTH)
    out = np.zeros(WIDTH)
    sums_of_lanes(array, out)
    assert np.array_equal(out, array[1] + 10.0 * array[2])


@numba.njit
def shuffle(array, out):
    s = sample(array)
    s.first = s.last
    s.pair[1] = 5.0
    s.matrix[1, 2] = 6.0
    s.matrix[0][1] += 1.0
    for k in range(WIDTH):
        other = sample(lane(view(out, 0), k, WIDTH))
        other.last = float(k)
        other.matrix[1, 0] = 10.0 * k


def test_fields_of_records():
    array = np.arange(10.0)
    lanes = np.zeros((Sample.size, WIDTH))
    shuffle(array, lanes)
    mine = Sample(array)
    assert (mine.first, mine.last) == (9.0, 9.0)
    assert mine.pair.tolist() == [1.0, 5.0]
    assert mine.matrix.tolist() == [[3.0, 5.0, 5.0], [6.0, 7.0, 6.0]]
    assert lanes[Sample.last].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert lanes[Sample.matrix][3].tolist() == [0.0, 10.0, 20.0, 30.0]
    assert lanes.sum() == 66.0


@numba.njit
def last_of(array):
    s = sample_without_last(array)
    return s.first, s.last


def test_absent_fields_read_as_zero():
    assert last_of(np.arange(1.0, 11.0)) == (1.0, 0.0)


@numba.njit
def write_nothing(array):
    v = discarding(view(array, 0))
    v[1] = 5.0


def test_discarding_views_write_nothing():
    array = np.zeros(3)
    write_nothing(array)
    checked.discarding(checked.view(array, 0))[1] = 5.0
    assert not array.any()


def test_a_record_refuses_unknown_names():
    with pytest.raises(AttributeError):
        Sample.zeros().second = 1.0

    @numba.njit
    def read(array):
        return sample(array).second

    with pytest.raises(TypingError, match="second"):
        read(np.zeros(10))


def test_interleaved_copies_are_the_lanes():
    lanes = np.arange(10.0 * WIDTH).reshape(Sample.size, WIDTH)
    all_lanes = interleaved(Sample, WIDTH)(lanes.reshape(-1))
    assert all_lanes.last.tolist() == lanes[Sample.last].tolist()
    assert all_lanes.pair.tolist() == lanes[Sample.pair].reshape(-1).tolist()
    assert all_lanes.matrix.tolist() == lanes[Sample.matrix].reshape(2, -1).tolist()


def test_a_record_of_many_strokes_has_columns():
    many = Sample(np.arange(20.0).reshape(2, 10))
    assert many.first.tolist() == [0.0, 10.0]
    many.last = 1.5
    assert many.array[:, Sample.last].tolist() == [1.5, 1.5]


def test_checked_views_read_as_compiled_ones():
    array, lanes = np.arange(10.0), np.zeros((Sample.size, WIDTH))
    expected, expected_lanes = array.copy(), lanes.copy()
    shuffle(expected, expected_lanes)
    plain = {name: getattr(checked, name) for name in ("view", "lane")}
    body = shuffle.py_func
    scope = {**body.__globals__, **plain, "sample": checked.named(Sample)}
    type(body)(body.__code__, scope)(array, lanes)
    assert np.array_equal(array, expected) and np.array_equal(lanes, expected_lanes)


def test_checked_views_check_their_bounds():
    v = checked.view(np.zeros(10), 2)
    assert v[7] == 0.0
    with pytest.raises(IndexError):
        v[8]
    s = checked.named(Sample)(np.zeros(10))
    with pytest.raises(IndexError):
        s.pair[2] = 1.0
    with pytest.raises(IndexError):
        checked.named(Sample)(np.zeros(5)).last = 1.0
    with pytest.raises(IndexError):
        checked.lane(checked.view(np.zeros(8), 0), 1, WIDTH)[2]


def test_strided_arrays_are_refused():
    with pytest.raises(TypingError, match="C-contiguous"):
        double_from(np.zeros((4, 4))[:, 0], 0)


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
