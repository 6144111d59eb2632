"""The closed-form Butterworth design and its sections against scipy and against closed forms."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from controller.filters import Section, SectionFilter, butterworth

CASES = [(6, 22.0, 100.0), (6, 22.0, 400.0), (2, 22.0, 100.0), (8, 40.0, 1000.0)]


def delay_at_rest_s(order: int, fc_hz: float, rate_hz: float) -> float:
    """Return the group delay at zero frequency, s: sum(1/Q_k) / (2 rate K).

    By it a slow ramp lags; sum(1/Q_k) includes 1 for the single pole of an odd order and equals
    1/sin(pi/(2 n)).
    """
    k = math.tan(math.pi * fc_hz / rate_hz)
    return 1.0 / (2.0 * rate_hz * k * math.sin(math.pi / (2 * order)))


def response(sections: tuple[Section, ...], f_hz: float, rate_hz: float) -> complex:
    back = cmath.exp(-2j * math.pi * f_hz / rate_hz)
    total = complex(1.0)
    for b0, b1, b2, a1, a2 in sections:
        total *= (b0 + b1 * back + b2 * back**2) / (1.0 + a1 * back + a2 * back**2)
    return total


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize(("fc_hz", "rate_hz"), [(22.0, 100.0), (22.0, 400.0), (0.5, 100.0)])
def test_same_output_as_scipy(order: int, fc_hz: float, rate_hz: float) -> None:
    noise = np.random.default_rng(order).normal(0.0, 1.0, 500)
    reference = signal.sosfilt(signal.butter(order, fc_hz, fs=rate_hz, output="sos"), noise)
    ours = SectionFilter(butterworth(order, fc_hz, rate_hz))
    assert np.max(np.abs(reference - [ours.update(x) for x in noise.tolist()])) < 1e-12


@pytest.mark.parametrize("order", range(1, 9))
def test_same_poles_and_zeros_as_scipy(order: int) -> None:
    sections = butterworth(order, 22.0, 100.0)
    assert len(sections) == (order + 1) // 2
    rows = np.array([[b0, b1, b2, 1.0, a1, a2] for b0, b1, b2, a1, a2 in sections])
    ours = signal.sos2tf(rows)
    reference = signal.butter(order, 22.0, fs=100.0)
    for mine, theirs in zip(ours, reference, strict=True):
        trimmed = np.trim_zeros(mine, "b")
        assert np.max(np.abs(trimmed - theirs)) < 1e-12


@given(
    order=st.integers(1, 8),
    fc_part=st.floats(0.01, 0.49),
    rate_hz=st.floats(10.0, 1000.0),
)
@settings(max_examples=100, deadline=None)
def test_gains_of_every_design(order: int, fc_part: float, rate_hz: float) -> None:
    sections = butterworth(order, fc_part * rate_hz, rate_hz)
    for section in sections:  # unit gain at rest, section by section
        at_rest = (section.b0 + section.b1 + section.b2) / (1.0 + section.a1 + section.a2)
        assert at_rest == pytest.approx(1.0, abs=1e-9)
        assert abs(section.a2) < 1.0  # stable
        assert abs(section.a1) < 1.0 + section.a2
    at_cut_off = abs(response(sections, fc_part * rate_hz, rate_hz))
    assert at_cut_off == pytest.approx(math.sqrt(0.5), rel=1e-8)
    assert abs(response(sections, 0.5 * rate_hz, rate_hz)) < 1e-12


@pytest.mark.parametrize(("order", "fc_hz", "rate_hz"), CASES)
def test_squared_gain_is_the_butterworth_law(order: int, fc_hz: float, rate_hz: float) -> None:
    sections = butterworth(order, fc_hz, rate_hz)
    k = math.tan(math.pi * fc_hz / rate_hz)
    for f_hz in (1.0, 10.0, 30.0, 45.0):
        ratio = math.tan(math.pi * f_hz / rate_hz) / k
        law = 1.0 / (1.0 + ratio ** (2 * order))
        assert abs(response(sections, f_hz, rate_hz)) ** 2 == pytest.approx(law, rel=1e-9)


@pytest.mark.parametrize(("order", "fc_hz", "rate_hz"), [*CASES, (3, 22.0, 100.0), (1, 9.0, 50.0)])
def test_delay_at_rest(order: int, fc_hz: float, rate_hz: float) -> None:
    sections = butterworth(order, fc_hz, rate_hz)
    small_hz = 1e-4 * fc_hz
    by_phase_s = -cmath.phase(response(sections, small_hz, rate_hz)) / (2 * math.pi * small_hz)
    assert delay_at_rest_s(order, fc_hz, rate_hz) == pytest.approx(by_phase_s, rel=1e-6)


def test_delay_of_today_s_filter() -> None:
    """3.8637/(200 tan(0.22 pi)) = 23.35 ms."""
    assert delay_at_rest_s(6, 22.0, 100.0) == pytest.approx(0.02335, abs=5e-6)


@pytest.mark.parametrize(("order", "fc_hz", "rate_hz"), CASES)
def test_a_ramp_lags_by_the_delay_at_rest(order: int, fc_hz: float, rate_hz: float) -> None:
    ours = SectionFilter(butterworth(order, fc_hz, rate_hz))
    slope = 0.3
    for n in range(3000):
        out = ours.update(slope * n / rate_hz)
    lag_s = n / rate_hz - out / slope
    assert lag_s == pytest.approx(delay_at_rest_s(order, fc_hz, rate_hz), rel=1e-9)


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("value", [0.0, 0.01285, -7.5])
def test_settled_means_at_rest(order: int, value: float) -> None:
    ours = SectionFilter(butterworth(order, 22.0, 100.0))
    ours.update(123.0)
    ours.settle(value)
    for _ in range(200):
        assert ours.update(value) == pytest.approx(value, abs=1e-12)


def test_a_step_from_rest_is_the_step_response_on_top() -> None:
    sections = butterworth(6, 22.0, 100.0)
    from_zero, from_one = SectionFilter(sections), SectionFilter(sections)
    from_one.settle(1.0)
    for _ in range(60):
        assert from_one.update(3.0) == pytest.approx(1.0 + 2.0 * from_zero.update(1.0), abs=1e-12)


def test_todays_filter_overshoots_by_17_percent() -> None:
    """Why neutral's window is wider than 17 % of the stroke."""
    ours = SectionFilter(butterworth(6, 22.0, 100.0))
    assert max(ours.update(1.0) for _ in range(60)) == pytest.approx(1.17048, abs=1e-5)


def test_worst_gain_keeps_the_estimate_in_the_range_of_the_status() -> None:
    """Sum of |impulse response|: no input within +-x gives an output beyond x times that."""
    for order in range(1, 9):
        for fc_hz in (1.0, 22.0, 49.0):
            ours = SectionFilter(butterworth(order, fc_hz, 100.0))
            total = abs(ours.update(1.0)) + sum(abs(ours.update(0.0)) for _ in range(4000))
            assert total * (0.1 + 0.01) < 0.5  # the largest settings against the range in the DBC


@pytest.mark.parametrize(
    ("order", "fc_hz", "rate_hz"),
    [
        (0, 22.0, 100.0),
        (-1, 22.0, 100.0),
        (6, 0.0, 100.0),
        (6, 50.0, 100.0),
        (6, -1.0, 100.0),
        (6, math.nan, 100.0),
    ],
)
def test_impossible_designs(order: int, fc_hz: float, rate_hz: float) -> None:
    with pytest.raises(ValueError, match=f"no Butterworth low-pass of order {order}, {fc_hz} Hz"):
        butterworth(order, fc_hz, rate_hz)
