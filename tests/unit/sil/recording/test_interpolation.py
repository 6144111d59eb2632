"""Cubic lines against scipy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from sil.recording.interpolation import hermite, monotone_slopes

STEPS = st.floats(0.1, 10.0)
VALUES = st.floats(-100.0, 100.0)
SAMPLES = st.integers(3, 12).flatmap(
    lambda n: st.tuples(
        st.lists(STEPS, min_size=n, max_size=n),
        st.lists(VALUES, min_size=n, max_size=n),
        st.lists(VALUES, min_size=n, max_size=n),
    )
)


@given(SAMPLES)
def test_hermite_is_scipys(samples: tuple[list[float], list[float], list[float]]) -> None:
    times, values, slopes = (np.array(s) for s in samples)
    times = np.cumsum(times)
    at = np.linspace(times[0], times[-1], 57)
    wanted = CubicHermiteSpline(times, values, slopes)(at)
    assert np.allclose(hermite(times, values, slopes, at), wanted, rtol=1e-9, atol=1e-9)


@given(SAMPLES)
def test_monotone_slopes_are_scipys(samples: tuple[list[float], list[float], list[float]]) -> None:
    times, values, _ = (np.array(s) for s in samples)
    times, values = np.cumsum(times), np.round(values, 3)  # differences that do not underflow
    wanted = PchipInterpolator(times, values).derivative()(times)
    assert np.allclose(monotone_slopes(times, values), wanted, rtol=1e-9, atol=1e-9)
