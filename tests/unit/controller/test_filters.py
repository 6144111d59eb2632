"""The Butterworth design against scipy and closed forms; how late a listener on the bus knows the position."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from can_dbc.messages import E2eState, PositionPulse
from controller.config import FirmwareConfig
from controller.filters import Section, SectionFilter, butterworth
from controller.firmware import Firmware, Inputs
from controller.settings import FilterConfig, SensorConfig
from tests.support.toy_actuator import pulse_s

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


@given(order=st.integers(1, 8), fc_part=st.floats(0.01, 0.49), rate_hz=st.floats(10.0, 1000.0))
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
        (0, 22.0, 100.0),     (-1, 22.0, 100.0),    (6, 0.0, 100.0),      (6, 50.0, 100.0),
        (6, -1.0, 100.0),     (6, math.nan, 100.0),
    ],
)  # fmt: skip
def test_impossible_designs(order: int, fc_hz: float, rate_hz: float) -> None:
    with pytest.raises(ValueError, match=f"no Butterworth low-pass of order {order}, {fc_hz} Hz"):
        butterworth(order, fc_hz, rate_hz)


STROKE_M = 0.01285
STROKE_S = 0.015
MEASURED_S = 0.00045
PUBLISHED_S = 0.0004
PHASES = 25

Path = Callable[[float], float]


def accelerated(t_s: float) -> float:
    """A stroke of 15 ms under constant force."""
    return STROKE_M * min(max(t_s / STROKE_S, 0.0), 1.0) ** 2


def estimates(
    config: FirmwareConfig, path: Path, started_s: float, lead_s: float
) -> list[tuple[float, float]]:
    """Return (time, estimate) of every status while the stay moves along a path."""
    firmware = Firmware(config)
    sensor_s = config.sensor.period_s
    reported: list[tuple[float, float]] = []
    taken = 0
    for k in range(round(0.35 / config.period_s)):
        tick_s = k * config.period_s
        pulses = []
        while (start_s := (taken + 1) * sensor_s - lead_s) <= tick_s - lead_s + 1e-9:
            position_m = path(start_s + MEASURED_S - started_s)
            pulses.append(PositionPulse(pulse_s(position_m), 293.15, taken % 256))
            taken += 1
        inputs = Inputs(tuple(pulses), position_state=E2eState.VALID)
        out = firmware.step(k * config.period_ns, inputs)
        reported.append((tick_s + PUBLISHED_S, out.status.estimate_m))
    return reported


def first_above(reported: list[tuple[float, float]], level_m: float) -> float:
    return next(time_s for time_s, estimate_m in reported if estimate_m >= level_m)


def lags_ms(config: FirmwareConfig, path: Path, lead_s: float) -> tuple[float, float]:
    """Mean lag at 10 % and at 90 % of the travel over all phases of the sampling."""
    low_s = high_s = 0.0
    for phase in range(PHASES):
        started_s = 0.1 + phase / PHASES * config.period_s
        reported = estimates(config, path, started_s, lead_s)
        for share in (0.1, 0.9):
            true_s = next(t * 1e-5 for t in range(2000) if path(t * 1e-5) >= share * STROKE_M)
            lag_s = first_above(reported, share * STROKE_M) - started_s - true_s
            if share == 0.1:
                low_s += lag_s
            else:
                high_s += lag_s
    return 1e3 * low_s / PHASES, 1e3 * high_s / PHASES


def test_with_todays_filter_30_ms_growing_to_40() -> None:
    lags = lags_ms(FirmwareConfig(), accelerated, lead_s=0.005)
    assert lags[0] == pytest.approx(30.0, abs=2.5) and lags[1] == pytest.approx(40.0, abs=2.5)


def test_without_filter_10_ms_throughout() -> None:
    """5.0 - 0.45 + 0.4 ms to the status, and 5 ms until it is there on average."""
    lags = lags_ms(FirmwareConfig(filter=FilterConfig(enabled=False)), accelerated, lead_s=0.005)
    assert lags[0] == pytest.approx(9.95, abs=0.4) and lags[1] == pytest.approx(9.95, abs=0.4)


def test_a_slow_ramp_lags_by_the_closed_form() -> None:
    """Filter delay at rest 23.35 ms + 4.55 + 0.4 + mean hold 5 ms."""

    def slow(t_s: float) -> float:
        return 0.05 * min(max(t_s, 0.0), 0.2)

    lags = []
    for phase in range(PHASES):
        started_s = 0.1 + phase / PHASES * 0.01
        reported = estimates(FirmwareConfig(), slow, started_s, 0.005)
        lags.append(first_above(reported, 0.008) - started_s - 0.16)
    mean_ms = 1e3 * sum(lags) / PHASES
    closed_ms = 1e3 * delay_at_rest_s(6, 22.0, 100.0) + 5.0 - 0.45 + 0.4 + 5.0
    assert mean_ms == pytest.approx(closed_ms, abs=0.7)  # a timer tick is 0.9 ms of this ramp


@pytest.mark.parametrize(
    ("period_s", "expected_ms"),
    [
        (0.0025, 2.5 - 0.45 + 0.4 + 1.25),  # pulse just done at the tick, short hold
        (0.01, 2.5 - 0.45 + 0.4 + 5.0),  # the hold of the firmware dominates
    ],
)
def test_fast_sampling_without_filter(period_s: float, expected_ms: float) -> None:
    config = FirmwareConfig(
        period_s=period_s, sensor=SensorConfig(period_s=0.0025), filter=FilterConfig(enabled=False)
    )
    lags = lags_ms(config, accelerated, lead_s=0.0025)
    assert lags[0] == pytest.approx(expected_ms, abs=0.5)
    assert lags[1] == pytest.approx(expected_ms, abs=0.5)
