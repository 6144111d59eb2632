"""Views read and write the elements that they say."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from plant.kernel import views
from plant.kernel.views import ABSENT, lane, rows, view

WIDTH = 4


@numba.njit
def double_from(array, offset):
    v = view(array, offset)
    for i in range(3):
        v[i] = 2.0 * v[i]
    tail = v[2:]
    tail[1] = -1.0


@numba.njit
def transpose(array, out):
    a = rows(view(array, 0), 3)
    b = rows(view(out, 0), 2)
    for i in range(2):
        row = a[i]
        for j in range(3):
            b[j, i] = row[j]


@numba.njit
def sums_of_lanes(array, out):
    v = view(array, 0)
    for k in range(WIDTH):
        column = lane(v, 1, k, WIDTH, "")
        out[k] = column[0] + 10.0 * column[1]


def test_elements_and_tails():
    array = np.arange(8.0)
    double_from(array, 2)
    assert array.tolist() == [0.0, 1.0, 4.0, 6.0, 8.0, -1.0, 6.0, 7.0]


def test_rows():
    array = np.arange(6.0).reshape(2, 3)
    out = np.zeros((3, 2))
    transpose(array, out)
    assert np.array_equal(out, array.T)


def test_lanes_are_columns():
    array = np.arange(3.0 * WIDTH).reshape(3, WIDTH)
    out = np.zeros(WIDTH)
    sums_of_lanes(array, out)
    assert np.array_equal(out, array[1] + 10.0 * array[2])


def test_absent_elements_read_as_zero():
    ABSENT["test: 1 and 70"] = 1 << 1 | 1 << 70

    @numba.njit
    def read(array, out):
        column = lane(view(array, 0), 0, 0, 1, "test: 1 and 70")
        for i in range(80):
            out[i] = column[i]

    array = np.arange(100.0, 180.0)
    out = np.zeros(80)
    try:
        read(array, out)
    finally:
        del ABSENT["test: 1 and 70"]
    expected = array.copy()
    expected[[1, 70]] = 0.0
    assert np.array_equal(out, expected)


def test_strided_arrays_are_refused():
    with pytest.raises(TypingError, match="C-contiguous"):
        double_from(np.zeros((4, 4))[:, 0], 0)


def test_type_names_tell_views_apart():
    first = views.View(numba.types.float64, 8, 0, "")
    second = views.View(numba.types.float64, 8, 0, "other")
    assert first != second
